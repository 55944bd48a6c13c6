"""One thread in BLAS and OpenCV inside, as many as before afterwards."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (its pool is one of those that are looked at)
from threadpoolctl import threadpool_info, threadpool_limits

from tk.threads import one_thread


def blas_threads() -> list[int]:
    np.ones((2, 2)) @ np.ones((2, 2))
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


@one_thread()
def inside() -> list[int]:
    return blas_threads()


def test_pools_have_one_thread_inside_and_their_own_outside() -> None:
    with threadpool_limits(2, "blas"):
        before = blas_threads()
        assert before and set(before) <= {1, 2}
        for _ in range(2):  # a decorated function may be called again, and within itself
            with one_thread():
                assert set(inside()) == {1}
                assert set(blas_threads()) == {1}
            assert blas_threads() == before


def test_opencvs_thread_number_is_restored_after_an_error() -> None:
    before = cv2.getNumThreads()
    with pytest.raises(ZeroDivisionError), one_thread():
        assert cv2.getNumThreads() == 1
        1 / 0  # noqa: B018
    assert cv2.getNumThreads() == before
