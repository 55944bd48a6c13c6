"""Whose pixels are whose before anybody has a body: people's visual hulls stand for their bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.raycast import FAR
from tk.model.cameras.camera import Rig
from tk.model.cues.part_colors import RenderedBody
from tk.model.cues.ray_costs import RayGrid
from tk.people.find import LocatedPerson, PeopleFinder
from tk.people.share import PixelOwners, assign, matched_bodies
from tk.trackers.protocol import Frame

Float = NDArray[np.float64]

# A hull has people's pixels mixed up if its volume changes by this factor in the opening.
_MIXED = 2.0


def owners_by_hulls(rig: Rig, grid: RayGrid, people: Sequence[LocatedPerson], frame: Frame) -> PixelOwners:
    """Return the owner of each pixel of a frame in which people were found.

    Args:
        rig, grid: the cameras, and their rays.
        people: in the frame.
        frame: its masks may have the value :data:`~tk.kernels.mask_values.OTHERS`.
    """
    return assign(rig, grid, [cast_points(rig, grid, person.points, person.voxel_m) for person in people], frame)


def shares_by_hulls(
    finder: PeopleFinder,
    grid: RayGrid,
    people: Sequence[LocatedPerson],
    frames: Sequence[Frame],
    sighted: Callable[[Frame], Sequence[RenderedBody]],
) -> list[list[Frame]]:
    """Return the observations of each person in consecutive frames, by hulls that are carved again in each.

    A person's observations end where the hull grows or shrinks as no body does: there it shows a part of somebody else,
    or somebody else has a part of this person.

    Args:
        finder: who has found them.
        grid: rays of its cameras.
        people: in the first frame.
        frames: their masks may have the value :data:`~tk.kernels.mask_values.OTHERS`.
        sighted: returns the bodies that the landmarks in a frame show.
    """
    rig = finder.rig
    places = [person.position for person in people]
    counts = [len(person.points) for person in people]
    hulls = [cast_points(rig, grid, person.points, person.voxel_m) for person in people]
    shares: list[list[Frame]] = [[] for _ in people]
    at_first: list[int] = []  # voxels of each hull in the second frame: in the first, all masks carved it
    mixed = [False] * len(people)
    for frame in frames:
        seen = sighted(frame)
        owners = assign(rig, grid, _in_place(seen, hulls), frame)
        if frame is not frames[0]:
            for k, place in enumerate(places):
                points, places[k] = finder.around(place, owners.share(frame, k).masks, counts[k])
                if len(points):
                    counts[k], hulls[k] = len(points), cast_points(rig, grid, points, finder.voxel_m)
            at_first = at_first or list(counts)
            owners = assign(rig, grid, _in_place(seen, hulls), frame)
            for k, (count, first) in enumerate(zip(counts, at_first, strict=True)):
                mixed[k] |= not 1 / _MIXED < count / first < _MIXED
        for k, own in enumerate(shares):
            if not mixed[k]:
                own.append(owners.share(frame, k))
    return shares


def _in_place(sighted: Sequence[RenderedBody], hulls: Sequence[RenderedBody]) -> list[RenderedBody]:
    """Return people's hulls, or in their place the bodies that landmarks show: hulls of people who stand close together
    contain parts of each other."""
    whose = matched_bodies([body.label > 0 for body in sighted], hulls)
    bodies = list(hulls)
    for n, k in whose.items():
        bodies[k] = sighted[n]
    return bodies


def cast_points(rig: Rig, grid: RayGrid, points: Float, voxel_m: float) -> RenderedBody:
    """Return voxels with centres (N, 3) on the grid, as a body of one part whose colours are unknown.

    Args:
        rig: the cameras, in the world of the points.
        grid: rays of the same cameras.
        points: metres.
        voxel_m: edge of a voxel, metres.
    """
    V, h, w = grid.rays.shape[:3]
    depth = np.full((V, h, w), FAR, np.float32)
    for v, camera in enumerate(rig):
        pixels, ahead = camera.project(points)
        seen = camera.sees(points) & (ahead > 0)
        if not seen.any():
            continue
        x, y = np.clip((pixels[seen] // grid.step).astype(np.int64), 0, (w - 1, h - 1)).T
        distance = np.linalg.norm(points[seen] - camera.center, axis=1).astype(np.float32)
        np.minimum.at(depth[v], (y, x), distance)
        cells = voxel_m * camera.matrix[0, 0] / float(np.median(distance)) / grid.step
        width = 2 * max(int(np.ceil(cells / 2)), 1) + 1
        depth[v] = cv2.erode(depth[v], np.ones((width, width), np.uint8))
    return RenderedBody((depth < FAR).astype(np.uint8), depth)
