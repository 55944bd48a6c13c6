"""Quantities derived from a sequence of poses, and smoothing."""
