"""Whether the masks of several cameras can show one person at one time: each against the visual hull of the others.

A point of the person lies in every mask, so the hull of any cameras contains the person. Where its silhouette in
another camera does not cover that camera's mask, one of the cameras is wrong: turned, late, or its mask is too large
or too small. Without the wrong camera the others agree, which identifies it. The property of the hull is Kehl & Van
Gool's (2006) and Laurentini's (1994); the test is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.hull.coarse import Hull, Voxels, dilated

Float = NDArray[np.float64]
Masks = NDArray[np.uint8]
Bool = NDArray[np.bool_]

# Voxels along the working volume's longest side; those near the person are divided by two.
_COARSE = 36
# Rows of an image that are used, approximately.
_ROWS = 120
# Cameras are inconsistent if this share of the masks lies outside the hulls of the others: exact masks leave less than
# 1 % outside, segmented ones 1 to 3 %.
INCONSISTENT = 0.06
# One camera is identified as wrong if the share outside falls to this fraction without it.
_LEFT_OVER = 0.5
# Several cameras are wrong if their shares exceed the median camera's by this factor. Chosen on the development
# captures; sensitivity not measured.
_ABOVE_MEDIAN = 4.0
# Share of a mask that may stay outside when it is shifted into the hull of the others: what segmented masks leave.
_OUTSIDE_SHIFTED = 0.03


@dataclass(frozen=True)
class Agreement:
    """Consistency of C cameras' masks over several frames.

    Attributes:
        outside: (C,) share of each camera's mask that lies outside the hull of the others; NaN if it shows nobody.
        without: (C,) mean of the others' ``outside`` if this camera is removed; NaN if unknown.
        shift_px: (C, 2) smallest shift, x and y, pixels of the full image, that moves each camera's mask into the hull
            of the others (without the odd one); NaN if none does.
        own: (C,) ``outside`` against the hull of the others, without the odd one.
        closes: (F,) whether each frame has a hull at all.
        odd: the one camera that is inconsistent with all others; None if there is none, or more than one.
        extent_m: the greatest extent of the hull, median of the frames; NaN without a hull.
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
        """The mean share of the masks outside the hulls of the others."""
        return float(np.nanmean(self.outside)) if np.isfinite(self.outside).any() else float("nan")

    @property
    def inconsistent(self) -> tuple[int, ...]:
        """The cameras that are inconsistent with the others, the odd one first; never more than half of them."""
        first = () if self.odd is None else (self.odd,)
        median = float(np.nanmedian(self.own)) if np.isfinite(self.own).any() else 0.0
        least = max(INCONSISTENT, _ABOVE_MEDIAN * median)
        own = [c for c in range(len(self.own)) if c != self.odd and self.own[c] > least]
        return (*first, *own) if len(first) + len(own) <= len(self.own) / 2 else first

    def reason(self, camera: int) -> str:
        """Return what is wrong with an inconsistent camera."""
        if self.own[camera] < INCONSISTENT / 2:
            return "its masks miss a part of the person"
        if np.isfinite(self.shift_px[camera]).all():
            return f"off by {np.hypot(*self.shift_px[camera]):.0f} px or more: turned, moved or late"
        return "its masks show something else beside the person, or are wrong"


