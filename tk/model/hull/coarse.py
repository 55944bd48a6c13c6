"""A coarse visual hull, for decisions about masks: which voxels each camera's mask contains.

A point of the person lies in the masks of all cameras that see it (Laurentini, 1994). The hull of any choice of cameras
is therefore computed from one table of voxels by cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume, VoxelGrid

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Voxels along the volume's longest side for the person's hull: 5 cm of 2.4 m, which a thigh fills.
_VOXELS = 48
# Volume of a hull that may be a person's, litres, at least: a child of six weighs 20 kg (WHO growth reference), and a
# part of it may be hidden.
LEAST_LITRES = 10.0
# A region of a mask belongs to the person within this many voxels of the hull: thin limbs contain no voxel's centre.
_NEAR_VOXELS = 2.5
# What the distance transform takes for the distance of two neighbouring pixels, at least.
_CHAMFER = 0.95
# With this many cameras that see a voxel, one of them may be wrong, if the hull would otherwise shrink to this share.
_ENOUGH, _MUCH_SMALLER = 4, 0.4
# Half the diagonal of a voxel, in edges.
_HALF_DIAGONAL = np.sqrt(3.0) / 2
# Directions in which an extent is measured: to the faces, edges and corners of a voxel.
_DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d > (1, 1, 1)], np.float64) - 1.0
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)


@dataclass(frozen=True)
class Voxels:
    """Voxels projected into every ``step``-th pixel of a rig's images.

    Attributes:
        centers: (N, 3) metres.
        sees: (C, N) whether a camera's image contains the voxel's centre.
        pixels: (C, N) flat index of its pixel.
        pixels_per_voxel: (C,) edge of a voxel in the image at the voxels' median depth; 0 if the camera sees none.
        shape: (h, w) of the images.
    """

    centers: Float
    sees: Bool
    pixels: NDArray[np.int32]
    pixels_per_voxel: Float
    shape: tuple[int, int]

    @staticmethod
    def of(rig: Rig, centers: Float, voxel_m: float, step: int = 1) -> Voxels:
        """Project voxels with centres (N, 3)."""
        offset = step // 2
        height, width = (len(range(offset, side, step)) for side in rig.frame_shape)
        sees, pixels = np.zeros((len(rig), len(centers)), bool), np.zeros((len(rig), len(centers)), np.int32)
        scale = np.zeros(len(rig))
        for c, camera in enumerate(rig):
            projected, depth = camera.project(centers)
            with np.errstate(invalid="ignore"):
                x, y = ((projected - offset) / step).round().T
                inside = (x >= 0) & (x * step + offset < camera.width) & (y >= 0) & (y * step + offset < camera.height)
            inside &= depth > 0
            sees[c] = inside
            pixels[c, inside] = (y[inside] * width + x[inside]).astype(np.int32)
            if inside.any():
                scale[c] = voxel_m * camera.matrix[0, 0] / float(np.median(depth[inside])) / step
        return Voxels(centers, sees, pixels, scale, (height, width))

    def inside(self, masks: NDArray) -> Bool:
        """Return (C, N) whether a voxel's centre is in the camera's mask, of (C, h, w), or outside its image."""
        return ~self.sees | np.stack([mask.ravel()[p] > 0 for mask, p in zip(masks, self.pixels, strict=True)])

    def by(self, cameras: Bool) -> Voxels:
        """Return the same voxels as some cameras (C,) see them; the others see none, and carve none."""
        return self if cameras.all() else replace(self, sees=self.sees & cameras[:, None])

    def xy(self, camera: int, chosen: Bool) -> NDArray[np.int64]:
        """Return (M, 2) pixels of the chosen voxels (N,) that a camera sees."""
        return np.stack(np.divmod(self.pixels[camera, chosen & self.sees[camera]], self.shape[1])[::-1], axis=1)

    @cached_property
    def reach(self) -> NDArray[np.int64]:
        """(C,) half a voxel's diagonal, pixels, at least 1."""
        return np.maximum(np.ceil(_HALF_DIAGONAL * self.pixels_per_voxel), 1).astype(np.int64)

    def near(self, inside: Bool, missing: int) -> NDArray[np.int64]:
        """Return the indices of voxels that all but ``missing`` masks (C, N) contain, at least two of them visibly."""
        least = max(2, len(inside) - missing)
        return np.flatnonzero((inside.sum(axis=0) >= least) & ((inside & self.sees).sum(axis=0) >= 2))

    def hull(self, inside: Bool, chosen: NDArray[np.int64]) -> Hull:
        """Return the hulls of the chosen voxels."""
        sees, pixels = self.sees[:, chosen], self.pixels[:, chosen]
        voxels = Voxels(self.centers[chosen], sees, pixels, self.pixels_per_voxel, self.shape)
        return Hull(voxels, inside[:, chosen])


