"""Markerless motion capture from a few calibrated cameras: no markers, no trained weights, no GPU."""

import os

# The matrices here are 24×24 at most. A pool of BLAS threads beside Taichi's costs milliseconds for what takes
# microseconds; it has an effect only where NumPy is not loaded yet, and the caller's own setting stands.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.1.0"
