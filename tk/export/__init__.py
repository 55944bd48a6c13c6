"""Export results to formats of other programs. Each format has a module and an entry in :data:`FORMATS`."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from tk.errors import ExportError, ResultError, TkError
from tk.export.bvh import BVH_UNITS, write_bvh
from tk.export.c3d import write_c3d
from tk.export.csv import write_angles_csv, write_points_csv
from tk.export.gltf import write_glb
from tk.export.mot import write_mot
from tk.export.motion import Motion, motion_of, read_motion
from tk.export.ply import write_body_meshes
from tk.export.trc import write_trc
from tk.io.paths import Kind, check_not_input, check_output, looks_like, replacing
from tk.io.results.data import Result
from tk.io.results.reader import read_result

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
# Packages that a format needs beyond those of tk itself, and the command that installs it.
_PACKAGES = {"c3d": ("ezc3d", "pip install 'tk-mocap[export]'")}
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
    """What :func:`export` has done.

    Attributes:
        files: the files and folders that were written.
        notes: for the user.
        failed: for each format that could not be written, its name, the reason and the remedy.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...]
    failed: tuple[str, ...] = ()


def export(
    result: str | os.PathLike[str],
    formats: Sequence[str],
    folder: Path | None = None,
    smoothed: bool = False,
    force: bool = False,
    bvh_units: str = "m",
) -> Exported:
    """Write a result in other formats; the files take its name, with `_0`, `_1`, … if it has several people.

    A format that cannot be written does not stop the others.

    Args:
        formats: names of :data:`FORMATS`, or "all".
        folder: output folder, created if necessary; None: the folder of the result.
        smoothed: export the smoothed copy; `_smoothed` is added to the files' names.
        force: replace existing files.
        bvh_units: "m" or "cm", the unit of lengths in BVH files.

    Raises:
        ResultError: the result cannot be read, or has nothing to export.
        ExportError: a format is unknown, a file exists, or none of the formats can be written.
    """
    formats = tuple(FORMATS) if "all" in formats else tuple(dict.fromkeys(formats))
    if not formats or not {*formats} <= {*FORMATS}:
        raise ExportError(f"formats {', '.join(formats)}: give some of {', '.join(FORMATS)}, or all")
    if bvh_units not in BVH_UNITS:
        raise ExportError(f"BVH unit {bvh_units}: give one of {', '.join(BVH_UNITS)}")
    failed = {
        name: f"needs the package {package}: {remedy}"
        for name, (package, remedy) in _PACKAGES.items()
        if name in formats and find_spec(package) is None
    }
    path = Path(result)
    folder = path.parent if folder is None else folder
    people = read_result(path).people
    writers: dict[str, tuple[tuple[str, Writer], ...]] = {
        **FORMATS,
        "bvh": ((".bvh", partial(write_bvh, units=bvh_units)),),
    }
    jobs = [
        (person, name, folder / f"{path.stem}{_number(person, people)}{smoothed * '_smoothed'}{ending}", write)
        for person in people
        for name in formats
        if name not in failed
        for ending, write in writers[name]
    ]
    for _, _, target, _ in jobs:
        if target.suffix in _SIGNATURES and target.parent.is_dir():
            kind = Kind(f"a file of tk export in {target.suffix}", (target.suffix,), _SIGNATURES[target.suffix])
            check_output(target, kind, force, [path])
        elif check_not_input(target, [path]).exists() and not force:
            raise ExportError(f"{target}: exists; choose another folder", hint="or replace it with --force")
    motions: dict[int, Motion] = {}
    notes: list[str] = []
    for person in people:
        whose = f"person {person.person}: " if len(people) > 1 else ""
        try:
            motion, found = motion_of(person, smoothed)
        except ResultError as error:
            if not whose:
                raise
            notes.append(f"{whose}not exported: {error}")
            continue
        motions[person.person] = motion
        notes += found
        lost = int((~motion.known).sum())
        holding = [name for name in formats if name in _HOLDING]
        if lost and holding:
            notes.append(f"{whose}{', '.join(holding)}: in {lost} lost frames the pose before is held")
    written = []
    for person, name, target, write in jobs:
        if name in failed or person.person not in motions:
            continue
        try:
            _write(motions[person.person], target, write)
            written.append(target)
        except TkError as error:
            failed[name] = str(error)
    if not written:
        raise ExportError("; ".join(dict.fromkeys(f"{name}: {reason}" for name, reason in failed.items()) or notes))
    return Exported(tuple(written), tuple(notes), tuple(f"{name}: {reason}" for name, reason in failed.items()))


def _number(person: Result, people: Sequence[Result]) -> str:
    return f"_{person.person}" if len(people) > 1 else ""


def _write(motion: Motion, target: Path, write: Writer) -> None:
    """Write to a temporary file and rename it, so that a file with the final name is complete."""
    with replacing(target) as part:
        target.parent.mkdir(parents=True, exist_ok=True)
        write(motion, part)
        if target.is_dir():  # a rename does not replace a folder
            _remove(target)


def _remove(folder: Path) -> None:
    """Remove the folder of an earlier export; refuse a folder with other files."""
    other = next((file for file in folder.iterdir() if not re.fullmatch(r"\d{6,}\.ply", file.name)), None)
    if other is not None:
        raise ExportError(f"{other}: tk export did not make it, so its folder is not replaced; choose another folder")
    shutil.rmtree(folder)