@dataclass(frozen=True)
class Hull:
    """The visual hulls of one frame, of any choice of cameras.

    Attributes:
        voxels: N voxels near the person.
        inside: (C, N) whether a camera's mask contains the voxel, see :meth:`Voxels.inside`.
    """

    voxels: Voxels
    inside: Bool

    def carve(self, cameras: Sequence[int]) -> Bool:
        """Return (N,) the hull of these cameras; voxels that none of them sees are not in it."""
        chosen = list(cameras)
        return np.asarray(self.inside[chosen].all(axis=0) & self.voxels.sees[chosen].any(axis=0))

    def common(self, cameras: Sequence[int]) -> Bool:
        """Return (N,) True for voxels of these cameras' hull that most cameras see: where few see, little is carved."""
        carved = self.carve(cameras)
        views = self.voxels.sees.sum(axis=0)
        return carved & (views >= np.percentile(views[carved], 95)) if carved.any() else carved

    def points(self, cameras: Sequence[int]) -> Float:
        """Return (M, 3) the centres of :meth:`common`, metres."""
        return self.voxels.centers[self.common(cameras)]

    def extent(self, cameras: Sequence[int]) -> float:
        """Return the greatest extent of these cameras' hull, metres, without specks; 0 if it is empty."""
        points = self.points(cameras)
        if not len(points):
            return 0.0
        low, high = np.percentile(points @ _DIRECTIONS.T, [1, 99], axis=0)
        return float((high - low).max())

    def silhouette(self, hull: Bool, camera: int) -> Bool:
        """Return (h, w) the silhouette of voxels (N,) in a camera, rather too large than too small."""
        image = np.zeros(self.voxels.shape, np.uint8)
        image.ravel()[self.voxels.pixels[camera, hull & self.voxels.sees[camera]]] = 1
        return dilated(image, int(self.voxels.reach[camera]))


class CoarseHull:
    """The person's hull in large voxels, from masks; one of the masks may be wrong."""

    def __init__(self, rig: Rig, volume: Volume) -> None:
        self._grid = VoxelGrid.cover(volume, _VOXELS)
        self._litre = 1000 * self._grid.voxel_m**3
        self._voxels = Voxels.of(rig, self._grid.centers(), self._grid.voxel_m)

    def subject(self, masks: NDArray[np.uint8], cameras: Bool) -> Bool:
        """Return (N,) the voxels of the largest object in most masks (C, H, W), 0 or more, of some cameras (C,).

        One of four or more cameras may be wrong, if the hull would be much smaller otherwise.
        """
        counts = self._counts(masks, cameras)
        strict, lenient = (self._largest(*counts, wrong) for wrong in (0, 1))
        return strict if np.count_nonzero(strict) >= _MUCH_SMALLER * np.count_nonzero(lenient) else lenient

    def everybody(self, masks: NDArray[np.uint8]) -> Bool:
        """Return (N,) the voxels in all masks (C, H, W), or in all but one of four or more."""
        return _in_most(*self._counts(masks, np.ones(len(masks), np.bool_)), 1)

    def _counts(self, masks: NDArray[np.uint8], cameras: Bool) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return (N,) how many of some cameras (C,) see each voxel, and in how many of their masks (C, H, W) it is."""
        seeing, agreeing = np.zeros((2, len(self._voxels.centers)), np.uint8)
        for c in np.flatnonzero(cameras):
            sees = self._voxels.sees[c]
            seeing += sees
            agreeing += sees & (masks[c].ravel().take(self._voxels.pixels[c]) > 0)
        return seeing, agreeing

    def _largest(self, seeing: NDArray[np.uint8], agreeing: NDArray[np.uint8], wrong: int) -> Bool:
        hull = _in_most(seeing, agreeing, wrong)
        chosen = np.flatnonzero(hull)
        if not len(chosen):
            return hull
        label, agree = regions(hull.reshape(self._grid.shape)).reshape(-1)[chosen], agreeing[chosen]
        # a region that only two cameras see may be larger than the person, whom more of them see
        levels = range(2, len(self._voxels.sees) + 1)
        sizes = np.array([np.bincount(label[agree >= n], minlength=int(label.max()) + 1) for n in levels])
        large = sizes * self._litre >= LEAST_LITRES
        level = int(np.flatnonzero(large.any(axis=1))[-1]) if large.any() else 0
        hull[chosen] = label == sizes[level].argmax()
        return hull

    def litres(self, voxels: Bool) -> float:
        """Return the volume of voxels (N,)."""
        return self._litre * np.count_nonzero(voxels)

    def points(self, voxels: Bool, c: int) -> Float:
        """Return (M, 2) the pixels of voxels (N,) in a camera's image."""
        return self._voxels.xy(c, voxels).astype(np.float64)

    def share(self, voxels: Bool, c: int, mask: NDArray[np.uint8]) -> float:
        """Return the share of the voxels (N,) in a camera's image that its mask (h, w) contains; 1 if it shows none."""
        x, y = self._voxels.xy(c, voxels).T
        return float(np.mean(mask[y, x] > 0)) if len(x) else 1.0

    def only(self, voxels: Bool, c: int, mask: NDArray[np.uint8], large: float = np.inf) -> NDArray[np.uint8]:
        """Return the regions of a mask (h, w) that are near voxels (N,) or have the share ``large`` of the largest
        region's area; the whole mask if the image shows none of the voxels."""
        box, labels, area = parts(mask)
        kept = np.append(True, area >= large * area.max(initial=1))  # the background, and the regions
        if kept.all():
            return mask
        # what is near the other regions, and the pixels over which distances to these are measured
        margin = int(np.ceil(self._near_px(c) / _CHAMFER)) + 1
        x, y, w, h = cv2.boundingRect((~kept)[labels].view(np.uint8))
        x, y = x + box[1].start, y + box[0].start
        around = slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin)
        seen = self._voxels.xy(c, voxels)
        if not len(seen):
            return mask
        near = np.zeros(mask.shape, np.bool_)
        near[around] = self._near(c, seen - (around[1].start, around[0].start), mask[around].shape)
        kept[labels[near[box]]] = True
        if kept.all():
            return mask
        result = np.zeros_like(mask)
        result[box] = np.where(kept[labels], mask[box], 0)
        return result

    def near(self, voxels: Bool, c: int, shape: tuple[int, ...]) -> Bool:
        """Return (h, w) the pixels near voxels (N,) in a camera's image; all of them if the image shows none."""
        seen = self._voxels.xy(c, voxels)
        return self._near(c, seen, shape) if len(seen) else np.ones(shape, np.bool_)

    def _near(self, c: int, pixels: NDArray[np.int64], shape: tuple[int, ...]) -> Bool:
        """Return (h, w) what is near pixels (M, 2) in a part of this shape of a camera's image."""
        away = np.ones(shape, np.uint8)
        x, y = pixels[((pixels >= 0) & (pixels < shape[::-1])).all(axis=1)].T
        away[y, x] = 0
        if away.all():
            return np.zeros(shape, np.bool_)
        return np.asarray(cv2.distanceTransform(away, cv2.DIST_L2, 3) <= self._near_px(c))

    def _near_px(self, c: int) -> float:
        return float(_NEAR_VOXELS * self._voxels.pixels_per_voxel[c])


