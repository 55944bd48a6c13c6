"""A body of superellipsoids as voxels: what the tests of initialisation and fitting look at instead of a hull."""

import numpy as np
from scipy import ndimage

from tk.kernels.nearest import SurfaceIndex
from tk.model.body import Body
from tk.model.skeleton import JOINTS, SEGMENTS
from tk.model.volume import Volume, VoxelGrid


def voxelise(body: Body, pose: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """(nx, ny, nz) bool: voxels in one of the body's pieces, or in the flesh that bridges shoulders and neck.

    Between trunk and arms, and trunk and neck, the pieces leave gaps of some centimetres that no person has.
    """
    T_world_segment = body.skeleton.segment_transforms(pose)
    B = np.eye(4)
    B[:3, :3] = body.skeleton.T_world_body
    centers = grid.centers()
    occupied = np.zeros(grid.count, bool)
    for piece in body.pieces:
        T = np.linalg.inv(T_world_segment[SEGMENTS.index(piece.segment)] @ B @ piece.T_body_piece)
        near = np.flatnonzero(np.linalg.norm(centers - np.linalg.inv(T)[:3, 3], axis=1) < 1.8 * max(piece.radii))
        occupied[near] |= piece.contains(centers[near] @ T[:3, :3].T + T[:3, 3])
    joints = dict(zip(JOINTS, body.skeleton.joints(pose), strict=True))
    d = body.dimensions
    flesh = (("neck", d.neck_radius), ("shoulder_l", d.upper_arm_radius), ("shoulder_r", d.upper_arm_radius))
    for name, radius in flesh:
        occupied |= np.linalg.norm(centers - joints[name], axis=1) < radius
    return occupied.reshape(grid.shape)


def grid_around(body: Body, pose: np.ndarray, voxel_m: float = 0.025) -> VoxelGrid:
    """The grid that holds a body at a pose with 10 cm to spare."""
    points, _ = body.place(pose)
    lower, upper = points.min(0) - 0.1, points.max(0) + 0.1
    center, size = (lower + upper) / 2, upper - lower
    return VoxelGrid.cover(Volume(tuple(center), tuple(size)), round(size.max() / voxel_m))


def surface_index(occupancy: np.ndarray, grid: VoxelGrid) -> SurfaceIndex:
    """Boundary voxels with the outward direction of falling occupancy; every colour patch fits.

    Their centres lie half an edge inside the surface, on average; here they are moved onto it.
    """
    surface = occupancy & ~ndimage.binary_erosion(occupancy)
    smooth = ndimage.gaussian_filter(occupancy.astype(float), 1.5)
    normals = -np.stack([g[surface] for g in np.gradient(smooth)], axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    positions = grid.centers(np.flatnonzero(surface)) + grid.voxel_m / 2 * normals
    return SurfaceIndex.build(positions, normals, np.full(len(positions), -1), 2 * grid.voxel_m)
