"""FreeMoCap: a recording with `synchronized_videos/` and `*_camera_calibration.toml`.

The tables are Anipose's, in the unit in which the size of the board's squares was given; FreeMoCap asks for
millimetres. Without a board on the floor, the world frame is that of camera 0.
"""

from __future__ import annotations

from pathlib import Path

from tk.io.importers.files import matching
from tk.io.importers.project import Format
from tk.io.importers.toml_cameras import read_cameras


def _find(root: Path) -> list[Path]:
    """Return the calibration that has the recording's name, else all."""
    found = matching(root, "*camera_calibration.toml")
    own = [path for path in found if path.name == f"{root.resolve().name}_camera_calibration.toml"]
    return own or found


FORMAT = Format(
    tool="FreeMoCap",
    files="*camera_calibration.toml",
    find=_find,
    read=read_cameras,
    videos=("synchronized_videos", "SyncedVideos", "*/synchronized_videos", "*/SyncedVideos", "."),
    unit="mm",
    nests=True,
    in_order=True,
)
