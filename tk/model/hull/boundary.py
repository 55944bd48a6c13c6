"""Where, between two voxels, the visual hull ends: surface points finer than the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig

__all__ = ["hull_boundary"]

_REACH = 1.75  # voxels outwards: a little over the diagonal sqrt(3), the farthest that a neighbour's centre lies
_STEPS = 16  # samples on the way: a ninth of a voxel each


def hull_boundary(
    rig: Rig,
    masks: NDArray[np.uint8],
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    voxel_m: float,
) -> NDArray[np.float32]:
    """Move surface voxels outwards along their normals to where they leave the first silhouette.

    A voxel's centre lies inside the hull, on average a third of a voxel behind its boundary. Each is projected at both
    ends of its way only (lens distortion included); between them its pixel moves evenly, which at a few centimetres of
    way is true to a tenth of a pixel. The paper knows voxels only; this is ours.

    Args:
        rig: C cameras.
        masks: (C, H, W) uint8, foreground where not 0.
        positions: (N, 3) metres, centres of surface voxels.
        normals: (N, 3) outward, of unit length; where zero the point stays.
        voxel_m: edge of a voxel, metres.

    Returns:
        (N, 3) float32 metres. A point that meets no silhouette's edge within its reach (its normal runs along the
        surface, or the cameras there do not hold it) stays where it is.
    """
    start = positions.astype(np.float64)
    way = _REACH * voxel_m * normals.astype(np.float64)
    share = np.arange(1, _STEPS + 1) / _STEPS
    outside = np.zeros((len(start), _STEPS), dtype=np.bool_)
    for camera, mask in zip(rig, masks, strict=True):
        near, far = np.split(camera.project(np.concatenate([start, start + way]))[0], 2)
        xy = np.floor(near[:, None] + share[:, None] * (far - near)[:, None] + 0.5)
        held = ((xy >= 0) & (xy < (camera.width, camera.height))).all(axis=-1)
        x, y = np.where(held, np.moveaxis(xy, -1, 0), 0).astype(np.intp)
        outside |= held & (mask[y, x] == 0)
    leaves = outside.any(axis=1)
    first = outside.argmax(axis=1)  # the edge lies between this sample and the one before
    return (start + np.where(leaves, (first + 0.5) / _STEPS, 0.0)[:, None] * way).astype(np.float32)
