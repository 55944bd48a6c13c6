"""Pose2Sim: a session with `calibration/`, and trials with `videos/`.

    SESSION/calibration/Calib*.toml       cameras, metres; or *.qca.txt of Qualisys
    SESSION/TRIAL/videos/*.mp4            or SESSION/videos; older versions call it raw-2d

Cameras are named by the folders of their intrinsic calibration ("int_cam01_img"). Pose2Sim matches cameras and videos
in the order of their names.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tk.io.importers import qualisys, toml_cameras
from tk.io.importers.files import matching
from tk.io.importers.project import Cameras, Format

_RAW = ("videos", "raw", "raw-2d", "raw_videos", "videos_raw")


def _find(root: Path) -> list[Path]:
    """Return the TOML files; without any, the files of Qualisys from which Pose2Sim makes them."""
    folder = root / "calibration"
    return matching(folder, "Calib*.toml") or matching(folder, "*.qca.txt")


def _read(files: Sequence[Path]) -> Cameras:
    return (qualisys if files[0].suffix == ".txt" else toml_cameras).read_cameras(files)


FORMAT = Format(
    tool="Pose2Sim",
    files="calibration/Calib*.toml or calibration/*.qca.txt",
    find=_find,
    read=_read,
    videos=(*_RAW, *(f"*/{name}" for name in _RAW), "."),
    nests=True,
    in_order=True,
)
