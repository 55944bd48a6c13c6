"""EasyMocap: `intri.yml` and `extri.yml`, YAML as OpenCV writes it.

    names: ["1", "2"]
    K_1, dist_1                intrinsic matrix; k1 k2 p1 p2 k3 [k4 k5 k6]
    H_1, W_1                   rows and columns; if missing, the videos' size is used
    R_1 or Rot_1, T_1          Rodrigues vector or matrix, world to camera; metres

The videos are in `videos/1.mp4`, or images in `images/1/000000.jpg`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.project import Format, Tables
from tk.io.importers.storage import numbers, read_storage
from tk.io.toml import shown


def _read(files: Sequence[Path]) -> Tables:
    folder = files[0].parent
    intrinsic, extrinsic = _OpenCvYaml(folder / "intri.yml"), _OpenCvYaml(folder / "extri.yml")
    found = Tables(intrinsic.path)
    for name in intrinsic.names():
        matrix, rotation = extrinsic.matrix(f"Rot_{name}", 9), extrinsic.matrix(f"R_{name}", 3)
        rotation = rotation if matrix is None else matrix.reshape(3, 3)
        translation = extrinsic.matrix(f"T_{name}", 3)
        if rotation is None or translation is None:
            found.leave_out(name, f"has no R_{name} and T_{name} in {extrinsic.path.name}")
            continue
        K, distortions = intrinsic.matrix(f"K_{name}", 9), intrinsic.matrix(f"dist_{name}", 5, 4, 8)
        if K is None:
            raise CalibrationError(f"{intrinsic.path}: has no K_{name}, the matrix of camera {name!r}")
        found.add(
            name,
            size=[intrinsic.pixels(f"W_{name}"), intrinsic.pixels(f"H_{name}")],
            matrix=K.reshape(3, 3),
            distortions=np.zeros(5) if distortions is None else distortions,
            rotation=rotation,
            translation=translation,
        )
    return found


class _OpenCvYaml:
    """A YAML file as OpenCV writes it: at the top level matrices, numbers and a list of names."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._values = read_storage(path)

    def names(self) -> list[str]:
        """Return the list `names`, which has one name per line or is in brackets."""
        listed = self._values.get("names")
        if not isinstance(listed, list):
            raise CalibrationError(f"{self.path}: has no list `names` of its cameras")
        found = [str(item).strip() for item in listed]
        if not all(found) or len(set(found)) < len(found):
            raise CalibrationError(f"{self.path}: names must be distinct and not empty, but are {found}")
        return found

    def matrix(self, key: str, *counts: int) -> NDArray[np.float64] | None:
        """Return the numbers of a matrix, flat, as many as one of ``counts``; None without such a key."""
        if key not in self._values:
            return None
        try:
            values = np.array(numbers(self._values[key]), dtype=np.float64).ravel()
        except (TypeError, ValueError):
            values = np.zeros(0)
        if len(values) not in counts or not np.isfinite(values).all():
            raise CalibrationError(f"{self.path}: {key} must be a matrix of {counts[0]} finite numbers")
        return values

    def pixels(self, key: str) -> int:
        """Return a whole number from 1; 0 without such a key."""
        if key not in self._values:
            return 0
        value = numbers(self._values[key])
        if not isinstance(value, float) or not 1 <= value < 1e6:
            raise CalibrationError(f"{self.path}: {key} = {shown(self._values[key])} must be a number of pixels")
        return round(value)


FORMAT = Format(
    "EasyMocap",
    tuple(f"{folder}{file}" for folder in ("", "calibration/", "cameras/") for file in ("intri.yml", "extri.yml")),
    _read,
    videos=("videos", "images", "."),
)
