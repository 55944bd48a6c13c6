"""Who is the subject: the one who stands in the working volume, in all cameras; and where to look for him or her.

Two ways to tell. Sightings of people in the pictures, any number in each, go together where their lines of sight meet
in the volume (:func:`locate`). Masks go together where the cones through them do: a coarse visual hull
(:class:`CoarseHull`). A bystander who is in two pictures, or behind the volume, is in neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import closest_to_lines, sample_box
from tk.model.cameras.volume import Volume, VoxelGrid

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: a sighting is the subject's where the point is seen within this share of its radius
_AGREE = 0.35
#: how far outside the volume the hips may be, metres
_MARGIN_M = 0.3

#: a body is seen from above or below where less than this share of it is across the line of sight
_FORESHORTENED = 0.3

#: voxels along the volume's longest side: 5 cm of 2.4 m, which a thigh fills
_VOXELS = 48
#: of a hull that may be a person's
_LEAST_LITRES = 10.0
#: a part of a mask belongs to the subject within so many voxels of the hull, for thin limbs hold no voxel's centre
_NEAR_VOXELS = 2.5
#: cameras that see a voxel, from which on one of them may be wrong, and how much smaller the hull then is
_ENOUGH, _MUCH_SMALLER = 4, 0.4


@dataclass(frozen=True)
class Sighting:
    """A person in a picture.

    Attributes:
        center: (x, y) of the mid-hip point, pixels.
        top: (x, y) of the point over it, along the body, on the circle about it that holds the whole body.
        score: how sure, 0 to 1.
    """

    center: tuple[float, float]
    top: tuple[float, float]
    score: float

    @property
    def radius(self) -> float:
        """Of the circle, pixels."""
        return float(np.hypot(self.top[0] - self.center[0], self.top[1] - self.center[1]))


@dataclass(frozen=True)
class Patch:
    """A square of a picture, turned, which may reach beyond the picture.

    Attributes:
        center: (x, y) pixels.
        side: pixels.
        angle: radians by which what is up in it is turned clockwise from what is up in the picture.
    """

    center: tuple[float, float]
    side: int
    angle: float = 0.0

    @staticmethod
    def about(points: Float, margin: float, angle: float = 0.0) -> Patch:
        """The square about points (N, 2), larger by the factor ``margin``."""
        turned = points @ _turn(angle)
        low, high = turned.min(axis=0), turned.max(axis=0)
        x, y = _turn(angle) @ ((low + high) / 2)
        return Patch((float(x), float(y)), max(round(margin * float((high - low).max())), 2), angle)

    def holds(self, points: Float) -> bool:
        """Whether all points (N, 2) lie in it."""
        return bool((np.abs((points - np.array(self.center)) @ _turn(self.angle)) <= self.side / 2).all())

    def cut(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(side, side, 3) what a picture (h, w, 3) shows in it; black beyond the picture."""
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(picture, self._to_picture(), (self.side, self.side), flags=flags), np.uint8)

    def paste(self, values: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Values (side, side) of it in a picture of this shape (h, w), 0 elsewhere."""
        return np.asarray(cv2.warpAffine(values, self._to_picture(), shape[::-1], flags=cv2.INTER_LINEAR), np.float32)

    def _to_picture(self) -> Float:
        """(2, 3) the affine map from its pixels to the picture's."""
        turn, middle = _turn(self.angle), (self.side - 1) / 2
        return np.column_stack([turn, np.array(self.center) - turn @ [middle, middle]])


def _turn(angle: float) -> Float:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class Subject:
    """Where the subject is: a ball.

    Attributes:
        center: (3,) the mid-hip point, world frame, metres.
        top: (3,) the point over it on the ball that holds the whole body.
        radius_m: of the ball, metres.
        views: cameras that have sighted him or her there.
    """

    center: Float
    top: Float
    radius_m: float
    views: int

    def patch(self, camera: Camera, margin: float) -> Patch | None:
        """The square about the ball in a picture, the body upright in it, larger by the factor ``margin``.

        None behind the camera. From above or below the square is as the picture is.
        """
        pixels, depth = camera.project(np.stack([self.center, self.top]))
        if not np.isfinite(pixels).all():
            return None
        radius = self.radius_m * _focal(camera) / depth[0]
        x, y = pixels[1] - pixels[0]
        angle = float(np.arctan2(x, -y)) if np.hypot(x, y) > _FORESHORTENED * radius else 0.0
        return Patch((float(pixels[0, 0]), float(pixels[0, 1])), max(round(2 * margin * radius), 2), angle)


def locate(rig: Rig, volume: Volume, sightings: Sequence[Sequence[Sighting]]) -> Subject | None:
    """The person whom most cameras see at one place in the volume; None where no two do.

    Pairs of sightings propose places; a place's support is the truncated quadratic of MSAC (Torr and Zisserman 2000),
    so that three cameras which agree exactly outweigh three which nearly do.

    Args:
        rig: C cameras.
        volume: the working volume.
        sightings: C lists, in pixels of the whole pictures.
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
    """The sightings of a person at a point, at most one a camera: how far off it, in their radii."""
    nearest: dict[int, tuple[float, int]] = {}
    for c, camera in enumerate(rig):
        pixels, _ = camera.project(point)
        for k, (view, sighting) in enumerate(seen):
            distance = float(np.linalg.norm(pixels[0] - sighting.center)) / max(sighting.radius, 1e-9)
            if view == c and distance <= min(_AGREE, nearest.get(c, (np.inf, 0))[0]):  # NaN is no agreement
                nearest[c] = distance, k
    return {k: distance for distance, k in nearest.values()}


def _radius_m(rig: Rig, point: Float, seen: Sequence[tuple[int, Sighting]]) -> float:
    """The median over the cameras."""
    return float(np.median([s.radius * rig[c].project(point)[1][0] / _focal(rig[c]) for c, s in seen]))


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))


def volume_patch(camera: Camera, volume: Volume) -> Patch:
    """The square about what a picture shows of the volume; about the whole picture where that is nothing."""
    pixels, _ = camera.project(sample_box(volume, 8))
    last = np.array([camera.width - 1.0, camera.height - 1.0])
    corners = np.stack([np.zeros(2), last])
    pixels = np.clip(pixels[np.isfinite(pixels).all(axis=1)], 0, last)
    return Patch.about(pixels if len(pixels) and (np.ptp(pixels, axis=0) > 1).all() else corners, 1.0)


class CoarseHull:
    """The subject's visual hull in large voxels."""

    def __init__(self, rig: Rig, volume: Volume) -> None:
        self._grid = VoxelGrid.cover(volume, _VOXELS)
        self._litre = 1000 * self._grid.voxel_m**3
        height, width = rig.frame_shape
        count = len(rig)
        self._pixels = np.zeros((count, self._grid.count), np.int64)  # flat, of the packed pictures
        self._xy = np.zeros((count, self._grid.count, 2), np.int32)
        self._in_view = np.zeros((count, self._grid.count), np.bool_)
        self._reach = np.zeros(count)
        centers = self._grid.centers()
        for c, camera in enumerate(rig):
            pixels, depth = camera.project(centers)
            inside = camera.sees(centers)
            x, y = (np.clip(pixels[inside].round().astype(np.int64), 0, None)).T
            self._in_view[c, inside] = True
            self._pixels[c, inside] = (c * height + y) * width + x
            self._xy[c, inside] = np.stack([x, y], axis=1)
            if inside.any():
                self._reach[c] = _NEAR_VOXELS * self._grid.voxel_m * _focal(camera) / np.median(depth[inside])

    def subject(self, masks: NDArray[np.uint8], but: int | None = None) -> Mask:
        """(N,) the voxels of the thing that most masks (C, H, W) agree about, the largest of several.

        One of four cameras and more may be wrong, if the hull would be much smaller otherwise.

        Args:
            masks: 0 or more.
            but: a camera that is not asked.
        """
        strict, lenient = (self._agreed(masks, but, wrong) for wrong in (0, 1))
        return strict if np.count_nonzero(strict) >= _MUCH_SMALLER * np.count_nonzero(lenient) else lenient

    def _agreed(self, masks: NDArray[np.uint8], but: int | None, wrong: int) -> Mask:
        asked = self._in_view.copy()
        if but is not None:
            asked[but] = False
        seeing = asked.sum(axis=0)
        agreeing = ((masks.reshape(-1)[self._pixels] > 0) & asked).sum(axis=0)
        held = (seeing >= 2) & (agreeing >= np.where(seeing >= _ENOUGH, seeing - wrong, seeing))
        parts, count = ndimage.label(held.reshape(self._grid.shape), np.ones((3, 3, 3)))
        if count == 0:
            return held
        part = parts.reshape(-1)
        # a corner that two cameras see may be larger than the person, whom more of them see
        sizes = np.array(
            [np.bincount(part[held & (agreeing >= n)], minlength=count + 1) for n in range(2, len(masks) + 1)]
        )
        large = sizes * self._litre >= _LEAST_LITRES
        level = int(np.flatnonzero(large.any(axis=1))[-1]) if large.any() else 0
        return np.asarray(part == sizes[level].argmax(), np.bool_) & held

    def litres(self, voxels: Mask) -> float:
        """Of voxels (N,)."""
        return self._litre * np.count_nonzero(voxels)

    def points(self, voxels: Mask, c: int) -> Float:
        """(M, 2) where a picture shows voxels (N,), pixels; those that it does not show are left out."""
        return self._xy[c, voxels & self._in_view[c]].astype(np.float64)

    def share(self, voxels: Mask, c: int, mask: NDArray[np.uint8]) -> float:
        """How much of what a picture shows of voxels (N,) is in its mask (h, w); 1 where it shows none."""
        seen = voxels & self._in_view[c]
        return float(np.mean(mask[self._xy[c, seen, 1], self._xy[c, seen, 0]] > 0)) if seen.any() else 1.0

    def only(self, voxels: Mask, c: int, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The parts of a mask (h, w) that lie at or near voxels (N,); all of it where the picture shows none."""
        xy = self._xy[c, voxels & self._in_view[c]]
        if len(xy) == 0:
            return mask
        parts = cv2.connectedComponents(mask, connectivity=8)[1]
        near = np.ones(mask.shape, np.uint8)
        inside = (xy[:, 0] < mask.shape[1]) & (xy[:, 1] < mask.shape[0])
        near[xy[inside, 1], xy[inside, 0]] = 0
        distance = cv2.distanceTransform(near, cv2.DIST_L2, 3)
        kept = np.unique(parts[distance <= self._reach[c]])
        return np.where(np.isin(parts, kept), mask, 0).astype(np.uint8)
