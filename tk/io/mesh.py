"""Triangle meshes: the surface of a hull, and PLY files of meshes, through Open3D, which is imported only then."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tk.io.point_cloud import claim, full, load_open3d
from tk.io.results.writer import HullPoints
from tk.model.cameras.volume import VoxelGrid

Float = NDArray[np.float64]

# Taubin's filter takes the voxels' steps away and keeps the volume (Taubin 1995, "A signal processing approach to fair
# surface design"); twice as many rounds change little.
_SMOOTHING_ROUNDS = 10


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Attributes:
        vertices: (N, 3) metres, world frame.
        triangles: (M, 3) corners as indices of the vertices, counter-clockwise seen from outside.
        colors: (N, 3) uint8 RGB.
    """

    vertices: Float
    triangles: NDArray[np.int32]
    colors: NDArray[np.uint8]


def hull_mesh(occupancy: NDArray[np.bool_], grid: VoxelGrid, surface: HullPoints) -> Mesh:
    """The closed surface of a hull: marching cubes on its voxels, then smoothed.

    Args:
        occupancy: (nx, ny, nz) the hull's voxels.
        grid: where they are.
        surface: the surface voxels, whose colours the nearest vertices take.

    Raises:
        ResultError: Open3D cannot be loaded.
    """
    if not occupancy.any():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    open3d = load_open3d(Path("hull mesh"))
    # a rim of empty voxels closes what touches the volume's border; Open3D takes the last axis for x
    volume = np.ascontiguousarray(np.pad(occupancy, 1).T, np.float32)
    mesh = open3d.t.geometry.TriangleMesh.create_isosurfaces(open3d.core.Tensor(volume), [0.5]).to_legacy()
    mesh = mesh.filter_smooth_taubin(_SMOOTHING_ROUNDS)
    vertices = np.asarray(grid.origin) + grid.voxel_m * (np.asarray(mesh.vertices) - 1)
    _, nearest = cKDTree(np.asarray(surface.positions, np.float64)).query(vertices)
    return Mesh(vertices, np.asarray(mesh.triangles, np.int32), np.asarray(surface.colors, np.uint8)[nearest])


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write one mesh as PLY; missing folders are made.

    Raises:
        ResultError: Open3D cannot be loaded, or the file cannot be written.
    """
    open3d = load_open3d(path)
    claim(path, faces=True)
    if len(mesh.triangles) == 0:
        return
    written = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.triangles)
    )
    written.vertex_colors = open3d.utility.Vector3dVector(mesh.colors / 255)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        if not open3d.io.write_triangle_mesh(path, written, write_vertex_normals=False):
            raise full(path)
