"""Read a whole result file, or only the joint positions of a result or of ground truth."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError, ResultError
from tk.io.hdf5 import Hdf5Reader, open_hdf5
from tk.io.results.data import Float, Hull, JointAngles, JointTrack, Result, ResultMeta, UsedCameras, Value
from tk.io.results.layout import unpack_state
from tk.io.results.schema import (
    ATTRIBUTES,
    CAMERAS,
    FORMAT,
    FORMAT_VERSION,
    HULL,
    MAX_NUMBER,
    ROWS,
    Dataset,
    columns_of,
    prefix_of,
    smoothed_columns,
)
from tk.model.body.joints import REQUIRED_JOINTS, in_joint_order
from tk.model.cameras.camera import Camera, Rig

_ENTRIES = {entry.path: entry for entry in ROWS}
_TEXTS = {field.name for field in fields(ResultMeta) if field.type == "str"}


def read_result(path: str | os.PathLike[str]) -> Result:
    """Read a whole result; of a file with several people, person 0, whose ``people`` are all.

    Raises:
        ResultError: the file does not exist, is not a result of this format version, or is incomplete or damaged.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        check_format(file)
        shared = {
            "path": path,
            "cameras": _read_cameras(file),
            "state": read_state(file)[1],
            "software": file.text("", "software", ""),
            "created": file.text("", "created", ""),
            "notes": file.names("", "notes") if file.attribute("", "notes") is not None else (),
        }
        others = [_read_person(file, person, shared) for person in range(1, count_people(file))]
        return _read_person(file, 0, {**shared, "others": tuple(others)})


def read_people(path: str | os.PathLike[str]) -> tuple[JointTrack, ...]:
    """Read the joints of each person of a result or of ground truth, in the order of
    :data:`~tk.model.body.joints.JOINTS`.

    Raises:
        ResultError: as :func:`read_result`, or a joint is missing, a frame is repeated, or the unit is not metres.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        if file.attribute("", "format") is not None:
            check_format(file)
        units = file.text("", "units", "m")
        if units != "m":
            file.fail(f"units = {units}; joint positions must be in metres (m)")
        if "people" not in file:
            return (_read_track(file, ""),)
        return tuple(_read_track(file, f"people/{person}/") for person in range(count_people(file)))


def read_joints(path: str | os.PathLike[str]) -> JointTrack:
    """Read the joints of the first person; see :func:`read_people`."""
    return read_people(path)[0]


def truth_of(result: Result, path: Path) -> Float | None:
    """Return the ground-truth joints (P, F, 15, 3) of each person in the result's frames, NaN if missing; None without
    the file."""
    if not path.exists():
        return None
    people = read_people(path)
    places = np.full((len(people), len(result), *people[0].positions.shape[1:]), np.nan)
    for person, track in zip(places, people, strict=True):
        _, mine, theirs = np.intersect1d(result.frames, track.frames, return_indices=True)
        person[mine] = track.positions[theirs]
    return places


_UNUSABLE = (
    ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError,
)  # fmt: skip


@contextlib.contextmanager
def as_damage_error(path: Path, what: str) -> Iterator[None]:
    """Convert exceptions that values of a wrong type, shape or size cause to a ResultError that names ``what``.

    It is for values that this module cannot check, such as a body or the state of a tracker.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            yield
    except (*_UNUSABLE, ConfigError) as error:
        detail = " ".join(str(error).split())[:100]
        raise ResultError(f"{path}: {what} cannot be used; the file is damaged ({detail})") from error


# --- shared with the writer -------------------------------------------------------------------------------------------


def check_format(file: Hdf5Reader) -> None:
    """Raise ResultError unless the file is a result of the format that this version of tk writes."""
    if not file.is_format(FORMAT):
        file.fail(f"an HDF5 file of other software, not a {FORMAT}; name another file")
    found = file.attribute("", "format_version")
    if np.ndim(found) or found != FORMAT_VERSION:
        newer = isinstance(found, int | np.integer) and found > FORMAT_VERSION
        remedy = "use a newer tk" if newer else "track the capture again"
        file.fail(f"format_version is {found}; this version of tk reads and resumes version {FORMAT_VERSION}: {remedy}")


