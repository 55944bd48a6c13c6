"""CMU Panoptic Studio: `calibration_*.json` for all of the dome's 500 cameras, and the videos of some.

    SEQUENCE/calibration_171204_pose1.json       name "00_12", type "hd", resolution, K, distCoef, R, t
    SEQUENCE/hdVideos/hd_00_12.mp4               or hdImgs/00_12/00_12_00000000.jpg, vgaVideos/, kinectVideos/

Lengths are centimetres; R and t map world to camera; the world's y axis points down.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tk.errors import CalibrationError
from tk.io.importers.files import matching, only, read_text
from tk.io.importers.project import Cameras, Format, check_camera
from tk.io.toml import Table
from tk.model.cameras.camera import Camera, Rig


def _find(root: Path) -> list[Path]:
    return matching(root, "calibration_*.json")


def _read(files: Sequence[Path]) -> Cameras:
    path = only(files)
    try:
        document = json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as reason:
        raise CalibrationError(f"{path}: invalid JSON: {reason}") from None
    listed = document.get("cameras") if isinstance(document, Mapping) else None
    if not isinstance(listed, list) or not all(isinstance(item, Mapping) for item in listed):
        raise CalibrationError(f"{path}: has no list of `cameras`")
    cameras = [_camera(item, index, path) for index, item in enumerate(listed)]
    keys = tuple(f"{item.get('type', '')}_{item.get('name', '')}" for item in listed)
    return Cameras(path, Rig(tuple(cameras)), keys, unit="cm", unit_from="the format")


def _camera(values: Mapping[str, object], index: int, path: Path) -> Camera:
    name = Table(values, f"{path}: camera {index}", CalibrationError).text("name", "")
    where = f"{path}: camera {name!r}"
    table = Table(values, where, CalibrationError)
    size = table.array("resolution", (2,))
    camera = Camera(
        name=name,
        width=int(size[0]),
        height=int(size[1]),
        matrix=table.array("K", (3, 3)),
        distortions=table.array("distCoef", (5,), (4,)),
        rotation=table.array("R", (3, 3)),
        translation=np.ravel(table.array("t", (3, 1), (3,), (1, 3))),
    )
    return check_camera(camera, where)


FORMAT = Format(
    tool="CMU Panoptic",
    files="calibration_*.json",
    find=_find,
    read=_read,
    videos=("hdVideos", "hdImgs", "kinectVideos", "kinectImgs", "vgaVideos", "vgaImgs", "videos", "."),
    up="-y",
    videos_of_all=False,
)
