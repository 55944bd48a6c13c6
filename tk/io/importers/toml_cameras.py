"""Camera tables in TOML: Anipose's format and the variants of other tools."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tk.errors import CalibrationError
from tk.io.captures.calibration import calibration_of, camera_tables, given_unit
from tk.io.importers.files import only, read_toml
from tk.io.importers.project import Cameras

#: values by which the tools mark an unknown entry; TOML has no null
_NOTHING: tuple[object, ...] = (None, "", "null", "None", [])


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


def has_camera_tables(path: Path) -> bool:
    """Return whether a TOML file has a table with a camera matrix; False if the file cannot be read."""
    try:
        document = read_toml(path)
        return any("matrix" in table for table in camera_tables(document, path).values())
    except CalibrationError:
        return False
