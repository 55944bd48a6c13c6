"""Projects of other tools, as capture folders: `tk import`. A format is one module and one line in :data:`FORMATS`."""

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
from tk.io.importers.project import Importer, Project, Request
from tk.io.importers.write import Imported, write_capture

__all__ = ["FORMATS", "Imported", "import_project", "read_project"]

#: in the order in which they are tried: the more particular ones first
FORMATS: tuple[Importer, ...] = (
    panoptic,
    easymocap,
    freemocap,
    caliscope,
    pose2sim,
    qualisys,
    vicon,
    anipose,
    opencap,
    projections,
)

#: folders above the given one that are searched for a calibration: SESSION/recordings/TRIAL
_LEVELS_UP = 2


def import_project(folder: Path, output: Path, unit: str | None = None, trial: str | None = None) -> Imported:
    """Read the project in ``folder`` and write it as the capture ``output``.

    Args:
        folder: as another tool left it.
        output: does not exist yet, or is empty.
        unit: "m", "cm" or "mm", of the calibration's lengths; None to infer it.
        trial: a part of the path of the videos that are meant, where there are several recordings.

    Raises:
        CaptureError: or a subclass, with one line that names the file and what is wrong with it.
    """
    return write_capture(read_project(Request(folder, unit, trial)), output)


def read_project(request: Request) -> Project:
    """The project in a folder, whichever tool's it is.

    Raises:
        CaptureError: nothing matches (it says what was looked for), it is a capture already, or it cannot be read.
    """
    folder = request.folder
    if not folder.is_dir():
        raise CaptureError(f"{folder}: is not a folder; give the project's folder of the tool that calibrated")
    if _is_capture(folder):
        raise CaptureError(f"{folder}: is a capture already; nothing to import: tk track {folder} -o RESULT.h5")
    root = folder
    for level in range(_LEVELS_UP + 1):
        for importer in FORMATS:
            if (level == 0 or importer.NESTS) and importer.detect(root):
                return importer.read(root, request)
        root = root.resolve().parent
    sought = "; ".join(f"{importer.TOOL}: {importer.LOOKS_FOR}" for importer in FORMATS)
    raise CaptureError(f"{folder}: matches no tool that tk imports from. Looked for {sought}")


def _is_capture(folder: Path) -> bool:
    """Whether the folder can be tracked as it is."""
    if not (folder / "calibration.toml").is_file():
        return False
    try:
        open_capture(folder)
    except CaptureError:
        return False
    return True
