"""Draws chairs into images, which hide parts of people from some cameras."""

from __future__ import annotations

from itertools import pairwise, product

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import HIPS, JOINTS, LIMBS, SHOULDERS
from tk.model.cameras.camera import Camera, Rig

Float = NDArray[np.float64]

# Seat and back of a chair: sizes and centres, metres; x away from the person, z up from the floor.
BOXES = (((0.42, 0.42, 0.44), (0.0, 0.0, 0.22)), ((0.05, 0.42, 0.45), (0.19, 0.0, 0.65)))
FROM_PELVIS_M = 0.42
SIDES = 4  # of a person, at which a chair may stand
FIRST_RAD = 0.4  # direction of the first side
# Bones, and how thick a person is about them, metres.
TRUNK = (*((hip, shoulder) for hip, shoulder in product(HIPS, SHOULDERS)), ("neck", "head_top"))
BONES = [(*bone, 0.25) for bone in TRUNK] + [(*bone, 0.14) for limb in LIMBS.values() for bone in pairwise(limb)]


def with_chairs(rig: Rig, images: NDArray[np.uint8], people: Float, side: int) -> NDArray[np.uint8]:
    """Return images (C, H, W, 3) of people with joints (P, J, 3), z up, in which a chair stands on one side of each."""
    angle = FIRST_RAD + 2 * np.pi * side / SIDES
    away = np.array([np.cos(angle), np.sin(angle), 0.0])
    turn = np.column_stack([away, np.cross([0.0, 0.0, 1.0], away), [0.0, 0.0, 1.0]])
    result = images.copy()
    for person in people:
        floor = person[JOINTS.index("pelvis")] * [1, 1, 0] + FROM_PELVIS_M * away
        for camera, image in zip(rig, result, strict=True):
            before = _people_before(camera, people, np.linalg.norm(camera.center - floor), image.shape[:2])
            drawn = image.copy()
            for corners, normal in sorted(_faces(turn, floor, camera), key=lambda face: -_distance(face[0], camera)):
                pixels = camera.project(corners)[0]
                if np.isfinite(pixels).all():
                    light = 90 + 60 * abs(normal[0]) + 40 * abs(normal[2])
                    cv2.fillConvexPoly(drawn, np.round(pixels).astype(np.int32), (0.6 * light, 0.8 * light, light))
            image[before == 0] = drawn[before == 0]
    return result


def _faces(turn: Float, floor: Float, camera: Camera) -> list[tuple[Float, Float]]:
    """Return corners (4, 3) and normal of the faces that a camera sees."""
    square, seen = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)]), []
    for size, center in BOXES:
        for axis, sign in product(range(3), (-1.0, 1.0)):
            corners = np.insert(square.astype(float), axis, sign, axis=1) / 2 * size + center
            world, normal = floor + corners @ turn.T, turn[:, axis] * sign
            if normal @ (camera.center - world.mean(axis=0)) > 0:
                seen.append((world, normal))
    return seen


def _distance(corners: Float, camera: Camera) -> float:
    return float(np.linalg.norm(corners.mean(axis=0) - camera.center))


def _people_before(camera: Camera, people: Float, most_m: float, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return which pixels show people who are nearer to a camera than a distance; 0: none."""
    shown = np.zeros(size, np.uint8)
    for person in people:
        distance = np.linalg.norm(person[JOINTS.index("pelvis")] - camera.center)
        if distance >= most_m:
            continue
        pixels = camera.project(person)[0]
        for first, second, thick in BONES:
            ends = pixels[[JOINTS.index(first), JOINTS.index(second)]]
            if np.isfinite(ends).all():
                begin, end = (tuple(map(int, point.round())) for point in ends)
                cv2.line(shown, begin, end, 255, max(round(thick * camera.matrix[0, 0] / distance), 1))
    return shown
