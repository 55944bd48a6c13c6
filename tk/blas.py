"""One BLAS thread while masks are made, poses and cameras found, so that a run's bits do not hang on who started it.

A pool of threads divides a matrix product otherwise than one thread does, and the last digits differ. The matrices here
are small, and a pool costs more than it gains: `tk refine` takes 2.3 times the processor time with one.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Inside, NumPy's and SciPy's BLAS run on one thread, whenever they were loaded; afterwards on as many as before.

    20 µs; a decorator, too. Meant for the whole process, as the pools are.
    """
    with _pools().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _pools() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  (its pool is to be among those found)

    return ThreadpoolController()