def count_people(file: Hdf5Reader) -> int:
    """Return the number of people in the file.

    Raises:
        ResultError: the people are not numbered 0, 1, …
    """
    if "people" not in file:
        return 1
    names = {name.split("/")[1] for name in (*file.groups, *file.shapes) if name.startswith("people/")}
    if not names or names != {str(person) for person in range(len(names))} or "people" in file.shapes:
        file.fail("/people does not hold groups 0, 1, …; the file is damaged")
    return len(names)


def read_meta(file: Hdf5Reader, prefix: str = "") -> ResultMeta:
    """Return the metadata of a person in an open result."""
    found: dict[str, Any] = {}
    for name, (source, kind) in ATTRIBUTES.items():
        found[source] = file.text("", name) if kind is str else kind(file.number("", name))
    found["timing_stages"] = file.names(f"{prefix}timing", "stages") if f"{prefix}timing" in file else ()
    angles = file.names(f"{prefix}angles", "joints") if f"{prefix}angles" in file else ()
    for entry in (entry for entry in ROWS if not entry.each):
        path = prefix + entry.path
        exists = path in file.shapes
        if not exists and not entry.optional:
            file.fail(f"has no /{path}; the file is damaged")
        for attribute, item in entry.attributes.items():
            if item in _TEXTS:
                found[str(item)] = file.text(path, attribute, "")
            elif isinstance(item, str) and item not in found:
                found[item] = file.names(path, attribute) if exists else ()
        if entry.optional:
            found.setdefault(entry.optional, exists)
    try:
        found["angles"] = tuple(
            JointAngles(
                joint,
                file.names(f"{prefix}angles/{joint}", "names"),
                file.text(f"{prefix}angles/{joint}", "convention"),
            )
            for joint in angles
        )
        return ResultMeta(**found)
    except ValueError as error:
        file.fail(f"{error}; the file is damaged")


def count_rows(file: Hdf5Reader, meta: ResultMeta, prefix: str = "") -> int:
    """Return the number of a person's frames, after checking the shape of every dataset with one row per frame.

    Raises:
        ResultError: a dataset is missing or has the wrong shape.
    """
    if len(file.shapes.get(f"{prefix}frames", ())) != 1:
        file.fail(f"has no /{prefix}frames with one number per frame; the file is damaged")
    rows = file.shapes[f"{prefix}frames"][0]
    for name, column in columns_of(meta).items():
        expected, path = (rows, *column.shape), prefix + name
        if file.shapes.get(path) != expected:
            found = f"has shape {file.shapes[path]}" if path in file.shapes else "is missing"
            file.fail(f"/{path} {found}; {expected} is expected for {rows} frames")
    return rows


def check_hull(file: Hdf5Reader, rows: int, prefix: str = "") -> NDArray[np.int64] | None:
    """Return `/hull/offsets`; None if there is no hull.

    Raises:
        ResultError: the offsets do not match the positions and colours.
    """
    if f"{prefix}hull" not in file:
        return None
    offsets = _read(file, f"{prefix}hull/offsets", HULL[2], (rows + 1,))
    shapes = [file.shapes.get(prefix + entry.path) for entry in HULL[:2]]
    if offsets[0] != 0 or (np.diff(offsets) < 0).any() or shapes != [(offsets[-1], 3)] * 2:
        file.fail(f"/{prefix}hull/offsets does not divide the voxels into frames; the file is damaged")
    return offsets


def read_model(file: Hdf5Reader, prefix: str = "") -> dict[str, Value]:
    """Return the fitted body of a person; {} if there is none."""
    return file.values(f"{prefix}model", MAX_NUMBER)


def read_state(file: Hdf5Reader) -> tuple[list[int], dict[str, Value]]:
    """Return the number of rows of each person that have a state, and the state of the run; [] and {} without one."""
    if "resume" not in file.shapes:
        return [], {}
    try:
        _, people, state = unpack_state(file.array("resume", "uint8", (None,)))
    except ValueError as error:
        file.fail(str(error))
    return people, state


def _read(file: Hdf5Reader, path: str, entry: Dataset, shape: tuple[int | None, ...]) -> NDArray[Any]:
    return file.array(path, entry.dtype, shape, *entry.valid, entry.finite)


