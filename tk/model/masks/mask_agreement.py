"""Whether the cameras and the silhouettes are consistent with one another, before anybody is tracked.

Pairs of cameras are tested by epipolar tangency (:mod:`tk.model.masks.tangency`). What no pair shows, such as a second
person beside the first in one view, the visual hull shows: a point of the person lies in every mask, so the hull of any
cameras contains the person (Laurentini, 1994), and its silhouette in another camera covers that camera's mask. The most
probable explanation of both decides (:mod:`tk.model.masks.camera_hypotheses`). `tk inspect` and the start of the
tracking use the same test. The test of hulls is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import LEAST_INFORMATION, depth_information
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.hull.coarse import Hull, Voxels, dilated
from tk.model.masks.camera_hypotheses import ERROR, WRONG, PairNats, most_probable
from tk.model.masks.tangency import Outline, Tangency, tangency

Float = NDArray[np.float64]
Masks = NDArray[np.uint8]
Bool = NDArray[np.bool_]

# Voxels along the working volume's longest side; those near the person are divided by two.
_COARSE = 36
# Rows of an image that are used for hulls, approximately.
_ROWS = 120
#: Share of the masks outside the hulls of the others that is less probable than a wrong camera.
INCONSISTENT = -ERROR * float(np.log(WRONG))

_CAUSES = (
    "a camera was turned or moved after the calibration, calibration.toml is of another recording, the videos do not "
    "belong to these cameras or to the same time, or the masks show something else than the person"
)


@dataclass(frozen=True)
class Agreement:
    """Consistency of C cameras and their masks over several frames.

    Attributes:
        names: of the cameras.
        tangency: the errors of all pairs.
        wrong: cameras that contradict the others; empty if the cameras are refused.
        refusal: why the cameras cannot be used together, one line; empty if they can.
        outside: (C,) share of each camera's mask that lies outside the hull of the other right cameras; NaN if it
            shows nobody.
        shift_px: (C, 2) smallest shift, x and y, pixels of the recorded image, that moves each camera's mask into that
            hull; NaN if none does.
        closes: (F,) whether each frame has a hull of all cameras.
        extent_m: greatest extent of the right cameras' hull, median of the frames; NaN without a hull.
        reductions: (C,) recorded pixels along a side of a mask's pixel.
    """

    names: tuple[str, ...]
    tangency: Tangency
    wrong: tuple[int, ...]
    refusal: str
    outside: Float
    shift_px: Float
    closes: Bool
    extent_m: float
    reductions: tuple[int, ...]

    @property
    def disagreement(self) -> float:
        """The mean share of the masks outside the hulls of the others."""
        return float(np.nanmean(self.outside)) if np.isfinite(self.outside).any() else float("nan")

    @property
    def undetected_m(self) -> float:
        """By how much the contours of a right camera may be displaced, metres: if a camera is wrong, others may be too,
        and one with a single tested partner may be wrong by what the test tolerates. 0 if there is none."""
        partners = np.isfinite(self.tangency.apart[np.ix_(self.right, self.right)]).sum(axis=1)
        if not self.wrong or not (partners == 1).any():
            return 0.0
        return float(self.extent_m * (ERROR + 2 * np.nanmedian(self.tangency.pixel)))

    @property
    def right(self) -> list[int]:
        """The cameras that are not wrong."""
        return [c for c in range(len(self.names)) if c not in self.wrong]

    @property
    def tested_right(self) -> Bool:
        """(C,) cameras that were tested with another one, and are not wrong."""
        return np.isfinite(self.tangency.apart).any(axis=1) & ~np.isin(np.arange(len(self.names)), self.wrong)

    @property
    def pairs_px(self) -> Float:
        """(C,) error of the pairs of each camera with the right ones, median, pixels of the recorded image; NaN if none
        was tested. A camera is wrong if most of its pairs err, whatever the hull of the others shows."""
        apart = [self.tangency.apart[c, [k for k in self.right if k != c]] for c in range(len(self.names))]
        median = [float(np.median(known)) if len(known := pairs[np.isfinite(pairs)]) else np.nan for pairs in apart]
        return np.asarray(np.array(self.reductions) * np.array(median) / self.tangency.pixel)

    def reason(self, camera: int) -> str:
        """Return what is wrong with a camera."""
        error, tolerance = self.tangency.error[camera], _tolerance(self.tangency)[camera, :, None]
        extends, short = (error > tolerance).any(), (error < -tolerance)[self.right].any()
        if self.outside[camera] < INCONSISTENT / 2 and not extends:
            return "its masks miss a part of the person"
        off = np.hypot(*self.shift_px[camera])
        if not off > 0 and short:
            off = self.pairs_px[camera]
        if off > 0:
            return f"off by {off:.0f} px or more: turned, moved, late, or another camera's video"
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
        return np.asarray(masks[:, offset :: self.step, offset :: self.step] >= PERSON)

    def possible(self, masks: Masks) -> Bool:
        """Return (C, h, w) the same, with the pixels where others may hide the person."""
        return self.small(masks) | self.small(np.uint8(255) * (masks == OTHERS))

    def compare(self, frames: Sequence[Masks], there: Bool | None = None, landmarks: Float | None = None) -> Agreement:
        """Return the agreement over F frames of masks (C, H, W).

        Args:
            frames: the masks. An empty one says that its camera sees nobody.
            there: (F, C) masks that say anything; the others are not compared. None: all.
            landmarks: (C,) logarithm of the likelihood ratio of each camera being right, nats; NaN if there is none.
        """
        C = len(self.rig)
        if there is None:
            there = np.ones((len(frames), C), np.bool_)
        frames = [
            masks if here.all() else masks * here[:, None, None] for masks, here in zip(frames, there, strict=True)
        ]
        outlines = [[_outline(camera, masks[c]) for c, camera in enumerate(self.rig)] for masks in frames]
        pairs = tangency(outlines, self.rig.centers)
        seen = [self.small(masks) for masks in frames]
        hulls = self.hulls([self.possible(masks) for masks in frames], there)
        views = [(masks, hull) for masks, hull in zip(seen, hulls, strict=True) if hull is not None]
        outside = cache(lambda cameras: self._outside(views, cameras))
        verdict = most_probable(
            PairNats.of(pairs.error, _tolerance(pairs)),
            np.isfinite(pairs.pixel),
            np.full(C, np.nan) if landmarks is None else landmarks,
            outside,
            lambda a, b: self._exchanged(frames, outlines, a, b),
        )
        wrong, right = verdict.wrong, [c for c in range(C) if c not in verdict.wrong]
        if verdict.exchanged:  # the other cameras may suffice, but the remedy is known
            a, b = (self.rig.names[c] for c in verdict.exchanged)
            refusal = f"the videos of {a} and {b} look swapped: exchange their names, and all cameras agree"
        elif verdict.refused:
            refusal = self._contradiction(frames, pairs)
        elif landmarks is None or not np.nansum(landmarks) > 0:  # landmarks show depth, too
            refusal = self._one_sided(pairs, right, wrong)
        else:
            refusal = ""
        shift = np.full((C, 2), np.nan)
        for c in range(C):
            if others := [k for k in right if k != c]:
                shift[c] = self.rig[c].reduction * self._least_shift(_silhouettes(views, c, others))
        extents = [extent for _, hull in views if (extent := hull.extent(right)) > 0]
        return Agreement(
            names=self.rig.names,
            tangency=pairs,
            wrong=wrong,
            refusal=refusal,
            outside=outside(tuple(right)),
            shift_px=shift,
            closes=np.array([hull is not None and hull.carve(range(C)).any() for hull in hulls], bool),
            extent_m=float(np.median(extents)) if extents else np.nan,
            reductions=self.rig.reductions,
        )

    def _exchanged(
        self, frames: Sequence[Masks], outlines: Sequence[Sequence[Outline | None]], a: int, b: int
    ) -> PairNats | None:
        """Return the errors of all pairs after two cameras' videos are exchanged; None if their sizes differ."""
        if (self.rig[a].width, self.rig[a].height) != (self.rig[b].width, self.rig[b].height):
            return None
        exchanged = []
        for masks, row in zip(frames, outlines, strict=True):
            views = list(row)
            views[a], views[b] = _outline(self.rig[a], masks[b]), _outline(self.rig[b], masks[a])
            exchanged.append(views)
        pairs = tangency(exchanged, self.rig.centers)
        return PairNats.of(pairs.error, _tolerance(pairs))

    def _contradiction(self, frames: Sequence[Masks], pairs: Tangency) -> str:
        """Return why the cameras are refused if no majority of them is consistent."""
        cameras = np.flatnonzero(np.isfinite(pairs.pixel))
        names = [self.rig.names[c] for c in cameras]
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
        if len(frames) > 1 and all(np.array_equal(masks, frames[0]) for masks in frames[1:]):
            return f"the masks of {listed} contradict each other, and they never change: do they show the person?"
        error = pairs.apart[np.ix_(cameras, cameras)]
        most = float(np.nanmax(error)) if np.isfinite(error).any() else np.nan
        if most <= ERROR:
            return (
                f"the outlines in {listed} agree, but the working volume does not hold the person whom they show: "
                "correct [volume] in capture.toml, or choose a first frame with the person inside (--frames N:)"
            )
        apart = f" by up to {most:.0%} of the person's size" if np.isfinite(most) else ""
        if len(names) == 2:
            return f"{listed} contradict each other{apart}, and two cameras do not show which one is wrong: {_CAUSES}"
        return f"the cameras {listed} do not belong together: they contradict each other{apart}: {_CAUSES}"

    def _one_sided(self, pairs: Tangency, right: Sequence[int], wrong: Sequence[int]) -> str:
        """Return why depth cannot be measured with the right cameras; empty if it can."""
        seeing = [c for c in right if np.isfinite(pairs.middle[c]).all()]
        if len(seeing) < 2 or depth_information(pairs.middle[seeing]) >= LEAST_INFORMATION:
            return ""
        names = " and ".join(self.rig.names[c] for c in seeing)
        without = f" (without {', '.join(self.rig.names[c] for c in wrong)}, which contradict the others)"
        return (
            f"{names}{without if wrong else ''} see the person from the same or from opposite sides, so the distance "
            f"along their line of sight is unknown by more than 5 cm: use a camera from another side, at 30 to 150°"
        )

    def mean_outside(self, frames: Sequence[Masks], cameras: Sequence[int]) -> float:
        """Return the mean share of the masks (C, H, W) of these cameras outside the hulls of the others of them; NaN if
        there is no hull."""
        hulls = self.hulls([self.possible(masks) for masks in frames])
        views = [(self.small(masks), hull) for masks, hull in zip(frames, hulls, strict=True) if hull is not None]
        shares = self._outside(views, cameras)[list(cameras)]
        return float(np.nanmean(shares)) if np.isfinite(shares).any() else float("nan")

    def hulls(self, seen: Sequence[Bool], there: Bool | None = None) -> list[Hull | None]:
        """Return each frame's hulls from its small masks (C, h, w); None if no two cameras see the same voxel.

        ``there``: (F, C) masks that carve; None: all.
        """
        if there is None:
            there = np.ones((len(seen), len(self.rig)), np.bool_)
        grid = VoxelGrid.cover(self.volume, _COARSE)
        coarse = Voxels.of(self.rig, grid.centers(), grid.voxel_m, self.step)
        near = np.zeros(grid.count, bool)
        found = []
        for masks, here in zip(seen, there, strict=True):
            # grown masks: a voxel counts if any part of it may be inside
            grown = np.stack([dilated(m, int(r)) for m, r in zip(masks, coarse.reach, strict=True)])
            voxels = coarse.by(here)
            chosen = voxels.near(voxels.inside(grown), 2)
            found.append(len(chosen) > 0)
            near[chosen] = True
        # each of these voxels is divided into eight
        corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3) * grid.voxel_m
        centers = (corners + grid.centers(np.flatnonzero(near))).reshape(-1, 3)
        fine = Voxels.of(self.rig, centers, grid.voxel_m / 2, self.step)
        result: list[Hull | None] = []
        for some, masks, here in zip(found, seen, there, strict=True):
            voxels = fine.by(here)
            inside = voxels.inside(masks)
            chosen = voxels.near(inside, 2)
            result.append(voxels.hull(inside, chosen) if some and len(chosen) else None)
        return result

    def _outside(self, views: Sequence[tuple[Bool, Hull]], cameras: Sequence[int]) -> Float:
        """Return (C,) the share of each camera's masks outside the hull of the others among some; NaN if unknown."""
        others = [[k for k in cameras if k != c] for c in range(len(self.rig))]
        return np.array([_share_outside(_silhouettes(views, c, k)) if k else np.nan for c, k in enumerate(others)])

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
        shifts = np.argwhere(inside >= (1 - INCONSISTENT / 2) * area)[:, ::-1] - reach
        if len(shifts) == 0:
            return np.full(2, np.nan)
        return np.asarray(shifts[np.argmin((shifts**2).sum(axis=1))] * float(self.step), np.float64)


