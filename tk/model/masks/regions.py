"""Decisions on label pictures: penumbrae, shadows, parts of the person, the rim, specks and holes.

Small functions on boolean pictures of one camera; :mod:`tk.model.masks.foreground` puts them in order. Sizes are odd
numbers
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
    few = np.count_nonzero(unsure) < 2**16
    kind = cv2.CV_16U if few else cv2.CV_32S
    count, numbers = cv2.connectedComponents(unsure.view(np.uint8), connectivity=4, ltype=kind)
    regions = np.asarray(numbers).reshape(-1)
    outside = _beside(~(unsure | certain), beyond=1) & unsure
    touching_outside = np.bincount(regions[np.flatnonzero(outside)], minlength=count)
    touching_inside = np.bincount(regions[np.flatnonzero(inside)], minlength=count)
    chosen = touching_inside > share * (touching_inside + touching_outside)
    result = np.zeros(unsure.shape, np.bool_)
    if chosen.any():
        pixels = np.flatnonzero(unsure)
        result.reshape(-1)[pixels] = chosen[regions[pixels]]
    return result


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
    hole: float,
    reach: float,
    width: int,
) -> Images:
    """The parts that are the person, in one piece where that is possible, without small holes.

    Of each picture's 8-connected parts of ``least`` pixels or more the largest stays, and those that hold more than
    three pixels of ``seed`` noise variances: the edges of shadows do not. They are then joined to the nearest other one
    by a bar, where it is no farther than ``reach`` and everything between them was seen to differ from the scene.

    Args:
        mask, seen, statistic: (h, w) of pictures side by side.
        starts: (C,) their first columns.
        hole: smaller holes are filled, pixels.

    Returns:
        (h, w) uint8, 0 or 1.
    """
    contours, inner = _outlines(mask.view(np.uint8))
    areas = np.array([_area(contour) for contour in contours])
    boxes = np.array([cv2.boundingRect(contour) for contour in contours]).reshape(-1, 4)
    picture = np.searchsorted(starts, boxes[:, 0], side="right")
    by_area = np.argsort(areas, kind="stable")
    largest = dict(zip(picture[by_area].tolist(), by_area.tolist(), strict=True)).values()
    others, dropped = [], []  # than the largest
    for k in by_area:
        if areas[k] < least:
            dropped.append(contours[k])
        elif k not in largest:
            part = _filled(contours[k], boxes[k])
            strong = _crop(mask, boxes[k]) & (_crop(statistic, boxes[k]) >= level_of(seed))
            if np.count_nonzero(strong & part) > 3:
                others.append((k, part))
            else:
                dropped.append(contours[k])
    result = mask.view(np.uint8).copy()
    _mend(result, inner, hole, dropped)
    if not others:
        return result
    kept = mask & result.view(np.bool_)
    bounds = [0, *starts[1:].tolist(), mask.shape[1]]
    closing = cv2.morphologyEx((seen | mask).view(np.uint8), cv2.MORPH_CLOSE, _SQUARE3)
    seen_closed = np.asarray(closing, np.uint8)
    bars = False
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
        (ax, ay), (bx, by) = ends
        ends = (ax + left, ay + top), (bx + left, by + top)
        line = cv2.line(np.zeros_like(result), *ends, 1, 1)
        if np.mean(seen_closed[line > 0]) >= _SEEN:
            result |= np.asarray(cv2.line(line, *ends, 1, width), np.uint8) & seen_closed
            bars = True
    if bars:  # may have closed a ring
        _mend(result, _outlines(result)[1], hole, [])
    return result


def _area(contour: NDArray[Any]) -> float:
    """Pixels in an outline, it and its holes included: Pick's theorem for the polygon through their centres."""
    return cv2.contourArea(contour) + len(contour) / 2 + 1


def _filled(contour: NDArray[Any], box: NDArray[np.int32]) -> Mask:
    """(h, w) of its bounding box: what lies in an outline."""
    part = np.zeros((box[3], box[2]), np.uint8)
    cv2.drawContours(part, [contour], 0, 1, cv2.FILLED, offset=(-int(box[0]), -int(box[1])))
    return part.view(np.bool_)


def _crop(mask: NDArray[Any], box: NDArray[np.int32]) -> NDArray[Any]:
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

    What lies inside an outline goes with it.

    Returns:
        (h, w) uint8, 0 or 255.
    """
    clean = mask.view(np.uint8) * np.uint8(255)
    outer, inner = _outlines(clean)
    _mend(clean, inner, hole, [contour for contour in outer if _area(contour) < speck], 255)
    return clean


def _outlines(mask: Images) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Of the 8-connected parts and of the 4-connected holes of a mask (h, w); a hole's runs on the part around it.

    Outlines are short, regions are not.
    """
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parents = hierarchy[0, :, 3].tolist() if len(contours) else []
    outer = [contour for contour, parent in zip(contours, parents, strict=True) if parent < 0]
    return outer, [contour for contour, parent in zip(contours, parents, strict=True) if parent >= 0]


def _mend(mask: Images, holes: list[NDArray[Any]], most: float, dropped: list[NDArray[Any]], value: int = 1) -> None:
    """Fill holes of less than ``most`` pixels in a mask and take parts off it, both given by their outlines."""
    filled = [contour for contour in holes if _area(contour) - len(contour) < most]
    for contour in filled:  # together, those within others would stay open
        cv2.drawContours(mask, [contour], -1, value, cv2.FILLED)
    if dropped:
        cv2.drawContours(mask, dropped, -1, 0, cv2.FILLED)


def trim_rim(mask: Images, contrast: Images, share: float, layers: int) -> Mask:
    """Take pixels off the outline, ``layers`` deep, that have less than a share of the largest contrast near them.

    ``mask`` (h, w) holds 0 and 1.
    """
    size = 2 * layers - 1
    largest = cv2.dilate(contrast, np.ones((size, size), np.uint8))
    strong = (contrast >= cv2.convertScaleAbs(largest, alpha=share)).view(np.uint8) & mask
    for _ in range(layers):
        mask = np.asarray(cv2.max(cv2.erode(mask, _SQUARE3, borderValue=1), strong), np.uint8)
    return mask.view(np.bool_)
