"""Decisions on label images: penumbrae, regions that may be shadow, parts of the person, the rim, specks and holes.

:mod:`tk.model.masks.foreground` calls these functions in order, on one image or on several side by side. Sizes are odd
numbers of pixels.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.background import STEPS_PER_OCTAVE, level_of

Mask = NDArray[np.bool_]
Images = NDArray[np.uint8]
Single = NDArray[np.float32]

SQUARE3 = np.ones((3, 3), np.uint8)
SQUARE5 = np.ones((5, 5), np.uint8)
_CROSS3 = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def without_penumbrae(labels: Mask, difference: Images, collinearity: Images, penumbra: float, core: float) -> Mask:
    """Return the labels (h, w) that are no edge of a shadow.

    An edge of a shadow is thin, or its statistic is below ``core`` noise variances; and its statistic is below a share
    ``penumbra`` of the plain difference nearby.
    """
    strong = labels & (collinearity >= level_of(core))
    thick = cv2.morphologyEx(strong.view(np.uint8), cv2.MORPH_OPEN, SQUARE5).view(np.bool_)
    levels = round(-STEPS_PER_OCTAVE * np.log2(penumbra))
    blurred = cv2.add(collinearity, levels) < cv2.dilate(difference, SQUARE5)
    return np.asarray(labels & (thick | ~blurred))


def shadow_evidence(
    image: Single,
    scene: Single,
    pixels: NDArray[np.intp],
    shape: tuple[int, int],
    noise: Single,
    darkest: float,
    size: int,
) -> Single:
    """Return by how much likelier the square around each of some pixels shows the scene in a shadow than cloth, (N,)
    nats.

    A shadow shows the scene's own structure, darker; cloth does not. So the difference of two neighbouring pixels is
    that of the scene times the factor of the shadow, or it does not depend on the scene. Each explanation leaves a
    residual. Its variance is unknown, but at least that of the noise: an outline of the shadow, folds and patterns
    contradict both. Then the logarithms of the likelihoods differ by half the number of differences times that of the
    ratio of the variances. The differences along rows and along columns repeat each other, and count half.

    Args:
        image, scene: (N,) brightness of the pixels, those that may be shadow or cloth.
        pixels: (N,) their flat indices in an image of this shape, ascending, none in its last row or column.
        shape: (h, w).
        noise: (N,) variance of the image's brightness.
        darkest: least factor of a shadow.
        size: of the square, pixels, odd.
    """
    number = np.full(shape[0] * shape[1], -1, np.int32)
    number[pixels] = np.arange(len(pixels), dtype=np.int32)
    sums = np.zeros((4, *shape), np.float32)  # differences; shown², shown times scene, scene²
    for away in (1, shape[1]):
        beside = number.take(pixels + away)
        first = np.flatnonzero(beside >= 0)
        second = beside[first]
        shown, expected = image[second] - image[first], scene[second] - scene[first]
        each = np.ones_like(shown), shown * shown, shown * expected, expected * expected
        for total, values in zip(sums.reshape(4, -1), each, strict=True):
            total[pixels[first]] += values
    squares = (cv2.boxFilter(one, -1, (size, size), normalize=False) for one in sums)
    count, of_image, common, of_scene = (np.asarray(one).reshape(-1).take(pixels) for one in squares)
    factor = np.clip(common / np.maximum(of_scene, np.float32(1e-3)), darkest, 1.0)
    left = np.maximum(of_image - factor * (2.0 * common - factor * of_scene), 0.0)
    floor = 2.0 * noise * count + np.float32(1e-3)
    return np.asarray(count / 4 * np.log((of_image + floor) / (left + floor)), np.float32)


def enclosed(unsure: Mask, certain: Mask, share: float) -> Mask:
    """Return the 4-connected regions of ``unsure`` that touch ``certain`` with more than this share of their border.

    With four neighbours, not eight, grey cloth and the shadow that touches it at a corner are two regions.
    """
    inside = _with_neighbours(certain) & unsure
    if not inside.any():
        return np.zeros_like(unsure)
    few = np.count_nonzero(unsure) < 2**16
    kind = cv2.CV_16U if few else cv2.CV_32S
    count, numbers = cv2.connectedComponents(unsure.view(np.uint8), connectivity=4, ltype=kind)
    regions = np.asarray(numbers).reshape(-1)
    outside = _with_neighbours(~(unsure | certain), beyond=1) & unsure
    touching_outside = np.bincount(regions[np.flatnonzero(outside)], minlength=count)
    touching_inside = np.bincount(regions[np.flatnonzero(inside)], minlength=count)
    chosen = touching_inside > share * (touching_inside + touching_outside)
    result = np.zeros(unsure.shape, np.bool_)
    if chosen.any():
        pixels = np.flatnonzero(unsure)
        result.reshape(-1)[pixels] = chosen[regions[pixels]]
    return result


def _with_neighbours(mask: Mask, beyond: int = 0) -> Mask:
    """Return where a pixel or one of its four neighbours is set; pixels outside the image count as ``beyond``."""
    grown = cv2.dilate(mask.view(np.uint8), _CROSS3, borderType=cv2.BORDER_CONSTANT, borderValue=beyond)
    return np.asarray(grown, np.uint8).view(np.bool_)


def closed(mask: Mask, size: int) -> Mask:
    """Return the morphological closing with a square of this size; pixels outside the image count as 0."""
    framed = cv2.copyMakeBorder(mask.view(np.uint8), size, size, size, size, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    return np.ascontiguousarray(closed[size:-size, size:-size]).view(np.bool_)


def person_parts(mask: Mask, statistic: Images, starts: NDArray[np.integer], seed: float, area_min: float) -> Images:
    """Return the parts of the mask that belong to the person, without small holes.

    In each image these are the largest 8-connected part, and the other parts of ``area_min`` pixels or more that
    contain pixels of a strong statistic. The edges of shadows do not.

    Args:
        mask, statistic: (h, w), the images of all cameras side by side.
        starts: (C,), the first column of each image.
        seed: strong statistic, noise variances.
        area_min: smaller parts are removed and smaller holes filled, pixels.

    Returns:
        (h, w) uint8, 0 or 1.
    """
    outlines, holes = _outlines(mask.view(np.uint8))
    large, dropped = _by_size(outlines, area_min)
    boxes = np.array([cv2.boundingRect(outline) for outline in large]).reshape(-1, 4)
    image = np.searchsorted(starts, boxes[:, 0], side="right")
    by_area = np.argsort([_area(outline) for outline in large], kind="stable")
    largest = set(dict(zip(image[by_area].tolist(), by_area.tolist(), strict=True)).values())
    for k, outline in enumerate(large):
        if k not in largest and not _is_strong(outline, boxes[k], mask, statistic, seed):
            dropped.append(outline)
    result = mask.view(np.uint8).copy()
    _mend(result, holes, area_min, dropped, 1)
    return result


def _is_strong(outline: NDArray[Any], box: NDArray[np.int_], mask: Mask, statistic: Images, seed: float) -> bool:
    """Return whether a pixel of the part within an outline has a strong statistic."""
    x, y, w, h = box
    here = slice(y, y + h), slice(x, x + w)
    strong = mask[here] & (statistic[here] >= level_of(seed))
    if not strong.any():
        return False
    part = np.zeros((h, w), np.uint8)
    cv2.drawContours(part, [outline], 0, 1, cv2.FILLED, offset=(-int(x), -int(y)))
    return bool((strong & part.view(np.bool_)).any())


def _by_size(outlines: list[NDArray[Any]], least: float) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Return the outlines with an area of ``least`` pixels or more, and the others."""
    large: list[NDArray[Any]] = []
    small: list[NDArray[Any]] = []
    for outline in outlines:
        count = len(outline)  # a circle of as many diagonal steps has the largest area
        is_large = count**2 / (2 * math.pi) + count / 2 + 1 >= least and _area(outline) >= least
        (large if is_large else small).append(outline)
    return large, small


