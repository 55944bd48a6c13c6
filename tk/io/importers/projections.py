"""Plain 3×4 projection matrices, one file a camera: `cam1.txt` (twelve numbers, rows first) or `cam1.npy`.

A matrix P maps a world point to homogeneous pixels; it is taken apart into K [R | t] (Hartley and Zisserman, *Multiple
View Geometry*, 2nd ed., section 6.2.4). There is no lens distortion in it, and no size of pictures: the videos' are
taken. Text files may begin with a line CONTOUR, and have comments after #.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from tk.errors import CalibrationError
from tk.io.importers.files import check_file, matching
from tk.io.importers.project import Cameras, Project, Request, assemble, check_camera, in_metres
from tk.io.importers.videos import Places
from tk.model.cameras.camera import Camera, Rig

TOOL = "projection matrices"
LOOKS_FOR = "a .txt or .npy file a camera with a 3×4 projection matrix, in the folder, calibration/ or cameras/"
NESTS = False

PLACES = Places(("videos", "images", "."))

#: bytes: twelve numbers take a kilobyte
_LARGEST = 2**16

#: skew above this share of the focal length is told; below it is rounding
_SKEW = 1e-6


def detect(root: Path) -> bool:
    return _files(root) is not None


def read(root: Path, request: Request) -> Project:
    files = _files(root)
    assert files is not None  # detected
    cameras: list[Camera] = []
    notes: list[str] = []
    for path in files:
        P = _matrix(path)
        if P is None:
            notes.append(f"{path}: holds no 3×4 matrix: left out")
            continue
        K, rotation, translation = take_apart(P, str(path))
        if abs(K[0, 1]) > _SKEW * K[0, 0]:
            notes.append(
                f"{path}: has a skew of {K[0, 1]:.3g} px, which is left out: the sides of the picture move by about "
                f"{abs(K[0, 1]) * K[1, 2] / K[1, 1]:.2g} px"
            )
            K[0, 1] = 0.0
        cameras.append(check_camera(Camera(path.stem, 0, 0, K, np.zeros(5), rotation, translation), str(path)))
    source = files[0].parent
    found = Cameras(source, Rig(tuple(cameras)), tuple(camera.name for camera in cameras), tuple(notes))
    return assemble(TOOL, in_metres(found, request, "m"), request, PLACES)


def take_apart(P: NDArray[np.float64], where: str) -> tuple[NDArray[np.float64], ...]:
    """K (3, 3) with positive focal lengths, R (3, 3) and t (3,) with P ~ K [R | t].

    Raises:
        CalibrationError: P is no finite camera: its left 3×3 part is singular.
    """
    left = P[:, :3]
    scale = np.abs(left).max()
    if not scale > 0 or abs(np.linalg.det(left / scale)) < 1e-12:
        raise CalibrationError(f"{where}: the left 3×3 part is singular: this is no projection of a camera")
    P = P * np.sign(np.linalg.det(left / scale)) / scale
    K, R = rq(P[:, :3])
    signs = np.diag(np.where(np.diag(K) < 0, -1.0, 1.0))
    K, R = K @ signs, signs @ R
    return K / K[2, 2], R, np.linalg.solve(K, P[:, 3])


def _files(root: Path) -> list[Path] | None:
    """The .txt and .npy files of the first folder in which two of them hold a matrix."""
    for folder in (root, root / "calibration", root / "calib", root / "cameras", root / "projections"):
        files = matching(folder, "*.txt", "*.npy")
        if sum(_matrix(path) is not None for path in files) >= 2:
            return files
    return None


def _matrix(path: Path) -> NDArray[np.float64] | None:
    """(3, 4) what the file holds, None when it holds something else."""
    try:
        check_file(path, _LARGEST)
        coded = path.read_bytes()
        if path.suffix == ".npy":
            values = np.load(io.BytesIO(coded), allow_pickle=False)
        else:
            lines = [line.split("#")[0] for line in coded.decode("utf-8-sig").splitlines()]
            words = " ".join(line for line in lines if line.strip() != "CONTOUR").replace(",", " ").split()
            values = np.array([float(word) for word in words])
        P = np.asarray(values, dtype=np.float64)
    except (CalibrationError, OSError, ValueError, EOFError):
        return None
    return P.reshape(3, 4) if P.size == 12 and np.isfinite(P).all() else None