def _read_person(file: Hdf5Reader, person: int, shared: dict[str, Any]) -> Result:
    prefix = prefix_of(person)
    meta = read_meta(file, prefix)
    rows = count_rows(file, meta, prefix)
    columns = columns_of(meta)
    found: dict[str, Any] = {"timing": {}, "angles": {}}
    for path, column in columns.items():
        values = _read(file, prefix + path, column.entry, (rows, *column.shape))
        if column.key:
            found[column.entry.field][column.key] = values
        else:
            found[column.entry.field] = values
    _check_frames(file, prefix, found["frames"])
    smoothed = None
    if f"{prefix}smoothed" in file:
        smoothed = {
            path: _read(file, f"{prefix}smoothed/{path}", column.entry, (rows, *column.shape))
            for path, column in smoothed_columns(columns).items()
            if f"{prefix}smoothed/{path}" in file or path == "bridged"
        }
    return Result(
        meta=meta,
        person=person,
        smoothed=smoothed,
        model=read_model(file, prefix),
        hull=_read_hull(file, rows, prefix),
        **found,
        **shared,
    )


def _read_hull(file: Hdf5Reader, rows: int, prefix: str) -> Hull | None:
    offsets = check_hull(file, rows, prefix)
    if offsets is None:
        return None
    positions, colors = (_read(file, prefix + entry.path, entry, (int(offsets[-1]), 3)) for entry in HULL[:2])
    return Hull(positions, colors, offsets)


def _read_track(file: Hdf5Reader, prefix: str) -> JointTrack:
    """Return the joints of a person. Ground truth has no other datasets, and may list the frames for all people."""
    listed = f"{prefix}frames" if f"{prefix}frames" in file.shapes else "frames"
    for name in (listed, f"{prefix}joints/position"):
        if name not in file.shapes:
            file.fail(f"has no /{name}; it is neither a tk result nor a capture's truth")
    frames = _read(file, listed, _ENTRIES["frames"], (None,))
    _check_frames(file, prefix, frames)
    names = file.names(f"{prefix}joints/position", "names")
    missing = [joint for joint in REQUIRED_JOINTS if joint not in names]
    if missing:
        file.fail(f"/{prefix}joints/position has no joint {missing[0]} in its attribute names")

    def read(name: str, *shape: int) -> NDArray[Any] | None:
        path = prefix + name
        return _read(file, path, _ENTRIES[name], (len(frames), *shape)) if path in file else None

    positions, status = read("joints/position", len(names), 3), read("status")
    sigma = read("joints/sigma", len(names))
    assert positions is not None
    positions = in_joint_order(positions, names)
    positions[~np.isfinite(positions)] = np.nan
    entry, group = _ENTRIES["timing/<stage>"], f"{prefix}timing"
    timing = {stage: _read(file, f"{group}/{stage}", entry, (len(frames),)) for stage in file.below(group)}
    seconds: Float | None = None
    if timing:
        seconds = timing["total"] if "total" in timing else np.sum(list(timing.values()), axis=0)
    sigma = None if sigma is None else in_joint_order(sigma, names)
    return JointTrack(file.path, frames, positions, status, seconds, sigma)


def _check_frames(file: Hdf5Reader, prefix: str, frames: NDArray[np.int64]) -> None:
    values, counts = np.unique(frames, return_counts=True)
    if (counts > 1).any():
        file.fail(f"/{prefix}frames: frame {values[counts > 1][0]} is listed twice; each frame must be listed once")


def _read_cameras(file: Hdf5Reader) -> UsedCameras | None:
    if "cameras" not in file:
        return None
    names = file.names("cameras", "names")
    counts = {"C": len(names)}
    found = {entry.path.split("/")[1]: _read(file, entry.path, entry, entry.lengths(counts)) for entry in CAMERAS}
    if (found["size"] < 1).any():
        file.fail("/cameras/size holds an image without pixels; the file is damaged")
    cameras = [
        Camera(
            name=name,
            width=int(found["size"][c, 0]),
            height=int(found["size"][c, 1]),
            matrix=found["matrix"][c],
            distortions=found["distortions"][c, : 4 if found["fisheye"][c] else 5],
            rotation=np.asarray(cv2.Rodrigues(found["rotation"][c])[0], dtype=np.float64),
            translation=found["translation"][c],
            fisheye=bool(found["fisheye"][c]),
        )
        for c, name in enumerate(names)
    ]
    return UsedCameras(Rig(tuple(cameras)), found["time_offset"])