def _area(outline: NDArray[Any]) -> float:
    """Return the pixels within an outline, with itself and its holes: Pick's theorem for the polygon of its centres."""
    return cv2.contourArea(outline) + len(outline) / 2 + 1


def clean_by_area(mask: Mask, speck: float, hole: float, relative: bool = False) -> Images:
    """Remove parts (8-connected) of less than ``speck`` pixels and fill holes (4-connected) of less than ``hole``.

    A part is removed with everything inside its outline. ``relative``: the sizes are shares of the largest part's area.

    Returns:
        (h, w) uint8, 0 or 255.
    """
    clean = mask.view(np.uint8) * np.uint8(255)
    outer, inner = _outlines(clean)
    unit = max(map(_area, outer), default=1.0) if relative else 1.0
    _mend(clean, inner, hole * unit, _by_size(outer, speck * unit)[1], 255)
    return clean


def _outlines(mask: Images) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Return the outlines of the 8-connected parts and of the 4-connected holes of a mask (h, w).

    The outline of a hole runs on the part around it.
    """
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parents = hierarchy[0, :, 3].tolist() if len(contours) else []
    outer = [contour for contour, parent in zip(contours, parents, strict=True) if parent < 0]
    return outer, [contour for contour, parent in zip(contours, parents, strict=True) if parent >= 0]


def _mend(mask: Images, holes: list[NDArray[Any]], hole_min: float, dropped: list[NDArray[Any]], value: int) -> None:
    """Fill holes of less than ``hole_min`` pixels with ``value`` and clear the dropped parts, all given by outlines."""
    for contour in holes:
        if _area(contour) - len(contour) < hole_min:  # one at a time: drawn together, a hole inside a hole stays open
            cv2.drawContours(mask, [contour], -1, value, cv2.FILLED)
    if dropped:
        cv2.drawContours(mask, dropped, -1, 0, cv2.FILLED)


def trim_rim(mask: Images, contrast: Images, share: float, layers: int) -> Mask:
    """Remove pixels up to ``layers`` deep in the outline whose contrast is below a share of the largest one nearby.

    ``mask`` (h, w) is 0 or 1.
    """
    size = 2 * layers - 1
    largest = cv2.dilate(contrast, np.ones((size, size), np.uint8))
    strong = (contrast >= cv2.convertScaleAbs(largest, alpha=share)).view(np.uint8) & mask
    for _ in range(layers):
        mask = np.asarray(cv2.max(cv2.erode(mask, SQUARE3, borderValue=1), strong), np.uint8)
    return mask.view(np.bool_)
