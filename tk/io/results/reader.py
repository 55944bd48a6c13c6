"""Read a whole result file, or only the joint positions of a result or of ground truth."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
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
    OLDEST_VERSION,
    ROWS,
    Dataset,
    columns_of,
    prefix_of,
    smoothed_columns,
)
from tk.io.results.status import Status
from tk.model.body.joints import in_joint_order
from tk.model.cameras.camera import Camera, Rig, shortened

_ENTRIES = {entry.path: entry for entry in ROWS}
_TEXTS = {field.name for field in fields(ResultMeta) if field.type == "str"}


def read_result(path: str | os.PathLike[str]) -> Result:
    """Read a whole result; of a file with several people, person 0, whose ``people`` are all. They have the same
    frames.

    Raises:
        ResultError: the file does not exist, is not a result of a version that can be read, or is incomplete or
            damaged.
    """
    path = Path(path)
    with open_result(path) as (file, people):
        stored = read_state(file)
        shared: dict[str, Any] = {
            "path": path,
            "cameras": _read_cameras(file),
            "state": stored[2] if stored else {},
            "software": file.text("", "software", ""),
            "created": file.text("", "created", ""),
            "notes": file.names("", "notes") if file.attribute("", "notes") is not None else (),
        }
        found = [person.result(shared) for person in people]
        first, *others = found if people[0].prefix else _aligned(found)
        return replace(first, others=tuple(others))


def read_people(path: str | os.PathLike[str]) -> tuple[JointTrack, ...]:
    """Read the joints of each person of a result or of ground truth, in the order of
    :data:`~tk.model.body.joints.JOINTS`.

    Raises:
        ResultError: as :func:`read_result`, or a joint is missing, a frame is repeated, or the unit is not metres.
    """
    with open_hdf5(Path(path)) as file:
        if file.attribute("", "format") is None:
            return _read_truths(file)
    return joint_tracks(read_result(path))


def read_truth(path: str | os.PathLike[str]) -> tuple[JointTrack, ...]:
    """Read the joints of each person of ground truth; see :func:`read_people`. A result of an older version, too, is
    ground truth: joints have the same place in every version."""
    with open_hdf5(Path(path)) as file:
        version = file.attribute("", "format_version")
        if file.is_format(FORMAT) and isinstance(version, int | np.integer) and version < FORMAT_VERSION:
            return _read_truths(file)
    return read_people(path)


def read_joints(path: str | os.PathLike[str]) -> JointTrack:
    """Read the joints of the first person; see :func:`read_people`."""
    return read_people(path)[0]


def joint_tracks(result: Result) -> tuple[JointTrack, ...]:
    """Return the joints of each person of a result."""
    return tuple(_track_of(person) for person in result.people)


def truth_of(result: Result, path: Path) -> Float | None:
    """Return the ground-truth joints (P, F, J, 3) of each person in the result's frames, NaN if missing; None without
    the file."""
    return positions_at(result.frames, read_truth(path)) if path.exists() else None


def positions_at(frames: NDArray[np.int64], people: Sequence[JointTrack]) -> Float:
    """Return the joints (P, F, J, 3) of each person in these frames, NaN if missing."""
    places = np.full((len(people), len(frames), *people[0].positions.shape[1:]), np.nan)
    for person, track in zip(places, people, strict=True):
        _, mine, theirs = np.intersect1d(frames, track.frames, return_indices=True)
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


@contextlib.contextmanager
def open_result(path: Path, to_change: bool = False) -> Iterator[tuple[Hdf5Reader, list[StoredPerson]]]:
    """Open a result and check its format and the shapes of its datasets; ``to_change``: it will be changed.

    Raises:
        ResultError: the file is not a result, of a version that can be read or changed, or it is damaged.
    """
    with open_hdf5(path) as file:
        old = _version(file, FORMAT_VERSION if to_change else OLDEST_VERSION) < FORMAT_VERSION
        yield file, [StoredPerson(file, n, "" if old and n == 0 else prefix_of(n)) for n in range(_count_people(file))]


def read_state(file: Hdf5Reader) -> tuple[int, int, dict[str, Value]] | None:
    """Return the number of frames, the number of people and the state of the run; None if no state can be used."""
    if "resume" not in file or file.attribute("", "format_version") != FORMAT_VERSION:
        return None
    try:
        return unpack_state(file.array("resume", "uint8", (None,)))
    except ValueError as error:
        file.fail(str(error))


class StoredPerson:
    """One person of an open result.

    Args:
        file: the result.
        number: of the person.
        prefix: start of the paths of the person's datasets; empty for person 0 of a file of version 3.

    Attributes:
        prefix: as given.
        meta: the metadata.
        count: number of frames.

    Raises:
        ResultError: a dataset or attribute is missing or has the wrong shape.
    """

    def __init__(self, file: Hdf5Reader, number: int, prefix: str) -> None:
        self._file, self._number, self.prefix = file, number, prefix
        # in version 3 each person had the run's datasets
        self._run = prefix if f"{prefix}frames" in file.shapes else ""
        self.meta = self._read_meta()
        self._columns = columns_of(self.meta)
        if prefix and number == 0:
            self._refuse_copies()
        if len(file.shapes.get(f"{self._run}frames", ())) != 1:
            file.fail(f"has no /{self._run}frames with one number per frame; the file is damaged")
        self.count = file.shapes[f"{self._run}frames"][0]
        for name, column in self._columns.items():
            expected, path = (self.count, *column.shape), self._path(column.entry, name)
            if file.shapes.get(path) != expected:
                found = f"has shape {file.shapes[path]}" if path in file.shapes else "is missing"
                file.fail(f"/{path} {found}; {expected} is expected for {self.count} frames")
        self._offsets = self._read_offsets()

    def _refuse_copies(self) -> None:
        """Refuse data instead of a link to person 0: another program has changed them, and tk would not see it."""
        own = {name.split("/")[0] for name, column in self._columns.items() if not column.entry.of_run}
        for path in (*self._file.groups, *self._file.shapes):
            if (name := path.split("/")[0]) in own | {"model", "smoothed", "hull"}:
                self._file.fail(
                    f"/{name} is not the link to /{self.prefix}{name} that tk writes; change /{self.prefix}{name}, and "
                    f"remove /{name}"
                )

    def model(self) -> dict[str, Value]:
        """Return the fitted body; {} if there is none."""
        return self._file.values(f"{self.prefix}model", MAX_NUMBER)

    def rows(self) -> dict[str, Any]:
        """Return the values of all frames, by the field of Result, after a check of each dataset."""
        found: dict[str, Any] = {"timing": {}, "angles": {}}
        for path, column in self._columns.items():
            values = self._read(path, column.entry, *column.shape)
            if column.key:
                found[column.entry.field][column.key] = values
            else:
                found[column.entry.field] = values
        _check_frames(self._file, self._run, found["frames"])
        return found

    def result(self, shared: dict[str, Any]) -> Result:
        """Return the whole content; ``shared`` are the fields of Result that belong to the file."""
        found, smoothed = self.rows(), None
        if f"{self.prefix}smoothed" in self._file:
            smoothed = {
                path: self._read(f"smoothed/{path}", column.entry, *column.shape)
                for path, column in smoothed_columns(self._columns).items()
                if f"{self.prefix}smoothed/{path}" in self._file or path == "bridged"
            }
        hull = None
        if self._offsets is not None:
            voxels = int(self._offsets[-1])
            positions, colors = (_read(self._file, self.prefix + e.path, e, (voxels, 3)) for e in HULL[:2])
            hull = Hull(positions, colors, self._offsets)
        return Result(
            meta=self.meta, person=self._number, smoothed=smoothed, model=self.model(), hull=hull, **found, **shared
        )

    def _path(self, entry: Dataset, path: str) -> str:
        return (self._run if entry.of_run else self.prefix) + path

    def _read(self, path: str, entry: Dataset, *shape: int) -> NDArray[Any]:
        return _read(self._file, self._path(entry, path), entry, (self.count, *shape))

    def _read_meta(self) -> ResultMeta:
        file, prefix = self._file, self.prefix
        found: dict[str, Any] = {}
        for name, (source, kind) in ATTRIBUTES.items():
            found[source] = file.text("", name) if kind is str else kind(file.number("", name))
        timing = f"{self._run}timing"
        found["timing_stages"] = file.names(timing, "stages") if timing in file else ()
        angles = file.names(f"{prefix}angles", "joints") if f"{prefix}angles" in file else ()
        for entry in (entry for entry in ROWS if not entry.each):
            path = self._path(entry, entry.path)
            exists = path in file.shapes
            if not exists and not entry.optional:
                file.fail(f"has no /{path}; the file is damaged")
            for attribute, item in entry.attributes.items():
                if item in _TEXTS:
                    found[str(item)] = file.text(path, attribute, "")
                elif isinstance(item, str) and item not in found:
                    found[item] = file.names(path, attribute) if exists else ()
            if entry.optional == "modes":
                found["modes"] = (*file.shapes[path], 1)[1] if exists else 0
            elif entry.optional:
                found.setdefault(entry.optional, exists)
        try:
            found["angles"] = tuple(
                JointAngles(
                    joint, file.names(path, "names"), file.text(path, "convention"), file.text(path, "unmeasured", "")
                )
                for joint, path in ((joint, f"{prefix}angles/{joint}") for joint in angles)
            )
            return ResultMeta(**found)
        except ValueError as error:
            file.fail(f"{error}; the file is damaged")

    def _read_offsets(self) -> NDArray[np.int64] | None:
        """Return `/hull/offsets`, if they match the positions and colours; None without hull."""
        if f"{self.prefix}hull" not in self._file:
            return None
        offsets = _read(self._file, f"{self.prefix}hull/offsets", HULL[2], (self.count + 1,))
        shapes = [self._file.shapes.get(self.prefix + entry.path) for entry in HULL[:2]]
        if offsets[0] != 0 or (np.diff(offsets) < 0).any() or shapes != [(offsets[-1], 3)] * 2:
            self._file.fail(f"/{self.prefix}hull/offsets does not divide the voxels into frames; the file is damaged")
        return offsets


# --- parts of a file --------------------------------------------------------------------------------------------------


def _version(file: Hdf5Reader, oldest: int) -> int:
    """Return the version of a result; refuse files of other software, and versions that are older or not known yet."""
    if not file.is_format(FORMAT):
        file.fail(f"an HDF5 file of other software, not a {FORMAT}; name another file")
    found = file.attribute("", "format_version")
    if not isinstance(found, int | np.integer) or not oldest <= found <= FORMAT_VERSION:
        newer = isinstance(found, int | np.integer) and found > FORMAT_VERSION
        remedy = "use a newer tk" if newer else "track the capture again"
        file.fail(
            f"format_version is {found}; this version of tk reads versions {OLDEST_VERSION} and {FORMAT_VERSION}, and "
            f"continues version {FORMAT_VERSION}: {remedy}"
        )
    return int(found)


def _aligned(people: Sequence[Result]) -> list[Result]:
    """Return the people of a file of version 3 with a row for each frame of anybody, NaN where a person is absent."""
    frames = np.unique(np.concatenate([person.frames for person in people]))
    time = np.empty(len(frames))
    for person in people:
        time[np.searchsorted(frames, person.frames)] = person.time
    found = []
    for person in people:
        rows = np.full(len(frames), -1)
        there = np.where(person.status == Status.ABSENT, -1, np.arange(len(person)))
        rows[np.searchsorted(frames, person.frames)] = there
        if (rows < 0).any():
            own = replace(person.at_rows(rows), frames=frames, time=time)
            if len(person) == len(frames):
                own = replace(own, hull=person.hull, timing=person.timing)
            person = own
        found.append(person)
    return found


def _count_people(file: Hdf5Reader) -> int:
    """Return the number of people, who must be numbered 0, 1, …"""
    if "people" not in file:
        return 1
    names = {name.split("/")[1] for name in (*file.groups, *file.shapes) if name.startswith("people/")}
    if not names or names != {str(person) for person in range(len(names))} or "people" in file.shapes:
        file.fail("/people does not hold groups 0, 1, …; the file is damaged")
    return len(names)


def _read(file: Hdf5Reader, path: str, entry: Dataset, shape: tuple[int | None, ...]) -> NDArray[Any]:
    return file.array(path, entry.dtype, shape, *entry.valid, entry.finite)


def _read_truths(file: Hdf5Reader) -> tuple[JointTrack, ...]:
    """Return the joints of each person in a file of ground truth."""
    units = file.text("", "units", "m")
    if units != "m":
        file.fail(f"units = {units}; joint positions must be in metres (m)")
    prefixes = [f"people/{person}/" for person in range(_count_people(file))] if "people" in file else [""]
    return tuple(_read_truth(file, prefix) for prefix in prefixes)


def _read_truth(file: Hdf5Reader, prefix: str) -> JointTrack:
    """Return the joints of a person in a file of ground truth, which may list the frames for all people."""
    listed = f"{prefix}frames" if f"{prefix}frames" in file.shapes else "frames"
    for name in (listed, f"{prefix}joints/position"):
        if name not in file.shapes:
            file.fail(f"has no /{name}; it is neither a tk result nor a capture's truth")
    frames = _read(file, listed, _ENTRIES["frames"], (None,))
    _check_frames(file, prefix, frames)
    names = file.names(f"{prefix}joints/position", "names")
    positions = _read(file, f"{prefix}joints/position", _ENTRIES["joints/position"], (len(frames), len(names), 3))
    try:
        return JointTrack(file.path, frames, in_joint_order(positions, names))
    except KeyError as error:
        file.fail(f"/{prefix}joints/position has no joint {error.args[0]} in its attribute names")


def _track_of(result: Result) -> JointTrack:
    """Return the joints of a result."""
    seconds = None
    if result.timing:
        stages = list(result.timing.values())
        seconds = result.timing["total"] if "total" in result.timing else np.sum(stages, axis=0)
    result = result.in_joint_order()
    return JointTrack(result.path, result.frames, result.joints, result.status, seconds, result.sigma)


def _check_frames(file: Hdf5Reader, prefix: str, frames: NDArray[np.int64]) -> None:
    values, counts = np.unique(frames, return_counts=True)
    if (counts > 1).any():
        file.fail(f"/{prefix}frames: frame {values[counts > 1][0]} is listed twice; each frame must be listed once")


def _read_cameras(file: Hdf5Reader) -> UsedCameras | None:
    if "cameras" not in file:
        return None
    names = file.names("cameras", "names")
    found = {
        entry.path.split("/")[1]: _read(file, entry.path, entry, entry.lengths({"C": len(names)})) for entry in CAMERAS
    }
    if (found["size"] < 1).any():
        file.fail("/cameras/size holds an image without pixels; the file is damaged")
    cameras = [
        Camera(
            name=name,
            width=int(found["size"][c, 0]),
            height=int(found["size"][c, 1]),
            matrix=found["matrix"][c],
            distortions=shortened(found["distortions"][c], bool(found["fisheye"][c])),
            rotation=np.asarray(cv2.Rodrigues(found["rotation"][c])[0], dtype=np.float64),
            translation=found["translation"][c],
            fisheye=bool(found["fisheye"][c]),
        )
        for c, name in enumerate(names)
    ]
    return UsedCameras(Rig(tuple(cameras)), found["time_offset"])
