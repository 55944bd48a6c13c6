"""The ring search for nearest voxels against all pairs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.kernels.nearest import SurfaceIndex, nearest

# single precision: distances of metres
SLACK = 2e-6
seeds = st.integers(0, 2**32 - 1)


def surface(rng, count, spread=0.5, patches=63, share=0.3, cell_m=0.1):
    """Random voxels, each with a share of the patches."""
    fits = np.zeros(count, np.int64)
    for p in range(patches):
        fits |= (rng.random(count) < share).astype(np.int64) << p
    return SurfaceIndex.build(rng.normal(0, spread, (count, 3)), fits, cell_m)


def candidates(index, point, patch, reach, slack):
    """(V,) distances, infinite where a voxel is no candidate; positive slack admits the uncertain ones."""
    distance = np.linalg.norm(index.positions.astype(np.float64) - point, axis=1)
    colour = (index.fits >> np.int64(patch)) & 1 == 1
    return np.where(colour & (distance < reach + slack), distance, np.inf)


def check(index, points, patch, reach):
    points = points.astype(np.float32)
    found = nearest(index, points, patch, reach)
    for n, v in enumerate(found):
        query = points[n].astype(np.float64), patch[n], reach
        best = candidates(index, *query, slack=-SLACK).min()
        if v < 0:
            assert best == np.inf, f"query {n}: nothing found, yet there is a candidate at {best} m"
        else:
            mine = candidates(index, *query, slack=SLACK)[v]
            assert mine < np.inf, f"query {n}: voxel {v} is no candidate"
            assert mine <= best + SLACK, f"query {n}: voxel {v} at {mine} m, yet the nearest is at {best} m"
    return found


@given(
    seeds,
    st.sampled_from([1, 2, 30, 400]),
    st.sampled_from([0.02, 0.1, 0.7, 5.0]),
    st.sampled_from([0.03, 0.3, 2.0]),
    st.sampled_from([0.2, 1.0, 6.0]),
)
@settings(max_examples=80)
def test_equals_all_pairs(seed, count, cell_m, reach, spread):
    """Cells smaller and larger than the reach, queries inside and far outside the grid."""
    rng = np.random.default_rng(seed)
    index = surface(rng, count, cell_m=cell_m)
    points = rng.normal(0, spread, (40, 3))
    check(index, points, rng.integers(0, 63, 40), reach)


def test_something_is_found_and_something_is_not():
    """The property above is not met by -1 throughout."""
    rng = np.random.default_rng(0)
    index = surface(rng, 400)
    found = check(index, rng.normal(0, 0.6, (200, 3)), rng.integers(0, 63, 200), 0.2)
    assert 0.1 < np.mean(found >= 0) < 0.9


def test_queries_on_the_walls_between_cells():
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.1] * 3, indexing="ij"), -1).reshape(-1, 3)
    index = SurfaceIndex.build(grid, np.full(len(grid), -1), 0.1)
    walls = grid + index.grid[:3].astype(np.float64) - grid.min(0)
    check(index, walls, np.zeros(len(walls), np.int64), 0.5)


@pytest.mark.parametrize("patch", [0, 31, 32, 62])
def test_each_bit_of_the_patches_counts(patch):
    """Two voxels, the nearer of another patch; bits beyond 32 are the ones that a narrow integer loses."""
    positions = np.array([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0]])
    others = ~(np.int64(1) << np.int64(patch)) & np.int64(2**63 - 1)
    index = SurfaceIndex.build(positions, np.array([others, np.int64(1) << np.int64(patch)]), 0.1)
    found = nearest(index, np.zeros((1, 3)), np.array([patch]))
    np.testing.assert_allclose(index.positions[found[0]], positions[1], atol=1e-7)
