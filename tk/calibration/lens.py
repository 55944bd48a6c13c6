"""Lens models. Intrinsics are one vector: fx, fy, cx, cy, then the distortion.

The distortion is in OpenCV's order: k1 k2 p1 p2 k3 (pinhole5), with k4 k5 k6 (pinhole8), or k1 to k4 (fisheye).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """A lens model."""

    name: str
    names: tuple[str, ...]  # names of the distortion's numbers
    fisheye: bool = False

    @property
    def size(self) -> int:
        """Number of intrinsics."""
        return 4 + len(self.names)

    @property
    def sigmas(self) -> Float:
        """(K - 4,) standard deviations of the priors of the distortion's numbers about 0."""
        return np.array([RADIAL_SIGMA if name.startswith("k") else TANGENTIAL_SIGMA for name in self.names])


PINHOLE5 = Model("pinhole5", ("k1", "k2", "p1", "p2", "k3"))
PINHOLE8 = Model("pinhole8", (*PINHOLE5.names, "k4", "k5", "k6"))
FISHEYE = Model("fisheye", ("k1", "k2", "k3", "k4"), fisheye=True)

#: models to choose from, the one with fewer numbers first: a later one must fit clearly better
CHOICE = (PINHOLE5, FISHEYE, PINHOLE8)
MODELS = {model.name: model for model in CHOICE}

#: standard deviations of the priors: logarithm of the focal length, of fx / fy, and principal point as a share of the
#: image's width. Pixels are square in all common cameras; a principal point lies within 3 % of the centre, except in
#: cropped images.
FOCAL_SIGMA, ASPECT_SIGMA, MIDDLE_SIGMA = 0.5, 0.002, 0.02
#: standard deviations of the priors of radial and tangential distortion. They are wide, and only matter where the
#: images determine nothing: lenses of phones, webcams and action cameras lie within one of them.
RADIAL_SIGMA, TANGENTIAL_SIGMA = 0.3, 0.005


def project(model: Model, lens: Float, p_camera: Float) -> tuple[Float, Float, Float]:
    """Return pixels (N, 2) of points (N, 3) in the camera frame, and their derivatives.

    Returns:
        pixels (N, 2), by the points (N, 2, 3), by the intrinsics (N, 2, K).
    """
    points = np.column_stack([p_camera[:, :2], np.maximum(p_camera[:, 2], 1e-6)])[:, None]
    matrix, zero = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]]), np.zeros(3)
    if model.fisheye:
        pixels, by_all = cv2.fisheye.projectPoints(points, zero, zero, matrix, lens[4:])
        by_lens, _, by_point, _ = np.split(by_all, [model.size, model.size + 3, model.size + 6], axis=1)
    else:
        pixels, by_all = cv2.projectPoints(points, zero, zero, matrix, lens[4:])
        _, by_point, by_lens = np.split(by_all, [3, 6], axis=1)
    return (
        np.asarray(pixels[:, 0], np.float64),
        np.asarray(by_point, np.float64).reshape(-1, 2, 3),
        np.asarray(by_lens, np.float64).reshape(-1, 2, model.size),
    )


def undistort(model: Model, lens: Float, pixels: Float) -> Float:
    """Return normalised coordinates (N, 2) of pixels (N, 2), by Newton's method; clipped where the model folds."""
    uv = (pixels - lens[2:4]) / lens[:2]
    unit = np.concatenate([[1.0, 1.0, 0.0, 0.0], lens[4:]])  # a lens whose pixels are distorted coordinates
    xy = uv.copy()
    if model.fisheye:
        angle = np.minimum(np.linalg.norm(uv, axis=1, keepdims=True), 1.5)
        xy = uv * np.tan(angle) / np.maximum(angle, 1e-9)
    for _ in range(12):
        now, by_point, _ = project(model, unit, np.column_stack([xy, np.ones(len(xy))]))
        by_xy = by_point[:, :, :2]
        if not np.isfinite(by_xy).all():
            break
        with np.errstate(all="ignore"):
            determinant = np.linalg.det(by_xy)
            good = np.abs(determinant) > 1e-3
            step = np.zeros_like(xy)
            step[good] = np.linalg.solve(by_xy[good], (uv - now)[good][:, :, None])[:, :, 0]
        xy += np.clip(step, -0.5, 0.5)
        if np.abs(step).max(initial=0.0) < 1e-10:
            break
    return xy


def prior(model: Model, lens: Float, start: Float, width: int, focal_sigma: float) -> tuple[Float, Float]:
    """Return the prior of the intrinsics at an estimate: precision matrix (K, K), and its gradient (K,), the direction
    towards the prior's mean.

    Args:
        lens, start: (K,) estimate and mean; the mean of a distortion's number is 0.
        width: of the image, pixels.
        focal_sigma: standard deviation of the logarithm of the focal length.
    """
    K = model.size
    H, f = np.zeros((K, K)), float(start[:2].mean())
    rows = np.zeros((2, K))
    rows[0, :2] = 0.5 / (f * focal_sigma)
    rows[1, :2] = np.array([1.0, -1.0]) / (f * ASPECT_SIGMA)
    H += rows.T @ rows
    H[[2, 3], [2, 3]] += 1 / (MIDDLE_SIGMA * width) ** 2
    index = np.arange(4, K)
    H[index, index] += 1 / np.square(model.sigmas)
    mean = np.concatenate([[f, f], start[2:4], np.zeros(K - 4)])
    return H, H @ (mean - lens)