class MaskAgreement:
    """Compares masks of a rig's cameras.

    Args:
        rig: the cameras.
        volume: the working volume.
    """

    def __init__(self, rig: Rig, volume: Volume) -> None:
        self.rig = rig
        self.volume = volume
        self.step = max(1, round(rig.frame_shape[0] / _ROWS))

    def small(self, masks: Masks) -> Bool:
        """Return (C, h, w) every ``step``-th pixel of masks (C, H, W)."""
        offset = self.step // 2
        return np.asarray(masks[:, offset :: self.step, offset :: self.step] >= 128)

    def compare(self, frames: Sequence[Masks], blame: bool = True) -> Agreement:
        """Return the agreement over frames of masks (C, H, W); ``blame``: identify the odd camera, too."""
        C = len(self.rig)
        seen = [self.small(masks) for masks in frames]
        hulls = self.hulls(seen)
        closes = np.array([hull is not None and hull.carve(range(C)).any() for hull in hulls], bool)
        pairs = [(masks, hull) for masks, hull in zip(seen, hulls, strict=True) if hull is not None]
        shown = [any(bool(masks[c].any()) for masks in seen) for c in range(C)]
        outside = self._outside(pairs, list(range(C)))
        without, odd = np.full(C, np.nan), None
        total = np.nanmean(outside) if np.isfinite(outside).any() else np.nan
        if blame and C >= 3 and np.isfinite(total):
            for k in range(C):
                if shown[k]:
                    rest = self._outside(pairs, [c for c in range(C) if c != k])
                    without[k] = np.nanmean(rest) if np.isfinite(rest).any() else np.nan
            if total > INCONSISTENT and np.isfinite(without).any():
                best = int(np.nanargmin(without))
                # with fewer cameras any hull is larger: the camera must stand out from the others' removal
                if without[best] < _LEFT_OVER * min(total, float(np.nanmedian(without))):
                    odd = best
        shift, own = np.full((C, 2), np.nan), np.full(C, np.nan)
        for c in range(C):
            others = [k for k in range(C) if k != c and k != odd]
            if len(others) >= 1:
                views = [(masks[c], hull.silhouette(hull.carve(others), c)) for masks, hull in pairs]
                own[c] = _share_outside(views)
                shift[c] = self._least_shift(views)
        extents = [hull.extent([c for c in range(C) if c != odd]) for _, hull in pairs]
        return Agreement(outside, without, shift, own, closes, odd, float(np.median(extents)) if extents else np.nan)

    def hulls(self, seen: Sequence[Bool]) -> list[Hull | None]:
        """Return each frame's hulls from its small masks (C, h, w); None if no two cameras see the same voxel."""
        grid = VoxelGrid.cover(self.volume, _COARSE)
        coarse = Voxels.of(self.rig, grid.centers(), grid.voxel_m, self.step)
        near = np.zeros(grid.count, bool)
        found = []
        for masks in seen:
            # grown masks: a voxel counts if any part of it may be inside
            grown = np.stack([dilated(m, int(r)) for m, r in zip(masks, coarse.reach, strict=True)])
            chosen = coarse.near(coarse.inside(grown), 2)
            found.append(len(chosen) > 0)
            near[chosen] = True
        # each of these voxels is divided into eight
        corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3) * grid.voxel_m
        centers = (corners + grid.centers(np.flatnonzero(near))).reshape(-1, 3)
        fine = Voxels.of(self.rig, centers, grid.voxel_m / 2, self.step)
        result: list[Hull | None] = []
        for some, masks in zip(found, seen, strict=True):
            inside = fine.inside(masks)
            chosen = fine.near(inside, 2)
            result.append(fine.hull(inside, chosen) if some and len(chosen) else None)
        return result

    def _outside(self, pairs: Sequence[tuple[Bool, Hull]], cameras: Sequence[int]) -> Float:
        """Return (len(cameras),) the share of each one's masks outside the hull of the others among them."""
        result = np.full(len(cameras), np.nan)
        for i, c in enumerate(cameras):
            others = [k for k in cameras if k != c]
            if others:
                result[i] = _share_outside(
                    [(masks[c], hull.silhouette(hull.carve(others), c)) for masks, hull in pairs]
                )
        return result

    def _least_shift(self, pairs: Sequence[tuple[Bool, Bool]]) -> Float:
        """Return (2,) the smallest shift, the same in all frames, that moves masks into silhouettes, or NaN."""
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
        shifts = np.argwhere(inside >= (1 - _OUTSIDE_SHIFTED) * area)[:, ::-1] - reach
        if len(shifts) == 0:
            return np.full(2, np.nan)
        return np.asarray(shifts[np.argmin((shifts**2).sum(axis=1))] * float(self.step), np.float64)


def _share_outside(pairs: Sequence[tuple[Bool, Bool]]) -> float:
    """Return the share of masks outside silhouettes, both (h, w); NaN if the masks are empty."""
    area = sum(int(mask.sum()) for mask, _ in pairs)
    out = sum(int((mask & ~silhouette).sum()) for mask, silhouette in pairs)
    return out / area if area else float("nan")
