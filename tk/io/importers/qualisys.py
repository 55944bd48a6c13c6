"""Qualisys: `*.qca.txt`, the calibration that QTM exports as XML.

Focal lengths and principal point are in 1/64 pixel of the whole sensor; `fov_video` is the part of the sensor that a
video shows. Lengths are millimetres: `x y z` is the camera centre; r11 … r33 map world to a camera frame with x right,
y up and z backwards, which is converted to OpenCV's. The distortion coefficients are OpenCV's: Pose2Sim divides them
by 64, but OpenCV's own calibration of the same cameras, in Pose2Sim's demo, has the undivided values.

A file also lists marker cameras, which record no videos.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from tk.errors import CalibrationError
from tk.io.importers.files import child, only, read_xml
from tk.io.importers.project import Format, Tables

#: QTM's units per pixel
_SUBPIXELS = 64.0

#: camera frame of QTM (x right, y up, z backwards) to OpenCV's
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])

_DISTORTIONS = (
    "radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3"
)  # fmt: skip


def read_tables(files: Sequence[Path]) -> Tables:
    """Read the video cameras of the one file."""
    path = only(files)
    listed = read_xml(path).findall("cameras/camera")
    if not listed:
        raise CalibrationError(f"{path}: has no <cameras> with <camera> in it; export the calibration from QTM again")
    active = [item for item in listed if item.get("active", "1") != "0"]
    videos = [item for item in active if _records_videos(item)] or active
    found = Tables(path, unit="mm", unit_from="the format")
    if len(videos) < len(listed):
        left_out = f"{len(listed) - len(videos)} of its {len(listed)} cameras record no videos"
        found.notes.append(f"{path}: {left_out}: left out")
    turned = []
    for index, item in enumerate(videos):
        name = item.get("serial") or str(index)
        where = f"{path}: camera {name!r}"
        view, intrinsic, transform = (child(item, tag, where) for tag in ("fov_video", "intrinsic", "transform"))
        left, top = view.number("left"), view.number("top")
        fx, fy, cx, cy = (
            intrinsic.number(key) / _SUBPIXELS
            for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        )
        rotation = _TO_OPENCV @ [[transform.number(f"r{row}{column}") for column in "123"] for row in "123"]
        found.add(
            name,
            size=[round(view.number("right") - left + 1), round(view.number("bottom") - top + 1)],
            matrix=[[fx, 0.0, cx - left], [0.0, fy, cy - top], [0.0, 0.0, 1.0]],
            distortions=[intrinsic.number(key, 0.0) for key in _DISTORTIONS],
            rotation=rotation,
            translation=-rotation @ [transform.number(key) for key in "xyz"],
        )
        if item.get("viewrotation", "0") != "0":
            turned.append(name)
    if turned:
        found.notes.append(
            f"{path}: QTM shows {', '.join(turned)} turned (viewrotation); their videos must be as the sensor sees them"
        )
    return found


def _records_videos(item: Element) -> bool:
    model = item.get("model", "none").lower()
    return "video" in model or model == "none"


FORMAT = Format("Qualisys", ("*.qca.txt",), read_tables, videos=(".", "videos", "Videos"))
