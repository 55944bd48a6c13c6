"""Captures: the folder that goes in."""
