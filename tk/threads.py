"""One thread in BLAS and in OpenCV for masks, poses, cameras and drawings.

tk runs cameras, processes and captures in parallel instead. A pool of threads splits a matrix product differently from
one thread, so the last digits of a result would depend on the number of cores. Pools also wait for work by spinning:
matrices and images are small, so a refinement takes 2.3 times the processor time with a pool, and drawing 1.9 times.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import ThreadpoolController


@contextmanager
def one_thread() -> Iterator[None]:
    """Run NumPy's and SciPy's BLAS and OpenCV on one thread inside; afterwards on as many as before.

    Takes 20 µs. Works as a decorator, too. It concerns the whole process, because the pools do.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with _pools("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)


@functools.cache
def _pools(with_scipy: bool) -> ThreadpoolController:
    """Return the pools of the libraries that are loaded; ``with_scipy``: SciPy's BLAS, which loads late, is one."""
    return ThreadpoolController()
