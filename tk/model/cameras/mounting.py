"""Which way is up in a calibration's world, told from how its cameras are mounted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.up import UP_AXES, up_text, up_vector

#: a direction this close to an axis is meant to be the axis
SNAP_DEG = 10.0

#: the mean of the cameras' upward directions is shorter than this when they are mounted every way
_AGREE = 0.4

#: cameras whose rightward directions are off the horizontal by more than this, root mean square, are rolled
_ROLLED_DEG = 4.0

#: the two greater eigenvalues of the rightward directions, as a ratio, below which these do not span the horizontal
_SPAN = 0.05


@dataclass(frozen=True)
class FoundUp:
    """The world's upward direction: ``up`` as :func:`tk.model.cameras.up.up_text` tells it, and ``how`` it was found.

    ``level``: whether it comes from cameras that are not rolled, which are right to some 2°.
    """

    up: str
    how: str
    level: bool = False


def infer_up(rig: Rig) -> FoundUp:
    """The upward direction, from cameras that are mounted upright.

    A first estimate is the mean of the directions that point up in the pictures. Cameras that look down tilt it, those
    on one side of a room all alike. A camera that is not rolled has a horizontal rightward direction however it looks
    down: so, where these directions span a plane, a second estimate is across it, to the side of the first. It counts
    where the cameras agree with it to 4° (root mean square); otherwise they are rolled, and the first counts.

    An estimate within 10° of an axis is that axis, since people lay the world's axes along the floor; where the cameras
    are rolled either estimate may be. Not so where the world is one of the cameras' own frame, which nobody has laid.
    """
    mean = -np.mean([camera.rotation[1] for camera in rig], axis=0)
    agreement = float(np.linalg.norm(mean))
    if agreement < 1e-6:
        return FoundUp("z", "the cameras say nothing: they are mounted every way; z is a guess")
    mean /= agreement
    level = False
    estimates = [(mean, "the mean of the directions that point up in the pictures")]
    right = np.array([camera.rotation[0] for camera in rig])
    values, vectors = np.linalg.eigh(right.T @ right)  # ascending
    across = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    if values[1] > _SPAN * values[2] and across @ mean > np.cos(np.pi / 4):
        second = (across, "the direction across those that point right in the pictures")
        roll_deg = float(np.degrees(np.sqrt(max(values[0], 0.0) / len(rig))))
        level = roll_deg <= _ROLLED_DEG
        estimates = [second] if level else [*estimates, second]
    unsure = "; the cameras are mounted every way, so make sure of it" if agreement < _AGREE else ""

    own = next((camera.name for camera in rig if _is_world(camera)), None)
    if own is not None:
        up, how = estimates[0]
        return FoundUp(up_text(up), f"{how}; the world is the frame of camera {own}{unsure}", level)
    for up, how in estimates:
        for name in UP_AXES:
            degrees = float(np.degrees(np.arccos(np.clip(up_vector(name) @ up, -1.0, 1.0))))
            if degrees <= SNAP_DEG:
                return FoundUp(name, f"the axis {degrees:.1f}° from {how}{unsure}", level)
    up, how = estimates[0]
    return FoundUp(up_text(up), f"{how}{unsure}", level)


def _is_world(camera: Camera) -> bool:
    """Whether the world is this camera's own frame."""
    return bool(np.allclose(camera.rotation, np.eye(3), atol=1e-6) and np.allclose(camera.translation, 0.0, atol=1e-6))
