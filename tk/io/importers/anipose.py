"""Anipose: `calibration.toml` with one table a camera, in the folder or in `calibration/`.

    SESSION/calibration/calibration.toml
    SESSION/TRIAL/videos-raw/*.mp4

Lengths are in the unit in which the board's square was given, often millimetres; the file does not say.
"""

from __future__ import annotations

from pathlib import Path

from tk.io.importers.files import matching
from tk.io.importers.project import Project, Request, assemble
from tk.io.importers.toml_cameras import read_cameras
from tk.io.importers.videos import Places

TOOL = "Anipose"
LOOKS_FOR = "calibration.toml or calibration/calibration.toml"
NESTS = True

_RAW = ("videos-raw", "videos", "images")
PLACES = Places((*_RAW, *(f"*/{name}" for name in _RAW), "."))


def detect(root: Path) -> bool:
    return bool(_calibrations(root))


def read(root: Path, request: Request) -> Project:
    return assemble(TOOL, read_cameras(_calibrations(root)[0], request, "m"), request, PLACES)


def _calibrations(root: Path) -> list[Path]:
    """Beside each other, the one in the folder itself counts."""
    return matching(root, "calibration.toml") or matching(root / "calibration", "calibration.toml")
