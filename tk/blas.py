"""One BLAS thread while a tracker works, so that a run's bits do not hang on who started it.

A pool of threads divides a matrix product otherwise than one thread does, and the last digits differ. The matrices here
are small: a pool costs more than it gains.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Inside, NumPy's and SciPy's BLAS run on one thread, whenever they were loaded; afterwards on as many as before.

    20 µs; meant for the whole process, as the pools are.
    """
    with _pools().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _pools() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  (its pool is to be among those found)

    return ThreadpoolController()
