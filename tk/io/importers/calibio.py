"""calib.io's Camera Calibrator: the calibration that it saves as JSON.

    Calibration: {cameras: [{model: {polymorphic_name, ptr_wrapper: {data: {parameters: {f: {val}, …}}}},
                             transform: {rotation: {rx, ry, rz}, translation: {x, y, z}}}]}

f and f · ar are the focal lengths; distortion and principal point are OpenCV's. The transform maps the first camera's
frame to the camera, with a Rodrigues vector. Lengths are in the unit in which the size of the board was given. The
cameras may have a serial number, and else no name: they are called camera_0, camera_1, … in the file's order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tk.errors import CalibrationError
from tk.io.importers.files import json_with, listed_cameras, only, read_json
from tk.io.importers.project import Format, Tables
from tk.io.toml import Table

_LENS = "libCalib::CameraModelOpenCV"

#: OpenCV's order, with its thin prism and its tilted sensor
_DISTORTIONS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")

#: bit of a `polymorphic_id` with which the file gives the name of a model; later cameras refer to the number alone
_NAMED = 1 << 31


def _read(files: Sequence[Path]) -> Tables:
    path = only(files)
    listed = listed_cameras(Table(read_json(path), str(path), CalibrationError).table("Calibration").values, path)
    found = Tables(path)
    models: dict[int, str] = {}
    for index, item in enumerate(listed):
        _add(found, item, index, models)
    if not any("serial" in item for item in listed):
        found.notes.append(
            f"{path}: does not name its cameras; they are called camera_0, camera_1, … in the file's order"
        )
    return found


def _add(found: Tables, item: Mapping[str, Any], index: int, models: dict[int, str]) -> None:
    """Add a camera. ``models``: names of the lens models by their numbers, which the file gives once."""
    name = f"camera_{index}"
    camera = Table(item, f"{found.source}: camera {index}", CalibrationError)
    serial = camera.values.get("serial")
    if isinstance(serial, (str, int)) and str(serial).strip():
        name = str(serial)
    model = camera.table("model")
    given = model.values.get("polymorphic_id")
    number = given & ~_NAMED if isinstance(given, int) else 0
    if "polymorphic_name" in model:
        models[number] = model.text("polymorphic_name", "")
    if models.get(number, _LENS) != _LENS:
        model.fail(f"the lens is a {models[number]}; tk reads {_LENS}: calibrate with the OpenCV model")
    data = model.table("ptr_wrapper").table("data")
    size = data.table("CameraModelCRT").table("CameraModelBase").table("imageSize")
    parameters = data.table("parameters")

    def value(key: str, default: float | None = None) -> float:
        return parameters.table(key).number("val", default) if key in parameters or default is None else default

    focal, transform = value("f"), camera.table("transform")
    rotation, translation = transform.table("rotation"), transform.table("translation")
    found.add(
        name,
        size=[size.number("width"), size.number("height")],
        matrix=[[focal, 0.0, value("cx")], [0.0, focal * value("ar", 1.0), value("cy")], [0.0, 0.0, 1.0]],
        distortions=[value(key, 0.0) for key in _DISTORTIONS],
        rotation=[rotation.number(key) for key in ("rx", "ry", "rz")],
        translation=[translation.number(key) for key in "xyz"],
    )


FORMAT = Format(
    "calib.io", ("*.json",), _read, videos=("videos", "images", "."), in_order=True,
    search=json_with(b'"Calibration"', b"libCalib::", b'"transform"'),
)  # fmt: skip
