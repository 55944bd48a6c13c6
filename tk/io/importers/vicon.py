"""Vicon: `*.xcp`, the calibration that Nexus and its relatives write as XML.

    <Camera DEVICEID="2114551" TYPE="…Video…" SENSOR_SIZE="1920 1080" PIXEL_ASPECT_RATIO="1">
      <KeyFrames><KeyFrame FOCAL_LENGTH PRINCIPAL_POINT ORIENTATION POSITION VICON_RADIAL2/></KeyFrames>

POSITION is the camera centre in millimetres; ORIENTATION is the quaternion of the rotation from world to camera (x
right, y down, z forward), real part last. A file also lists marker cameras; a camera without calibration has no key
frame. The videos are called `TRIAL.2114551.….avi`.

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
from tk.io.importers.files import Attributes, matching, only, read_xml
from tk.io.importers.project import Cameras, Format, check_camera
from tk.model.cameras.camera import Camera, Rig

#: words of VICON_RADIAL2 before the coefficients: the model's name and the centre of distortion
_BEFORE_RADIAL2 = 3

#: a note reports a larger error of the fitted distortion, pixels. Masks are accurate to about a pixel.
_WELL_FITTED_PX = 0.1


def _read(files: Sequence[Path]) -> Cameras:
    path = only(files)
    root = read_xml(path)
    listed = root.findall("Camera")
    if not listed:
        raise CalibrationError(f"{path}: has no <Camera>; save the calibration from Vicon's program again")
    videos = [item for item in listed if _records_videos(item)] or listed
    cameras: list[Camera] = []
    keys: list[str] = []
    notes: list[str] = []
    if len(videos) < len(listed):
        notes.append(f"{path}: {len(listed) - len(videos)} of its {len(listed)} cameras record no videos: left out")
    for index, item in enumerate(videos):
        name = item.get("DEVICEID") or item.get("USERID") or str(index)
        if item.find("KeyFrames/KeyFrame") is None:
            notes.append(f"{path}: camera {name!r} is not calibrated: left out")
            continue
        camera, error_px = _camera(item, name, path)
        if error_px > _WELL_FITTED_PX:
            notes.append(f"{path}: camera {name!r}: OpenCV's distortion is up to {error_px:.2g} px off Vicon's")
        cameras.append(camera)
        keys.append(item.get("NAME") or name)
    if len(cameras) < 2:
        raise CalibrationError(f"{path}: {len(cameras)} calibrated video camera; a capture needs at least 2")
    return Cameras(path, Rig(tuple(cameras)), tuple(keys), tuple(notes), unit="mm", unit_from="the format")


def _records_videos(item: Element) -> bool:
    kind = f"{item.get('TYPE', '')} {item.get('DISPLAY_TYPE', '')}".lower()
    return "video" in kind or "vue" in kind


def _camera(item: Element, name: str, path: Path) -> tuple[Camera, float]:
    """Return the camera and the largest error of its distortion, pixels."""
    where = f"{path}: camera {name!r}"
    device, key_frame = Attributes(item, where), Attributes.child(item, "KeyFrames/KeyFrame", where)
    width, height = (round(value) for value in device.numbers("SENSOR_SIZE", 2)[:2])
    aspect = device.number("PIXEL_ASPECT_RATIO", 1.0)
    focal = key_frame.number("FOCAL_LENGTH")
    cx, cy = key_frame.numbers("PRINCIPAL_POINT", 2)[:2]
    if not aspect > 0 or not focal > 0:
        raise CalibrationError(f"{where}: FOCAL_LENGTH = {focal:g}, PIXEL_ASPECT_RATIO = {aspect:g} must be positive")
    quaternion = np.array(key_frame.numbers("ORIENTATION", 4)[:4])
    if np.linalg.norm(quaternion) < 1e-6:
        raise CalibrationError(f"{where}: ORIENTATION is not a rotation: its four numbers are zero")
    rotation = scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix()
    center = np.array(key_frame.numbers("POSITION", 3)[:3])
    reach_px = max(float(np.hypot(x - cx, y - cy)) for x in (0, width) for y in (0, height))
    try:
        radial, error_px = _opencv_radial(_vicon_radial(key_frame), focal, reach_px)
    except ValueError as reason:
        raise CalibrationError(f"{where}: {reason}") from None
    k1, k2, k3 = radial
    camera = Camera(
        name=name,
        width=width,
        height=height,
        matrix=np.array([[focal, 0.0, cx], [0.0, focal / aspect, cy], [0.0, 0.0, 1.0]]),
        distortions=np.array([k1, k2, 0.0, 0.0, k3]),
        rotation=rotation,
        translation=-rotation @ center,
    )
    return check_camera(camera, where), error_px


def _vicon_radial(key_frame: Attributes) -> list[float]:
    """Return k₁, k₂, k₃ of Vicon's model, pixels to the power of -2, -4, -6."""
    if "VICON_RADIAL2" in key_frame.element.attrib:
        values = key_frame.numbers("VICON_RADIAL2", 1, skip=_BEFORE_RADIAL2)
    else:
        values = key_frame.numbers("VICON_RADIAL", 1, [0.0])
    return [*values, 0.0, 0.0][:3]


def _opencv_radial(vicon: list[float], focal_px: float, reach_px: float) -> tuple[NDArray[np.float64], float]:
    """Return k1, k2, k3 (3,) of OpenCV's model, fitted within ``reach_px`` of the principal point, and the error, px.

    Raises:
        ValueError: Vicon's model is not monotonic within that distance.
    """
    distorted = np.linspace(0.0, reach_px, 200)[1:]
    squares = distorted**2
    ideal = distorted * (1 + vicon[0] * squares + vicon[1] * squares**2 + vicon[2] * squares**3)
    if not (np.diff(ideal) > 0).all():
        raise ValueError("the distortion is not monotonic within the image; calibrate again")
    x, y = ideal / focal_px, distorted / focal_px
    A = np.stack([x**3, x**5, x**7], axis=1)
    scale = np.abs(A).max(axis=0)
    radial = np.linalg.lstsq(A / scale, y - x, rcond=None)[0] / scale
    return radial, float(np.abs(A @ radial + x - y).max() * focal_px)


def _find(root: Path) -> list[Path]:
    return matching(root, "*.xcp")


FORMAT = Format(
    tool="Vicon", files="*.xcp", find=_find, read=_read, videos=(".", "videos", "Videos"), videos_of_all=False
)
