"""Markerless motion capture from a few calibrated cameras: no markers, no trained weights, no GPU."""

__version__ = "0.1.0"
