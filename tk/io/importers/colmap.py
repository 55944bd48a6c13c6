"""COLMAP: a sparse model as text, `cameras.txt` and `images.txt`.

    cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS…
    images.txt:  IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME     then a line of points, X Y POINT3D_ID …

Quaternion and translation map world to camera, in OpenCV's axes. The centre of the first pixel is (0.5, 0.5), not
(0, 0). The length of the unit is arbitrary, and so is the world's up direction. One image of each camera counts: they
are named by the images, `cam1.png`, or by the folders of the images, `cam1/000.png`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.files import matching
from tk.io.importers.project import Format, Tables
from tk.io.toml import read_text

Float = NDArray[np.float64]

#: parameters of each lens model, in COLMAP's order; f: both focal lengths
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}

#: folders in which COLMAP and programs around it leave a model
_FOLDERS = ("", "sparse/0/", "sparse/", "colmap/", "colmap/sparse/0/", "colmap/sparse/", "model/", "calibration/")

#: images of one camera that stands still differ by less: radians, and share of the largest distance of two cameras
_STILL = 0.01


def _read(files: Sequence[Path]) -> Tables:
    folder = files[0].parent
    if not (folder / "cameras.txt").exists():
        raise CalibrationError(
            f"{folder / 'cameras.bin'}: a binary model; write it as text",
            hint=f"colmap model_converter --input_path {folder} --output_path {folder} --output_type TXT",
        )
    lenses = _lenses(folder / "cameras.txt")
    found = Tables(folder / "images.txt", unit=None)
    found.scaled = False
    poses = _images(folder / "images.txt", lenses)
    apart = max((float(np.linalg.norm(a - b)) for *_, a in _all(poses) for *_, b in _all(poses)), default=0.0)
    for name, images in poses.items():
        lens_id, R, center = images[0]
        turn = max(scipy.spatial.transform.Rotation.from_matrix(other @ R.T).magnitude() for _, other, _ in images)
        shift = max(float(np.linalg.norm(other - center)) for *_, other in images)
        if turn > _STILL or shift > _STILL * apart or any(other[0] != lens_id for other in images):
            raise CalibrationError(
                f"{found.source}: the {len(images)} images of camera {name!r} have different poses, up to "
                f"{np.degrees(turn):.1f}° apart: a capture's cameras stand still; give each its own folder of images, "
                "or one image"
            )
        if len(images) > 1:
            found.notes.append(f"{found.source}: {len(images)} images of camera {name!r} have the same pose")
        fisheye, size, matrix, distortions = lenses[lens_id]
        found.add(name, size, matrix, distortions, R, -R @ center, fisheye=fisheye)
    return found


def _all(poses: dict[str, list[tuple[str, Float, Float]]]) -> list[tuple[str, Float, Float]]:
    return [images[0] for images in poses.values()]


def _lenses(path: Path) -> dict[str, tuple[bool, list[int], list[list[float]], list[float]]]:
    """Return whether it is a fisheye lens, size, matrix and distortions of each camera by its number."""
    lenses = {}
    for number, line in _lines(path):
        where, words = f"{path}: line {number}", line.split()
        if len(words) < 5 or words[1] not in _MODELS:
            lens = words[1] if len(words) > 1 else line[:40]
            raise CalibrationError(f"{where}: {lens!r} is no lens model that tk reads ({', '.join(_MODELS)})")
        keys, values = _MODELS[words[1]].split(), _numbers(words[2:], where)
        if len(values) != 2 + len(keys):
            raise CalibrationError(f"{where}: {words[1]} needs {len(keys)} parameters, {', '.join(keys)}")
        given = dict(zip(keys, values[2:], strict=True))
        fx, fy = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
        fisheye = "FISHEYE" in words[1]
        order = "k1 k2 k3 k4" if fisheye else "k1 k2 p1 p2 k3 k4 k5 k6"
        # the centre of the first pixel is (0.5, 0.5)
        matrix = [[fx, 0.0, given["cx"] - 0.5], [0.0, fy, given["cy"] - 0.5], [0.0, 0.0, 1.0]]
        size = [round(value) for value in values[:2]]
        lenses[words[0]] = fisheye, size, matrix, [given.get(key, 0.0) for key in order.split()]
    return lenses


def _images(path: Path, lenses: Collection[str]) -> dict[str, list[tuple[str, Float, Float]]]:
    """Return the lens, rotation and centre of each image, by camera."""
    listed: list[tuple[PurePosixPath, str, Float, Float]] = []
    after_image = False  # the next line holds the points of an image; it may be empty, or missing
    for number, line in _lines(path, empty=True):
        where, words = f"{path}: line {number}", line.split(maxsplit=9)
        if not words or (after_image and _is_points(line)):
            after_image = False
            continue
        after_image = True
        if len(words) < 10:
            raise CalibrationError(f"{where}: must be an image (ten values, the last one its name) or its points")
        values = _numbers(words[1:8], where)
        if not np.linalg.norm(values[:4]) > 1e-6:
            raise CalibrationError(f"{where}: QW QX QY QZ = 0 is not a rotation")
        if words[8] not in lenses:
            raise CalibrationError(f"{where}: camera {words[8]} is not in cameras.txt")
        w, *xyz = values[:4]
        R = scipy.spatial.transform.Rotation.from_quat([*xyz, w]).as_matrix()
        listed.append((PurePosixPath(words[9].replace("\\", "/")), words[8], R, -R.T @ values[4:]))
    folders = {str(name.parent) for name, *_ in listed}
    found: dict[str, list[tuple[str, Float, Float]]] = {}
    for name, lens, R, center in listed:
        found.setdefault(name.parent.name if len(folders) > 1 else name.stem, []).append((lens, R, center))
    return found


def _is_points(line: str) -> bool:
    words = line.split()
    try:
        for word in words:
            float(word)
    except ValueError:
        return False
    return len(words) % 3 == 0


def _numbers(words: Sequence[str], where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [np.nan]
    if not np.isfinite(values).all() or (np.abs(values) > 1e9).any():
        raise CalibrationError(f"{where}: must hold finite numbers, and has {' '.join(words)[:60]!r}")
    return values


def _lines(path: Path, empty: bool = False) -> list[tuple[int, str]]:
    """Return the lines of a file with their numbers, without comments and, unless asked for, without empty ones."""
    lines = enumerate(map(str.strip, read_text(path, CalibrationError).splitlines()), 1)
    return [(number, line) for number, line in lines if not line.startswith("#") and (line or empty)]


def _find(root: Path) -> list[Path]:
    for folder in _FOLDERS:
        for suffix, least in (("txt", 1), ("bin", 2)):
            found = matching(root, f"{folder}cameras.{suffix}", f"{folder}images.{suffix}")
            if len(found) >= least:
                return found
    return []


FORMAT = Format("COLMAP", ("cameras.txt",), _read, videos=("videos", "."), search=_find)
