"""Sightings: people that a detector finds in single images, and where these people are in space.

Sightings of one person in several images are matched where their lines of sight meet (:func:`locate`). A
:class:`Patch` is the square of an image in which a network looks for a person.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_points import LANDMARKS
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import closest_to_lines, sample_box
from tk.model.cameras.volume import Volume

Float = NDArray[np.float64]

# A sighting is a person's if the person's point is within this share of its radius.
_AGREE = 0.35
#: how far outside the working volume people are searched for, metres: operators stand there
BEYOND_M = 2.0

# A body is seen from above or below if less than this share of it is across the line of sight.
_FORESHORTENED = 0.3

# Landmarks at both ends of the trunk, each of two sides.
_TRUNK = ("hip", "shoulder")


@dataclass(frozen=True)
class Sighting:
    """A person in an image."""

    center: tuple[float, float]  # (x, y) of the mid-hip point, pixels
    # (x, y) of the point over it, along the body, on the circle about it that holds the whole body
    top: tuple[float, float]
    score: float  # confidence, 0 to 1

    @property
    def radius(self) -> float:
        """Radius of the circle, pixels."""
        return float(np.hypot(self.top[0] - self.center[0], self.top[1] - self.center[1]))

    def patch(self, margin: float) -> Patch:
        """Return the square about the circle, the body upright in it, larger by the factor ``margin``."""
        angle = float(np.arctan2(self.top[0] - self.center[0], self.center[1] - self.top[1]))
        return Patch(self.center, max(round(2 * margin * self.radius), 2), angle)


@dataclass(frozen=True)
class Patch:
    """A rotated square of an image, which may reach beyond the image."""

    center: tuple[float, float]  # (x, y) pixels
    side: int  # pixels
    angle: float = 0.0  # radians, clockwise, from the image's upward direction to the square's

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

    def fits(self, other: Patch, margin: float, too_large: float) -> bool:
        """Return whether it serves in place of a square that is larger than a person by the factor ``margin``: it holds
        the circle around the person, and is larger than the other square by the factor ``too_large`` at most."""
        circle = np.array(other.center) + other.side / (2 * margin) * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
        return self.side <= too_large * other.side and self.holds(circle)

    def cut(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return its pixels (side, side, 3) of an image (h, w, 3); black beyond the image."""
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, self._to_image(), (self.side, self.side), flags=flags), np.uint8)

    def paste(self, values: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return its values (side, side) in an image of this shape (h, w), 0 elsewhere."""
        return np.asarray(cv2.warpAffine(values, self._to_image(), shape[::-1], flags=cv2.INTER_LINEAR), np.float32)

    def in_image(self, points: Float) -> Float:
        """Return its pixels (N, 2) as pixels (N, 2) of the image."""
        affine = self._to_image()
        return np.asarray(points @ affine[:, :2].T + affine[:, 2])

    def _to_image(self) -> Float:
        """Return (2, 3) the affine map from its pixels to the image's."""
        turn, middle = _turn(self.angle), (self.side - 1) / 2
        return np.column_stack([turn, np.array(self.center) - turn @ [middle, middle]])


def _turn(angle: float) -> Float:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class SeenPerson:
    """Where a person is: a sphere that contains the whole body."""

    center: Float  # (3,) the mid-hip point, world frame, metres
    top: Float  # (3,) the point of the sphere above it, along the body
    radius_m: float  # metres
    cameras: tuple[int, ...]  # indices of the cameras with a sighting of the person

    @staticmethod
    def at(points: Float) -> SeenPerson | None:
        """Return the person whose landmarks are at points (L, 3), see :data:`~tk.model.body.body_points.LANDMARKS`,
        metres, NaN where unknown; None without hips and shoulders."""
        hips, shoulders = (points[[LANDMARKS.index(f"{name}_{side}") for side in "lr"]].mean(axis=0) for name in _TRUNK)
        if not np.isfinite([hips, shoulders]).all():
            return None
        reach = float(np.nanmax(np.linalg.norm(points - hips, axis=1)))
        along = (shoulders - hips) / np.linalg.norm(shoulders - hips)
        return SeenPerson(hips, hips + reach * along, reach, ())

    def ahead(self, before: Sequence[SeenPerson]) -> SeenPerson:
        """Return where the person is after the time that has passed since people were at the places ``before``, if the
        person moves on as from the nearest of them; one who is not within the radius is somebody else."""
        steps = [self.center - person.center for person in before]
        step = min(steps, key=lambda step: float(np.linalg.norm(step)), default=np.zeros(3))
        if np.linalg.norm(step) > self.radius_m:
            return self
        return replace(self, center=self.center + step, top=self.top + step)

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


def locate(
    rig: Rig, volume: Volume, sightings: Sequence[Sequence[Sighting]]
) -> tuple[list[SeenPerson], list[list[Sighting]]]:
    """Return the people in and around the volume that two or more cameras see, and the sightings of none of them.

    Each pair of sightings of two cameras proposes the point where their lines of sight meet. The support of a point is
    the truncated quadratic of MSAC (Torr and Zisserman 2000), so that three cameras with an exact match outweigh three
    with a rough one. The point with the most support is a person; the sightings that agree with it are his or hers; the
    next person is found among the others.

    Args:
        rig: C cameras.
        volume: the working volume. The hips of a person are at most :data:`BEYOND_M` outside.
        sightings: C lists, in pixels of the full images.
    """
    seen = [(c, sighting) for c, each in enumerate(sightings) for sighting in each]
    camera = np.array([c for c, _ in seen], np.int64)
    hips = [(rig[c].center, rig[c].rays([s.center])[0]) for c, s in seen]
    pairs = [(a, b) for a, b in combinations(range(len(seen)), 2) if camera[a] != camera[b]]
    met = [point for a, b in pairs if (point := _meeting([hips[a], hips[b]])) is not None and near(point, volume)]
    distance = _distances(rig, np.array(met).reshape(-1, 3), seen)
    score = np.array([s.score for _, s in seen])
    people = []
    free = np.ones(len(seen), np.bool_)
    while True:
        # the nearest free sighting of each camera, if it agrees
        open_to = np.where(free & (distance <= _AGREE), distance, np.inf)
        chosen = np.zeros(open_to.shape, np.bool_)
        for c in np.unique(camera):
            own = np.flatnonzero(camera == c)
            nearest = own[open_to[:, own].argmin(axis=1)]
            chosen[np.arange(len(chosen)), nearest] = np.isfinite(open_to[np.arange(len(chosen)), nearest])
        support = np.where(chosen, score * (1 - (np.where(chosen, distance, 0) / _AGREE) ** 2), 0).sum(axis=1)
        support[chosen.sum(axis=1) < 2] = 0
        if not support.any():
            break
        of_person = np.flatnonzero(chosen[support.argmax()])
        free[of_person] = False
        if (person := place_of(rig, [seen[k] for k in of_person])) is not None:
            people.append(person)
    rest = [[s for k, (view, s) in enumerate(seen) if view == c and free[k]] for c in range(len(rig))]
    return people, rest


def place_of(rig: Rig, seen: Sequence[tuple[int, Sighting]]) -> SeenPerson | None:
    """Return where a person is by sightings, each with its camera; None if their lines of sight are parallel."""
    points = np.array([[sighting.center, sighting.top] for _, sighting in seen])
    origins = np.array([rig[c].center for c, _ in seen])
    rays = np.array([rig[c].rays(both) for (c, _), both in zip(seen, points, strict=True)])
    center, top = (closest_to_lines(origins, rays[:, k]) for k in range(2))
    if center is None or top is None:
        return None
    # the median radius over the cameras
    radius_m = np.median([s.radius * rig[c].project(center)[1][0] / _focal(rig[c]) for c, s in seen])
    return SeenPerson(center, top, float(radius_m), tuple(c for c, _ in seen))


def _distances(rig: Rig, points: Float, seen: Sequence[tuple[int, Sighting]]) -> Float:
    """Return (P, N) the distance of each point (P, 3) from each sighting in the image, in the sighting's radii."""
    projected = [camera.project(points)[0] for camera in rig]
    columns = [np.linalg.norm(projected[c] - np.array(s.center), axis=1) / max(s.radius, 1e-9) for c, s in seen]
    found = np.array(columns).reshape(len(seen), len(points)).T
    return np.where(np.isfinite(found), found, np.inf)


def _meeting(lines: Sequence[tuple[Float, Float]]) -> Float | None:
    return closest_to_lines(np.array([origin for origin, _ in lines]), np.array([along for _, along in lines]))


def near(point: Float, volume: Volume) -> bool:
    """Return whether a point (3,) is in the volume or at most :data:`BEYOND_M` outside; not if it is NaN."""
    return bool(((volume.lower - BEYOND_M <= point) & (point <= volume.upper + BEYOND_M)).all())


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))


def volume_patch(camera: Camera, volume: Volume) -> Patch:
    """Return the square about the volume in an image; the whole image if it shows none of the volume."""
    pixels, _ = camera.project(sample_box(volume, 8))
    last = np.array([camera.width - 1.0, camera.height - 1.0])
    corners = np.stack([np.zeros(2), last])
    pixels = np.clip(pixels[np.isfinite(pixels).all(axis=1)], 0, last)
    return Patch.about(pixels if len(pixels) and (np.ptp(pixels, axis=0) > 1).all() else corners, 1.0)
