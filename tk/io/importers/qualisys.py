"""Qualisys: `*.qca.txt`, the calibration that QTM exports as XML; Theia writes a variant of it.

Focal lengths and principal point are in 1/64 pixel of the whole sensor; `fov_video` is the part of the sensor that a
video shows. Without it, as in Theia's files, videos show the whole sensor, whose unit is then that of its extent.
Lengths are millimetres: `x y z` is the camera centre; r11 … r33 map world to a camera frame with x right, y up and z
backwards, which is converted to OpenCV's. Theia's description has a translation instead of the centre, and its axes are
only in a picture: the cameras decide. The distortion coefficients are OpenCV's: Pose2Sim divides them by 64, but
OpenCV's own calibration of the same cameras, in Pose2Sim's demo, has the undivided values.

A file also lists marker cameras. Their models do not say for sure which cameras record videos (Oqus and Miqus Hybrid
can), so a camera with a video is a video camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from tk.errors import CalibrationError
from tk.io.importers.files import child, matching, only, read_xml
from tk.io.importers.project import Format, Tables
from tk.io.importers.readings import choose, placed, to_camera, y_up
from tk.io.paths import looks_like

#: QTM's units per pixel
_SUBPIXELS = 64.0

#: a larger extent of the sensor is in 1/64 pixel: no camera has as many pixels, and none has as few in 1/64
_LEAST_SUBPIXELS = 12_800

#: readings of <transform>, QTM's first
_READINGS = {
    "x y z is a camera's centre, its y axis points up": y_up(placed),
    "x y z is a translation, the camera's y axis points up": y_up(to_camera),
    "x y z is a camera's centre, its y axis points down": placed,
    "x y z is a translation, the camera's y axis points down": to_camera,
}

_DISTORTIONS = (
    "radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3"
)  # fmt: skip


def read_tables(files: Sequence[Path]) -> Tables:
    """Read the cameras of the one file."""
    path = only(files)
    listed = read_xml(path).findall("cameras/camera")
    if not listed:
        raise CalibrationError(f"{path}: has no <cameras> with <camera> in it; export the calibration from QTM again")
    active = [item for item in listed if item.get("active", "1") != "0"]
    found = Tables(path, unit="mm", unit_from="the format")
    if len(active) < len(listed):
        found.notes.append(f"{path}: {len(listed) - len(active)} of its {len(listed)} cameras are inactive: left out")
    some = any(_records_videos(item) for item in active)
    turned = []
    for index, item in enumerate(active):
        name = item.get("serial") or str(index)
        turns = {"90": 1, "180": 2, "270": 3}.get(item.get("viewrotation", "0"), 0)
        with found.optional(name, some and not _records_videos(item)):
            _add(found, item, name, turns if turns == 2 else 0)  # it is unknown to which side QTM turns the others
            if turns:
                turned.append(name)
    choose(found, _READINGS)
    turned = [name for name in turned if name not in found.markers]
    if any(item.find("fov_video") is None and item.find("fov_video_max") is None for item in active):
        found.notes.append(f"{path}: has no fov_video: the videos are taken to show the whole sensor")
    if turned:
        found.notes.append(
            f"{path}: QTM shows {', '.join(turned)} turned (viewrotation); their videos must be as the sensor sees them"
        )
    return found


def _add(found: Tables, item: Element, name: str, turns: int) -> None:
    where = f"{found.source}: camera {name!r}"
    intrinsic, transform = (child(item, tag, where) for tag in ("intrinsic", "transform"))
    view = next((tag for tag in ("fov_video", "fov_video_max") if item.find(tag) is not None), None)
    unit = _SUBPIXELS
    if view is not None:
        shown = child(item, view, where)
        left, top, right, bottom = (shown.number(key) for key in ("left", "top", "right", "bottom"))
    else:
        extent = [intrinsic.number(f"sensor{key}") for key in ("MinU", "MinV", "MaxU", "MaxV")]
        unit = _SUBPIXELS if max(extent) >= _LEAST_SUBPIXELS else 1.0
        left, top = extent[0] / unit, extent[1] / unit
        # the extent ends with the last pixel, or after it
        right, bottom = (2 * (int(end / unit + 1) // 2) - 1 for end in extent[2:])
    fx, fy, cx, cy = (
        intrinsic.number(key) / unit for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    rotation = [[transform.number(f"r{row}{column}") for column in "123"] for row in "123"]
    found.add(
        name,
        size=[round(right - left + 1), round(bottom - top + 1)],
        matrix=[[fx, intrinsic.number("skew", 0.0) / unit, cx - left], [0.0, fy, cy - top], [0.0, 0.0, 1.0]],
        distortions=[intrinsic.number(key, 0.0) for key in _DISTORTIONS],
        rotation=rotation,
        translation=[transform.number(key) for key in "xyz"],
        turns=turns,
    )


def _records_videos(item: Element) -> bool:
    model = item.get("model", "none").lower()
    return "video" in model or model == "none"


def _find(root: Path) -> list[Path]:
    """Return QTM's files in a folder, or else texts with the same content, as Theia writes them."""
    named = matching(root, "*.qca.txt")
    return named or [path for path in matching(root, "*.txt", "*.xml") if _is_calibration(path)]


def _is_calibration(path: Path) -> bool:
    return path.is_file() and looks_like(rb".*<calibration.*<camera")(path)


FORMAT = Format("Qualisys", ("*.qca.txt",), read_tables, videos=(".", "videos", "Videos"), search=_find)
