"""Launches from remembered kernels: the same as Taichi's own, and as careful about what they are handed."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.kernels.test_runtime import run
from tk.kernels.launch import Launcher
from tk.kernels.runtime import ensure_runtime, ti


@ti.kernel
def _affine(
    slope: ti.types.ndarray(dtype=ti.f32, ndim=1),  # (1,)
    offset: ti.f32,
    times: ti.i32,
    x: ti.types.ndarray(dtype=ti.f32, ndim=2),
    y: ti.types.ndarray(dtype=ti.f32, ndim=2),  # out
):
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            y[i, j] = times * (slope[0] * x[i, j] + offset)


def launcher():
    ensure_runtime()
    return Launcher(_affine, np.array([2.0], np.float32))


def test_every_call_is_the_kernel():
    launch = launcher()
    rng = np.random.default_rng(0)
    for call in range(6):
        x = rng.normal(size=(call + 1, 7 - call)).astype(np.float32)
        y = np.full_like(x, np.nan)
        launch(np.float32(0.25) if call % 2 else call, np.int64(call), x, y)
        np.testing.assert_array_equal(y, np.float32(call) * (2 * x + np.float32(0.25 if call % 2 else call)))


def test_two_launchers_of_a_kernel_keep_their_own_constants():
    ensure_runtime()
    x, y = np.ones((1, 1), np.float32), np.zeros((1, 1), np.float32)
    double, triple = (Launcher(_affine, np.array([factor], np.float32)) for factor in (2, 3))
    for _ in range(3):
        for launch, expected in ((double, 2), (triple, 3)):
            launch(0.0, 1, x, y)
            assert y == expected


@pytest.mark.parametrize(
    "bad",
    [np.zeros((3, 4)), np.zeros(12, np.float32), np.zeros((4, 3), np.float32).T],
    ids=["another type", "another shape", "not contiguous"],
)
def test_other_arrays_than_the_first_calls_are_refused(bad):
    launch = launcher()
    x = np.zeros((3, 4), np.float32)
    launch(0.0, 1, x, x.copy())
    with pytest.raises(TypeError, match="argument 3"):
        launch(0.0, 1, bad, x.copy())
    with pytest.raises(ValueError, match="zip"):
        launch(0.0, 1, x)


def test_a_runtime_made_anew_compiles_anew():
    printed = run(
        """
        import numpy as np
        from tests.kernels.test_launch import launcher
        from tk.kernels.runtime import ti
        launch = launcher()
        x = np.ones((2, 2), np.float32)
        for _ in range(2):
            y = np.zeros_like(x)
            launch(1.0, 1, x, y)
            launch(1.0, 1, x, y)
            print(y.sum())
            ti.init(arch=ti.cpu, log_level=ti.ERROR)
        """
    )
    assert printed.count("12.0") == 2


def test_threads_do_not_mix_their_arrays():
    launch = launcher()

    def work(value):
        for _ in range(200):
            x, y = np.full((2, 3), value, np.float32), np.zeros((2, 3), np.float32)
            launch(0.0, 1, x, y)
            assert (y == 2 * value).all()

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(1, 5)))


def test_arrays_that_come_again_are_read_again():
    launch = launcher()
    x, y = np.zeros((1, 2), np.float32), np.zeros((1, 2), np.float32)
    for value in range(5):
        x[:] = value
        launch(0.0, 1, x, y)
        assert (y == 2 * value).all()
