"""One thread in BLAS and in OpenCV while masks are made, poses and cameras found, and pictures drawn.

Cameras, processes and captures are what runs side by side here. A pool of threads divides a matrix product otherwise
than one thread does, so that a run's last digits would hang on who started it. And pools wait for work by spinning:
matrices and pictures are small, so `tk refine` takes 2.3 times the processor time with one, and drawing with nothing
beside 1.9 times.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import ThreadpoolController


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside, NumPy's and SciPy's BLAS, whenever they were loaded, and OpenCV run on one thread; afterwards on as many
    as before.

    20 µs; a decorator, too. Meant for the whole process, as the pools are.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with _pools().limit(limits=1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)


@functools.cache
def _pools() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  (its pool is to be among those found)

    return ThreadpoolController()
