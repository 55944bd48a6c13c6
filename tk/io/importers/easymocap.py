"""EasyMocap: `intri.yml` and `extri.yml`, YAML as OpenCV writes it.

    names: ["1", "2"]
    K_1, dist_1                intrinsic matrix; k1 k2 p1 p2 k3
    H_1, W_1                   rows and columns, not always there: then the videos' own
    R_1 or Rot_1, T_1          Rodrigues vector or matrix, world to camera; metres

The videos are in `videos/1.mp4`, or pictures in `images/1/000000.jpg`.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.files import read_text
from tk.io.importers.project import Cameras, Project, Request, assemble, check_camera, in_metres
from tk.io.importers.videos import Places
from tk.model.camera import Camera, Rig

TOOL = "EasyMocap"
LOOKS_FOR = "intri.yml and extri.yml"
NESTS = False

PLACES = Places(("videos", "images", "."))


def detect(root: Path) -> bool:
    return _folder(root) is not None


def read(root: Path, request: Request) -> Project:
    folder = _folder(root)
    assert folder is not None  # detected
    return assemble(TOOL, in_metres(_read_cameras(folder), request, "m"), request, PLACES)


def _folder(root: Path) -> Path | None:
    for folder in (root, root / "calibration", root / "cameras"):
        if any((folder / name).exists() for name in ("intri.yml", "extri.yml")):
            return folder
    return None


def _read_cameras(folder: Path) -> Cameras:
    intrinsic, extrinsic = _Storage(folder / "intri.yml"), _Storage(folder / "extri.yml")
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
            width=intrinsic.integer(f"W_{name}"),
            height=intrinsic.integer(f"H_{name}"),
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


class _Storage:
    """A YAML file of OpenCV's, read from memory: the file itself has been made sure of."""

    def __init__(self, path: Path) -> None:
        self.path = path
        text = read_text(path)
        if not text.lstrip().startswith("%YAML"):
            text = "%YAML:1.0\n---\n" + text
        try:
            self._storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        except (cv2.error, SystemError) as reason:
            raise self._damaged(reason) from None
        if not self._storage.isOpened():
            raise self._damaged("it cannot be parsed")

    def names(self) -> list[str]:
        node = self._storage.getNode("names")
        if node.empty() or not node.isSeq():
            raise CalibrationError(f"{self.path}: has no list `names` of its cameras")
        found = []
        for index in range(node.size()):
            item = node.at(index)
            found.append(item.string() if item.isString() else f"{item.real():g}")
        return found

    def matrix(self, key: str, *counts: int) -> NDArray[np.float64] | None:
        """The numbers of a matrix, flat, as many as one of ``counts``; None when there is no such key."""
        node = self._storage.getNode(key)
        if node.empty():
            return None
        try:
            found = node.mat() if node.isMap() else None
        except (cv2.error, SystemError) as reason:
            raise self._damaged(f"{key}: {reason}") from None
        if found is None or found.size not in counts:
            size = "no matrix" if found is None else f"{found.size} numbers"
            raise CalibrationError(f"{self.path}: {key} must be a matrix of {counts[0]} numbers, and is {size}")
        return np.asarray(found, dtype=np.float64).ravel()

    def integer(self, key: str) -> int:
        """A whole number, 0 when there is no such key."""
        node = self._storage.getNode(key)
        return 0 if node.empty() or not (node.isInt() or node.isReal()) else round(node.real())

    def _damaged(self, reason: object) -> CalibrationError:
        return CalibrationError(f"{self.path}: is no YAML as OpenCV writes it: {' '.join(str(reason).split())[:120]}")
