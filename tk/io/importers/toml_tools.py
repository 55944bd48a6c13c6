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
    RECORDING/synchronized_videos/*.mp4

Pose2Sim: metres. Cameras are named by the folders of their intrinsic calibration ("int_cam01_img"); cameras and videos
are matched in the order of their names.

    SESSION/calibration/Calib*.toml            or *.qca.txt of Qualisys
    SESSION/TRIAL/videos/*.mp4                 or SESSION/videos; older versions call it raw-2d
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tk.errors import CalibrationError
from tk.io.captures.calibration import calibration_of, camera_tables, given_unit
from tk.io.importers import qualisys
from tk.io.importers.files import matching, only, read_toml
from tk.io.importers.project import Cameras, Format

#: values by which the tools mark an unknown entry; TOML has no null
_NOTHING: tuple[object, ...] = (None, "", "null", "None", [])

#: Pose2Sim's folders of videos, of all versions
_RAW = ("videos", "raw", "raw-2d", "raw_videos", "videos_raw")


def read_cameras(files: Sequence[Path]) -> Cameras:
    """Read the cameras of the one TOML file. Tables without a camera, a pose, or with ``ignore`` are left out.

    Raises:
        CalibrationError: there are several files, an entry is wrong, or fewer than two cameras have a pose.
    """
    path = only(files)
    document = read_toml(path)
    tables: dict[str, Mapping[str, object]] = {}
    notes: list[str] = []
    for key, table in camera_tables(document, path).items():
        if "matrix" not in table and "size" not in table and "translation" not in table:
            continue  # settings of the tool
        missing = [name for name in ("matrix", "rotation", "translation") if table.get(name) in _NOTHING]
        if table.get("ignore") is True:
            notes.append(f"{path}: camera {key!r} is switched off (ignore = true): left out")
        elif missing:
            notes.append(f"{path}: camera {key!r} has no {' and no '.join(missing)}: left out")
        else:
            tables[key] = table
    if len(tables) < 2:
        skipped = f" ({'; '.join(note.removeprefix(f'{path}: ') for note in notes)})" if notes else ""
        raise CalibrationError(
            f"{path}: {len(tables)} camera with a pose, and a capture needs at least 2{skipped}; finish the calibration"
        )
    calibration = calibration_of(path, tables, "m")
    return Cameras(path, calibration.rig, calibration.keys, tuple(notes), given_unit(document, path))


def _has_camera_tables(path: Path) -> bool:
    """Return whether a TOML file has a table with a camera matrix; False if the file cannot be read."""
    try:
        return any("matrix" in table for table in camera_tables(read_toml(path), path).values())
    except CalibrationError:
        return False


def _find_anipose(root: Path) -> list[Path]:
    return (matching(root, "calibration.toml") or matching(root / "calibration", "calibration.toml"))[:1]


def _find_caliscope(root: Path) -> list[Path]:
    arrays = matching(root, "camera_array.toml", "calibration/camera_array.toml", "calibration/*/camera_array.toml")
    return (arrays or [path for path in matching(root, "config.toml") if _has_camera_tables(path)])[:1]


def _find_freemocap(root: Path) -> list[Path]:
    """Return the calibration that has the recording's name, else all."""
    found = matching(root, "*camera_calibration.toml")
    own = [path for path in found if path.name == f"{root.resolve().name}_camera_calibration.toml"]
    return own or found


def _find_pose2sim(root: Path) -> list[Path]:
    """Return the TOML files; without any, the files of Qualisys from which Pose2Sim makes them."""
    return matching(root / "calibration", "Calib*.toml") or matching(root / "calibration", "*.qca.txt")


ANIPOSE = Format(
    tool="Anipose",
    files="calibration.toml or calibration/calibration.toml",
    find=_find_anipose,
    read=read_cameras,
    videos=("videos-raw", "videos", "images", "*/videos-raw", "*/videos", "*/images", "."),
    nests=True,
)
CALISCOPE = Format(
    tool="Caliscope",
    files="camera_array.toml, calibration/camera_array.toml, or config.toml with [cam_0] and so on",
    find=_find_caliscope,
    read=read_cameras,
    videos=("recordings/*", "recordings", ".", "*"),
    nests=True,
)
FREEMOCAP = Format(
    tool="FreeMoCap",
    files="*camera_calibration.toml",
    find=_find_freemocap,
    read=read_cameras,
    videos=("synchronized_videos", "SyncedVideos", "*/synchronized_videos", "*/SyncedVideos", "."),
    unit="mm",
    nests=True,
    in_order=True,
)
POSE2SIM = Format(
    tool="Pose2Sim",
    files="calibration/Calib*.toml or calibration/*.qca.txt",
    find=_find_pose2sim,
    read=lambda files: (qualisys.read_cameras if files[0].suffix == ".txt" else read_cameras)(files),
    videos=(*_RAW, *(f"*/{name}" for name in _RAW), "."),
    nests=True,
    in_order=True,
)
