"""Which way is up in a calibration's world, and where in it the person is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tk.errors import VolumeError
from tk.model.camera import Camera, Rig
from tk.model.common_view import closest_to_axes, common_boxes
from tk.model.up import UP_AXES, up_text, up_vector
from tk.model.volume import Volume

#: a direction this close to an axis is meant to be the axis
SNAP_DEG = 10.0

#: a working volume that is narrower than this has no room for a person, metres
ROOM_M = 1.5

#: the mean of the cameras' upward directions is shorter than this when they are mounted every way
_AGREE = 0.4

#: cameras whose rightward directions are off the horizontal by more than this, root mean square, are rolled
_ROLLED_DEG = 4.0

#: the two greater eigenvalues of the rightward directions, as a ratio, below which these do not span the horizontal
_SPAN = 0.05


@dataclass(frozen=True)
class FoundUp:
    """The world's upward direction: ``up`` as :func:`tk.model.up.up_text` tells it, and ``how`` it was found."""

    up: str
    how: str


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
    estimates = [(mean, "the mean of the directions that point up in the pictures")]
    right = np.array([camera.rotation[0] for camera in rig])
    values, vectors = np.linalg.eigh(right.T @ right)  # ascending
    across = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    if values[1] > _SPAN * values[2] and across @ mean > np.cos(np.pi / 4):
        second = (across, "the direction across those that point right in the pictures")
        roll_deg = float(np.degrees(np.sqrt(max(values[0], 0.0) / len(rig))))
        estimates = [second] if roll_deg <= _ROLLED_DEG else [*estimates, second]
    unsure = "; the cameras are mounted every way, so make sure of it" if agreement < _AGREE else ""

    own = next((camera.name for camera in rig if _is_world(camera)), None)
    if own is not None:
        up, how = estimates[0]
        return FoundUp(up_text(up), f"{how}; the world is the frame of camera {own}{unsure}")
    for up, how in estimates:
        for name in UP_AXES:
            degrees = float(np.degrees(np.arccos(np.clip(up_vector(name) @ up, -1.0, 1.0))))
            if degrees <= SNAP_DEG:
                return FoundUp(name, f"the axis {degrees:.1f}° from {how}{unsure}")
    up, how = estimates[0]
    return FoundUp(up_text(up), f"{how}{unsure}")


def _is_world(camera: Camera) -> bool:
    """Whether the world is this camera's own frame."""
    return bool(np.allclose(camera.rotation, np.eye(3), atol=1e-6) and np.allclose(camera.translation, 0.0, atol=1e-6))


def find_volume(rig: Rig) -> tuple[Volume | None, str]:
    """A working volume where the views overlap, around the point nearest to all optical axes; and how it was found.

    What all cameras see in common, if a person fits into it; else what all but one do, and so on, down to two.
    """
    try:
        middle = closest_to_axes(rig)
        boxes = list(common_boxes(rig))
    except VolumeError as reason:
        return None, f"no [volume] could be inferred: {reason}; give one"
    behind = [camera.name for camera in rig if camera.to_camera(middle)[0, 2] <= 0]
    looks = f"; {', '.join(behind)} look away from it: is the calibration right?" if behind else ""
    if not boxes:
        return None, f"no [volume] could be inferred: no two cameras see the point nearest to all axes{looks}; give one"
    roomy = [(views, box) for views, box in boxes if min(box.size) >= ROOM_M]
    views, box = roomy[0] if roomy else boxes[0]
    who = "all cameras see" if views == len(rig) else f"{views} of the {len(rig)} cameras see"
    return _rounded(box), f"the box around what {who} near the point that is nearest to their axes{looks}"


def _rounded(volume: Volume) -> Volume:
    """To centimetres, for people to read and edit."""
    center = [round(x, 2) for x in volume.center]
    size = [max(round(x, 2), 0.01) for x in volume.size]
    return Volume((center[0], center[1], center[2]), (size[0], size[1], size[2]))