def _outline(camera: Camera, mask: Masks) -> Outline | None:
    """Return the outline of a mask (H, W); None if it is empty, or if another person may hide a part of it."""
    others = (mask == OTHERS).astype(np.uint8)
    if others.any() and (dilated(others, 1) & (mask >= PERSON)).any():
        return None
    return Outline.of(camera, mask)


def _silhouettes(views: Sequence[tuple[Bool, Hull]], camera: int, others: Sequence[int]) -> list[tuple[Bool, Bool]]:
    """Return a camera's mask, and the silhouette of the hull of some others, of each frame in which one of them sees
    anything."""
    return [
        (masks[camera], hull.silhouette(hull.carve(others), camera))
        for masks, hull in views
        if hull.voxels.sees[list(others)].any()
    ]


def _share_outside(pairs: Sequence[tuple[Bool, Bool]]) -> float:
    """Return the share of masks outside silhouettes, both (h, w); NaN if the masks are empty."""
    area = sum(int(mask.sum()) for mask, _ in pairs)
    out = sum(int((mask & ~silhouette).sum()) for mask, silhouette in pairs)
    return out / area if area else float("nan")


def excess(pairs: Tangency) -> Float:
    """Return (C, C) the errors of all pairs in tolerances; NaN where a pair cannot be tested."""
    return np.asarray(pairs.apart / _tolerance(pairs))


def _tolerance(pairs: Tangency) -> Float:
    """Return (C, C) the three standard deviations of the error of a right pair, as a share of the person's size."""
    return np.asarray(ERROR + pairs.pixel[:, None] + pairs.pixel)
