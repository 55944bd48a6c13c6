"""Decisions on label pictures: penumbrae, shadows, parts of the person, the rim, specks and holes.

Small functions on boolean pictures of one camera; :mod:`tk.model.foreground` puts them in order. Sizes are odd numbers
of pixels of the picture that is given.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.background import STEPS_PER_OCTAVE, level_of

Mask = NDArray[np.bool_]
Images = NDArray[np.uint8]

_SQUARE3 = np.ones((3, 3), np.uint8)
_SQUARE5 = np.ones((5, 5), np.uint8)
_CROSS3 = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def without_penumbrae(labels: Mask, difference: Images, collinearity: Images, penumbra: float, core: float) -> Mask:
    """The labels (h, w) that are certain foreground: no edge of a shadow.

    The edge of a shadow is thin or its statistic is below ``core`` noise variances, and it is below a share
    ``penumbra`` of the plain difference nearby.
    """
    strong = labels & (collinearity >= level_of(core))
    thick = cv2.morphologyEx(strong.view(np.uint8), cv2.MORPH_OPEN, _SQUARE5).view(np.bool_)
    levels = round(-STEPS_PER_OCTAVE * np.log2(penumbra))
    blurred = cv2.add(collinearity, levels) < cv2.dilate(difference, _SQUARE5)
    return np.asarray(labels & (thick | ~blurred))


def beyond_shadows(unsure: Mask, certain: Mask, dark: Mask, width: int, share: float) -> Mask:
    """The part of ``unsure`` that no shadow explains: too faint for a shadow, too far from one for its penumbra.

    Args:
        unsure, certain: disjoint labels.
        dark: where the picture is as dark as a shadow makes it.
        width: the farthest that a penumbra reaches, pixels across.
        share: of their border, by which such regions must touch certain foreground.
    """
    shadow = cv2.morphologyEx((dark & unsure).view(np.uint8), cv2.MORPH_OPEN, _SQUARE3)
    reach = cv2.dilate(shadow, np.ones((width, width), np.uint8)).view(np.bool_)
    # closed: where the picture passes from darker to brighter than the scene it equals the scene on a line
    seen = cv2.morphologyEx((unsure | certain).view(np.uint8), cv2.MORPH_CLOSE, _SQUARE3).view(np.bool_)
    faint = seen & ~reach & ~certain
    # the window widens the outline by a pixel or two: no evidence of anything
    thick = cv2.morphologyEx(faint.view(np.uint8), cv2.MORPH_OPEN, _SQUARE3).view(np.bool_)
    return enclosed(thick, certain, share)


def enclosed(unsure: Mask, certain: Mask, share: float) -> Mask:
    """The 4-connected regions of ``unsure`` whose border touches ``certain`` more than the share allows.

    Four neighbours, not eight: a grey cloth that touches its shadow at a corner is not the shadow.
    """
    inside = _beside(certain) & unsure
    if not inside.any():
        return np.zeros_like(unsure)
    count, numbers = cv2.connectedComponents(unsure.view(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    regions = np.asarray(numbers, np.int32)
    outside = _beside(~(unsure | certain), beyond=1) & unsure
    touching_outside = np.bincount(regions[outside], minlength=count)
    touching_inside = np.bincount(regions[inside], minlength=count)
    chosen = touching_inside > share * (touching_inside + touching_outside)
    chosen[0] = False
    return chosen.take(regions)


def _beside(mask: Mask, beyond: int = 0) -> Mask:
    """Where a pixel or one of its four neighbours is set; ``beyond``: what lies outside the picture."""
    grown = cv2.dilate(mask.view(np.uint8), _CROSS3, borderType=cv2.BORDER_CONSTANT, borderValue=beyond)
    return np.asarray(grown, np.uint8).view(np.bool_)


def closed(mask: Mask, size: int) -> Mask:
    """Morphological closing with a square of this size, as if nothing lay outside."""
    framed = cv2.copyMakeBorder(mask.view(np.uint8), size, size, size, size, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    return np.ascontiguousarray(closed[size:-size, size:-size]).view(np.bool_)


def joined(
    mask: Mask,
    seen: Mask,
    statistic: Images,
    starts: NDArray[np.integer],
    *,
    seed: float,
    least: float,
    reach: float,
    width: int,
) -> Mask:
    """The parts that are the person, in one piece where that is possible.

    Of each picture's 8-connected parts the largest stays, and those that hold more than three pixels of ``seed`` noise
    variances: the edges of shadows do not. Those of ``least`` pixels or more are then joined to the nearest other one
    by a bar, where it is no farther than ``reach`` and everything between them was seen to differ from the scene.

    Args:
        mask, seen, statistic: (h, w) of pictures side by side.
        starts: (C,) their first columns.
    """
    contours, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if len(contours) <= 1:
        return mask
    areas = np.array([_area(contour) for contour in contours])
    boxes = np.array([cv2.boundingRect(contour) for contour in contours])
    picture = np.searchsorted(starts, boxes[:, 0], side="right")
    by_area = np.argsort(areas, kind="stable")
    largest = dict(zip(picture[by_area].tolist(), by_area.tolist(), strict=True)).values()
    strong = mask & (statistic >= level_of(seed))
    others = []  # than the largest
    for k in by_area[areas[by_area] >= least]:
        if k not in largest:
            part = _filled(contours[k], boxes[k])
            if np.count_nonzero(_crop(strong, boxes[k]) & part) > 3:
                others.append((k, part))
    result = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(result, [contours[k] for k in (*largest, *(k for k, _ in others))], -1, 1, cv2.FILLED)
    kept = result.view(np.bool_) & mask
    result &= mask
    seen_closed: Images | None = None
    bounds = [0, *starts[1:].tolist(), mask.shape[1]]
    for k, part in others:
        x, y, w, h = boxes[k].tolist()
        margin = int(reach) + 1  # nothing farther matters
        left, right = max(x - margin, bounds[picture[k] - 1]), min(x + w + margin, bounds[picture[k]])
        top, bottom = max(y - margin, 0), y + h + margin
        near = kept[top:bottom, left:right].copy()
        here = np.zeros_like(near)
        here[y - top : y - top + h, x - left : x - left + w] = part
        ends = _shortest(here & near, near & ~here, reach)
        if ends is None:
            continue
        if seen_closed is None:
            closing = cv2.morphologyEx((seen | mask).view(np.uint8), cv2.MORPH_CLOSE, _SQUARE3)
            seen_closed = np.asarray(closing, np.uint8)
        (ax, ay), (bx, by) = ends
        ends = (ax + left, ay + top), (bx + left, by + top)
        line = cv2.line(np.zeros_like(result), *ends, 1, 1)
        if np.mean(seen_closed[line > 0]) >= _SEEN:
            result |= np.asarray(cv2.line(line, *ends, 1, width), np.uint8) & seen_closed
    return result.view(np.bool_)


def _area(contour: NDArray[Any]) -> float:
    """Pixels in an outline, it and its holes included: Pick's theorem for the polygon through their centres."""
    return cv2.contourArea(contour) + len(contour) / 2 + 1


