"""Infer the working volume from the cameras."""

from __future__ import annotations

from tk.errors import VolumeError
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import closest_to_axes, common_boxes
from tk.model.cameras.volume import Volume

#: least side of a working volume, metres: a person with arms spread needs more
ROOM_M = 1.5


def find_volume(rig: Rig) -> tuple[Volume | None, str]:
    """Return the working volume, around the point nearest to all optical axes, and how it was found.

    It is the box that all cameras see, if a person fits into it; else the box that all but one see, and so on.
    """
    try:
        middle = closest_to_axes(rig)
        boxes = list(common_boxes(rig))
    except VolumeError as reason:
        return None, f"no [volume] could be inferred: {reason}; give one"
    behind = [camera.name for camera in rig if camera.to_camera(middle)[0, 2] <= 0]
    looks = f"; {', '.join(behind)} look away from it: check the calibration" if behind else ""
    if not boxes:
        return None, f"no [volume] could be inferred: no two cameras see the point nearest to all axes{looks}; give one"
    roomy = [(views, box) for views, box in boxes if min(box.size) >= ROOM_M]
    views, box = roomy[0] if roomy else boxes[0]
    who = "all cameras see" if views == len(rig) else f"{views} of the {len(rig)} cameras see"
    return _rounded(box), f"the box that {who} around the point nearest to their axes{looks}"


def _rounded(volume: Volume) -> Volume:
    """Round to centimetres, for people to read and edit."""
    center = [round(x, 2) for x in volume.center]
    size = [max(round(x, 2), 0.01) for x in volume.size]
    return Volume((center[0], center[1], center[2]), (size[0], size[1], size[2]))
