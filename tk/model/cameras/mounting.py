"""Infers the up direction of a calibration's world from the mounting of its cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.up import UP_AXES, up_text, up_vector

#: an inferred direction this close to an axis is taken to be the axis, degrees: cameras that look down tilt it by less
SNAP_DEG = 10.0

#: the cameras are mounted differently if the mean of their upward directions is shorter than this
_AGREE = 0.4

#: cameras are rolled if their rightward directions are off the horizontal by more than this, root mean square, degrees
_ROLLED_DEG = 4.0

#: least ratio of the two largest eigenvalues of the rightward directions at which these span the horizontal plane
_SPAN = 0.05


@dataclass(frozen=True)
class FoundUp:
    """The world's up direction."""

    up: str  # text as of `tk.model.cameras.up.up_text`
    how: str  # how it was inferred, for messages
    level: bool = False  # whether it comes from cameras that are not rolled; it is then right to about 2°


def infer_up(rig: Rig) -> FoundUp:
    """Infer the up direction from cameras that are mounted upright.

    The first estimate is the mean of the directions that point up in the images. Cameras that look down tilt it, and
    those on one side of a room tilt it alike. A camera that is not rolled has a horizontal rightward direction however
    far it looks down. If these directions span a plane, the second estimate is its normal, on the side of the first. It
    counts if the cameras agree with it to 4° (root mean square); otherwise they are rolled, and the first counts.

    An estimate within 10° of an axis is that axis, because people align the world's axes with the floor; for rolled
    cameras either estimate may be. No axis is preferred if the world is the frame of one of the cameras.
    """
    mean = -np.mean([camera.rotation[1] for camera in rig], axis=0)
    agreement = float(np.linalg.norm(mean))
    if agreement < 1e-6:
        return FoundUp("z", "the cameras are mounted in opposite directions; z is a guess")
    mean /= agreement
    level = False
    estimates = [(mean, "the mean of the directions that point up in the images")]
    right = np.array([camera.rotation[0] for camera in rig])
    values, vectors = np.linalg.eigh(right.T @ right)  # ascending
    across = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    if values[1] > _SPAN * values[2] and across @ mean > np.cos(np.pi / 4):
        second = (across, "the direction perpendicular to those that point right in the images")
        roll_deg = float(np.degrees(np.sqrt(max(values[0], 0.0) / len(rig))))
        level = roll_deg <= _ROLLED_DEG
        estimates = [second] if level else [*estimates, second]
    unsure = "; the cameras are mounted differently: check it" if agreement < _AGREE else ""

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
    """Return whether the world is this camera's own frame."""
    return bool(np.allclose(camera.rotation, np.eye(3), atol=1e-6) and np.allclose(camera.translation, 0.0, atol=1e-6))
