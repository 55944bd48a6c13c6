"""Files as OpenCV's FileStorage writes them, YAML or JSON, with the names of OpenCV's samples.

    cam1.yml, cam2.yml …           camera_matrix, distortion_coefficients, image_width, image_height, rvec, tvec
    calibration.json               {"cam1": {the same}, "cam2": {…}}
    intrinsics.yml, extrinsics.yml M1, D1, M2, D2; R, T of `stereoCalibrate`: the first camera's frame to the second's

rvec (or R) and tvec (or T) map world to camera, as `solvePnP` returns them. If the cameras then look past each other,
but at one place with the inverse, they are taken for the camera's own pose. Lengths are in the unit of the board.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tk.errors import CalibrationError
from tk.io.importers.files import contains, matching
from tk.io.importers.project import Format, Tables
from tk.io.importers.readings import choose, of_camera, to_camera
from tk.io.importers.storage import numbers, read_storage
from tk.io.toml import Table

# names of the entries, without underscores and in small letters
_MATRIX = ("cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx", "k", "m")
_DISTORTIONS = ("distortioncoefficients", "distcoeffs", "distcoefs", "distortion", "distortions", "dist", "d")
_ROTATION = ("rvec", "rotationvector", "r", "rotation", "rotationmatrix", "rot")
_TRANSLATION = ("tvec", "translationvector", "t", "translation")
_SIZE = ("imagesize", "size", "resolution")
_WIDTH, _HEIGHT = ("imagewidth", "width"), ("imageheight", "height")

#: bytes of which one is in every file that is looked into
_SIGNS = (
    b"camera_matrix", b"cameraMatrix", b"CameraMatrix", b"opencv-matrix", b"dist_coeffs", b"distCoeffs", b"rvec",
    b"tvec", b"mtx", b'"K"',
)  # fmt: skip


def _read(files: Sequence[Path]) -> Tables:
    documents = [(path, numbers(read_storage(path))) for path in files if _is_opencv(path)]
    found = Tables(files[0].parent if len(files) > 1 else files[0])
    found.notes += [f"{path}: holds no camera: left out" for path in files if not _is_opencv(path)]
    if stereo := _stereo(documents):
        for one in stereo:
            _add(found, *one)
        return found
    for path, name, table in _cameras(documents):
        if table is None:
            found.notes.append(f"{path}: holds no camera_matrix: left out")
        elif _entry(table, _ROTATION) and _entry(table, _TRANSLATION):
            _add(found, name, table)
        else:
            found.leave_out(name, "has no rvec and tvec, where it stands")
    if found.cameras:
        readings = {"rvec and tvec map world to camera": to_camera, "rvec and tvec map camera to world": of_camera}
        choose(found, readings)
    return found


def _cameras(documents: Sequence[tuple[Path, Mapping[str, Any]]]) -> Iterator[tuple[Path, str, Table | None]]:
    """Yield file, name and table of each camera: a file's own, or those in it; no table for a file without any.

    A file's `camera_name` counts if no other file has the same, as a default of the program that wrote them.
    """
    given = Counter(str(document.get("camera_name")) for _, document in documents)
    for path, document in documents:
        whole = Table(document, str(path), CalibrationError)
        if _entry(whole, _MATRIX):
            name = str(document.get("camera_name") or path.stem)
            yield path, path.stem if given[name] > 1 else name, whole
            continue
        inside = document.get("cameras", document)
        listed = (
            inside.items()
            if isinstance(inside, Mapping)
            else (
                (str(item.get("name", index)), item) for index, item in enumerate(inside) if isinstance(item, Mapping)
            )
        )
        tables = [
            (str(name), Table(values, f"{path}: camera {name!r}", CalibrationError))
            for name, values in listed
            if isinstance(values, Mapping)
        ]
        cameras: list[tuple[Path, str, Table | None]] = [
            (path, name, table) for name, table in tables if _entry(table, _MATRIX)
        ]
        yield from cameras or [(path, "", None)]


def _stereo(documents: Sequence[tuple[Path, Mapping[str, Any]]]) -> list[tuple[str, Table, Any, Any]] | None:
    """Return the two cameras of `stereoCalibrate` with their poses; None if the files are not of a pair."""
    merged: dict[str, Any] = {}
    for _, document in documents:
        merged |= document
    whole = Table(merged, ", ".join(str(path) for path, _ in documents), CalibrationError)
    pair: list[tuple[str, Table, Any, Any]] = []
    for side in ("1", "2"):
        own = {key.rstrip("_")[: -len(side)]: value for key, value in merged.items() if key.endswith(side)}
        table = Table({**_shared_size(whole), **own}, f"{whole.where}: camera {side}", CalibrationError)
        if not isinstance(table.values.get(_entry(table, _MATRIX)), list):  # k1 and k2 may be distortions
            return None
        pair.append((f"cam{side}", table, np.zeros(3), np.zeros(3)))
    if not (_entry(whole, _ROTATION) and _entry(whole, _TRANSLATION)):
        raise CalibrationError(f"{whole.where}: has no R and T, from the first camera to the second one")
    name, table, *_ = pair[1]
    return [pair[0], (name, table, _rotation(whole), whole.array(_entry(whole, _TRANSLATION), (3,)))]


def _shared_size(whole: Table) -> dict[str, Any]:
    return {key: whole.values[key] for key in whole.values if _bare(key) in (*_SIZE, *_WIDTH, *_HEIGHT)}


def _add(found: Tables, name: str, table: Table, rotation: Any = None, translation: Any = None) -> None:
    size = [0.0, 0.0]
    if key := _entry(table, _SIZE):
        size = table.array(key, (2,)).tolist()
    elif (width := _entry(table, _WIDTH)) and (height := _entry(table, _HEIGHT)):
        size = [table.number(width), table.number(height)]
    key = _entry(table, _DISTORTIONS)
    fisheye = _is_fisheye(table)
    found.add(
        name,
        size=size,
        matrix=table.array(_entry(table, _MATRIX), (3, 3)),
        distortions=table.array(key, (4,), (5,), (8,), (12,), (14,)) if key else np.zeros(5),
        rotation=_matrix(_rotation(table) if rotation is None else rotation),
        translation=table.array(_entry(table, _TRANSLATION), (3,)) if translation is None else translation,
        fisheye=fisheye,
    )


def _rotation(table: Table) -> Any:
    return table.array(_entry(table, _ROTATION), (3,), (3, 3))


def _matrix(rotation: Any) -> Any:
    return rotation if np.shape(rotation) == (3, 3) else np.asarray(cv2.Rodrigues(np.asarray(rotation))[0])


def _is_fisheye(table: Table) -> bool:
    """Return whether a file says that its lens has OpenCV's fisheye model; the numbers do not show it."""
    if "fisheye_model" in table or "fisheye" in table:
        return bool(table.values.get("fisheye_model", table.values.get("fisheye")))
    named = str(table.values.get("distortion_model", table.values.get("model", ""))).lower()
    return "fisheye" in named or "equidistant" in named


def _entry(table: Table, names: Sequence[str]) -> str:
    """Return the key of the first of these entries that a table has, "" without any."""
    keys = {_bare(key): key for key in table.values}
    return next((keys[name] for name in names if name in keys), "")


def _bare(key: str) -> str:
    return key.replace("_", "").lower()


def _is_opencv(path: Path) -> bool:
    return any(contains(path, sign) for sign in _SIGNS)


def _find(root: Path) -> list[Path]:
    """Return the YAML files, else the JSON files, of the first folder in which one of them looks like OpenCV's."""
    for folder in (root, root / "calibration", root / "calib", root / "cameras", root / "calibrations"):
        for patterns in (("*.yml", "*.yaml"), ("*.json",)):
            found = matching(folder, *patterns)
            if any(_is_opencv(path) for path in found):
                return found
    return []


FORMAT = Format("OpenCV", ("*.yml", "*.yaml"), _read, videos=("videos", "images", "."), search=_find)
