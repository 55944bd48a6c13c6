"""Find the video that starts late or early from masks: at which shift do they lie in the hull of the others?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tk.model.hull.coarse import Hull
from tk.model.masks.mask_agreement import Agreement, MaskAgreement

#: largest shift of a video that is compared, frames; at the edge it is no optimum
REACH = 6
#: a video is delayed if shifting it reduces the share of its masks outside the hull to less than this share of itself,
#: and that share without a shift is larger than the second value
_DELAY_GAIN, _DELAY_LEAST = 0.5, 0.01


def find_delays(
    compare: MaskAgreement, masks: dict[int, NDArray[np.uint8]], centers: Sequence[int], agreement: Agreement
) -> tuple[NDArray[np.int64], bool]:
    """Return the delay of each camera (C,) frames, the shift with which its masks lie in the hull of the others; and
    whether it is certain, see :func:`best_shift`."""
    C = len(compare.rig)
    small = {index: compare.small(m) for index, m in masks.items()}
    hulls = compare.hulls([compare.possible(masks[i]) for i in centers])
    shifts = np.arange(-REACH, REACH + 1)
    late = np.zeros(C, np.int64)
    found = [
        best_shift(*_areas_by_shift(small, centers, hulls, [k for k in agreement.right if k != c], c, shifts))
        for c in range(C)
    ]
    # a delayed camera also spoils the hulls for the others, which then gain from a shift, too; only the shift of the
    # delayed one makes all cameras agree
    candidates = [c for c, (shift, *_) in enumerate(found) if shift]
    if not candidates:
        return late, True

    def outside(c: int) -> float:
        pairs = [(masks[i], masks[i + found[c][0]]) for i in centers if i + found[c][0] in masks]
        this = np.arange(C)[:, None, None] == c
        return compare.mean_outside([np.where(this, shifted, now) for now, shifted in pairs], agreement.right)

    c = min(candidates, key=outside)
    late[c] = -found[c][0]
    return late, found[c][2]


def best_shift(outside: NDArray[np.float64], area: NDArray[np.float64]) -> tuple[int, float, bool]:
    """Return the shift that moves a camera's masks into the hull of the others, frames; by how much the share outside
    falls; and whether it is the same, to a frame, and not 0, without any one of the frames (jackknife). 0, 0.0 if none
    does: a shift at the edge of the range is no optimum.

    Args:
        outside, area: (N, S) area outside the hull and whole area, of N frames and shifts from -S // 2 to S // 2.
    """
    total = np.array([outside, area])
    result = _lowest(*total.sum(axis=1))
    rest = [_lowest(*np.delete(total, k, axis=1).sum(axis=1))[0] for k in range(len(area))]
    return *result, all(abs(shift - result[0]) <= 1 and np.sign(shift) == np.sign(result[0]) for shift in rest)


def _lowest(outside: NDArray[np.float64], area: NDArray[np.float64]) -> tuple[int, float]:
    share = np.where(area > 0, outside / np.maximum(area, 1), np.inf)
    best, middle = int(np.argmin(share)), len(share) // 2
    now, least = float(share[middle]), float(share[best])
    inside = 0 < best < len(share) - 1
    mended = _DELAY_LEAST < now < np.inf and least < _DELAY_GAIN * now
    return (best - middle, now - least) if inside and mended else (0, 0.0)


def _areas_by_shift(
    small: dict[int, NDArray[np.bool_]],
    centers: Sequence[int],
    hulls: Sequence[Hull | None],
    others: Sequence[int],
    camera: int,
    shifts: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return (2, N, S) the area of a camera's masks outside the others' hull and their whole area, in N frames, for
    masks taken S shifts later."""
    areas = np.zeros((2, len(centers), len(shifts)))
    for n, (center, hull) in enumerate(zip(centers, hulls, strict=True)):
        # all shifts or none, so that they are compared over the same frames
        if hull is None or any(center + int(s) not in small for s in shifts):
            continue
        silhouette = hull.silhouette(hull.carve(others), camera)
        for i, s in enumerate(shifts):
            mask = small[center + int(s)][camera]
            areas[:, n, i] = np.count_nonzero(mask & ~silhouette), mask.sum()
    return areas


def in_frames(late: int) -> str:
    """Return the delay as text, "2 frames late"."""
    return f"{abs(late)} frame{'s' if abs(late) > 1 else ''} {'late' if late > 0 else 'early'}"
