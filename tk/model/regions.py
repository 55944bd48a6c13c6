"""Decisions on label pictures: penumbrae, shadows, parts of the person, the rim, specks and holes.

Small functions on boolean pictures of one camera; :mod:`tk.model.foreground` puts them in order. Sizes are odd numbers
of pixels of the picture that is given.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.background import STEPS_PER_OCTAVE, level_of

Mask = NDArray[np.bool_]
Images = NDArray[np.uint8]

_SQUARE3 = np.ones((3, 3), np.uint8)
_SQUARE5 = np.ones((5, 5), np.uint8)
_CROSS3 = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def without_penumbrae(
    labels: Mask, difference: Images, collinearity: Images, penumbra: float, core: float
) -> tuple[Mask, Mask]:
    """Split what differs from the scene into certain foreground and what may be a shadow (both (h, w) bool).

    The edge of a shadow is thin or its statistic is below ``core`` noise variances, and it is below a share
    ``penumbra`` of the plain difference nearby.
    """
    strong = labels & (collinearity >= level_of(core))
    thick = cv2.morphologyEx(strong.view(np.uint8), cv2.MORPH_OPEN, _SQUARE5).view(np.bool_)
    levels = round(-STEPS_PER_OCTAVE * np.log2(penumbra))
    blurred = cv2.add(collinearity, levels) < cv2.dilate(difference, _SQUARE5)
    certain = labels & (thick | ~blurred)
    return certain, (difference > 0) & ~certain


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
    """The 4-connected regions of ``unsure`` whose border touches ``certain`` more than the share allows."""
    count, regions = cv2.connectedComponents(unsure.view(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    background = (~(unsure | certain)).view(np.uint8)
    outside = cv2.dilate(background, _CROSS3, borderType=cv2.BORDER_CONSTANT, borderValue=1).view(np.bool_)
    inside = cv2.dilate(certain.view(np.uint8), _CROSS3).view(np.bool_)
    touching_outside = np.bincount(regions[unsure & outside], minlength=count)
    touching_inside = np.bincount(regions[unsure & inside], minlength=count)
    chosen = touching_inside > share * (touching_inside + touching_outside)
    chosen[0] = False
    return chosen[regions]


def closed(mask: Mask, size: int) -> Mask:
    """Morphological closing with a square of this size, as if nothing lay outside."""
    framed = cv2.copyMakeBorder(mask.view(np.uint8), size, size, size, size, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    return np.ascontiguousarray(closed[size:-size, size:-size]).view(np.bool_)


def joined(mask: Mask, seen: Mask, statistic: Images, seed: float, least: float, reach: float, width: int) -> Mask:
    """The parts that are the person, in one piece where that is possible.

    Of the 8-connected parts the largest stays, and those that hold more than three pixels of ``seed`` noise variances:
    the edges of shadows do not. Those of ``least`` pixels or more are then joined to the nearest other one by a bar,
    where it is no farther than ``reach`` and everything between them was seen to differ from the scene.
    """
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    if count <= 2:
        return mask
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    keep = np.bincount(parts[mask & (statistic >= level_of(seed))], minlength=count) > 3
    keep[np.argmax(areas)] = True
    keep[0] = False
    result = keep[parts].view(np.uint8)
    large = keep & (areas >= least)
    order = np.flatnonzero(large)[np.argsort(areas[large], kind="stable")]
    if len(order) > 1:
        seen_closed = cv2.morphologyEx((seen | mask).view(np.uint8), cv2.MORPH_CLOSE, _SQUARE3)
    for part in order[:-1]:
        ends = _shortest(parts == part, large[parts] & (parts != part), reach)
        if ends is None:
            continue
        line = cv2.line(np.zeros_like(result), *ends, 1, 1)
        if np.mean(seen_closed[line > 0]) >= _SEEN:
            result |= cv2.line(line, *ends, 1, width) & seen_closed
    return result.view(np.bool_)


_SEEN = 0.9
"""Share of a joining line that must differ from the scene; the rest is for noise."""


def _shortest(part: Mask, others: Mask, reach: float) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """The two ends (x, y) of a shortest line from a part to the others; None where it is longer than ``reach``."""
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

    Works on outlines, which are short, not on regions: Pick's theorem turns the polygon through the outline's pixel
    centres into a count of pixels. The outline of a hole runs on the foreground around it. What lies inside an outline
    goes with it.

    Returns:
        (h, w) uint8, 0 or 255.
    """
    clean = mask.view(np.uint8) * np.uint8(255)
    contours, hierarchy = cv2.findContours(clean, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    specks = []
    for contour, (_, _, _, parent) in zip(contours, hierarchy[0] if len(contours) else (), strict=True):
        area, half_length = cv2.contourArea(contour), len(contour) / 2
        if parent < 0 and area + half_length + 1 < speck:
            specks.append(contour)
        elif parent >= 0 and area - half_length + 1 < hole:
            cv2.drawContours(clean, [contour], -1, 255, cv2.FILLED)
    if specks:
        cv2.drawContours(clean, specks, -1, 0, cv2.FILLED)
    return clean


def trim_rim(mask: Mask, contrast: Images, share: float, layers: int) -> Mask:
    """Take pixels off the outline, ``layers`` deep, that have less than a share of the largest contrast near them."""
    size = 2 * layers - 1
    weak = contrast < share * cv2.dilate(contrast, np.ones((size, size), np.uint8))
    for _ in range(layers):
        inside = cv2.erode(mask.view(np.uint8), _SQUARE3, borderValue=1).view(np.bool_)
        mask = mask & (inside | ~weak)
    return mask
