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
from tk.io.importers.files import Attributes, matching, only, read_xml
from tk.io.importers.project import Cameras, Format, check_camera
from tk.model.cameras.camera import Camera, Rig

#: QTM's units per pixel
_SUBPIXELS = 64.0

#: camera frame of QTM (x right, y up, z backwards) to OpenCV's
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])


def read_cameras(files: Sequence[Path]) -> Cameras:
    """Read the video cameras of the one file.

    Raises:
        CalibrationError: there are several files, the file is damaged, or it has fewer than two video cameras.
    """
    path = only(files)
    root = read_xml(path)
    listed = root.findall("cameras/camera")
    if not listed:
        raise CalibrationError(f"{path}: has no <cameras> with <camera> in it; export the calibration from QTM again")
    active = [item for item in listed if item.get("active", "1") != "0"]
    videos = [item for item in active if _records_videos(item)] or active
    cameras = [_camera(item, index, path) for index, item in enumerate(videos)]
    if len(cameras) < 2:
        raise CalibrationError(f"{path}: {len(cameras)} active video camera; a capture needs at least 2")
    notes = []
    if len(videos) < len(listed):
        notes.append(f"{path}: {len(listed) - len(videos)} of its {len(listed)} cameras record no videos: left out")
    turned = [camera.name for camera, item in zip(cameras, videos, strict=True) if item.get("viewrotation", "0") != "0"]
    if turned:
        notes.append(
            f"{path}: QTM shows {', '.join(turned)} turned (viewrotation); their videos must be as the sensor sees them"
        )
    keys = tuple(camera.name for camera in cameras)
    return Cameras(path, Rig(tuple(cameras)), keys, tuple(notes), unit="mm", unit_from="the format")


def _records_videos(item: Element) -> bool:
    model = item.get("model", "none").lower()
    return "video" in model or model == "none"


def _camera(item: Element, index: int, path: Path) -> Camera:
    name = item.get("serial") or str(index)
    where = f"{path}: camera {name!r}"
    view, intrinsic, transform = (Attributes.child(item, tag, where) for tag in ("fov_video", "intrinsic", "transform"))
    left, top = view.number("left"), view.number("top")
    fx, fy, cx, cy = (
        intrinsic.number(key) / _SUBPIXELS for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    distortions = [
        intrinsic.number(key, 0.0)
        for key in (
            *("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2"),
            "radialDistortion3",
        )
    ]
    world_to_qtm = np.array([[transform.number(f"r{row}{column}") for column in "123"] for row in "123"])
    rotation = _TO_OPENCV @ world_to_qtm
    center = np.array([transform.number(key) for key in "xyz"])
    camera = Camera(
        name=name,
        width=round(view.number("right") - left + 1),
        height=round(view.number("bottom") - top + 1),
        matrix=np.array([[fx, 0.0, cx - left], [0.0, fy, cy - top], [0.0, 0.0, 1.0]]),
        distortions=np.array(distortions),
        rotation=rotation,
        translation=-rotation @ center,
    )
    return check_camera(camera, where)


def _find(root: Path) -> list[Path]:
    return matching(root, "*.qca.txt")


FORMAT = Format(tool="Qualisys", files="*.qca.txt", find=_find, read=read_cameras, videos=(".", "videos", "Videos"))
