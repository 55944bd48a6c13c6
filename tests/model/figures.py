"""Average bodies for tests: the cone body, the superellipsoid body, and its voxels in place of a hull."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from tk.kernels.nearest import SurfaceIndex
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.superellipsoid_body import SPACING_M, SuperellipsoidBody, build_superellipsoid_body
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.cues.ray_costs import RayGrid

DIMENSIONS = BodyDimensions.from_stature(1.75)
BODY = build_cone_body(DIMENSIONS)


def scaled(dimensions: BodyDimensions, **factors: float) -> BodyDimensions:
    """Return dimensions of which the named ones are multiplied by factors."""
    return replace(dimensions, **{name: getattr(dimensions, name) * factor for name, factor in factors.items()})


def surface_points(body: ConeBody, pose: np.ndarray, part: np.ndarray, unscaled: np.ndarray) -> np.ndarray:
    """Return world points (N, 3) on the surface of parts (N,), see :meth:`ConeBody.local`."""
    T = body.part_transforms(body.skeleton.segment_transforms(pose))[part]
    return (T[:, :3, :3] @ body.local(part, unscaled)[:, :, None])[:, :, 0] + T[:, :3, 3]


_GRIDS: dict[int, RayGrid] = {}  # by rig, the last few; a grid keeps its rig alive


def grid_of(rig: Rig) -> RayGrid:
    """Return the rays of all pixels of a rig."""
    if id(rig) not in _GRIDS:
        if len(_GRIDS) > 4:
            _GRIDS.clear()
        _GRIDS[id(rig)] = RayGrid(rig, rig.frame_shape[0])
    return _GRIDS[id(rig)]


def draw_silhouettes(body: ConeBody, rig: Rig, poses: np.ndarray) -> np.ndarray:
    """Render silhouettes (B, V, H, W) of the body at poses (B, D), 0 or 255."""
    grid = grid_of(rig)
    drawn = [grid.render(body, pose[None]).label[0] > 0 for pose in poses]  # one by one, to save memory
    return np.where(drawn, np.uint8(255), np.uint8(0))


def skin_of(dimensions: BodyDimensions, up: str = "z", spacing_m: float = SPACING_M) -> SuperellipsoidBody:
    """The skin of a body with these dimensions whose parts are as they are on an average."""
    return build_superellipsoid_body(build_cone_body(dimensions, up), up, spacing_m)


def piece_transforms(body: SuperellipsoidBody, pose: np.ndarray) -> np.ndarray:
    """Return (P, 4, 4) from each piece's frame to the world."""
    T, s = body.skeleton.segment_transforms(pose), body.skeleton
    return np.array([T[SEGMENTS.index(p.segment)] @ s.in_world(p.T_body_piece) for p in body.pieces])


def voxelise(body: SuperellipsoidBody, pose: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """(nx, ny, nz) bool: voxels in one of the body's pieces."""
    centers = grid.centers()
    occupied = np.zeros(grid.count, bool)
    for piece, T_world_piece in zip(body.pieces, piece_transforms(body, pose), strict=True):
        T = np.linalg.inv(T_world_piece)
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
