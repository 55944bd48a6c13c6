"""Convert projects of other tools to captures: `tk import`. A format is one module and one line in :data:`FORMATS`."""

from __future__ import annotations

from pathlib import Path

from tk.errors import CaptureError
from tk.io.captures.capture import open_capture
from tk.io.importers import (
    anipose,
    caliscope,
    easymocap,
    freemocap,
    opencap,
    panoptic,
    pose2sim,
    projections,
    qualisys,
    vicon,
)
from tk.io.importers.project import Project, read_format
from tk.io.importers.write import Imported, write_capture

__all__ = ["FORMATS", "Imported", "import_project", "read_project"]

#: in the order in which they are tried: formats with more specific file names first
FORMATS = tuple(
    module.FORMAT
    for module in (
        panoptic, easymocap, freemocap, caliscope, pose2sim, qualisys, vicon, anipose, opencap, projections,
    )
)  # fmt: skip

#: folders above the given one that are searched for a calibration: SESSION/recordings/TRIAL
_LEVELS_UP = 2


def import_project(folder: Path, output: Path, unit: str | None = None, trial: str | None = None) -> Imported:
    """Read the project in ``folder`` and write it as the capture ``output``.

    Args:
        folder: another tool's project, or a recording in it.
        output: path of the capture; it must not exist, or be empty.
        unit: "m", "cm" or "mm", unit of the calibration's lengths; None to infer it.
        trial: a part of the path of the videos, if there are several recordings.

    Raises:
        CaptureError: or a subclass, with one line that names the file and what is wrong with it.
    """
    return write_capture(read_project(folder, unit, trial), output)


def read_project(folder: Path, unit: str | None = None, trial: str | None = None) -> Project:
    """Read the project in a folder, of any tool; arguments as for :func:`import_project`.

    Raises:
        CaptureError: no format matches, the folder is a capture already, or a file cannot be read.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: is not a folder; give the project folder of the tool that calibrated")
    if _is_capture(folder):
        raise CaptureError(f"{folder}: is a capture already; nothing to import: tk track {folder} -o RESULT.h5")
    root = folder
    for level in range(_LEVELS_UP + 1):
        for form in FORMATS:
            files = form.find(root) if level == 0 or form.nests else []
            if files:
                return read_format(form, files, folder, unit, trial)
        root = root.resolve().parent
    searched = "; ".join(f"{form.tool}: {form.files}" for form in FORMATS)
    raise CaptureError(f"{folder}: matches no tool that tk imports from. It searched for {searched}")


def _is_capture(folder: Path) -> bool:
    """Return whether the folder can be tracked as it is."""
    if not (folder / "calibration.toml").is_file():
        return False
    try:
        open_capture(folder)
    except CaptureError:
        return False
    return True
