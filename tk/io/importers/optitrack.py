"""OptiTrack: `*.mcal`, the calibration that Motive 3.2 and later write as XML, in UTF-16.

    <Camera Serial="C11764"> <Properties CameraID="13"/> <Attributes ImagerPixelWidth ImagerPixelHeight/>
      <IntrinsicStandardCameraModel LensCenterX … HorizontalFocalLength … k1 k2 k3 TangentialX TangentialY/>
      <Extrinsic X Y Z OrientMatrix0 … OrientMatrix8/>

The standard camera model is OpenCV's; <Intrinsic> is Motive's own, which is not described. X, Y, Z is the camera's
centre in metres. The matrix maps the camera's frame (x right, y up, z backwards) to the world, whose y axis points up.
Motive's description does not say so: the cameras decide whether this, or the transposed matrix, is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from tk.errors import CalibrationError
from tk.io.importers.files import attributes, child, only, read_xml
from tk.io.importers.project import Format, Tables
from tk.io.importers.readings import choose, placed, y_up

#: first letter of the serial numbers of cameras that record colour
_COLOUR = "C"


def _read(files: Sequence[Path]) -> Tables:
    path = only(files)
    listed = read_xml(path).findall(".//Camera[@Serial]")
    if not listed:
        raise CalibrationError(f"{path}: has no <Camera Serial=…>; export the calibration from Motive 3.2 or later")
    found = Tables(path, unit="m", unit_from="the format")
    some = any(item.get("Serial", "").startswith(_COLOUR) for item in listed)
    for item in listed:
        serial = item.get("Serial", "")
        with found.optional(serial, some and not serial.startswith(_COLOUR)):
            _add(found, item, serial)
    choose(
        found,
        {
            "its matrices map the camera's frame to the world": y_up(lambda R, v: placed(R.T, v)),
            "its matrices map the world to the camera's frame": y_up(placed),
        },
    )
    return found


def _add(found: Tables, item: Element, serial: str) -> None:
    where = f"{found.source}: camera {serial!r}"
    lens, pose = child(item, "IntrinsicStandardCameraModel", where), child(item, "Extrinsic", where)
    sensor = child(item, "Attributes", where)
    properties = item.find("Properties")
    number = None if properties is None else attributes(properties, where).values.get("CameraID")
    focal = [lens.number(f"{key}FocalLength") for key in ("Horizontal", "Vertical")]
    center = [lens.number(f"LensCenter{key}") for key in "XY"]
    found.add(
        serial,
        size=[sensor.number("ImagerPixelWidth"), sensor.number("ImagerPixelHeight")],
        matrix=[[focal[0], 0.0, center[0]], [0.0, focal[1], center[1]], [0.0, 0.0, 1.0]],
        distortions=[lens.number(key, 0.0) for key in ("k1", "k2", "TangentialX", "TangentialY", "k3")],
        rotation=np.reshape([pose.number(f"OrientMatrix{index}") for index in range(9)], (3, 3)),
        translation=[pose.number(key) for key in "XYZ"],
        key=f"Camera {number:g}" if isinstance(number, float) else "",
    )


FORMAT = Format("OptiTrack", ("*.mcal",), _read, videos=(".", "videos"), up="y", videos_of_all=False)
