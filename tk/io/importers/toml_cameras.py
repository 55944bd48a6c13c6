"""Camera tables in TOML, as Anipose began them and others took them over, each a little differently."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tk.errors import CalibrationError
from tk.io.captures.calibration import calibration_of, camera_tables, given_unit
from tk.io.importers.files import read_toml
from tk.io.importers.project import Cameras, Request, in_metres

#: how the tools write "not known yet" in a language without null
_NOTHING: tuple[object, ...] = (None, "", "null", "None", [])


def read_cameras(path: Path, request: Request, default_unit: str) -> Cameras:
    """The cameras of a TOML file, metres. Tables that are no camera, are switched off or have no pose are left out.

    Raises:
        CalibrationError: with the file, the camera and the key that is wrong; or fewer than two cameras are left.
    """
    document = read_toml(path)
    tables: dict[str, Mapping[str, object]] = {}
    notes: list[str] = []
    for key, table in camera_tables(document, path).items():
        if "matrix" not in table and "size" not in table and "translation" not in table:
            continue  # settings of the tool
        missing = [name for name in ("matrix", "rotation", "translation") if table.get(name) in _NOTHING]
        if table.get("ignore") is True:
            notes.append(f"{path}: camera {key!r} is switched off there: left out")
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
    cameras = Cameras(path, calibration.rig, calibration.keys, tuple(notes))
    return in_metres(cameras, request, default_unit, said=given_unit(document, path))


def has_camera_tables(path: Path) -> bool:
    """Whether a TOML file has a table with a camera matrix; False for one that cannot be read."""
    try:
        document = read_toml(path)
        return any("matrix" in table for table in camera_tables(document, path).values())
    except CalibrationError:
        return False
