"""Vicon: `*.xcp`, the calibration that Nexus and its relatives write as XML.

    <Camera DEVICEID="2114551" TYPE="…Video…" SENSOR_SIZE="1920 1080" PIXEL_ASPECT_RATIO="1">
      <KeyFrames><KeyFrame FOCAL_LENGTH PRINCIPAL_POINT ORIENTATION POSITION VICON_RADIAL2/></KeyFrames>

POSITION is the camera centre in millimetres; ORIENTATION is the quaternion of the rotation from world to camera (x
right, y down, z forward), real part last. A file also lists marker cameras; a camera without calibration has no key
frame. A camera with a video is a video camera, whatever its type. The videos are called `TRIAL.2114551.….avi`.

Vicon's distortion model is the inverse of OpenCV's: with r the distance from the principal point in pixels, the
undistorted point is (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) times as far away. OpenCV's coefficients are fitted to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.files import attributes, child, only, read_xml
from tk.io.importers.project import Format, Tables
from tk.io.toml import Table

#: words of an attribute that are its numbers; of VICON_RADIAL2 the name of the model and the centre come first
_WORDS = {"VICON_RADIAL2": slice(3, 6)}

#: a note reports a larger error of the fitted distortion, pixels. Masks are accurate to about a pixel.
_WELL_FITTED_PX = 0.1


def _read(files: Sequence[Path]) -> Tables:
    path = only(files)
    listed = read_xml(path).findall("Camera")
    if not listed:
        raise CalibrationError(f"{path}: has no <Camera>; save the calibration from Vicon's program again")
    found = Tables(path, unit="mm", unit_from="the format")
    some = any(_records_videos(item) for item in listed)
    for index, item in enumerate(listed):
        name = item.get("DEVICEID") or item.get("USERID") or str(index)
        marker = some and not _records_videos(item)
        if item.find("KeyFrames/KeyFrame") is None:
            if marker:
                found.unusable += 1
            else:
                found.leave_out(name, "is not calibrated")
            continue
        with found.optional(name, marker):
            _add(found, item, name)
    return found


def _records_videos(item: Element) -> bool:
    kind = f"{item.get('TYPE', '')} {item.get('DISPLAY_TYPE', '')}".lower()
    return "video" in kind or "vue" in kind


def _add(found: Tables, item: Element, name: str) -> None:
    where = f"{found.source}: camera {name!r}"
    device, key_frame = attributes(item, where), child(item, "KeyFrames/KeyFrame", where, _WORDS)
    width, height = device.array("SENSOR_SIZE", (2,))
    aspect, focal = device.number("PIXEL_ASPECT_RATIO", 1.0), key_frame.number("FOCAL_LENGTH")
    cx, cy = key_frame.array("PRINCIPAL_POINT", (2,))
    if not aspect > 0 or not focal > 0:
        device.fail(f"FOCAL_LENGTH = {focal:g}, PIXEL_ASPECT_RATIO = {aspect:g} must be positive")
    if skew := device.number("SKEW", 0.0):
        device.fail(f"SKEW = {skew:g}: a skewed sensor in this format is not supported; calibrate without skew")
    quaternion = key_frame.array("ORIENTATION", (4,))
    if np.linalg.norm(quaternion) < 1e-6:
        key_frame.fail("ORIENTATION is not a rotation: its four numbers are zero")
    rotation = scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix()
    reach_px = max(float(np.hypot(x - cx, y - cy)) for x in (0, width) for y in (0, height))
    (k1, k2, k3), error_px = _opencv_radial(_vicon_radial(key_frame), focal, reach_px, key_frame)
    if error_px > _WELL_FITTED_PX:
        found.notes.append(f"{where}: OpenCV's distortion is up to {error_px:.2g} px off Vicon's")
    found.add(
        name,
        key=item.get("NAME", ""),
        size=[round(width), round(height)],
        matrix=[[focal, 0.0, cx], [0.0, focal / aspect, cy], [0.0, 0.0, 1.0]],
        distortions=[k1, k2, 0.0, 0.0, k3],
        rotation=rotation,
        translation=-rotation @ key_frame.array("POSITION", (3,)),
    )


def _vicon_radial(key_frame: Table) -> list[float]:
    """Return k₁, k₂, k₃ of Vicon's model, pixels to the power of -2, -4, -6."""
    key = "VICON_RADIAL2" if "VICON_RADIAL2" in key_frame else "VICON_RADIAL"
    found = key_frame.array(key, (), (2,), (3,)) if key in key_frame else np.zeros(1)
    return [*np.ravel(found), 0.0, 0.0][:3]


def _opencv_radial(
    vicon: list[float], focal_px: float, reach_px: float, key_frame: Table
) -> tuple[NDArray[np.float64], float]:
    """Return k1, k2, k3 (3,) of OpenCV's model, fitted within ``reach_px`` of the principal point, and the error, px.

    A model that is not monotonic within that distance is an error.
    """
    distorted = np.linspace(0.0, reach_px, 200)[1:]
    squares = distorted**2
    ideal = distorted * (1 + vicon[0] * squares + vicon[1] * squares**2 + vicon[2] * squares**3)
    if not (np.diff(ideal) > 0).all():
        key_frame.fail("the distortion is not monotonic within the image; calibrate again")
    x, y = ideal / focal_px, distorted / focal_px
    A = np.stack([x**3, x**5, x**7], axis=1)
    scale = np.abs(A).max(axis=0)
    radial = np.linalg.lstsq(A / scale, y - x, rcond=None)[0] / scale
    return radial, float(np.abs(A @ radial + x - y).max() * focal_px)


FORMAT = Format("Vicon", ("*.xcp",), _read, videos=(".", "videos", "Videos"), videos_of_all=False)
