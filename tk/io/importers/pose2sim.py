"""Pose2Sim: a session with `calibration/`, and trials with `videos/`.

    SESSION/calibration/Calib*.toml       cameras, metres; or *.qca.txt of Qualisys
    SESSION/TRIAL/videos/*.mp4            or SESSION/videos; older versions call it raw-2d

Cameras are named by the folders of their intrinsic calibration ("int_cam01_img"). Pose2Sim matches cameras and videos
in the order of their names.
"""

from __future__ import annotations

from pathlib import Path

from tk.io.importers import qualisys
from tk.io.importers.files import matching, only
from tk.io.importers.project import Project, Request, assemble
from tk.io.importers.toml_cameras import read_cameras
from tk.io.importers.videos import Places

TOOL = "Pose2Sim"
LOOKS_FOR = "calibration/Calib*.toml or calibration/*.qca.txt"
NESTS = True

_RAW = ("videos", "raw", "raw-2d", "raw_videos", "videos_raw")
PLACES = Places((*_RAW, *(f"*/{name}" for name in _RAW), "."))


def detect(root: Path) -> bool:
    return bool(_calibrations(root))


def read(root: Path, request: Request) -> Project:
    path = only(_calibrations(root), "calibrations")
    cameras = qualisys.read_cameras(path, request) if path.suffix == ".txt" else read_cameras(path, request, "m")
    return assemble(TOOL, cameras, request, PLACES, in_order=True)


def _calibrations(root: Path) -> list[Path]:
    """The TOML files; else those of Qualisys, which Pose2Sim makes the TOML files from."""
    folder = root / "calibration"
    return matching(folder, "Calib*.toml") or matching(folder, "*.qca.txt")
