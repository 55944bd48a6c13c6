"""Calibrated cameras. Pixel centres lie at integer coordinates (OpenCV's convention)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

# Termination of OpenCV's undistortion: its default of five rounds leaves up to 0.07 px under common barrel distortion;
# 1e-12 is rounding.
_CONVERGED = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)


def _undistort(points: Float, distortions: Float, criteria: tuple[int, int, float]) -> Float:
    """Return ideal coordinates (N, 1, 2) of distorted ones (N, 1, 2), normalised, iterated until ``criteria`` hold."""
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4 has a separate function
        result = cv2.undistortPointsIter(points, np.eye(3), distortions, None, None, criteria)
    else:
        result = cv2.undistortPoints(points, np.eye(3), distortions, criteria=criteria)
    return np.asarray(result, dtype=np.float64)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with lens distortion.

    ``p_camera = rotation @ p_world + translation`` with x right, y down, z forward.
    """

    name: str  # the camera's name, as in `calibration.toml`
    # width, height: image size, pixels
    width: int
    height: int
    matrix: Float  # (3, 3) intrinsic matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], pixels
    # (4,), (5,) or (8,) in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]]; (4,) k1…k4 when `fisheye`
    distortions: Float
    rotation: Float  # (3, 3) rotation from world to camera
    translation: Float  # (3,) metres, of the world's origin in the camera frame
    fisheye: bool = False  # True for OpenCV's fisheye (equidistant) model
    # (width, height) of the recorded image, pixels, if this image is a reduced one; else None
    recorded_size: tuple[int, int] | None = None

    @property
    def reduction(self) -> int:
        """Recorded pixels along a side of the square whose mean is a pixel of this camera's image; 1 if not reduced."""
        return 1 if self.recorded_size is None else self.recorded_size[0] // self.width

    def reduced(self, factor: int) -> Camera:
        """Return the camera of the image whose pixels are means over squares of ``factor`` pixels a side.

        Remaining columns and rows at the right and bottom are dropped.
        """
        if factor == 1:
            return self
        width, height = self.width // factor, self.height // factor
        matrix = _scaled(self.matrix, 1 / factor)
        return replace(self, width=width, height=height, matrix=matrix, recorded_size=(self.width, self.height))

    def recorded(self) -> Camera:
        """Return the camera of the recorded image: the inverse of :meth:`reduced`."""
        if self.recorded_size is None:
            return self
        width, height = self.recorded_size
        matrix = _scaled(self.matrix, self.reduction)
        return replace(self, width=width, height=height, matrix=matrix, recorded_size=None)

    def pixels_per_metre(self, point: ArrayLike) -> float:
        """Return the length in pixels of a metre across the view at a world point (3,)."""
        return float(self.matrix[0, 0] / np.linalg.norm(self.center - np.asarray(point)))

    @property
    def center(self) -> Float:
        """(3,) centre of projection in the world frame, metres."""
        return -self.rotation.T @ self.translation

    def to_camera(self, p_world: ArrayLike) -> Float:
        """Return world points (N, 3) in the camera frame, metres."""
        p_camera = np.asarray(p_world, dtype=np.float64).reshape(-1, 3) @ self.rotation.T
        for a in range(3):  # by columns, as in `_pixels`: arithmetic on rows of two or three numbers is slow
            p_camera[:, a] += self.translation[a]
        return p_camera

    def project(self, p_world: ArrayLike) -> tuple[Float, Float]:
        """Project world points, lens distortion included.

        Args:
            p_world: (N, 3) metres.

        Returns:
            pixels (N, 2) as (x, y) and depth (N,) in metres. Points at or behind the camera plane have NaN pixels.
        """
        p_camera = self.to_camera(p_world)
        depth = p_camera[:, 2]
        front = depth > 1e-6
        if front.all():
            return self._pixels(p_camera), depth
        pixels = np.full((len(p_camera), 2), np.nan)
        pixels[front] = self._pixels(p_camera[front])
        return pixels, depth

    def _pixels(self, p_camera: Float) -> Float:
        """Return pixels (N, 2) of points (N, 3) in front of the camera, NaN beyond the fold of the distortion."""
        xy = np.column_stack([p_camera[:, a] / p_camera[:, 2] for a in range(2)])
        squared = np.einsum("na,na->n", xy, xy)
        if self.fisheye:
            bent = np.arctan(np.sqrt(squared)) ** 2
            if len(p_camera):  # OpenCV refuses an empty array
                distorted = cv2.fisheye.distortPoints(xy[:, None], np.eye(3), self.distortions[:4])
                xy = np.asarray(distorted, np.float64)[:, 0]
        else:
            # not OpenCV's function, which takes several times as long
            k1, k2, p1, p2, *more = self.distortions
            k3, rational = more[0] if more else 0.0, more[1:]
            bent = squared
            radial = 1 + squared * (k1 + squared * (k2 + squared * k3))
            if rational:
                k4, k5, k6 = rational
                radial /= 1 + squared * (k4 + squared * (k5 + squared * k6))
            tangential = 2 * (xy @ np.array([p2, p1]))  # along the point's direction, like the radial part
            along = radial + tangential
            xy = np.column_stack([xy[:, a] * along + squared * p for a, p in enumerate((p2, p1))])
        pixels = np.column_stack([xy[:, a] * self.matrix[a, a] + self.matrix[a, 2] for a in range(2)])
        if self.matrix[0, 1] != 0.0:
            pixels[:, 0] += self.matrix[0, 1] * xy[:, 1]
        pixels[bent > self.fold] = np.nan
        return np.asarray(pixels, np.float64)

    @cached_property
    def fold(self) -> float:
        """Squared radius (fisheye: angle from the axis) up to which the distorted radius grows; infinite if always.

        Far outside the image the distortion's polynomial folds back: such a point is not visible.
        """
        k = self.distortions[:4] if self.fisheye else np.delete(self.distortions, [2, 3])[:3]
        above, below = np.array([1.0, *k]), np.array([1.0, *(() if self.fisheye else self.distortions[5:])])
        # the derivative of r A(s) / B(s) with s = r² is (A B + 2 s (A' B - A B')) / B²; it ends at a zero of B, too
        rate = np.convolve(above, below)
        for factor, one, other in ((2.0, above, below), (-2.0, below, above)):
            rate = rate + factor * np.convolve(np.arange(len(one)) * one, other)
        # the first zero, lowest power first: solved for 1 / s, whose highest coefficient is 1
        roots = np.concatenate([np.roots(rate), np.roots(below)])
        found = roots.real[np.isreal(roots) & (roots.real > 0)]
        return float(1 / found.max()) if len(found) else np.inf

    def undistort(self, pixels: ArrayLike) -> Float:
        """Return normalised image coordinates (N, 2), x/z and y/z in the camera frame, of pixels (N, 2)."""
        points = np.ascontiguousarray(np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2))
        if len(points) == 0:  # OpenCV returns a single zero for an empty array
            return np.zeros((0, 2))
        # not by OpenCV, which ignores a skew
        points = (points - self.matrix[:2, 2]) / self.matrix.diagonal()[:2]
        points[..., 0] -= self.matrix[0, 1] / self.matrix[0, 0] * points[..., 1]
        if self.fisheye:
            result = cv2.fisheye.undistortPoints(points, np.eye(3), self.distortions[:4])
        else:
            result = _undistort(points, self.distortions, _CONVERGED)
        return np.asarray(result, dtype=np.float64).reshape(-1, 2)

    def rays(self, pixels: ArrayLike) -> Float:
        """Return unit viewing directions (N, 3) in the world frame through pixels (N, 2)."""
        xy = self.undistort(pixels)
        directions = np.column_stack([xy, np.ones(len(xy))]) @ self.rotation
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def sees(self, p_world: ArrayLike) -> NDArray[np.bool_]:
        """Return (N,) True for points whose projection rounds to a pixel of the image."""
        pixels, _ = self.project(p_world)
        with np.errstate(invalid="ignore"):
            return (
                (pixels[:, 0] >= -0.5)
                & (pixels[:, 0] < self.width - 0.5)
                & (pixels[:, 1] >= -0.5)
                & (pixels[:, 1] < self.height - 0.5)
            )


