"""Find a part of the recording in which nobody is in any picture.

A part without motion may also show somebody who stands still. The outline of the difference between such a part and
the images with motion decides: where somebody was there and left, the still image has the outline, and the images with
motion have the background.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.synchronise.looks import DIFFERS, GRID_HZ, SOMEBODY, Look
from tk.synchronise.ties import Clocks

Float = NDArray[np.float64]

#: least length of the empty part, and what is left off at each end, seconds
_LEAST_S, _MARGIN_S = 1.5, 0.2
#: images with motion that are compared with the still one; share of them that must show the outline
_SAMPLES, _CLEAR = 24, 0.8
#: by how much stronger the outline is in the images with motion than in the still one
_STRONGER = 1.5


def find_empty(looks: Sequence[Look], clocks: Clocks) -> tuple[float, float] | None:
    """Return the common time at which the longest empty part begins and ends, seconds; None if none is certain."""
    begin = max(clocks.common(c, float(look.times_s[0])) for c, look in enumerate(looks))
    end = min(clocks.common(c, float(look.times_s[-1])) for c, look in enumerate(looks))
    clock = np.arange(begin, end, 1 / GRID_HZ)
    if len(clock) < 2 * _LEAST_S * GRID_HZ:
        return None
    moving = np.zeros(len(clock), np.bool_)
    for c, look in enumerate(looks):
        at = np.asarray([clocks.common(c, float(time)) for time in look.middles_s])
        step = np.clip(np.rint((at - begin) * GRID_HZ).astype(int), 0, len(clock) - 1)
        np.logical_or.at(moving, step, (look.moving > SOMEBODY) & (at > begin - 0.05) & (at < end + 0.05))
    if not moving.any():
        return None
    for first, end in runs(~moving):
        start, stop = clock[first] + _MARGIN_S, clock[end - 1] - _MARGIN_S
        if stop - start >= _LEAST_S and all(
            _is_empty(look, (np.array([start, stop]) - clocks.offsets_s[c]) / clocks.rates[c])
            for c, look in enumerate(looks)
        ):
            return float(start), float(stop)
    return None


def runs(still: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the indices at which runs of True begin and end, the longest run first."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return sorted(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True), key=lambda run: run[0] - run[1])


def _is_empty(look: Look, span: Float) -> bool:
    """Return whether somebody who is seen elsewhere is missing between two own times of a recording."""
    inside = (look.times_s >= span[0]) & (look.times_s <= span[1])
    if inside.sum() < 3:
        return False
    still = np.median(look.greys[inside][:: max(1, int(inside.sum()) // 15)], axis=0).astype(np.float32)
    busy = np.flatnonzero((look.moving > SOMEBODY) & ~inside[1:])
    if len(busy) < 3:
        return False
    chosen = busy[np.unique(np.linspace(0, len(busy) - 1, _SAMPLES).round().astype(int))]
    clear = [_outlined(look.greys[k + 1].astype(np.float32), still) for k in chosen]
    return float(np.mean(clear)) >= _CLEAR


def _outlined(image: Float | NDArray[np.float32], still: NDArray[np.float32]) -> bool:
    """Return whether an image differs from the still one by something that has its outline in the image."""
    difference = image - still
    difference = difference - np.median(difference)
    mask = (cv2.GaussianBlur(np.abs(difference), (0, 0), 1.0) > DIFFERS).astype(np.uint8)
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)), np.uint8)
    if mask.mean() < SOMEBODY:
        return False
    border = (cv2.dilate(mask, np.ones((3, 3), np.uint8)) - cv2.erode(mask, np.ones((3, 3), np.uint8))) > 0
    there, before = _slope(image)[border].mean(), _slope(still)[border].mean()
    return bool(there > _STRONGER * before)


def _slope(image: NDArray[np.float32] | Float) -> Float:
    return np.asarray(
        np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3)), np.float64
    )
