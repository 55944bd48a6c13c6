"""multical: `calibration.json`.

    cameras: {"cam1": {model, image_size: [width, height], K, dist: [[k1 k2 p1 p2 k3 …]]}}
    camera_poses: {"cam1": {R, T}, "cam2_to_cam1": {R, T}}

R and T of a name alone map the rig's frame to the camera. Those of "cam2_to_cam1" map the frame of cam1 to that of
cam2: multical computes them as the pose of cam2 times the inverse of that of cam1. Lengths are in the unit in which the
size of the board was given, usually metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.files import json_with, only, read_json
from tk.io.importers.project import Format, Tables
from tk.io.toml import Table

#: what multical writes between two cameras' names
_TO = "_to_"


def _read(files: Sequence[Path]) -> Tables:
    path = only(files)
    document = Table(read_json(path), str(path), CalibrationError)
    found = Tables(path)
    cameras = document.table("cameras")
    poses = _poses(document.table("camera_poses"), list(cameras.values))
    for name in cameras.values:
        camera = cameras.table(name)
        if name not in poses:
            found.leave_out(name, "has no pose in camera_poses")
            continue
        fisheye = "fisheye" in camera.text("model", "standard")
        found.add(
            name,
            size=camera.array("image_size", (2,)),
            matrix=camera.array("K", (3, 3)),
            distortions=camera.array("dist", (4,), (5,), (8,), (12,), (14,)),
            rotation=poses[name][:3, :3],
            translation=poses[name][:3, 3],
            fisheye=fisheye,
        )
    return found


def _poses(table: Table, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Return the pose (4, 4), world to camera, of each camera that is connected to one with a pose of its own."""
    poses: dict[str, NDArray[np.float64]] = {}
    relative: dict[str, tuple[str, NDArray[np.float64]]] = {}
    for key in table.values:
        pose = np.eye(4)
        entry = table.table(key)
        pose[:3, :3], pose[:3, 3] = entry.array("R", (3, 3)), entry.array("T", (3,))
        first = next((name for name in names if key.startswith(name + _TO) and key[len(name + _TO) :] in names), None)
        if key in names:
            poses[key] = pose
        elif first is not None:
            relative[first] = key[len(first + _TO) :], pose
        else:
            table.fail(f"{key} must be the name of a camera, or two names with {_TO} between them")
    while ready := [name for name, (other, _) in relative.items() if other in poses]:
        for name in ready:
            other, pose = relative.pop(name)
            poses[name] = pose @ poses[other]
    return poses


FORMAT = Format(
    "multical", ("calibration.json",), _read, videos=("videos", "images", "."),
    search=json_with(b'"camera_poses"', b'"cameras"', b'"image_size"'),
)  # fmt: skip
