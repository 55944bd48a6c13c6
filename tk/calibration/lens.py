"""Lens models with analytic derivatives. Intrinsics are one vector: fx, fy, cx, cy, then the distortion.

The distortion is in OpenCV's order: k1 k2 p1 p2 k3 (pinhole5), with k4 k5 k6 (pinhole8), or k1 to k4 (fisheye).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """A lens model and the priors of its intrinsics.

    The priors only matter where the images determine nothing. Their standard deviations are wide: lenses of phones,
    webcams and action cameras lie within one of them.
    """

    name: str
    names: tuple[str, ...]  # names of the distortion's numbers
    fisheye: bool = False

    @property
    def size(self) -> int:
        """Number of intrinsics."""
        return 4 + len(self.names)

    @property
    def sigmas(self) -> Float:
        """(D,) standard deviations of the distortion's numbers about 0."""
        return np.array([TANGENTIAL_SIGMA if name.startswith("p") else RADIAL_SIGMA for name in self.names])


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
#: standard deviations of the priors of the distortion's numbers k and p
RADIAL_SIGMA, TANGENTIAL_SIGMA = 0.5, 0.005


def distort(model: Model, xy: Float, d: Float) -> tuple[Float, Float, Float]:
    """Return distorted coordinates (N, 2) of normalised ones (N, 2), and their derivatives by both inputs.

    Returns:
        uv (N, 2), duv/dxy (N, 2, 2), duv/dd (N, 2, D).
    """
    x, y = xy.T
    q = x * x + y * y
    if model.fisheye:
        return _distort_fisheye(x, y, q, d)
    k1, k2, p1, p2, k3 = d[:5]
    k4, k5, k6 = d[5:8] if len(d) > 5 else np.zeros(3)
    top, bottom = 1 + q * (k1 + q * (k2 + q * k3)), 1 + q * (k4 + q * (k5 + q * k6))
    L = top / bottom
    dL = (k1 + q * (2 * k2 + 3 * k3 * q) - L * (k4 + q * (2 * k5 + 3 * k6 * q))) / bottom
    uv = np.stack([x * L + 2 * p1 * x * y + p2 * (q + 2 * x * x), y * L + p1 * (q + 2 * y * y) + 2 * p2 * x * y], 1)
    across = 2 * x * y * dL + 2 * p1 * x + 2 * p2 * y
    by_xy = np.empty((len(x), 2, 2))
    by_xy[:, 0, 0] = L + 2 * x * x * dL + 2 * p1 * y + 6 * p2 * x
    by_xy[:, 0, 1] = by_xy[:, 1, 0] = across
    by_xy[:, 1, 1] = L + 2 * y * y * dL + 6 * p1 * y + 2 * p2 * x
    by_d = np.empty((len(x), 2, len(d)))
    for column, power in ((0, 1), (1, 2), (4, 3)):
        by_d[:, :, column] = xy * (q**power / bottom)[:, None]
    for column, power in ((5, 1), (6, 2), (7, 3)) if len(d) > 5 else ():
        by_d[:, :, column] = -xy * (L * q**power / bottom)[:, None]
    by_d[:, 0, 2], by_d[:, 1, 2] = 2 * x * y, q + 2 * y * y
    by_d[:, 0, 3], by_d[:, 1, 3] = q + 2 * x * x, 2 * x * y
    return uv, by_xy, by_d


def _distort_fisheye(x: Float, y: Float, q: Float, d: Float) -> tuple[Float, Float, Float]:
    r = np.sqrt(np.maximum(q, 1e-16))
    angle = np.arctan(r)
    s = angle * angle
    bent = angle * (1 + s * (d[0] + s * (d[1] + s * (d[2] + s * d[3]))))
    slope = 1 + s * (3 * d[0] + s * (5 * d[1] + s * (7 * d[2] + 9 * s * d[3])))
    scale = bent / r
    growth = (slope / (1 + q) - scale) / r  # of the scale, by r
    xy = np.stack([x, y], axis=1)
    by_xy = scale[:, None, None] * np.eye(2) + (growth / r)[:, None, None] * xy[:, :, None] * xy[:, None, :]
    powers = angle[:, None] ** np.array([3, 5, 7, 9]) / r[:, None]
    return xy * scale[:, None], by_xy, xy[:, :, None] * powers[:, None, :]


def project(model: Model, lens: Float, p_camera: Float) -> tuple[Float, Float, Float]:
    """Return pixels (N, 2) of points (N, 3) in the camera frame, and their derivatives.

    Returns:
        pixels (N, 2), by the points (N, 2, 3), by the intrinsics (N, 2, K).
    """
    z = np.maximum(p_camera[:, 2], 1e-6)
    xy = p_camera[:, :2] / z[:, None]
    uv, by_xy, by_d = distort(model, xy, lens[4:])
    focal = lens[:2]
    by_point = np.empty((len(z), 2, 3))
    by_point[:, :, :2] = by_xy / z[:, None, None]
    by_point[:, :, 2] = -np.einsum("nij,nj->ni", by_xy, xy) / z[:, None]
    by_lens = np.zeros((len(z), 2, model.size))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = uv.T
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4:] = by_d * focal[:, None]
    return uv * focal + lens[2:4], by_point * focal[:, None], by_lens


def undistort(model: Model, lens: Float, pixels: Float) -> Float:
    """Return normalised coordinates (N, 2) of pixels (N, 2), by Newton's method; clipped where the model folds."""
    uv = (pixels - lens[2:4]) / lens[:2]
    xy = uv.copy()
    if model.fisheye:
        angle = np.minimum(np.linalg.norm(uv, axis=1, keepdims=True), 1.5)
        xy = uv * np.tan(angle) / np.maximum(angle, 1e-9)
    for _ in range(12):
        now, by_xy, _ = distort(model, xy, lens[4:])
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
