"""EasyMocap: `intri.yml` and `extri.yml`, YAML as OpenCV writes it.

    names: ["1", "2"]
    K_1, dist_1                intrinsic matrix; k1 k2 p1 p2 k3
    H_1, W_1                   rows and columns; if missing, the videos' size is used
    R_1 or Rot_1, T_1          Rodrigues vector or matrix, world to camera; metres

The videos are in `videos/1.mp4`, or images in `images/1/000000.jpg`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.files import read_text
from tk.io.importers.project import Cameras, Format, check_camera
from tk.model.cameras.camera import Camera, Rig


def _find(root: Path) -> list[Path]:
    for folder in (root, root / "calibration", root / "cameras"):
        files = [folder / "intri.yml", folder / "extri.yml"]
        if any(path.exists() for path in files):
            return files
    return []


def _read(files: Sequence[Path]) -> Cameras:
    folder = files[0].parent
    intrinsic, extrinsic = (_OpenCvYaml(path) for path in files)
    cameras: list[Camera] = []
    notes: list[str] = []
    for name in intrinsic.names():
        where = f"{folder}: camera {name!r}"
        rotation = extrinsic.matrix(f"Rot_{name}", 9)
        if rotation is None:
            vector = extrinsic.matrix(f"R_{name}", 3)
            rotation = None if vector is None else np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)
        translation = extrinsic.matrix(f"T_{name}", 3)
        if rotation is None or translation is None:
            notes.append(f"{extrinsic.path}: has no R_{name} and T_{name}: camera {name!r} is left out")
            continue
        matrix = intrinsic.matrix(f"K_{name}", 9)
        if matrix is None:
            raise CalibrationError(f"{intrinsic.path}: has no K_{name}, the matrix of camera {name!r}")
        distortions = intrinsic.matrix(f"dist_{name}", 5, 4)
        camera = Camera(
            name=name,
            width=intrinsic.pixels(f"W_{name}"),
            height=intrinsic.pixels(f"H_{name}"),
            matrix=matrix.reshape(3, 3),
            distortions=np.zeros(5) if distortions is None else distortions,
            rotation=rotation.reshape(3, 3),
            translation=translation,
        )
        cameras.append(check_camera(camera, where))
    if len(cameras) < 2:
        raise CalibrationError(
            f"{folder}: {len(cameras)} camera in both intri.yml and extri.yml; at least 2 are needed"
        )
    return Cameras(folder / "intri.yml", Rig(tuple(cameras)), tuple(camera.name for camera in cameras), tuple(notes))


class _OpenCvYaml:
    """A YAML file as OpenCV writes it: at the top level matrices, numbers and a list of names.

    OpenCV's own reader is not used: a damaged file can crash the process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        blocks = re.findall(r"^([^\s:#%-][^:\n]*):(.*?)(?=^[^\s-]|\Z)", f"{read_text(path)}\n", re.M | re.S)
        self._blocks = {key.strip(): block.strip() for key, block in blocks}
        if not self._blocks:
            raise CalibrationError(f"{path}: is not YAML as OpenCV writes it: it has no keys")

    def names(self) -> list[str]:
        """Return the list `names`, which has one name per line or is in brackets."""
        block = self._blocks.get("names")
        if block is None:
            raise CalibrationError(f"{self.path}: has no list `names` of its cameras")
        inside = re.fullmatch(r"\[(.*)\]", block, re.S)
        items = inside.group(1).split(",") if inside else re.findall(r"^\s*-(.*)$", block, re.M)
        found = [item.strip().strip("\"'").strip() for item in items]
        if not all(found) or len(set(found)) < len(found):
            raise CalibrationError(f"{self.path}: names must be distinct and not empty, but are {found}")
        return found

    def matrix(self, key: str, *counts: int) -> NDArray[np.float64] | None:
        """Return the numbers of a matrix, flat, as many as one of ``counts``; None without such a key."""
        block = self._blocks.get(key)
        if block is None:
            return None
        data = re.search(r"data:\s*\[(.*?)\]", block, re.S)
        try:
            values = [float(word) for word in data.group(1).split(",")] if data else []
        except ValueError:
            values = []
        if len(values) not in counts or not np.isfinite(values).all():
            raise CalibrationError(f"{self.path}: {key} must be a matrix of {counts[0]} finite numbers")
        return np.array(values)

    def pixels(self, key: str) -> int:
        """Return a whole number from 1; 0 without such a key."""
        block = self._blocks.get(key)
        if block is None:
            return 0
        try:
            value = float(block)
        except ValueError:
            value = 0.0
        if not 1 <= value < 1e6:
            raise CalibrationError(f"{self.path}: {key} = {block[:40]!r} must be a number of pixels")
        return round(value)


FORMAT = Format(
    tool="EasyMocap", files="intri.yml and extri.yml", find=_find, read=_read, videos=("videos", "images", ".")
)
