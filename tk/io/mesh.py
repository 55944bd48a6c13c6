"""The closed surface of a hull as a triangle mesh. Open3D is imported only when needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tk.errors import ResultError
from tk.io.results.data import HullPoints
from tk.model.cameras.volume import VoxelGrid

Float = NDArray[np.float64]

# Taubin's filter removes the steps of the voxels and keeps the volume (Taubin 1995, "A signal processing approach to
# fair surface design"); twice as many iterations change little.
_SMOOTHING_ITERATIONS = 10


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: Float  # (N, 3) metres, world frame
    triangles: NDArray[np.int32]  # (M, 3) indices of the corners, counter-clockwise seen from outside
    colors: NDArray[np.uint8]  # (N, 3) uint8 RGB


def hull_mesh(occupancy: NDArray[np.bool_], grid: VoxelGrid, surface: HullPoints) -> Mesh:
    """Return the closed surface of a hull: marching cubes on its voxels, then smoothing.

    Args:
        occupancy: (nx, ny, nz) bool, voxels of the hull.
        grid: their positions.
        surface: surface voxels; each vertex gets the colour of the nearest one.
    """
    if not occupancy.any():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    try:
        from open3d.core import Tensor
        from open3d.t.geometry import TriangleMesh
    except (ImportError, OSError) as error:
        raise ResultError(f"meshes of a hull need Open3D, which does not load: {error}") from None
    # a rim of empty voxels closes the surface at the volume's border; for Open3D the last axis is x
    volume = np.ascontiguousarray(np.pad(occupancy, 1).T, np.float32)
    mesh = TriangleMesh.create_isosurfaces(Tensor.from_numpy(volume), [0.5]).to_legacy()
    mesh = mesh.filter_smooth_taubin(_SMOOTHING_ITERATIONS)
    vertices = np.asarray(grid.origin) + grid.voxel_m * (np.asarray(mesh.vertices) - 1)
    _, nearest = cKDTree(np.asarray(surface.positions, np.float64)).query(vertices)
    return Mesh(vertices, np.asarray(mesh.triangles, np.int32), np.asarray(surface.colors, np.uint8)[nearest])
