"""Triangle meshes: the surface of a hull, and PLY files. Open3D is imported only when needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tk.errors import ResultError
from tk.io.paths import c_name
from tk.io.point_cloud import create_empty_ply, load_open3d, ply_error
from tk.io.results.data import HullPoints
from tk.model.cameras.volume import VoxelGrid

Float = NDArray[np.float64]

# Taubin's filter removes the steps of the voxels and keeps the volume (Taubin 1995, "A signal processing approach to
# fair surface design"); twice as many iterations change little.
_SMOOTHING_ITERATIONS = 10


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (N, 3) metres, world frame.
        triangles: (M, 3) indices of the corners, counter-clockwise seen from outside.
        colors: (N, 3) uint8 RGB.
    """

    vertices: Float
    triangles: NDArray[np.int32]
    colors: NDArray[np.uint8]


def hull_mesh(occupancy: NDArray[np.bool_], grid: VoxelGrid, surface: HullPoints) -> Mesh:
    """Return the closed surface of a hull: marching cubes on its voxels, then smoothing.

    Args:
        occupancy: (nx, ny, nz) bool, voxels of the hull.
        grid: their positions.
        surface: surface voxels; each vertex gets the colour of the nearest one.

    Raises:
        ResultError: Open3D cannot be loaded.
    """
    if not occupancy.any():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    open3d = load_open3d(Path("hull mesh"))
    # a rim of empty voxels closes the surface at the volume's border; for Open3D the last axis is x
    volume = np.ascontiguousarray(np.pad(occupancy, 1).T, np.float32)
    mesh = open3d.t.geometry.TriangleMesh.create_isosurfaces(open3d.core.Tensor(volume), [0.5]).to_legacy()
    mesh = mesh.filter_smooth_taubin(_SMOOTHING_ITERATIONS)
    vertices = np.asarray(grid.origin) + grid.voxel_m * (np.asarray(mesh.vertices) - 1)
    _, nearest = cKDTree(np.asarray(surface.positions, np.float64)).query(vertices)
    return Mesh(vertices, np.asarray(mesh.triangles, np.int32), np.asarray(surface.colors, np.uint8)[nearest])


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write one mesh as PLY; missing folders are created.

    Raises:
        ResultError: Open3D cannot be loaded, or the file cannot be written.
    """
    open3d = load_open3d(path)
    create_empty_ply(path, faces=True)
    if len(mesh.triangles) == 0:
        return
    written = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.triangles)
    )
    written.vertex_colors = open3d.utility.Vector3dVector(mesh.colors / 255)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        if not open3d.io.write_triangle_mesh(c_name(path, ResultError), written, write_vertex_normals=False):
            raise ply_error(path)
