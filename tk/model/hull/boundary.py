"""Surface points of the visual hull, finer than the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig

__all__ = ["hull_boundary"]

_REACH = 1.75  # voxels outwards: slightly more than sqrt(3), the distance to the farthest neighbour's centre
_STEPS = 16  # samples along it, a ninth of a voxel apart; more cost time, fewer lose resolution


def hull_boundary(
    rig: Rig,
    masks: NDArray[np.uint8],
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    voxel_m: float,
) -> NDArray[np.float32]:
    """Move surface voxels outwards along their normals to the place where they leave the first silhouette.

    A voxel's centre lies inside the hull, on average a third of a voxel behind its boundary. Only both ends of the line
    are projected (lens distortion included); pixels in between are interpolated, which over a few centimetres is exact
    to a tenth of a pixel. The paper has voxels only; this is an addition.

    Args:
        rig: C cameras.
        masks: (C, H, W) uint8, foreground where not 0.
        positions: (N, 3) metres, centres of surface voxels.
        normals: (N, 3) outward, of unit length; where zero the point stays.
        voxel_m: edge of a voxel, metres.

    Returns:
        (N, 3) float32 metres. A point that crosses no silhouette's edge within 1.75 voxels stays in place.
    """
    start = positions.astype(np.float64)
    reach = _REACH * voxel_m * normals.astype(np.float64)
    share = np.arange(1, _STEPS + 1) / _STEPS
    outside = np.zeros((len(start), _STEPS), dtype=np.bool_)
    for camera, mask in zip(rig, masks, strict=True):
        near, far = np.split(camera.project(np.concatenate([start, start + reach]))[0], 2)
        xy = np.floor(near[:, None] + share[:, None] * (far - near)[:, None] + 0.5)
        held = ((xy >= 0) & (xy < (camera.width, camera.height))).all(axis=-1)
        x, y = np.where(held, np.moveaxis(xy, -1, 0), 0).astype(np.intp)
        outside |= held & (mask[y, x] == 0)
    leaves = outside.any(axis=1)
    first = outside.argmax(axis=1)  # the edge lies between this sample and the one before
    return (start + np.where(leaves, (first + 0.5) / _STEPS, 0.0)[:, None] * reach).astype(np.float32)