def _filled(contour: NDArray[Any], box: NDArray[np.int32]) -> Mask:
    """(h, w) of its bounding box: what lies in an outline."""
    part = np.zeros((box[3], box[2]), np.uint8)
    cv2.drawContours(part, [contour], 0, 1, cv2.FILLED, offset=(-int(box[0]), -int(box[1])))
    return part.view(np.bool_)


def _crop(mask: Mask, box: NDArray[np.int32]) -> Mask:
    x, y, w, h = box
    return mask[y : y + h, x : x + w]


_SEEN = 0.9
"""Share of a joining line that must differ from the scene; the rest is for noise."""


def _shortest(part: Mask, others: Mask, reach: float) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """The two ends (x, y) of a shortest line from a part to the others; None where it is longer than ``reach``."""
    if not others.any():
        return None
    distance, nearest = cv2.distanceTransformWithLabels(
        (~others).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(part)
    lengths = distance[rows, columns]
    shortest = np.flatnonzero(lengths == lengths.min())
    k = shortest[len(shortest) // 2]  # the middle of a straight end
    if distance[rows[k], columns[k]] > reach:
        return None
    to = np.argwhere((nearest == nearest[rows[k], columns[k]]) & others)[0]
    return (int(columns[k]), int(rows[k])), (int(to[1]), int(to[0]))


def clean_by_area(mask: Mask, speck: float, hole: float) -> Images:
    """Drop foreground (8-connected) of less than ``speck`` pixels, fill holes (4-connected) of less than ``hole``.

    Works on outlines, which are short, not on regions. The outline of a hole runs on the foreground around it. What
    lies inside an outline goes with it.

    Returns:
        (h, w) uint8, 0 or 255.
    """
    clean = mask.view(np.uint8) * np.uint8(255)
    contours, hierarchy = cv2.findContours(clean, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    specks = []
    for contour, (_, _, _, parent) in zip(contours, hierarchy[0] if len(contours) else (), strict=True):
        if parent < 0 and _area(contour) < speck:
            specks.append(contour)
        elif parent >= 0 and _area(contour) - len(contour) < hole:
            cv2.drawContours(clean, [contour], -1, 255, cv2.FILLED)
    if specks:
        cv2.drawContours(clean, specks, -1, 0, cv2.FILLED)
    return clean


def trim_rim(mask: Mask, contrast: Images, share: float, layers: int) -> Mask:
    """Take pixels off the outline, ``layers`` deep, that have less than a share of the largest contrast near them."""
    size = 2 * layers - 1
    largest = cv2.dilate(contrast, np.ones((size, size), np.uint8))
    weak = contrast < cv2.convertScaleAbs(largest, alpha=share)
    for _ in range(layers):
        inside = cv2.erode(mask.view(np.uint8), _SQUARE3, borderValue=1).view(np.bool_)
        mask = mask & (inside | ~weak)
    return mask
