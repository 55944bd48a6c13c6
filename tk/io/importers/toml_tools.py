"""Anipose, Caliscope, FreeMoCap and Pose2Sim: one TOML table per camera, distinguished by the files' names and folders.

Anipose: lengths are in the unit in which the size of the board's squares was given, often millimetres; no file says so.

    SESSION/calibration/calibration.toml       or SESSION/calibration.toml
    SESSION/TRIAL/videos-raw/*.mp4

Caliscope: metres; rotations are 3×3 or Rodrigues vectors. A camera without extrinsic calibration has no rotation and
translation (or "null"). The videos of camera 0 are called `cam_0.mp4`, in older versions `port_0.mp4`.

    PROJECT/camera_array.toml                  with [cameras.0]; older versions: config.toml with [cam_0]
    PROJECT/recordings/NAME/cam_0.mp4

FreeMoCap: Anipose's tables; FreeMoCap asks for millimetres. Without a board on the floor, the world frame is that of
camera 0.

    RECORDING/*_camera_calibration.toml
    RECORDING/synchronized_videos/*.mp4        FreeMoCap 2: RECORDING/videos/synchronized/*.mp4

Pose2Sim: metres. Cameras are named by the folders of their intrinsic calibration ("int_cam01_img"); cameras and videos
are matched in the order of their names.

    SESSION/calibration/Calib*.toml            or *.qca.txt of Qualisys
    SESSION/TRIAL/videos/*.mp4                 or SESSION/videos; older versions call it raw-2d
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tk.errors import CalibrationError
from tk.io.captures.calibration import camera_tables, given_unit
from tk.io.importers import qualisys
from tk.io.importers.files import matching, only
from tk.io.importers.project import Format, Tables
from tk.io.toml import load_toml

#: values by which the tools mark an unknown entry; TOML has no null
_NOTHING: tuple[object, ...] = (None, "", "null", "None", [])

#: Pose2Sim's folders of videos, of all versions
_RAW = ("videos", "raw", "raw-2d", "raw_videos", "videos_raw")


def read_tables(files: Sequence[Path]) -> Tables:
    """Read the cameras of the one TOML file. Tables without a camera, a pose, or with ``ignore`` are left out."""
    path = only(files)
    document = load_toml(path, CalibrationError)
    found = Tables(path, given_unit(document, path))
    for key, table in camera_tables(document, path).items():
        if "matrix" not in table and "size" not in table and "translation" not in table:
            continue  # settings of the tool
        missing = [name for name in ("matrix", "rotation", "translation") if table.get(name) in _NOTHING]
        if table.get("ignore") is True:
            found.leave_out(key, "is switched off (ignore = true)")
        elif missing:
            found.leave_out(key, f"has no {' and no '.join(missing)}")
        else:
            found.cameras[key] = table
    return found


def _find_caliscope(root: Path) -> list[Path]:
    """Return the file of cameras; other tools, too, have a config.toml."""
    arrays = matching(root, "camera_array.toml", "calibration/camera_array.toml", "calibration/*/camera_array.toml")
    return (arrays or [path for path in matching(root, "config.toml") if _has_camera_tables(path)])[:1]


def _find_freemocap(root: Path) -> list[Path]:
    """Return the calibration that has the recording's name, else all."""
    found = matching(root, "*camera_calibration.toml")
    return [path for path in found if path.name == f"{root.resolve().name}_camera_calibration.toml"] or found


def _has_camera_tables(path: Path) -> bool:
    try:
        tables = camera_tables(load_toml(path, CalibrationError), path)
    except CalibrationError:
        return False
    return any("matrix" in table for table in tables.values())


ANIPOSE = Format(
    "Anipose", ("calibration.toml", "calibration/calibration.toml"), read_tables,
    videos=("videos-raw", "videos", "images", "*/videos-raw", "*/videos", "*/images", "."), nests=True,
)  # fmt: skip
CALISCOPE = Format(
    "Caliscope", ("camera_array.toml",), read_tables,
    videos=("recordings/*", "recordings", ".", "*"), nests=True, search=_find_caliscope,
)  # fmt: skip
FREEMOCAP = Format(
    "FreeMoCap", ("*camera_calibration.toml",), read_tables,
    videos=(
        "synchronized_videos", "SyncedVideos", "videos/synchronized",
        "*/synchronized_videos", "*/SyncedVideos", "*/videos/synchronized", ".",
    ),
    unit="mm", nests=True, in_order=True, search=_find_freemocap,
)  # fmt: skip
POSE2SIM = Format(
    "Pose2Sim", ("calibration/Calib*.toml", "calibration/*.qca.txt"),
    lambda files: (qualisys.read_tables if files[0].suffix == ".txt" else read_tables)(files),
    videos=(*_RAW, *(f"*/{name}" for name in _RAW), "."), nests=True, in_order=True,
)  # fmt: skip
