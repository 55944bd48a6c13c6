"""The working volume and its grid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tk.errors import VolumeError
from tk.model.cameras.volume import Volume, VoxelGrid

metres = st.floats(0.05, 8.0)
sizes = st.tuples(metres, metres, metres)
points = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


def test_bounds_of_a_volume():
    volume = Volume((1.0, 2.0, 3.0), (2.0, 4.0, 6.0))
    assert volume.lower.tolist() == [0.0, 0.0, 0.0]
    assert volume.upper.tolist() == [2.0, 4.0, 6.0]


@pytest.mark.parametrize("size", [(0.0, 1.0, 1.0), (1.0, -2.0, 1.0), (1.0, 1.0, float("nan"))])
def test_empty_volume_is_refused(size):
    with pytest.raises(VolumeError, match="working volume is empty"):
        Volume((0.0, 0.0, 0.0), size)


def test_grid_of_one_voxel_is_refused():
    with pytest.raises(VolumeError, match="voxels = 1"):
        VoxelGrid.cover(Volume((0, 0, 0), (1, 1, 1)), 1)


@given(points, sizes, st.integers(2, 40))
def test_grid_covers_its_volume_with_less_than_a_voxel_to_spare(center, size, voxels):
    volume = Volume(center, size)
    grid = VoxelGrid.cover(volume, voxels)
    lower = np.array(grid.origin) - grid.voxel_m / 2
    upper = lower + grid.voxel_m * np.array(grid.shape)
    slack = 1e-6
    assert max(grid.shape) == voxels
    assert (lower <= volume.lower + slack).all() and (upper >= volume.upper - slack).all()
    assert (upper - lower < np.array(size) + grid.voxel_m + slack).all()


@given(st.tuples(*[st.integers(1, 5)] * 3), points, metres)
def test_flat_indices_run_with_z_fastest(shape, origin, voxel_m):
    grid = VoxelGrid(origin, voxel_m, shape)
    expected = [
        (origin[0] + voxel_m * i, origin[1] + voxel_m * j, origin[2] + voxel_m * k)
        for i in range(shape[0])
        for j in range(shape[1])
        for k in range(shape[2])
    ]
    assert grid.count == len(expected)
    np.testing.assert_allclose(grid.centers(), expected, rtol=0, atol=1e-12)
    some = np.arange(grid.count)[::-2]
    np.testing.assert_array_equal(grid.centers(some), grid.centers()[some])


@given(points, points)
def test_voxels_within_a_box_are_those_with_centres_in_it(a, b):
    grid = VoxelGrid.cover(Volume((0.3, -0.2, 1.0), (2.0, 1.5, 2.2)), 9)
    lower, upper = np.minimum(a, b), np.maximum(a, b)
    centers = grid.centers()
    expected = np.flatnonzero(((lower <= centers) & (centers <= upper)).all(axis=1))
    np.testing.assert_array_equal(grid.within(lower, upper), expected)
