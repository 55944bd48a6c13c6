"""Whether the masks of several cameras can show one person at one time: each against the visual hull of the others.

A point of the person lies in every mask. So the hull of any cameras holds the person, and where its silhouette in
another camera leaves out a part of that camera's mask, one of those involved is wrong: turned, late, or its mask shows
too much or too little. Which one is told by leaving it out: the rest then agree. Kehl & Van Gool (2006) and Laurentini
(1994) have the hull's property; what is made of it here is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume, VoxelGrid

Float = NDArray[np.float64]
Masks = NDArray[np.uint8]
Bool = NDArray[np.bool_]

#: voxels along the working volume's longest side; those about the person are divided by two
_COARSE = 36
#: about so many rows of a picture are looked at
_ROWS = 120
#: cameras disagree where this share of the masks lies outside the hulls of the others; exact masks leave under 1 %,
#: segmented ones 1 to 3 %
DISAGREE = 0.06
#: without the odd camera no more than this share of the disagreement is left
_LEFT_OVER = 0.5
#: a camera's masks stick out of what the others allow if they do so by this factor more than the median camera's
_MORE_THAN_USUAL = 4.0
#: the share of its mask that may stay outside when a camera's mask is moved into the hull of the others
_INSIDE = 0.03
#: directions in which an extent is measured: to the faces, edges and corners of a cube
_DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d > (1, 1, 1)], np.float64) - 1.0
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)


@dataclass(frozen=True)
class Agreement:
    """How some cameras' masks agree, over several frames.

    Attributes:
        outside: (C,) share of each camera's mask that lies outside the hull of the others; NaN where it shows nobody.
        without: (C,) the mean of the others' ``outside`` when this camera is left out; NaN where it cannot be told.
        shift_px: (C, 2) the least movement, x and y, pixels of the full picture, that brings each camera's mask into
            the hull of the others (of those but the odd one, where there is one); NaN where none does.
        own: (C,) ``outside`` against the hull of the others, the odd one left out.
        closes: (F,) whether each frame has a hull at all.
        odd: the camera that disagrees with all others; None where they agree, or no single one is to blame.
        extent_m: the greatest extent of the hull, by the median of the frames; NaN where there is none.
    """

    outside: Float
    without: Float
    shift_px: Float
    own: Float
    closes: Bool
    odd: int | None
    extent_m: float

    @property
    def disagreement(self) -> float:
        """The mean share of the masks that lies outside the hulls of the others."""
        return float(np.nanmean(self.outside)) if np.isfinite(self.outside).any() else float("nan")

    @property
    def apart(self) -> tuple[int, ...]:
        """The cameras that disagree with the others, the odd one first."""
        first = () if self.odd is None else (self.odd,)
        # where several disagree and none is the odd one, it is those whose masks stick out of what the others allow
        usual = float(np.nanmedian(self.own)) if np.isfinite(self.own).any() else 0.0
        least = max(DISAGREE, _MORE_THAN_USUAL * usual)
        own = [c for c in range(len(self.own)) if c != self.odd and self.own[c] > least]
        return (*first, *own) if len(first) + len(own) <= len(self.own) / 2 else first

    def why(self, camera: int) -> str:
        """What is the matter with a camera that disagrees, in words."""
        if self.own[camera] < DISAGREE / 2:
            return "its masks miss a part of the person"
        if np.isfinite(self.shift_px[camera]).all():
            return f"off by {np.hypot(*self.shift_px[camera]):.0f} px or more: turned, moved or late"
        return "its masks show something else beside the person, or are wrong"


class MaskAgreement:
    """Compares masks of a rig's cameras.

    Args:
        rig: the cameras.
        volume: where the person is.
    """

    def __init__(self, rig: Rig, volume: Volume) -> None:
        self.rig = rig
        self.volume = volume
        self.step = max(1, round(rig.frame_shape[0] / _ROWS))

    def small(self, masks: Masks) -> Bool:
        """(C, h, w) every ``step``-th pixel of masks (C, H, W)."""
        offset = self.step // 2
        return np.asarray(masks[:, offset :: self.step, offset :: self.step] >= 128)

    def compare(self, frames: Sequence[Masks], blame: bool = True) -> Agreement:
        """The agreement over frames' masks (C, H, W); ``blame``: look for the odd camera, too."""
        C = len(self.rig)
        seen = [self.small(masks) for masks in frames]
        places = self.places(seen)
        closes = np.array([place is not None and place.carve(range(C)).any() for place in places], bool)
        pairs = [(masks, place) for masks, place in zip(seen, places, strict=True) if place is not None]
        shown = [any(bool(masks[c].any()) for masks in seen) for c in range(C)]
        outside = self._outside(pairs, list(range(C)))
        without, odd = np.full(C, np.nan), None
        total = np.nanmean(outside) if np.isfinite(outside).any() else np.nan
        if blame and C >= 3 and np.isfinite(total):
            for k in range(C):
                if shown[k]:
                    rest = self._outside(pairs, [c for c in range(C) if c != k])
                    without[k] = np.nanmean(rest) if np.isfinite(rest).any() else np.nan
            if total > DISAGREE and np.isfinite(without).any():
                best = int(np.nanargmin(without))
                # what one camera less explains by itself is not held against it
                if without[best] < _LEFT_OVER * min(total, float(np.nanmedian(without))):
                    odd = best
        shift, own = np.full((C, 2), np.nan), np.full(C, np.nan)
        for c in range(C):
            others = [k for k in range(C) if k != c and k != odd]
            if len(others) >= 1:
                hulls = [(masks[c], place.silhouette(place.carve(others), c)) for masks, place in pairs]
                own[c] = _share_outside(hulls)
                shift[c] = self._least_shift(hulls)
        extents = [place.extent([c for c in range(C) if c != odd]) for _, place in pairs]
        return Agreement(outside, without, shift, own, closes, odd, float(np.median(extents)) if extents else np.nan)

    def places(self, seen: Sequence[Bool]) -> list[Place | None]:
        """For each frame's small masks the voxels about the person; None where no two cameras see anybody together."""
        grid = VoxelGrid.cover(self.volume, _COARSE)
        coarse = _Voxels(self.rig, grid.centers(), grid.voxel_m, self.step, self.rig.frame_shape)
        near = np.zeros(grid.count, bool)
        found = []
        for masks in seen:
            # a voxel counts when any part of it may be inside
            place = coarse.place(np.stack([_grown(m, int(r)) for m, r in zip(masks, coarse.reach, strict=True)]), 2)
            found.append(place is not None)
            if place is not None:
                near[place.voxels] = True
        # each of these voxels in eight
        corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3) * grid.voxel_m
        centers = (corners + grid.centers(np.flatnonzero(near))).reshape(-1, 3)
        fine = _Voxels(self.rig, centers, grid.voxel_m / 2, self.step, self.rig.frame_shape)
        return [fine.place(masks, 2) if some else None for some, masks in zip(found, seen, strict=True)]

    def _outside(self, pairs: Sequence[tuple[Bool, Place]], cameras: Sequence[int]) -> Float:
        """(len(cameras),) share of each one's masks outside the hull of the others among them."""
        result = np.full(len(cameras), np.nan)
        for i, c in enumerate(cameras):
            others = [k for k in cameras if k != c]
            if others:
                result[i] = _share_outside(
                    [(masks[c], place.silhouette(place.carve(others), c)) for masks, place in pairs]
                )
        return result

    def _least_shift(self, pairs: Sequence[tuple[Bool, Bool]]) -> Float:
        """(2,) the least movement that brings masks into silhouettes, the same in all frames; NaN where none does."""
        area, reach = 0.0, 24
        inside: Float = np.zeros((2 * reach + 1, 2 * reach + 1))
        for mask, silhouette in pairs:
            box = cv2.boundingRect(mask.view(np.uint8))
            if box[2] == 0:
                continue
            x, y, w, h = box
            padded = np.zeros((h + 2 * reach, w + 2 * reach), np.float32)
            y0, x0 = y - reach, x - reach
            ys, xs = slice(max(y0, 0), y + h + reach), slice(max(x0, 0), x + w + reach)
            part = silhouette[ys, xs]
            padded[ys.start - y0 : ys.start - y0 + part.shape[0], xs.start - x0 : xs.start - x0 + part.shape[1]] = part
            inside += cv2.matchTemplate(padded, mask[y : y + h, x : x + w].astype(np.float32), cv2.TM_CCORR)
            area += float(mask.sum())
        if area == 0.0:
            return np.full(2, np.nan)
        moves = np.argwhere(inside >= (1 - _INSIDE) * area)[:, ::-1] - reach
        if len(moves) == 0:
            return np.full(2, np.nan)
        return np.asarray(moves[np.argmin((moves**2).sum(axis=1))] * float(self.step), np.float64)


