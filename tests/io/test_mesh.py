"""Meshes of voxels: closed, turned outwards, where the voxels are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.io.mesh import Mesh, hull_mesh
from tk.io.results.data import HullPoints
from tk.model.cameras.volume import VoxelGrid

GRID = VoxelGrid((1.0, -2.0, 0.5), 0.04, (24, 20, 30))


SMALL = VoxelGrid((1.0, -2.0, 0.5), 0.04, (9, 8, 10))


def surface_of(occupancy: np.ndarray, grid: VoxelGrid = GRID) -> HullPoints:
    """All voxels stand for the surface's: the lower half red, the upper half blue."""
    flat = np.flatnonzero(occupancy)
    upper = np.argwhere(occupancy)[:, 2] >= 15
    colors = np.where(upper[:, None], [0, 0, 255], [255, 0, 0]).astype(np.uint8)
    return HullPoints(grid.centers(flat), colors)


def legacy(mesh: Mesh) -> Any:
    import open3d  # takes seconds, which each worker that collects the tests would need

    return open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.triangles)
    )


def test_mesh_of_a_ball_has_its_place_volume_and_colours() -> None:
    x, y, z = np.meshgrid(*(np.arange(n) for n in GRID.shape), indexing="ij")
    occupancy = (x - 12) ** 2 + (y - 10) ** 2 + (z - 15) ** 2 <= 8**2
    mesh = hull_mesh(occupancy, GRID, surface_of(occupancy))
    center = np.array([1.0, -2.0, 0.5]) + 0.04 * np.array([12, 10, 15])
    np.testing.assert_allclose(mesh.vertices.mean(axis=0), center, atol=0.004)
    radius = np.linalg.norm(mesh.vertices - center, axis=1)
    assert radius.min() > 0.04 * 7.2 and radius.max() < 0.04 * 8.8
    found = legacy(mesh)
    assert found.is_watertight() and found.is_orientable()
    assert found.get_volume() == pytest.approx(occupancy.sum() * 0.04**3, rel=0.04)
    corners = mesh.vertices[mesh.triangles]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outwards * (corners.mean(axis=1) - center)).sum(axis=1) > 0).all()
    high = mesh.vertices[:, 2] > center[2] + 0.05
    assert (mesh.colors[high] == [0, 0, 255]).all()


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.05, 0.95))
def test_any_voxels_have_a_closed_surface(seed: int, share: float) -> None:
    """Whether they touch the border of the volume, or each other by a corner only."""
    occupancy = np.random.default_rng(seed).random(SMALL.shape) < share
    mesh = hull_mesh(occupancy, SMALL, surface_of(occupancy, SMALL))
    edges = np.sort(np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]]))
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts % 2 == 0).all(), "an edge with a triangle on one side only is a hole"


def test_no_voxels_no_triangles() -> None:
    empty = np.zeros(GRID.shape, bool)
    assert len(hull_mesh(empty, GRID, surface_of(empty)).triangles) == 0
