"""FreeMoCap: a recording with `synchronized_videos/` and `*_camera_calibration.toml`.

The tables are Anipose's, in the unit in which the board's square was given: millimetres, as the program asks for them.
Without a board on the floor the world is camera 0's own frame.
"""

from __future__ import annotations

from pathlib import Path

from tk.io.importers.files import matching, only
from tk.io.importers.project import Project, Request, assemble
from tk.io.importers.toml_cameras import read_cameras
from tk.io.importers.videos import Places

TOOL = "FreeMoCap"
LOOKS_FOR = "*camera_calibration.toml"
NESTS = True

_VIDEOS = ("synchronized_videos", "SyncedVideos")
PLACES = Places((*_VIDEOS, *(f"*/{name}" for name in _VIDEOS), "."))


def detect(root: Path) -> bool:
    return bool(_calibrations(root))


def read(root: Path, request: Request) -> Project:
    path = only(_calibrations(root), "camera calibrations")
    return assemble(TOOL, read_cameras(path, request, "mm"), request, PLACES, in_order=True)


def _calibrations(root: Path) -> list[Path]:
    """The one that has the recording's name, where several lie there; else all."""
    found = matching(root, "*camera_calibration.toml")
    own = [path for path in found if path.name == f"{root.resolve().name}_camera_calibration.toml"]
    return own or found
