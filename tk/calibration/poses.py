"""Rigid motions, and the pose of a board in one view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """A rigid motion: ``p -> rotation @ p + translation``, metres."""

    rotation: Float  # (3, 3)
    translation: Float  # (3,)

    def __matmul__(self, other: Pose) -> Pose:
        """Return the motion that applies ``other`` first."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> Pose:
        """Return the inverse motion."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Float) -> Float:
        """Return points (..., 3) moved."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def moved(self, step: Float) -> Pose:
        """Return the pose after a step (6,): a rotation vector applied to the rotation, then a translation."""
        return Pose(exp(step[:3]) @ self.rotation, self.translation + step[3:])


IDENTITY = Pose(np.eye(3), np.zeros(3))


def exp(w: Float) -> Float:
    """Return the rotation (3, 3) of a rotation vector (3,)."""
    return np.asarray(cv2.Rodrigues(np.asarray(w, np.float64).reshape(3, 1))[0])


def log(rotation: Float) -> Float:
    """Return the rotation vector (3,) of a rotation (3, 3)."""
    return np.asarray(cv2.Rodrigues(rotation)[0], np.float64).ravel()


def angle_deg(a: Float, b: Float) -> float:
    """Return the angle between two rotations, degrees."""
    return float(np.degrees(np.linalg.norm(log(a @ b.T))))


def cross(v: Float) -> Float:
    """Return the matrices (N, 3, 3) of the cross products with vectors (N, 3) from the left."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)


def planar_poses(points: Float, xy: Float, refine: bool = True) -> list[tuple[float, Pose]]:
    """Return the poses of a plane's points (N, 3) that fit normalised coordinates (N, 2), at most two, best first.

    A plane far away has two: it may be tilted towards the camera or away from it. Each comes with its
    root-mean-square error in normalised coordinates.
    """
    try:
        # OpenCV wants a plane centred on zero
        middle = points.mean(axis=0)
        _, turns, moves, _ = cv2.solvePnPGeneric(points - middle, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return []
    found = []
    for turn, move in zip(turns, moves, strict=True):
        if refine:
            turn, move = cv2.solvePnPRefineLM(points - middle, xy, np.eye(3), None, turn, move)
        rotation = exp(np.asarray(turn, np.float64))
        pose = Pose(rotation, np.asarray(move).ravel() - rotation @ middle)
        seen = pose.apply(points)
        if np.isfinite(seen).all() and (seen[:, 2] > 0).all():
            error = np.sqrt(((seen[:, :2] / seen[:, 2:] - xy) ** 2).sum(axis=1).mean())
            found.append((float(error), pose))
    return sorted(found, key=lambda pair: pair[0])
