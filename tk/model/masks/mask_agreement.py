"""Whether the cameras and the silhouettes are consistent with one another, before anybody is tracked.

Pairs of cameras are tested by epipolar tangency (:mod:`tk.model.masks.tangency`). The largest majority of cameras that
agree with most of their partners is right; the others are wrong. What no pair shows, such as a second person beside the
first in one view, the visual hull shows: a point of the person lies in every mask, so the hull of any cameras contains
the person (Laurentini, 1994), and its silhouette in another camera covers that camera's mask. `tk inspect` and the
start of the tracking use the same test. The tests of hulls and sets are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import LEAST_INFORMATION, depth_information
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.hull.coarse import Hull, Voxels, dilated
from tk.model.masks.tangency import Outline, Tangency, tangency
from tk.model.reduced_images import every

Float = NDArray[np.float64]
Masks = NDArray[np.uint8]
Bool = NDArray[np.bool_]

# Error that two correct cameras may have, as a share of the person's size, plus one pixel of either mask.
TOLERANCE = 0.012
# Voxels along the working volume's longest side; those near the person are divided by two.
_COARSE = 36
# Rows of an image that are used for hulls, approximately.
_ROWS = 120
# Share of the masks outside the hulls of the others above which a camera is wrong: exact masks leave less than 1 %
# outside, segmented ones 1 to 3 %.
INCONSISTENT = 0.06
# One camera is identified as wrong if the share outside falls to this fraction without it. If none is identified, the
# cameras are refused above this many times INCONSISTENT.
_LEFT_OVER, _REFUSED = 0.5, 2.0
# Without a majority, exchanged videos are searched for among at most this many cameras: of more, without two of them,
# the others are a majority.
_SWAPS_OF = 8
# Sets of cameras that are compared at once: memory and speed only.
_TOGETHER = 20000

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

    def confirmed(self, evidence: Float) -> Agreement:
        """Return the agreement without contradictions that other evidence denies.

        Args:
            evidence: (C,) logarithm of the likelihood ratio of each camera being right, nats; NaN if there is none. The
                masks' verdict about a camera stays without evidence.
        """
        wrong = tuple(c for c in self.wrong if not evidence[c] > 0)
        denied = not wrong and (evidence > 0).any() and not (evidence < 0).any()
        return replace(self, wrong=wrong, refusal="" if denied else self.refusal)

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
        return float(self.extent_m * (TOLERANCE + 2 * np.nanmedian(self.tangency.pixel)))

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
        error = self.tangency.error[camera, self.right]
        error, tolerance = error[np.isfinite(error)], TOLERANCE + 2 * self.tangency.pixel[camera]
        if self.outside[camera] < INCONSISTENT / 2 and not contradicts(self.tangency, camera):
            return "its masks miss a part of the person"
        off = np.hypot(*self.shift_px[camera])
        if not off > 0 and (error < -tolerance).any():
            off = self.pairs_px[camera]
        if off > 0:
            return f"off by {off:.0f} px or more: turned, moved, zoomed, late, or another camera's video"
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
        return np.asarray(every(masks, masks.shape[1:], self.step) >= PERSON)

    def possible(self, masks: Masks) -> Bool:
        """Return (C, h, w) the same, with the pixels where others may hide the person."""
        small = every(masks, masks.shape[1:], self.step)
        return (small >= PERSON) | (small == OTHERS)

    def compare(self, frames: Sequence[Masks], there: Bool | None = None) -> Agreement:
        """Return the agreement over F frames of masks (C, H, W).

        Args:
            frames: the masks. An empty one says that its camera sees nobody.
            there: (F, C) masks that say anything; the others are not compared. None: all.
        """
        C = len(self.rig)
        if there is None:
            there = np.ones((len(frames), C), np.bool_)
        frames = [
            masks if here.all() else masks * here[:, None, None] for masks, here in zip(frames, there, strict=True)
        ]
        outlines = [[_outline(camera, masks[c]) for c, camera in enumerate(self.rig)] for masks in frames]
        pairs = tangency(outlines, self.rig.centers)
        error = excess(pairs)
        tested = np.flatnonzero(np.isfinite(error).any(axis=1)).tolist()
        kept = largest_consistent(error)
        # a silhouette that is smaller on one side is no contradiction: the mask misses a part, or others have a shadow
        wrong = [c for c in tested if c not in kept and contradicts(pairs, c)] if kept else []
        seen = [self.small(masks) for masks in frames]
        hulls = self.hulls([self.possible(masks) for masks in frames], there)
        views = [(masks, hull) for masks, hull in zip(seen, hulls, strict=True) if hull is not None]
        right = [c for c in range(C) if c not in wrong]
        refused = not kept and bool(tested)
        while not refused and (total := self._mean_outside(views, right)) > INCONSISTENT:
            odd = self._odd(views, right, total)
            if odd is None or len(right) - 1 <= C / 2:
                refused = total > _REFUSED * INCONSISTENT
                break
            wrong.append(odd)
            right.remove(odd)
        accused = wrong if not refused else tested if C <= _SWAPS_OF else []
        swapped = self._swapped(frames, outlines, accused)
        if swapped or refused:
            wrong, right = [], list(range(C))
        if swapped:  # the other cameras may suffice, but the remedy is known
            a, b = (self.rig.names[c] for c in swapped)
            refusal = f"the videos of {a} and {b} look swapped: exchange their names, and all cameras agree"
        elif refused:
            refusal = self._contradiction(frames, pairs, tested or right)
        else:
            refusal = self._one_sided(pairs, right, wrong)
        outside, shift = np.full(C, np.nan), np.full((C, 2), np.nan)
        for c in range(C):
            others = [k for k in right if k != c]
            if others:
                shown = _silhouettes(views, c, others)
                outside[c] = _share_outside(shown)
                shift[c] = self.rig[c].reduction * self._least_shift(shown)
        extents = [extent for _, hull in views if (extent := hull.extent(right)) > 0]
        return Agreement(
            names=self.rig.names,
            tangency=pairs,
            wrong=tuple(sorted(wrong)),
            refusal=refusal,
            outside=outside,
            shift_px=shift,
            closes=np.array([hull is not None and hull.carve(range(C)).any() for hull in hulls], bool),
            extent_m=float(np.median(extents)) if extents else np.nan,
            reductions=self.rig.reductions,
        )

    def _swapped(
        self, frames: Sequence[Masks], outlines: Sequence[Sequence[Outline | None]], accused: Sequence[int]
    ) -> tuple[int, int] | None:
        """Return the two accused cameras whose exchanged videos make all cameras consistent; None if no two do."""
        found: list[tuple[float, tuple[int, int]]] = []
        for a, b in combinations(sorted(accused), 2):
            if (self.rig[a].width, self.rig[a].height) != (self.rig[b].width, self.rig[b].height):
                continue
            exchanged = []
            for masks, row in zip(frames, outlines, strict=True):
                views = list(row)
                views[a], views[b] = _outline(self.rig[a], masks[b]), _outline(self.rig[b], masks[a])
                exchanged.append(views)
            error = excess(tangency(exchanged, self.rig.centers))
            known = np.isfinite(error)
            error = error[known.any(axis=1)]
            # one partner agrees by chance
            if known[[a, b]].sum(axis=1).min() >= 2 and np.nanmedian(error, axis=1).max() <= 1.0:
                found.append((float(np.nanmean(error)), (a, b)))
        return min(found)[1] if found else None

    def _contradiction(self, frames: Sequence[Masks], pairs: Tangency, cameras: Sequence[int]) -> str:
        """Return why the cameras are refused if no majority of them is consistent."""
        names = [self.rig.names[c] for c in cameras]
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
        if len(frames) > 1 and all(np.array_equal(masks, frames[0]) for masks in frames[1:]):
            return f"the masks of {listed} contradict each other, and they never change: do they show the person?"
        error = pairs.apart[np.ix_(cameras, cameras)]
        most = float(np.nanmax(error)) if np.isfinite(error).any() else np.nan
        if most <= TOLERANCE:
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
        return self._mean_outside(views, cameras)

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

    def _odd(self, views: Sequence[tuple[Bool, Hull]], cameras: Sequence[int], total: float) -> int | None:
        """Return the camera without which the other masks lie in each other's hulls; None if there is none.

        ``total`` is the mean share outside with all of them.
        """
        if len(cameras) < 3:
            return None
        without = [self._mean_outside(views, [k for k in cameras if k != c]) for c in cameras]
        if not np.isfinite(without).any():
            return None
        best = int(np.nanargmin(without))
        # with fewer cameras any hull is larger: the camera must stand out from the others' removal
        return cameras[best] if without[best] < _LEFT_OVER * min(total, float(np.nanmedian(without))) else None

    def _mean_outside(self, views: Sequence[tuple[Bool, Hull]], cameras: Sequence[int]) -> float:
        """Return the mean share of the masks outside the hull of the others among these cameras; NaN if unknown."""
        shares = []
        for c in cameras:
            others = [k for k in cameras if k != c]
            if others:
                shares.append(_share_outside(_silhouettes(views, c, others)))
        known = np.isfinite(shares)
        return float(np.array(shares)[known].mean()) if known.any() else float("nan")

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
    return np.asarray(pairs.apart / (TOLERANCE + pairs.pixel[:, None] + pairs.pixel[None]))


def contradicts(pairs: Tangency, camera: int) -> bool:
    """Return whether a camera's silhouette extends beyond that of another one, or is smaller on both sides, as with a
    lens of another focal length."""
    tolerance = (TOLERANCE + pairs.pixel[camera] + pairs.pixel)[:, None]
    error = pairs.error[camera]
    return bool((error > tolerance).any() or (error < -tolerance).all(axis=1).any())


def largest_consistent(error: Float) -> list[int]:
    """Return the largest majority of the tested cameras in which every camera agrees with most of its tested partners.

    Most, not all, because a mask with a fault disagrees with one or two partners, and a wrong camera with most. Of
    several such sets the one with the least errors is returned. None is returned if another set of this size is
    possible in which no pair tests one of the cameras: then none can be blamed.

    Args:
        error: (C, C) in tolerances; NaN where a pair cannot be tested.

    Returns:
        The cameras; empty if there is no such set.
    """
    tested = np.flatnonzero(np.isfinite(error).any(axis=1))
    right, wrong = (error <= 1.0).astype(np.float64), (error > 1.0).astype(np.float64)
    for size in range(len(tested), len(tested) // 2, -1):
        best, least, sets = list[int](), np.inf, combinations(tested.tolist(), size)
        while some := list(islice(sets, _TOGETHER)):  # of 31 cameras, 8 of them wrong, there are 8 million
            chosen = np.array(some)
            member = np.zeros((len(chosen), len(error)))
            np.put_along_axis(member, chosen, 1, axis=1)
            agree, contradict = member @ right, member @ wrong
            possible = ((agree > contradict) | (contradict == 0) | (member == 0)).all(axis=1)
            if not possible.any():
                continue
            if not ((agree > 0) | (member == 0))[possible].all():
                return []
            total = ((member[possible] @ np.nan_to_num(error)) * member[possible]).sum(axis=1)
            if total.min() < least:
                best, least = chosen[possible][np.argmin(total)].tolist(), float(total.min())
        if best:
            return best
    return []
