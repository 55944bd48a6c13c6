"""Markerless motion capture from a few calibrated cameras."""
