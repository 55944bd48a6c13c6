"""Anipose: `calibration.toml` with one table per camera, in the folder or in `calibration/`.

    SESSION/calibration/calibration.toml
    SESSION/TRIAL/videos-raw/*.mp4

Lengths are in the unit in which the size of the board's squares was given, often millimetres; the file does not say.
"""

from __future__ import annotations

from pathlib import Path

from tk.io.importers.files import matching
from tk.io.importers.project import Format
from tk.io.importers.toml_cameras import read_cameras


def _find(root: Path) -> list[Path]:
    return (matching(root, "calibration.toml") or matching(root / "calibration", "calibration.toml"))[:1]


FORMAT = Format(
    tool="Anipose",
    files="calibration.toml or calibration/calibration.toml",
    find=_find,
    read=read_cameras,
    videos=("videos-raw", "videos", "images", "*/videos-raw", "*/videos", "*/images", "."),
    nests=True,
)
