"""Caliscope: `camera_array.toml` with ``[cameras.0]``; before that, `config.toml` with ``[cam_0]``.

Rotations are 3×3 or Rodrigues vectors, world to camera; lengths are metres. A camera that has not been placed yet has
no rotation and translation (or "null"). The videos of camera 0 are called `cam_0.mp4`, earlier `port_0.mp4`:

    PROJECT/camera_array.toml
    PROJECT/recordings/NAME/cam_0.mp4
"""

from __future__ import annotations

from pathlib import Path

from tk.io.importers.files import matching
from tk.io.importers.project import Project, Request, assemble
from tk.io.importers.toml_cameras import has_camera_tables, read_cameras
from tk.io.importers.videos import Places

TOOL = "Caliscope"
LOOKS_FOR = "camera_array.toml, calibration/camera_array.toml, or config.toml with [cam_0] and so on"
NESTS = True

PLACES = Places(("recordings/*", "recordings", ".", "*"))


def detect(root: Path) -> bool:
    return _calibration(root) is not None


def read(root: Path, request: Request) -> Project:
    path = _calibration(root)
    assert path is not None  # detected
    return assemble(TOOL, read_cameras(path, request, "m"), request, PLACES)


def _calibration(root: Path) -> Path | None:
    arrays = matching(root, "camera_array.toml", "calibration/camera_array.toml", "calibration/*/camera_array.toml")
    if arrays:
        return arrays[0]
    return next((path for path in matching(root, "config.toml") if has_camera_tables(path)), None)