class _Voxels:
    """Voxels, by their centres (N, 3), in the small pictures of a rig's cameras."""

    def __init__(self, rig: Rig, centers: Float, voxel_m: float, step: int, frame_shape: tuple[int, int]) -> None:
        self.centers = centers
        shape = tuple(len(range(step // 2, side, step)) for side in frame_shape)
        self.pixels = np.zeros((len(rig), len(centers)), np.int32)
        self.sees = np.zeros((len(rig), len(centers)), bool)
        self.reach = np.ones(len(rig), np.int64)
        for c, camera in enumerate(rig):
            pixels, depth = camera.project(centers)
            with np.errstate(invalid="ignore"):
                x, y = ((pixels - step // 2) / step).round().T
                held = (
                    (x >= 0) & (x * step + step // 2 < camera.width) & (y >= 0) & (y * step + step // 2 < camera.height)
                )
            held &= depth > 0
            self.sees[c] = held
            self.pixels[c, held] = (y[held] * shape[1] + x[held]).astype(np.int32)
            if held.any():  # half a voxel's diagonal in this picture
                half = 0.87 * voxel_m * camera.matrix[0, 0] / float(np.median(depth[held])) / step
                self.reach[c] = max(1, int(np.ceil(half)))

    def place(self, masks: Bool, missing: int) -> Place | None:
        """The voxels that all but ``missing`` cameras do not carve, two of which see them; None without any."""
        inside = ~self.sees | np.stack([mask.ravel()[pixels] for mask, pixels in zip(masks, self.pixels, strict=True)])
        least = max(2, len(masks) - missing)
        near = np.flatnonzero((inside.sum(axis=0) >= least) & ((inside & self.sees).sum(axis=0) >= 2))
        if not len(near):
            return None
        return Place(
            self.centers[near],
            near,
            self.pixels[:, near],
            self.sees[:, near],
            inside[:, near],
            self.reach,
            masks.shape[1:],
        )


@dataclass(frozen=True)
class Place:
    """The voxels about a person in one frame.

    Attributes:
        centers: (N, 3) metres.
        voxels: (N,) their indices.
        pixels: (C, N) flat index of the pixel of each camera's small picture.
        sees: (C, N) whether the camera's picture holds the voxel.
        inside: (C, N) whether the voxel's centre falls on the camera's mask, or outside its picture.
        reach: (C,) half a voxel's diagonal, small pixels.
        shape: (h, w) of the small pictures.
    """

    centers: Float
    voxels: NDArray[np.int64]
    pixels: NDArray[np.int32]
    sees: Bool
    inside: Bool
    reach: NDArray[np.int64]
    shape: tuple[int, ...]

    def carve(self, cameras: Sequence[int]) -> Bool:
        """(N,) the hull of these cameras; where a voxel is in none of their pictures it is empty."""
        chosen = list(cameras)
        return np.asarray(self.inside[chosen].all(axis=0) & self.sees[chosen].any(axis=0))

    def common(self, cameras: Sequence[int]) -> Bool:
        """(N,) these cameras' hull where the most of them look: elsewhere little is carved away."""
        carved = self.carve(cameras)
        views = self.sees.sum(axis=0)
        return carved & (views >= np.percentile(views[carved], 95)) if carved.any() else carved

    def hull(self, cameras: Sequence[int]) -> Float:
        """(N, 3) the points of :meth:`common`, metres."""
        return self.centers[self.common(cameras)]

    def extent(self, cameras: Sequence[int]) -> float:
        """The greatest extent of these cameras' hull, metres, without what specks add; 0 if it is empty."""
        hull = self.hull(cameras)
        if not len(hull):
            return 0.0
        low, high = np.percentile(hull @ _DIRECTIONS.T, [1, 99], axis=0)
        return float((high - low).max())

    def silhouette(self, hull: Bool, camera: int) -> Bool:
        """(h, w) the silhouette of the hull's voxels (N,) in a camera, rather too large than too small."""
        picture = np.zeros(self.shape, np.uint8)
        picture.ravel()[self.pixels[camera, hull & self.sees[camera]]] = 1
        return _grown(picture, int(self.reach[camera]))


def _grown(mask: NDArray, by: int) -> Bool:
    """A mask (h, w) with so many pixels more on all sides."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)).astype(bool)


def _share_outside(pairs: Sequence[tuple[Bool, Bool]]) -> float:
    area = sum(int(mask.sum()) for mask, _ in pairs)
    out = sum(int((mask & ~silhouette).sum()) for mask, silhouette in pairs)
    return out / area if area else float("nan")
