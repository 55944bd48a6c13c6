"""Epipolar tangency: whether two cameras' silhouettes can show the same person at the same time.

A plane through both camera centres that touches the person touches its silhouette in both images (Wong & Cipolla,
*Structure and motion from silhouettes*, ICCV 2001; Boyer, *On using silhouettes for camera calibration*, ACCV 2006). A
pair has two such planes, one on each side of the person. The angle between one camera's plane and the other's, about
the line through both centres, is the error. Nothing else can be learned from two silhouettes without a body. The error
is given at the person, as a share of the person's size, so it does not depend on the unit of the calibration.

A pair cannot be tested if the line through the centres passes near the person: cameras that face each other. A
silhouette that the border of the image cuts is only known to extend at least that far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import PERSON
from tk.model.cameras.camera import Camera
from tk.model.masks.silhouettes import SPECK_SHARE

Float = NDArray[np.float64]
Masks = NDArray[np.uint8]

# Pixels of a mask's largest part, at least: a smaller one has no shape.
_LEAST_PIXELS = 20
# Two cameras are tested if the line through their centres is farther from the middle of the person than this many of
# the person's greatest extents, as seen from either camera: half an extent would touch the silhouette.
_CLEAR_OF_LINE = 0.65
# A tangent beyond this angle about the line is on its other side: the silhouettes have nothing in common.
_OPPOSITE = np.pi / 2


@dataclass(frozen=True)
class Outline:
    """The convex hull of the person's silhouette in one image.

    Attributes:
        rays: (N, 3) unit vectors in the world frame through its corners.
        cut: (N,) whether the corner lies at the border of the image.
        middle: (3,) unit vector, mean of the rays.
        size: rad, greatest angle between two rays.
        pixel: size of a pixel, as a share of ``size``.
    """

    rays: Float
    cut: NDArray[np.bool_]
    middle: Float
    size: float
    pixel: float

    @staticmethod
    def of(camera: Camera, mask: Masks) -> Outline | None:
        """Return the outline in a mask (H, W), which may be larger than the image; None if it shows nobody."""
        shown = np.ascontiguousarray(mask[: camera.height, : camera.width] >= PERSON).view(np.uint8)
        contours, _ = cv2.findContours(shown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        areas = [cv2.contourArea(contour) for contour in contours]
        largest = max(areas, default=0.0)
        if largest < _LEAST_PIXELS:
            return None
        parts = [contour[:, 0] for contour, area in zip(contours, areas, strict=True) if area >= SPECK_SHARE * largest]
        pixels = np.concatenate(parts).astype(np.float64)
        corners = cv2.convexHull(camera.undistort(pixels).astype(np.float32), returnPoints=False)[:, 0]
        last = np.array([camera.width, camera.height]) - 1.0
        cut = ((pixels[corners] < 1) | (pixels[corners] > last - 1)).any(axis=1)
        rays = camera.rays(pixels[corners])
        middle = rays.mean(axis=0)
        size = float(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))
        extent = float(np.linalg.norm(np.ptp(pixels, axis=0)))
        return Outline(rays, cut, middle / np.linalg.norm(middle), size, 1.0 / extent)


@dataclass(frozen=True)
class Tangency:
    """Errors of all pairs of C cameras over several frames.

    Attributes:
        error: (C, C, 2) by how much a camera's silhouette extends beyond the other's on both sides, as a share of the
            person's size, median of the frames; antisymmetric; NaN where a pair cannot be tested.
        pixel: (C,) size of a pixel as a share of the person's size, median of the frames; NaN if a camera sees nobody.
        middle: (C, 3) unit vectors in the world frame from each camera to the person, median of the frames; NaN too.
    """

    error: Float
    pixel: Float
    middle: Float

    @property
    def apart(self) -> Float:
        """(C, C) mean of a pair's errors on both sides, without sign; NaN where a pair cannot be tested.

        A camera that is turned errs on both sides; a mask with a shadow or without a head, on one.
        """
        one, other = np.moveaxis(np.abs(self.error), 2, 0)
        return np.asarray((np.where(np.isnan(one), other, one) + np.where(np.isnan(other), one, other)) / 2)


def tangency(outlines: Sequence[Sequence[Outline | None]], centers: Float) -> Tangency:
    """Return the errors of all pairs. A pair is tested if most of the frames allow it.

    Args:
        outlines: C of each frame; None where a camera sees nobody.
        centers: (C, 3) the cameras' centres.
    """
    C = len(centers)
    error = np.full((len(outlines), C, C, 2), np.nan)
    pixel, middle = np.full((len(outlines), C), np.nan), np.full((len(outlines), C, 3), np.nan)
    for f, seen in enumerate(outlines):
        for a, first in enumerate(seen):
            if first is None:
                continue
            pixel[f, a], middle[f, a] = first.pixel, first.middle
            for b in range(a):
                second = seen[b]
                if second is not None:
                    error[f, a, b] = pair_error(first, second, centers[b] - centers[a])
                    error[f, b, a] = -error[f, a, b]
    most = np.isfinite(error).sum(axis=0) > len(outlines) / 2
    toward = _median(middle)
    return Tangency(
        error=np.where(most, _median(error), np.nan),
        pixel=_median(pixel),
        middle=toward / np.linalg.norm(toward, axis=1, keepdims=True),
    )


def pair_error(first: Outline, second: Outline, baseline: Float) -> Float:
    """Return (2,) by how much the first outline extends beyond the second on each side of the epipolar pencil.

    Args:
        first, second: outlines in the same frame.
        baseline: (3,) from the first camera's centre to the second's, any length above zero.

    Returns:
        Shares of the person's size; NaN where the pair cannot be tested.
    """
    length = float(np.linalg.norm(baseline))
    if length == 0.0:
        return np.full(2, np.nan)
    axis = baseline / length
    for outline in (first, second):
        if np.arccos(min(abs(float(outline.middle @ axis)), 1.0)) < _CLEAR_OF_LINE * outline.size:
            return np.full(2, np.nan)
    across = first.middle - (first.middle @ axis) * axis
    across /= np.linalg.norm(across)
    beside = np.cross(axis, across)
    angles = [np.arctan2(outline.rays @ beside, outline.rays @ across) for outline in (first, second)]
    result = np.full(2, np.nan)
    for side, sign in enumerate((1.0, -1.0)):
        i, j = (int(np.argmax(sign * angle)) for angle in angles)
        beyond = float(sign * (angles[0][i] - angles[1][j]))
        if (first.cut[i] and beyond < 0) or (second.cut[j] and beyond > 0):
            continue  # the cut silhouette may extend as far as the other
        # an angle about the baseline is a distance at the person: times the sine of the ray's angle from the baseline
        sines = [np.sqrt(max(1.0 - float(ray @ axis) ** 2, 0.0)) for ray in (first.rays[i], second.rays[j])]
        scale = (sines[0] / first.size + sines[1] / second.size) / 2
        result[side] = scale * np.sin(np.clip(beyond, -_OPPOSITE, _OPPOSITE))
    return result


def _median(values: Float) -> Float:
    """Return the median of the finite values along the first axis; NaN where there is none."""
    found = np.isfinite(values).any(axis=0)
    return np.asarray(np.nanmedian(np.where(found, values, 0.0), axis=0)) * np.where(found, 1.0, np.nan)
