"""Caliscope: `camera_array.toml` with ``[cameras.0]``; older versions: `config.toml` with ``[cam_0]``.

Rotations are 3×3 or Rodrigues vectors, world to camera; lengths are metres. A camera without extrinsic calibration has
no rotation and translation (or "null"). The videos of camera 0 are called `cam_0.mp4`, in older versions `port_0.mp4`:

    PROJECT/camera_array.toml
    PROJECT/recordings/NAME/cam_0.mp4
"""

from __future__ import annotations

from pathlib import Path

from tk.io.importers.files import matching
from tk.io.importers.project import Format
from tk.io.importers.toml_cameras import has_camera_tables, read_cameras


def _find(root: Path) -> list[Path]:
    arrays = matching(root, "camera_array.toml", "calibration/camera_array.toml", "calibration/*/camera_array.toml")
    return (arrays or [path for path in matching(root, "config.toml") if has_camera_tables(path)])[:1]


FORMAT = Format(
    tool="Caliscope",
    files="camera_array.toml, calibration/camera_array.toml, or config.toml with [cam_0] and so on",
    find=_find,
    read=read_cameras,
    videos=("recordings/*", "recordings", ".", "*"),
    nests=True,
)