def shortened(distortions: Float, fisheye: bool) -> Float:
    """Return coefficients as :attr:`Camera.distortions` has them, without zeros at the end: (4,), (5,) or (8,)."""
    last = int(np.flatnonzero(distortions).max(initial=-1)) + 1
    return distortions[: 4 if fisheye else 5 if last <= 5 else 8]


def _scaled(matrix: Float, scale: float) -> Float:
    """Return the intrinsic matrix (3, 3) of an enlarged image, whose corner (not a pixel's centre) stays at -0.5."""
    scaled = matrix.copy()
    scaled[:2] *= scale
    scaled[:2, 2] += (scale - 1) / 2
    return scaled


@dataclass(frozen=True)
class Rig:
    """The cameras of a capture, in a fixed order."""

    cameras: tuple[Camera, ...]

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, index: int) -> Camera:
        return self.cameras[index]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(height, width) of packed image stacks: the largest of all cameras."""
        return max(c.height for c in self.cameras), max(c.width for c in self.cameras)

    @property
    def sizes(self) -> NDArray[np.int64]:
        """(C, 2) width and height of each camera's images, pixels."""
        return np.array([(c.width, c.height) for c in self.cameras])

    @property
    def centers(self) -> Float:
        """(C, 3) centres of projection, metres."""
        return np.array([c.center for c in self.cameras])

    def pixels_per_metre(self, point: ArrayLike) -> float:
        """Return the length in pixels of a metre across the view at a world point (3,); the median of the cameras."""
        return float(np.median([camera.pixels_per_metre(point) for camera in self.cameras]))

    @property
    def reductions(self) -> tuple[int, ...]:
        """(C,) each camera's :attr:`Camera.reduction`."""
        return tuple(camera.reduction for camera in self.cameras)

    def reduced(self, factors: Sequence[int]) -> Rig:
        """Return the cameras, each reduced by its factor (C,)."""
        return Rig(tuple(camera.reduced(factor) for camera, factor in zip(self.cameras, factors, strict=True)))

    def recorded_pixels(self, landmarks: Float) -> Float:
        """Return landmarks (..., C, L, 4), x and y in pixels of these cameras, in pixels of the recorded images."""
        factor = np.array(self.reductions, np.float64)[:, None, None]
        result = np.array(landmarks, np.float64)
        result[..., :2] = (result[..., :2] + 0.5) * factor - 0.5
        return result

    def reduced_pixels(self, landmarks: Float) -> Float:
        """Return the inverse of :meth:`recorded_pixels`."""
        factor = np.array(self.reductions, np.float64)[:, None, None]
        result = np.array(landmarks, np.float64)
        result[..., :2] = (result[..., :2] + 0.5) / factor - 0.5
        return result

    def recorded(self) -> Rig:
        """Return the cameras of the recorded images."""
        return Rig(tuple(camera.recorded() for camera in self.cameras))
