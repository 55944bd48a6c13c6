"""Superellipsoid bodies of average shape, and their voxels, which stand for a hull in tests."""

import numpy as np
from scipy import ndimage

from tk.kernels.nearest import SurfaceIndex
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.superellipsoid_body import SPACING_M, SuperellipsoidBody, build_superellipsoid_body
from tk.model.cameras.volume import Volume, VoxelGrid


def skin_of(
    dimensions: BodyDimensions, up: str = "z", waist: bool = False, spacing_m: float = SPACING_M
) -> SuperellipsoidBody:
    """The skin of a body with these dimensions whose parts are as they are on an average."""
    return build_superellipsoid_body(build_cone_body(dimensions, up), up, waist, spacing_m)


def voxelise(body: SuperellipsoidBody, pose: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """(nx, ny, nz) bool: voxels in one of the body's pieces."""
    T_world_segment = body.skeleton.segment_transforms(pose)
    B = np.eye(4)
    B[:3, :3] = body.skeleton.T_world_body
    centers = grid.centers()
    occupied = np.zeros(grid.count, bool)
    for piece in body.pieces:
        T = np.linalg.inv(T_world_segment[SEGMENTS.index(piece.segment)] @ B @ piece.T_body_piece)
        near = np.flatnonzero(np.linalg.norm(centers - np.linalg.inv(T)[:3, 3], axis=1) < 1.8 * max(piece.radii))
        occupied[near] |= piece.contains(centers[near] @ T[:3, :3].T + T[:3, 3])
    return occupied.reshape(grid.shape)


def grid_around(body: SuperellipsoidBody, pose: np.ndarray, voxel_m: float = 0.025) -> VoxelGrid:
    """The grid that holds a body at a pose with 10 cm to spare."""
    points = body.place(pose)
    lower, upper = points.min(0) - 0.1, points.max(0) + 0.1
    center, size = (lower + upper) / 2, upper - lower
    return VoxelGrid.cover(Volume(tuple(center), tuple(size)), round(size.max() / voxel_m))


def surface_index(occupancy: np.ndarray, grid: VoxelGrid) -> SurfaceIndex:
    """Boundary voxels; every colour patch fits.

    Their centres lie half an edge inside the surface, on average; here they are moved onto it.
    """
    surface = occupancy & ~ndimage.binary_erosion(occupancy)
    smooth = ndimage.gaussian_filter(occupancy.astype(float), 1.5)
    normals = -np.stack([g[surface] for g in np.gradient(smooth)], axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    positions = grid.centers(np.flatnonzero(surface)) + grid.voxel_m / 2 * normals
    return SurfaceIndex.build(positions, np.full(len(positions), -1), 2 * grid.voxel_m)
