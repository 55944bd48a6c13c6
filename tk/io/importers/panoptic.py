"""CMU Panoptic Studio: `calibration_*.json` for all of the dome's 500 cameras, and the videos of some.

    SEQUENCE/calibration_171204_pose1.json       name "00_12", type "hd", resolution, K, distCoef, R, t
    SEQUENCE/hdVideos/hd_00_12.mp4               or hdImgs/00_12/00_12_00000000.jpg, vgaVideos/, kinectVideos/

Lengths are centimetres; R and t map world to camera; the world's y axis points down.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tk.errors import CalibrationError
from tk.io.importers.files import listed_cameras, only, read_json
from tk.io.importers.project import Format, Tables
from tk.io.toml import Table


def _read(files: Sequence[Path]) -> Tables:
    path = only(files)
    found = Tables(path, unit="cm", unit_from="the format")
    for index, item in enumerate(listed_cameras(read_json(path), path)):
        name = Table(item, f"{path}: camera {index}", CalibrationError).text("name", "")
        table = Table(item, f"{path}: camera {name!r}", CalibrationError)
        found.add(
            name,
            key=f"{item.get('type', '')}_{name}",
            size=table.array("resolution", (2,)),
            matrix=table.array("K", (3, 3)),
            distortions=table.array("distCoef", (5,), (4,), (8,)),
            rotation=table.array("R", (3, 3)),
            translation=np.ravel(table.array("t", (3, 1), (3,), (1, 3))),
        )
    return found


FORMAT = Format(
    "CMU Panoptic", ("calibration_*.json",), _read,
    videos=("hdVideos", "hdImgs", "kinectVideos", "kinectImgs", "vgaVideos", "vgaImgs", "videos", "."),
    up="-y", videos_of_all=False,
)  # fmt: skip
