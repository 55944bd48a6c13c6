"""Infers the up direction of a calibration's world from the mounting of its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.up import UP_AXES, up_text, up_vector

Float = NDArray[np.float64]

#: up direction of a world if nothing indicates another one
DEFAULT_UP = "z"

#: an inferred direction this close to an axis is taken to be the axis, degrees: cameras that look down tilt it by less
SNAP_DEG = 10.0

# A camera is upright if its rightward direction is off the horizontal by at most _UPRIGHT_DEG, which hand-held and
# clamped cameras keep (Pose2Sim's demo: 24°), and if up in its image points up, i.e. is at most _LEVEL_DEG off. A
# camera that looks straight down or up shows no upward direction.
_UPRIGHT_DEG, _LEVEL_DEG = 35.0, 70.0

#: cameras are rolled if their rightward directions are off the horizontal by more than this, root mean square, degrees
_ROLLED_DEG = 4.0

#: least ratio of the two largest eigenvalues of the rightward directions at which these span the horizontal plane
_SPAN = 0.05

#: spread of the optical axes, radians, below which it does not show along which direction the cameras are spread out
_PARALLEL = 0.02

#: most cameras whose pairs propose a direction
_PROPOSERS = 40


@dataclass(frozen=True)
class FoundUp:
    """The world's up direction."""

    up: str  # text as of `tk.model.cameras.up.up_text`
    how: str  # how it was inferred, for messages
    level: bool = False  # whether it comes from cameras that are not rolled; it is then right to about 2°
    sure: bool = True  # whether most cameras agree on it; otherwise it is the default


def infer_up(rig: Rig, turns: Sequence[int] = ()) -> FoundUp:
    """Infer the up direction from cameras, most of which are mounted upright.

    Every camera votes: for the directions along which its image is upright. The direction with the most votes counts if
    more than half of the cameras vote for it, and if these cameras are spread out around it and not along it: cameras
    on their side in an arc agree as well on a direction, but it would have them stacked. Otherwise the up direction is
    the default, :data:`DEFAULT_UP`.

    The first estimate is the mean of the directions that point up in the images. Cameras that look down tilt it, and
    those on one side of a room tilt it alike. A camera that is not rolled has a horizontal rightward direction however
    far it looks down. If these directions span a plane, the second estimate is its normal, on the side of the first. It
    counts if the cameras agree with it to 4° (root mean square); otherwise they are rolled, and the first counts.

    An estimate within 10° of an axis is that axis, because people align the world's axes with the floor; for rolled
    cameras either estimate may be. No axis is preferred if the world is the frame of one of the cameras.

    Args:
        rig: the cameras.
        turns: (C,) clockwise quarter turns after which each image is upright; empty: none.
    """
    right, above = _directions(rig, turns)
    upright, overhead = _vote(rig, right, above)
    if not upright.any():
        return FoundUp(DEFAULT_UP, f"the cameras are mounted differently: {DEFAULT_UP} is a guess", sure=False)
    right, mean = right[upright | overhead], above[upright].mean(axis=0)
    mean /= np.linalg.norm(mean)
    level = False
    estimates = [(mean, "the mean of the directions that point up in the images")]
    values, vectors = np.linalg.eigh(right.T @ right)  # ascending
    across = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    if values[1] > _SPAN * values[2] and across @ mean > np.cos(np.pi / 4):
        second = (across, "the direction perpendicular to those that point right in the images")
        roll_deg = float(np.degrees(np.sqrt(max(values[0], 0.0) / len(right))))
        level = roll_deg <= _ROLLED_DEG
        estimates = [second] if level else [*estimates, second]
        level &= len(right) > 2  # two directions always span a plane

    own = next((camera.name for camera in rig if _is_world(camera)), None)
    if own is not None:
        up, how = estimates[0]
        return FoundUp(up_text(up), f"{how}; the world is the frame of camera {own}", level)
    for up, how in estimates:
        for name in UP_AXES:
            degrees = float(np.degrees(np.arccos(np.clip(up_vector(name) @ up, -1.0, 1.0))))
            if degrees <= SNAP_DEG:
                return FoundUp(name, f"the axis {degrees:.1f}° from {how}", level)
    up, how = estimates[0]
    return FoundUp(up_text(up), how, level)


def _directions(rig: Rig, turns: Sequence[int]) -> tuple[Float, Float]:
    """Return the directions (C, 3) that point right and up in the images after their turns, world frame."""
    R = np.array([camera.rotation for camera in rig])
    x, up = R[:, 0], -R[:, 1]
    quarter = np.asarray(turns if len(turns) else [0] * len(rig))[:, None] % 4
    # after a clockwise quarter turn, left points up, and up points right
    return (
        np.select([quarter == 0, quarter == 1, quarter == 2], [x, up, -x], -up),
        np.select([quarter == 0, quarter == 1, quarter == 2], [up, -x, -up], x),
    )


def _vote(rig: Rig, right: Float, above: Float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (C,) the cameras that are upright in the world, and those that look straight down; none of either if the
    upright ones are not the majority.

    Args:
        rig: the cameras.
        right, above: (C, 3) directions that point right and up in the images.
    """
    some = np.unique(np.linspace(0, len(rig) - 1, min(len(rig), _PROPOSERS)).astype(int))
    proposed = [up_vector(name) for name in UP_AXES] + list(above)
    for i, k in combinations(some.tolist(), 2):
        normal = np.cross(right[i], right[k])
        if (length := float(np.linalg.norm(normal))) > np.sin(np.radians(5.0)):
            proposed += [normal / length, -normal / length]
    ups = np.array(proposed)  # (K, 3)
    off = np.abs(ups @ right.T)  # (K, C) sine of the roll
    high = ups @ above.T
    level = np.cos(np.radians(_LEVEL_DEG))
    straight = off <= np.sin(np.radians(_UPRIGHT_DEG))
    votes, abstains = straight & (high > level), straight & (np.abs(high) <= level)
    # of equal numbers of votes, the direction along which the cameras are rolled least
    rolls = np.where(votes, off**2, 0.0).sum(axis=1) / np.maximum(votes.sum(axis=1), 1)
    best = int(np.lexsort((rolls, -votes.sum(axis=1)))[0])
    count = int(votes[best].sum())
    none = np.zeros(len(rig), bool)
    if not count > (len(rig) - int(abstains[best].sum())) / 2:
        return none, none
    axes = np.array([camera.rotation[2] for camera in rig])[votes[best]]
    axes -= axes.mean(axis=0)
    whole, along = float((axes**2).sum()), float(((axes @ ups[best]) ** 2).sum())
    if whole > count * _PARALLEL**2 and along > whole / 2:
        return none, none
    return votes[best], abstains[best]


def _is_world(camera: Camera) -> bool:
    """Return whether the world is this camera's own frame."""
    return bool(np.allclose(camera.rotation, np.eye(3), atol=1e-6) and np.allclose(camera.translation, 0.0, atol=1e-6))
