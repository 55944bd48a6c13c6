"""Plain 3×4 projection matrices, one file per camera: `cam1.txt` (twelve numbers, rows first) or `cam1.npy`.

A matrix P maps a world point to homogeneous pixels; it is factorised into K [R | t] (Hartley and Zisserman, *Multiple
View Geometry*, 2nd ed., section 6.2.4). It has no lens distortion and no image size: the videos' size
is used. Text files may begin with a line CONTOUR, and have comments after #.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.files import matching
from tk.io.importers.project import Format, Tables

#: largest file, bytes; twelve numbers take 1 kB
_LARGEST = 65_536

#: a smaller skew, as a share of the focal length, is rounding of the file's numbers
_SKEW = 1e-6


def _read(files: Sequence[Path]) -> Tables:
    found = Tables(files[0].parent)
    for path in files:
        P = _matrix(path)
        if P is None:
            found.notes.append(f"{path}: holds no 3×4 matrix: left out")
            continue
        K, rotation, translation = factorise(P, str(path))
        if abs(K[0, 1]) < _SKEW * K[0, 0]:
            K[0, 1] = 0.0
        K[[1, 2, 2], [0, 0, 1]] = 0.0  # rounding
        found.add(path.stem, [0, 0], K, np.zeros(5), rotation, translation)
    return found


def factorise(P: NDArray[np.float64], where: str) -> tuple[NDArray[np.float64], ...]:
    """Return K (3, 3) with positive focal lengths, R (3, 3) and t (3,) with P ~ K [R | t].

    Raises:
        CalibrationError: P is not the matrix of a finite camera: its left 3×3 part is singular.
    """
    left = P[:, :3]
    scale = np.abs(left).max()
    if not scale > 0 or abs(np.linalg.det(left / scale)) < 1e-12:
        raise CalibrationError(f"{where}: the left 3×3 part is singular: this is not the projection of a camera")
    P = P * np.sign(np.linalg.det(left / scale)) / scale
    K, R = scipy.linalg.rq(P[:, :3])
    signs = np.diag(np.where(np.diag(K) < 0, -1.0, 1.0))
    K, R = K @ signs, signs @ R
    return K / K[2, 2], R, np.linalg.solve(K, P[:, 3])


def _find(root: Path) -> list[Path]:
    """Return the .txt and .npy files of the first folder in which two of them hold a matrix."""
    for folder in (root, root / "calibration", root / "calib", root / "cameras", root / "projections"):
        files = matching(folder, "*.txt", "*.npy")
        if sum(_matrix(path) is not None for path in files) >= 2:
            return files
    return []


def _matrix(path: Path) -> NDArray[np.float64] | None:
    """Return the matrix (3, 4) of a file; None if the file holds something else."""
    try:
        if not path.is_file() or path.stat().st_size > _LARGEST:  # a pipe never ends
            return None
        content = path.read_bytes()
        if path.suffix == ".npy":
            values = np.load(io.BytesIO(content), allow_pickle=False)
        else:
            lines = [line.split("#")[0] for line in content.decode("utf-8-sig").splitlines()]
            words = " ".join(line for line in lines if line.strip() != "CONTOUR").replace(",", " ").split()
            values = np.array([float(word) for word in words])
        P = np.asarray(values, dtype=np.float64)
    except (OSError, ValueError, EOFError):
        return None
    return P.reshape(3, 4) if P.size == 12 and np.isfinite(P).all() else None


FORMAT = Format("projection matrices", ("*.txt", "*.npy"), _read, videos=("videos", "images", "."), search=_find)