def parts(mask: NDArray[np.uint8]) -> tuple[tuple[slice, slice], NDArray[np.int32], NDArray[np.int32]]:
    """Return the box that holds a mask (h, w), the number of the 8-connected region of each pixel in it, from 1, 0
    outside the mask, and (R,) the areas of the regions."""
    x, y, w, h = cv2.boundingRect(mask)
    box = slice(y, y + h), slice(x, x + w)
    if not w:
        return box, np.zeros((0, 0), np.int32), np.zeros(0, np.int32)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask[box], connectivity=8)
    return box, np.asarray(labels, np.int32), np.asarray(stats[1:, cv2.CC_STAT_AREA], np.int32)


def _in_most(seeing: NDArray[np.uint8], agreeing: NDArray[np.uint8], wrong: int) -> Bool:
    """Return (N,) the voxels that two cameras or more see, and that all but ``wrong`` masks contain."""
    return (seeing >= 2) & (agreeing >= np.where(seeing >= _ENOUGH, seeing - np.uint8(wrong), seeing))


def regions(voxels: Bool) -> NDArray[np.int32]:
    """Return the number of the region, from 1, of each of the voxels (X, Y, Z) that are True, else 0. Voxels are
    connected by faces, edges and corners. (`scipy.ndimage.label`, which takes 0.4 s to import.)"""
    result = np.zeros(voxels.shape, np.int32)
    if not voxels.any():
        return result
    others = [tuple(np.delete(range(3), axis)) for axis in range(3)]
    spans = [np.flatnonzero(voxels.any(axis=axes))[[0, -1]] for axes in others]
    box = tuple(slice(int(first), int(last) + 1) for first, last in spans)
    label, count = result[box], 0
    for layer, plane in zip(label, np.ascontiguousarray(voxels[box]).view(np.uint8), strict=True):
        found, numbers = cv2.connectedComponents(plane, connectivity=8, ltype=cv2.CV_32S)
        layer[...] = np.where(np.asarray(numbers) > 0, np.asarray(numbers) + count, 0)
        count += found - 1
    _, Y, Z = label.shape
    padded = np.pad(label[1:], ((0, 0), (1, 1), (1, 1)))
    pairs = set()
    for y, z in np.ndindex(3, 3):
        above, below = label[:-1], padded[:, y : y + Y, z : z + Z]
        both = (above > 0) & (below > 0)
        pairs |= set(zip(above[both].tolist(), below[both].tolist(), strict=True))
    number = np.arange(count + 1)
    for one, other in sorted(pairs):
        low, high = sorted((int(number[one]), int(number[other])))
        number[number == high] = low
    label[...] = np.unique(number, return_inverse=True)[1][label]
    return result


def dilated(mask: NDArray, by: int) -> Bool:
    """Return a mask (h, w) grown by ``by`` pixels on all sides."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)).astype(bool)
