"""Export results to formats of other programs. Each format has a module and an entry in :data:`FORMATS`."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tk.errors import ExportError
from tk.export.bvh import write_bvh
from tk.export.c3d import write_c3d
from tk.export.csv import write_angles_csv, write_points_csv
from tk.export.gltf import write_glb
from tk.export.mot import write_mot
from tk.export.motion import Motion, read_motion
from tk.export.ply import write_body_meshes
from tk.export.trc import write_trc
from tk.io.paths import Kind, check_not_input, check_output, looks_like

__all__ = ["FORMATS", "Exported", "Motion", "export", "read_motion"]

Writer = Callable[[Motion, Path], None]

# For each format the files or folders to write: the suffix added to the result's name, and the function that writes it.
FORMATS: dict[str, tuple[tuple[str, Writer], ...]] = {
    "trc": ((".trc", write_trc),),
    "mot": ((".mot", write_mot),),
    "c3d": ((".c3d", write_c3d),),
    "bvh": ((".bvh", write_bvh),),
    "csv": ((".csv", write_points_csv), ("_angles.csv", write_angles_csv)),
    "gltf": ((".glb", write_glb),),
    "ply": (("_ply", write_body_meshes),),
}
#: how a file of each format begins
_SIGNATURES = {
    ".trc": looks_like(rb"PathFileType\t"),
    ".mot": looks_like(rb"[^\n]*\nversion=1\n"),
    ".c3d": looks_like(rb".P"),
    ".bvh": looks_like(rb"HIERARCHY"),
    ".csv": looks_like(rb"frame,time,status,"),
    ".glb": looks_like(rb"glTF"),
}
# Formats that cannot mark a pose as unknown.
_HOLDING = ("bvh", "gltf", "ply")


@dataclass(frozen=True)
class Exported:
    """The files that :func:`export` has written, and notes for the user."""

    files: tuple[Path, ...]
    notes: tuple[str, ...]


def export(
    result: str | os.PathLike[str],
    formats: Sequence[str],
    folder: Path | None = None,
    smoothed: bool = False,
    force: bool = False,
) -> Exported:
    """Write a result in other formats; the files take its name.

    Args:
        formats: names of :data:`FORMATS`.
        folder: output folder, created if necessary; None: the folder of the result.
        smoothed: export the smoothed copy; `_smoothed` is added to the files' names.
        force: replace existing files.

    Raises:
        ResultError: the result cannot be read, or has nothing to export.
        ExportError: a format is unknown, a file exists, a package is missing, or a file cannot be written.
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise ExportError(f"formats {', '.join(formats)}: give some of {', '.join(FORMATS)}")
    path = Path(result)
    folder = path.parent if folder is None else folder
    stem = path.stem + ("_smoothed" if smoothed else "")
    jobs = [(folder / (stem + ending), write) for name in dict.fromkeys(formats) for ending, write in FORMATS[name]]
    for target, _ in jobs:
        if target.suffix in _SIGNATURES and target.parent.is_dir():
            kind = Kind(f"a file of tk export in {target.suffix}", (target.suffix,), _SIGNATURES[target.suffix])
            check_output(target, kind, force, [path])
        elif check_not_input(target, [path]).exists() and not force:
            raise ExportError(f"{target}: exists; choose another folder", hint="or replace it with --force")
    motion, notes = read_motion(path, smoothed)
    lost = int((~motion.known).sum())
    holding = [name for name in formats if name in _HOLDING]
    if lost and holding:
        notes = (*notes, f"{', '.join(holding)}: in {lost} lost frames the pose before is held")
    for target, write in jobs:
        _write(motion, target, write)
    return Exported(tuple(target for target, _ in jobs), notes)


def _write(motion: Motion, target: Path, write: Writer) -> None:
    """Write to a temporary file and rename it, so that a file with the final name is complete."""
    part = target.with_name(f".{target.stem}.part{target.suffix}")  # keep the suffix: ezc3d would add a missing one
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write(motion, part)
        if target.is_dir():  # a rename does not replace a folder
            _remove(target)
        os.replace(part, target)
    except OSError as error:
        raise ExportError(f"{target}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(part) if part.is_dir() else part.unlink()


def _remove(folder: Path) -> None:
    """Remove the folder of an earlier export; refuse a folder with other files."""
    other = next((file for file in folder.iterdir() if not re.fullmatch(r"\d{6,}\.ply", file.name)), None)
    if other is not None:
        raise ExportError(f"{other}: tk export did not make it, so its folder is not replaced; choose another folder")
    shutil.rmtree(folder)
