"""A grid of voxels and their pixels in all cameras, for hulls of many frames; connected components of voxels."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import VoxelGrid
from tk.model.hull.coarse import Voxels

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Voxels along the edge of a block. Blocks that the hull cannot contain are not looked at. Affects speed only.
_BLOCK = 5
# Factor on the radius of a block in an image, and pixels that are added: a lens enlarges it, and pixels are rounded.
# Too small, and voxels are missed (tested); too large costs time only.
_WIDER, _ROUNDED_PX = 1.5, 2.0


class VoxelTable:
    """The pixels of the voxels of a grid. A voxel is projected when a hull first may contain its block.

    Args:
        rig: C cameras.
        grid: N voxels.
        step: pixels of the images along an edge of a reduced one's pixel.
    """

    def __init__(self, rig: Rig, grid: VoxelGrid, step: int) -> None:
        self._rig, self._grid, self._step = rig, grid, step
        self._sees = np.zeros((len(rig), grid.count), np.bool_)
        self._pixels = np.zeros((len(rig), grid.count), np.int32)
        self._known = np.zeros(grid.count, np.bool_)
        height, width = (len(range(step // 2, side, step)) for side in rig.frame_shape)
        self._shape = height, width  # of a reduced image
        self._blocks = tuple(-(-side // _BLOCK) for side in grid.shape)
        corner = np.array(grid.origin) + grid.voxel_m * (_BLOCK - 1) / 2
        centers = corner + grid.voxel_m * _BLOCK * np.indices(self._blocks).reshape(3, -1).T
        radius_m = np.sqrt(3.0) / 2 * _BLOCK * grid.voxel_m
        self._places: list[tuple[Float, Float]] = []  # of the blocks in each image: centre and radius, pixels
        self._whole: list[Bool] = []  # blocks that the image contains as a whole
        for camera in rig:
            pixels, depth = camera.project(centers)
            radius_px = (
                _WIDER * radius_m * camera.matrix[0, 0] / np.maximum(depth - radius_m, 1e-3) / step + _ROUNDED_PX
            )
            known = np.isfinite(pixels).all(axis=1)
            # beside the border of what the lens shows a block may be anywhere in the image, as at the camera's plane
            windows = sliding_window_view(np.pad(known.reshape(self._blocks), 1), (3, 3, 3))
            shown = windows.any(axis=(3, 4, 5)).ravel()
            radius_px[~known] = np.inf
            radius_px[~shown] = -np.inf
            center = np.nan_to_num(pixels) / step
            border = np.minimum(center, np.array([camera.width, camera.height]) / step - center).min(axis=1)
            self._places.append((center, radius_px))
            self._whole.append(known & (border > radius_px))

    def near_hull(self, shown: Bool, allowed: Bool, cameras: Sequence[int]) -> tuple[NDArray[np.int64], Voxels]:
        """Return the voxels in blocks that the cameras' hull may contain, see :meth:`voxels`.

        Args:
            shown, allowed: (C, h, w) the masks without and with the uncertain pixels.
            cameras: a voxel of the hull is shown by two of these or more, and allowed by all of these that see it.
        """
        places = [(self._places[c], self._whole[c]) for c in cameras]
        count = np.zeros(self._blocks, np.int64).ravel()
        possible = count == 0
        for c, (place, whole) in zip(cameras, places, strict=True):
            count += _touched(shown[c], *place)
            possible &= ~whole | _touched(allowed[c], *place)
        blocks = ((count >= 2) & possible).reshape(self._blocks)
        for axis, side in enumerate(self._grid.shape):
            blocks = np.repeat(blocks, _BLOCK, axis=axis).take(range(side), axis=axis)
        return self.voxels(np.flatnonzero(blocks))

    def voxels(self, flat: NDArray[np.int64]) -> tuple[NDArray[np.int64], Voxels]:
        """Return those of the voxels with flat indices (N,) that two cameras or more see: indices (M,) and voxels."""
        new = flat[~self._known[flat]]
        if len(new):
            projected = Voxels.of(self._rig, self._grid.centers(new), self._grid.voxel_m, self._step)
            self._sees[:, new], self._pixels[:, new] = projected.sees, projected.pixels
            self._known[new] = True
        flat = flat[self._sees[:, flat].sum(axis=0) >= 2]
        sees, pixels = self._sees[:, flat], self._pixels[:, flat]
        return flat, Voxels(self._grid.centers(flat), sees, pixels, np.zeros(len(self._rig)), self._shape)


def _touched(mask: Bool, center: Float, radius: Float) -> Bool:
    """Return (K,) which circles, centres (K, 2) and radii (K,) in pixels, may contain a pixel of a mask (h, w)."""
    if not mask.any():
        return np.zeros(len(center), np.bool_)
    away = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inside = np.clip(center, 0, np.array(mask.shape[::-1]) - 1)
    x, y = inside.round().astype(np.int64).T
    outside = np.linalg.norm(center - inside, axis=1)
    return np.asarray(np.maximum(outside, away[y, x] - outside) <= radius)


def components(shown: Bool) -> NDArray[np.int64]:
    """Return (X, Y, Z) the number of each voxel's component, connected by faces, from 1; 0 where nothing is shown.

    As SciPy's ndimage.label, which takes 0.2 s to import.
    """
    number = np.cumsum(shown).reshape(shown.shape) * shown
    pairs = []
    for axis in range(3):
        one, other = (np.moveaxis(number, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        both = (one > 0) & (other > 0)
        pairs.append(np.stack([one[both], other[both]]))
    one, other = np.concatenate(pairs, axis=1)
    least = np.arange(number.max(initial=0) + 1)  # each voxel points to one of its component with a lower number
    while (least[one] != least[other]).any():
        low, high = np.minimum(least[one], least[other]), np.maximum(least[one], least[other])
        np.minimum.at(least, high, low)
        while (least[least] != least).any():
            least = least[least]
    return np.asarray(np.unique(least, return_inverse=True)[1][number])
