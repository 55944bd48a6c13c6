"""Who the subject is, and where to look for him or her: the person in the working volume whom most cameras see.

Sightings of people in the images, any number in each, are matched where their lines of sight meet in the volume
(:func:`locate`); masks are matched by a coarse visual hull (:class:`tk.model.hull.coarse.CoarseHull`). A bystander in
two images, or behind the volume, is in neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import closest_to_lines, sample_box
from tk.model.cameras.volume import Volume

Float = NDArray[np.float64]

# A sighting is the subject's if the point is within this share of its radius. Chosen on the development captures;
# sensitivity not measured.
_AGREE = 0.35
# How far outside the volume the hips may be, metres: a step.
_MARGIN_M = 0.3

# A body is seen from above or below if less than this share of it is across the line of sight.
_FORESHORTENED = 0.3


@dataclass(frozen=True)
class Sighting:
    """A person in an image.

    Attributes:
        center: (x, y) of the mid-hip point, pixels.
        top: (x, y) of the point over it, along the body, on the circle about it that holds the whole body.
        score: confidence, 0 to 1.
    """

    center: tuple[float, float]
    top: tuple[float, float]
    score: float

    @property
    def radius(self) -> float:
        """Radius of the circle, pixels."""
        return float(np.hypot(self.top[0] - self.center[0], self.top[1] - self.center[1]))


@dataclass(frozen=True)
class Patch:
    """A rotated square of an image, which may reach beyond the image.

    Attributes:
        center: (x, y) pixels.
        side: pixels.
        angle: radians, clockwise, from the image's upward direction to the square's.
    """

    center: tuple[float, float]
    side: int
    angle: float = 0.0

    @staticmethod
    def about(points: Float, margin: float, angle: float = 0.0) -> Patch:
        """Return the square about points (N, 2), larger by the factor ``margin``."""
        turned = points @ _turn(angle)
        low, high = turned.min(axis=0), turned.max(axis=0)
        x, y = _turn(angle) @ ((low + high) / 2)
        return Patch((float(x), float(y)), max(round(margin * float((high - low).max())), 2), angle)

    def holds(self, points: Float) -> bool:
        """Return whether all points (N, 2) lie in it."""
        return bool((np.abs((points - np.array(self.center)) @ _turn(self.angle)) <= self.side / 2).all())

    def cut(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return its pixels (side, side, 3) of an image (h, w, 3); black beyond the image."""
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, self._to_image(), (self.side, self.side), flags=flags), np.uint8)

    def paste(self, values: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return its values (side, side) in an image of this shape (h, w), 0 elsewhere."""
        return np.asarray(cv2.warpAffine(values, self._to_image(), shape[::-1], flags=cv2.INTER_LINEAR), np.float32)

    def _to_image(self) -> Float:
        """Return (2, 3) the affine map from its pixels to the image's."""
        turn, middle = _turn(self.angle), (self.side - 1) / 2
        return np.column_stack([turn, np.array(self.center) - turn @ [middle, middle]])


def _turn(angle: float) -> Float:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class Subject:
    """Where the subject is: a sphere that contains the whole body.

    Attributes:
        center: (3,) the mid-hip point, world frame, metres.
        top: (3,) the point of the sphere above it, along the body.
        radius_m: metres.
        views: number of cameras with a sighting of the person.
    """

    center: Float
    top: Float
    radius_m: float
    views: int

    def patch(self, camera: Camera, margin: float) -> Patch | None:
        """Return the square about the sphere in an image, the body upright in it, larger by the factor ``margin``.

        None if the sphere is behind the camera. From above or below the square is not rotated.
        """
        pixels, depth = camera.project(np.stack([self.center, self.top]))
        if not np.isfinite(pixels).all():
            return None
        radius = self.radius_m * _focal(camera) / depth[0]
        x, y = pixels[1] - pixels[0]
        angle = float(np.arctan2(x, -y)) if np.hypot(x, y) > _FORESHORTENED * radius else 0.0
        return Patch((float(pixels[0, 0]), float(pixels[0, 1])), max(round(2 * margin * radius), 2), angle)


def locate(rig: Rig, volume: Volume, sightings: Sequence[Sequence[Sighting]]) -> Subject | None:
    """Return the person whom most cameras see at one point of the volume; None if no two do.

    Pairs of sightings propose points; the support of a point is the truncated quadratic of MSAC (Torr and Zisserman
    2000), so that three cameras with an exact match outweigh three with a rough one.

    Args:
        rig: C cameras.
        volume: the working volume.
        sightings: C lists, in pixels of the full images.
    """
    seen = [(c, sighting) for c, each in enumerate(sightings) for sighting in each]
    hips = [(rig[c].center, rig[c].rays([s.center])[0]) for c, s in seen]
    tops = [(rig[c].center, rig[c].rays([s.top])[0]) for c, s in seen]
    best = 0.0
    found: Subject | None = None
    for a, b in combinations(range(len(seen)), 2):
        if seen[a][0] == seen[b][0]:
            continue
        point = _meeting([hips[a], hips[b]])
        if point is None or not _inside(point, volume):
            continue
        agreeing = _agreeing(rig, point, seen)
        support = sum(seen[k][1].score * (1 - (distance / _AGREE) ** 2) for k, distance in agreeing.items())
        if len(agreeing) > 1 and support > best:
            chosen = list(agreeing)
            center, top = (_meeting([lines[k] for k in chosen]) for lines in (hips, tops))
            if center is not None and top is not None:
                best = support
                found = Subject(center, top, _radius_m(rig, center, [seen[k] for k in chosen]), len(chosen))
    return found


def _meeting(lines: Sequence[tuple[Float, Float]]) -> Float | None:
    return closest_to_lines(np.array([origin for origin, _ in lines]), np.array([along for _, along in lines]))


def _inside(point: Float, volume: Volume) -> bool:
    return bool(((volume.lower - _MARGIN_M <= point) & (point <= volume.upper + _MARGIN_M)).all())


def _agreeing(rig: Rig, point: Float, seen: Sequence[tuple[int, Sighting]]) -> dict[int, float]:
    """Return the sightings of a person at a point, at most one a camera, with their distances in their radii."""
    nearest: dict[int, tuple[float, int]] = {}
    for c, camera in enumerate(rig):
        pixels, _ = camera.project(point)
        for k, (view, sighting) in enumerate(seen):
            distance = float(np.linalg.norm(pixels[0] - sighting.center)) / max(sighting.radius, 1e-9)
            if view == c and distance <= min(_AGREE, nearest.get(c, (np.inf, 0))[0]):  # false for NaN
                nearest[c] = distance, k
    return {k: distance for distance, k in nearest.values()}


def _radius_m(rig: Rig, point: Float, seen: Sequence[tuple[int, Sighting]]) -> float:
    """Return the median radius over the cameras, metres."""
    return float(np.median([s.radius * rig[c].project(point)[1][0] / _focal(rig[c]) for c, s in seen]))


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))


def volume_patch(camera: Camera, volume: Volume) -> Patch:
    """Return the square about the volume in an image; the whole image if it shows none of the volume."""
    pixels, _ = camera.project(sample_box(volume, 8))
    last = np.array([camera.width - 1.0, camera.height - 1.0])
    corners = np.stack([np.zeros(2), last])
    pixels = np.clip(pixels[np.isfinite(pixels).all(axis=1)], 0, last)
    return Patch.about(pixels if len(pixels) and (np.ptp(pixels, axis=0) > 1).all() else corners, 1.0)
