"""Qualisys: `*.qca.txt`, the calibration that QTM exports as XML.

Focal lengths, centre and sensor limits are 64ths of a pixel of the whole sensor, of which `fov_video` is the part that
a video shows. Lengths are millimetres: `x y z` is the camera's place, r11 … r33 lead from the world to a camera frame
with x right, y up and z backwards, turned here into OpenCV's. The distortion's numbers are OpenCV's as they stand:
Pose2Sim divides them by 64, but the same cameras, calibrated by OpenCV for Pose2Sim's demo, have them undivided.

A file also lists marker cameras, which make no videos.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from tk.errors import CalibrationError
from tk.io.importers.files import matching, only, read_xml
from tk.io.importers.project import Cameras, Project, Request, assemble, check_camera, in_metres
from tk.io.importers.videos import Places
from tk.io.importers.xml_values import Attributes
from tk.model.cameras.camera import Camera, Rig

TOOL = "Qualisys"
LOOKS_FOR = "*.qca.txt"
NESTS = False

PLACES = Places((".", "videos", "Videos"))

#: parts of a pixel in which QTM counts
_SUBPIXELS = 64.0

#: camera frame of QTM (x right, y up, z backwards) to OpenCV's
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])


def detect(root: Path) -> bool:
    return bool(matching(root, "*.qca.txt"))


def read(root: Path, request: Request) -> Project:
    path = only(matching(root, "*.qca.txt"), "calibrations")
    return assemble(TOOL, read_cameras(path, request), request, PLACES)


def read_cameras(path: Path, request: Request) -> Cameras:
    """The video cameras of a file, metres.

    Raises:
        CalibrationError: it is no such file, or damaged, or has fewer than two of them.
    """
    root = read_xml(path)
    listed = root.findall("cameras/camera")
    if not listed:
        raise CalibrationError(f"{path}: has no <cameras> with <camera> in it; export the calibration from QTM again")
    active = [item for item in listed if item.get("active", "1") != "0"]
    videos = [item for item in active if _makes_videos(item)] or active
    cameras = [_camera(item, index, path) for index, item in enumerate(videos)]
    if len(cameras) < 2:
        raise CalibrationError(f"{path}: {len(cameras)} active video camera; a capture needs at least 2")
    notes = []
    if len(videos) < len(listed):
        notes.append(f"{path}: {len(listed) - len(videos)} of its {len(listed)} cameras make no videos: left out")
    turned = [camera.name for camera, item in zip(cameras, videos, strict=True) if item.get("viewrotation", "0") != "0"]
    if turned:
        notes.append(
            f"{path}: QTM shows {', '.join(turned)} turned (viewrotation); their videos are taken to be as the sensor "
            "sees"
        )
    found = Cameras(path, Rig(tuple(cameras)), tuple(camera.name for camera in cameras), tuple(notes))
    return in_metres(found, request, "mm", always=True)


def _makes_videos(item: Element) -> bool:
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
