"""Export results to formats of other programs. Each format has a module and an entry in :data:`FORMATS`."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
from tk.io.paths import Kind, check_not_input, check_output, looks_like, replacing, resolved
from tk.io.results.data import Result
from tk.io.results.reader import read_result

__all__ = ["FORMATS", "Exported", "Motion", "export", "read_motion"]

# writes a file or a folder, and returns a note for the user if the format cannot hold all of the motion
Writer = Callable[[Motion, Path], str | None]


@dataclass(frozen=True)
class Format:
    """A format of other programs."""

    # for each file, or folder, the suffix added to the result's name, and the function that writes it
    outputs: tuple[tuple[str, Writer], ...]
    begins: bytes | None = None  # regular expression for the begin of its files; None for a folder
    holds: bool = False  # True if it cannot mark a pose as unknown


FORMATS = {
    "trc": Format(((".trc", write_trc),), rb"PathFileType\t"),
    "mot": Format(((".mot", write_mot),), rb"[^\n]*\nversion=1\n"),
    "c3d": Format(((".c3d", write_c3d),), rb".P"),
    "bvh": Format(((".bvh", write_bvh),), rb"HIERARCHY", holds=True),
    "csv": Format(((".csv", write_points_csv), ("_angles.csv", write_angles_csv)), rb"frame,time,status,"),
    "gltf": Format(((".glb", write_glb),), rb"glTF", holds=True),
    "ply": Format((("_ply", write_body_meshes),), holds=True),
}


@dataclass(frozen=True)
class Exported:
    """What :func:`export` has done."""

    files: tuple[Path, ...]  # the files and folders that were written
    notes: tuple[str, ...]  # for the user
    failed: tuple[str, ...] = ()  # for each format that could not be written, its name, the reason and the remedy


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
    chosen = _chosen(formats, bvh_units)
    path = Path(result)
    folder = path.parent if folder is None else folder
    people = read_result(path).people
    jobs = [
        (person, name, folder / f"{path.stem}{_number(person, people)}{smoothed * '_smoothed'}{ending}", write)
        for person in people
        for name, form in chosen.items()
        for ending, write in form.outputs
    ]
    capture = next((each for each in resolved(folder).parents if (each / "calibration.toml").is_file()), None)
    for _, name, target, _ in jobs:
        _check_target(target, FORMATS[name], path, force, capture)
    motions, notes = _motions(people, smoothed, ", ".join(name for name, form in chosen.items() if form.holds))
    written, failed, refused = list[Path](), dict[str, str](), list[TkError]()
    for person, name, target, write in jobs:
        if name not in failed and person.person in motions:
            try:
                note = _write(motions[person.person], target, write)
                written.append(target)
                notes += [f"{target}: {note}"] if note else []
            except TkError as error:
                failed[name] = str(error)
                refused.append(error)
    reasons = tuple(f"{name}: {reason}" for name, reason in failed.items())
    if not written:
        raise (type(refused[0]) if refused else ExportError)("; ".join(dict.fromkeys(reasons or notes)))
    return Exported(tuple(written), tuple(notes), reasons)


def _chosen(formats: Sequence[str], bvh_units: str) -> dict[str, Format]:
    """Return the formats with these names."""
    names = tuple(FORMATS) if "all" in formats else tuple(dict.fromkeys(formats))
    if not names or not {*names} <= {*FORMATS}:
        raise ExportError(f"formats {', '.join(names)}: give some of {', '.join(FORMATS)}, or all")
    if bvh_units not in BVH_UNITS:
        raise ExportError(f"BVH unit {bvh_units}: give one of {', '.join(BVH_UNITS)}")
    bvh = replace(FORMATS["bvh"], outputs=((".bvh", partial(write_bvh, units=bvh_units)),))
    return {name: bvh if name == "bvh" else FORMATS[name] for name in names}


def _check_target(target: Path, form: Format, result: Path, force: bool, capture: Path | None) -> None:
    """Refuse a target that exists, unless it is of the format and ``force``; the result itself; and a capture's own
    folders, if the target lies in a ``capture``."""
    if form.begins is not None and target.parent.is_dir():
        kind = Kind(f"a file of tk export in {target.suffix}", (target.suffix,), looks_like(form.begins))
        check_output(target, kind, force, [result], capture)
    elif check_not_input(target, [result], capture).exists() and not force:
        raise ExportError(f"{target}: exists; choose another folder", hint="or replace it with --force")


def _motions(people: Sequence[Result], smoothed: bool, holding: str) -> tuple[dict[int, Motion], list[str]]:
    """Return the motion of each person who has one, and notes. ``holding``: the formats that hold a pose if frames are
    lost."""
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
        if lost and holding:
            notes.append(f"{whose}{holding}: in {lost} lost frames the pose before is held")
    return motions, notes


def _number(person: Result, people: Sequence[Result]) -> str:
    return f"_{person.person}" if len(people) > 1 else ""


def _write(motion: Motion, target: Path, write: Writer) -> str | None:
    """Write to a temporary file and rename it, so that a file with the final name is complete; return the note."""
    with replacing(target) as part:
        target.parent.mkdir(parents=True, exist_ok=True)
        note = write(motion, part)
        if target.is_dir():  # a rename does not replace a folder
            _remove(target)
    return note


def _remove(folder: Path) -> None:
    """Remove the folder of an earlier export; refuse a folder with other files."""
    other = next((file for file in folder.iterdir() if not re.fullmatch(r"\d{6,}\.ply", file.name)), None)
    if other is not None:
        raise ExportError(f"{other}: tk export did not make it, so its folder is not replaced; choose another folder")
    shutil.rmtree(folder)
