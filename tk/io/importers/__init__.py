"""Convert projects of other tools to captures: `tk import`. A format is a :class:`Format` in :data:`FORMATS`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tk.errors import CaptureError, ClockError
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.session import inherited, is_session
from tk.io.importers import (
    calibio,
    colmap,
    easymocap,
    multical,
    opencap,
    opencv,
    optitrack,
    panoptic,
    projections,
    qualisys,
    toml_tools,
    vicon,
)
from tk.io.importers.project import Format, Project, Wanted, read_format
from tk.io.importers.write import Imported, write_capture
from tk.io.paths import referred_files

__all__ = ["FORMATS", "Imported", "Wanted", "import_project", "read_project"]

#: in the order in which they are tried: formats with more specific file names first
FORMATS = (
    multical.FORMAT, calibio.FORMAT, panoptic.FORMAT, easymocap.FORMAT,
    toml_tools.FREEMOCAP, toml_tools.CALISCOPE, toml_tools.POSE2SIM, qualisys.FORMAT,
    vicon.FORMAT, optitrack.FORMAT, colmap.FORMAT, toml_tools.ANIPOSE, opencap.FORMAT, opencv.FORMAT,
    projections.FORMAT,
)  # fmt: skip

#: what a user wants who gives no options
_ANYTHING = Wanted()
#: folders above the given one that are searched for a calibration: SESSION/recordings/TRIAL
_LEVELS_UP = 2
#: files that a message about an unknown folder names; more would not fit into three lines
_NAMED = 6


def import_project(folder: Path, output: Path, wanted: Wanted = _ANYTHING) -> Imported:
    """Read the project in ``folder`` and write it as the capture ``output``.

    Args:
        folder: another tool's project, or a recording in it.
        output: path of the capture; it must not exist, or be empty.
        wanted: what the user gives: units, trial, scale.

    Raises:
        CaptureError: or a subclass, with one line that names the file and what is wrong with it.
    """
    return write_capture(read_project(folder, wanted), output)


def read_project(folder: Path, wanted: Wanted = _ANYTHING) -> Project:
    """Read the project in a folder, of any tool; arguments as for :func:`import_project`."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: is not a folder; give the project folder of the tool that calibrated")
    if is_session(folder):
        raise CaptureError(f"{folder}: is a session of captures; nothing to import: tk batch {folder} -o FOLDER")
    if _is_capture(folder):
        raise CaptureError(f"{folder}: is a capture already; nothing to import: tk track {folder} -o RESULT.h5")
    found = _find(folder)
    if found is not None:
        return read_format(*found, folder, wanted)
    known = [form for form in FORMATS if form is not opencv.FORMAT]
    searched = ", ".join(dict.fromkeys(form.patterns[0] for form in [*known, opencv.FORMAT]))
    here = sorted(f"{path.name}/" if path.is_dir() else path.name for path in folder.iterdir())
    names = ", ".join(here[:_NAMED]) + (f" and {len(here) - _NAMED} more" if len(here) > _NAMED else "")
    raise CaptureError(
        f"{folder}: has no calibration of a tool that tk imports from: it holds {names or 'nothing'}; "
        f"searched: {searched} (with camera_matrix, rvec, tvec)"
    )


def open_recording(
    path: Path, cameras: Sequence[str] | None = None, masks: str = "auto", resample: bool = False
) -> Capture:
    """Open a capture, see :func:`tk.io.captures.capture.open_capture`. The error about a project of another tool says
    how to convert it."""
    try:
        return open_capture(path, cameras, masks, resample)
    except CaptureError as error:
        images = (path / "videos").is_dir() or (path / "images").is_dir() or bool(referred_files(path))
        if path.is_dir() and not is_session(path) and not (images and inherited(path, "calibration.toml").exists()):
            found = _find(path)
            # calibration.toml is a capture's file, too; then the videos' folder decides
            own = ("videos", "images", ".")
            if found is not None and (
                found[1][0] != path / "calibration.toml"
                or any(list(path.glob(pattern)) for pattern in found[0].videos if pattern not in own)
            ):
                raise CaptureError(
                    f"{path}: is a project of {found[0].tool} with {found[1][0].name}, not a capture; import it first",
                    hint=f"type tk import {path} -o CAPTURE",
                ) from None
        raise error


def _find(folder: Path) -> tuple[Format, list[Path]] | None:
    """Return the format of the calibration in a folder, or in those above it, and its files."""
    root = folder
    for level in range(_LEVELS_UP + 1):
        for form in FORMATS:
            files = form.find(root) if level == 0 or form.nests else []
            if files:
                return form, files
        root = root.resolve().parent
    return None


def _is_capture(folder: Path) -> bool:
    """Return whether the folder can be tracked as it is."""
    if not inherited(folder, "calibration.toml").is_file():
        return False
    try:
        open_capture(folder)
    except ClockError:
        return True
    except CaptureError:
        return False
    return True
