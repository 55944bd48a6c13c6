"""Colour segmentation of voxels against NumPy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.kernels.appearance import segment


def segment_oracle(mean, bound, colors, seen):
    inside = (np.abs(colors[:, None] - mean[None]) <= bound[None]).all(axis=2) | (seen[:, None] == 0)
    return np.array([sum(int(bit) << p for p, bit in enumerate(row)) for row in inside], dtype=np.int64)


@given(st.integers(0, 2**32 - 1), st.integers(1, 63), st.integers(0, 60))
@settings(max_examples=40)
def test_equals_the_boxes_written_out(seed, patches, voxels):
    """Whole numbers, so that voxels lie on the walls of the boxes too."""
    rng = np.random.default_rng(seed)
    mean = rng.integers(0, 12, (patches, 3)).astype(np.float32)
    bound = rng.integers(0, 6, (patches, 3)).astype(np.float32)
    colors = rng.integers(0, 12, (voxels, 3)).astype(np.float32)
    seen = rng.integers(0, 3, voxels)
    fits = segment(mean, bound, colors, seen)
    assert fits.dtype == np.int64
    np.testing.assert_array_equal(fits, segment_oracle(mean, bound, colors, seen))


def test_a_voxel_that_no_camera_sees_fits_every_patch():
    far = np.full((1, 3), 1e6)
    fits = segment(np.zeros((63, 3)), np.ones((63, 3)), np.concatenate([far, far]), np.array([0, 1]))
    np.testing.assert_array_equal(fits, [2**63 - 1, 0])


def test_a_patch_without_bounds_fits_every_voxel():
    bound = np.array([[1e9] * 3, [1.0] * 3])
    colors = np.random.default_rng(0).uniform(-255, 255, (50, 3))
    assert (segment(np.zeros((2, 3)), bound, colors, np.ones(50, int)) & 1 == 1).all()
