"""Create the datasets of a result file and append frames. :mod:`tk.io.results.writer` decides when and where."""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from tk.io.results.data import FrameResult, HullPoints, ResultMeta, UsedCameras, Value
from tk.io.results.files import SafeFile
from tk.io.results.schema import (
    ATTRIBUTES,
    CAMERAS,
    FORMAT,
    FORMAT_VERSION,
    HULL,
    PERSON,
    Column,
    columns_of,
    prefix_of,
    row_of,
)

# Duration of a chunk of rows, s. A longer chunk makes each append slower, a shorter one makes reading slower.
CHUNK_SECONDS = 1.5
HULL_CHUNK = 8192  # voxels per chunk: some seconds of frames at 64³, a few frames at 128³

State = Mapping[str, Value]


@dataclass(frozen=True)
class FrameSet:
    """The rows of a frame set, by person. They are copies: a tracker may reuse its arrays before they are written."""

    index: int
    rows: Mapping[int, Mapping[str, NDArray[Any]]]
    hulls: Mapping[int, HullPoints | None]
    state: State | None

    @staticmethod
    def of(
        index: int, people: Mapping[int, FrameResult], state: State | None, columns: Mapping[str, Column]
    ) -> FrameSet:
        """Copy and check the frames.

        Raises:
            ValueError: a shape, the status or a timing stage does not match the columns.
        """
        if state is not None:
            state = {name: value if isinstance(value, str) else np.array(value) for name, value in state.items()}
        rows = {person: row_of(frame, columns) for person, frame in people.items()}
        return FrameSet(index, rows, {person: _copied(frame.hull) for person, frame in people.items()}, state)


class Twin:
    """One of the two files. Datasets stay open: opening one costs more than writing a row.

    Attributes:
        disk: the file.
        count: number of frame sets in the file.
        models: the bodies in the file.
    """

    def __init__(self, disk: SafeFile, meta: ResultMeta, models: Sequence[State]) -> None:
        self.disk = disk
        self.file = file = disk.file
        self.models = list(models)
        self._meta = meta
        self._rows = [int(file[f"{prefix_of(person)}frames"].shape[0]) for person in range(len(models))]
        self.count = self._rows[0]
        self._open: dict[str, h5py.h5d.DatasetID] = {}
        self._smoothed = {prefix for person in range(len(models)) if f"{(prefix := prefix_of(person))}smoothed" in file}
        self._relink = False
        if "resume" in file:
            self._drop_rows_without_state()

    def append(self, new: Sequence[FrameSet]) -> None:
        """Append frame sets and the latest state, without flushing. `/smoothed` is deleted: it is now incomplete."""
        with_state = max((k for k, frame_set in enumerate(new, 1) if frame_set.state is not None), default=0)
        for part in (new[:with_state], new[with_state:]):
            for person in range(1 + max((person for frame_set in part for person in frame_set.rows), default=-1)):
                self._append_rows(person, [frame_set for frame_set in part if person in frame_set.rows])
            self.count += len(part)
            if part and part[-1].state is not None:
                self._put_state(part[-1].state)
        if self._relink:
            link_first_person(self.file)
            self._relink = False

    def put_models(self, models: Sequence[State]) -> None:
        """Write the bodies that this file does not have yet."""
        for person, model in enumerate(models):
            if person >= len(self.models) or self.models[person] is not model:
                if person == len(self._rows):
                    self._add_person()
                put_model(self.file, model, person)
                self._relink = True
        self.models = list(models)

    def _drop_rows_without_state(self) -> None:
        self.count, counts, _ = unpack_state(self.file["resume"][()])
        for person in range(len(self._rows)):
            prefix, rows = prefix_of(person), counts[person] if person < len(counts) else 0
            if rows == self._rows[person]:
                continue
            self._rows[person] = rows
            self._drop_smoothed(prefix)
            for name in columns_of(self._meta):
                self.file[prefix + name].resize(rows, axis=0)
            if f"{prefix}hull" in self.file:
                hull = self.file[f"{prefix}hull"]
                voxels = int(hull["offsets"][rows])
                for name, length in (("offsets", rows + 1), ("positions", voxels), ("colors", voxels)):
                    hull[name].resize(length, axis=0)

    def _append_rows(self, person: int, new: Sequence[FrameSet]) -> None:
        prefix = prefix_of(person)
        if person == len(self._rows):
            self._add_person()
        if not new:
            return
        self._drop_smoothed(prefix)
        for name in new[0].rows[person]:
            values = np.array([frame_set.rows[person][name] for frame_set in new])
            self._extend(prefix + name, values, self._rows[person])
        hulls = [frame_set.hulls[person] for frame_set in new]
        if f"{prefix}hull" in self.file or any(hull is not None for hull in hulls):
            self._append_hulls(prefix, hulls, self._rows[person])
        self._rows[person] += len(new)

    def _append_hulls(self, prefix: str, hulls: Sequence[HullPoints | None], rows: int) -> None:
        if f"{prefix}hull" not in self.file:
            for entry in HULL:
                shape = entry.lengths({"N": 0, "F+1": 0})[1:]
                chunk = 64 if entry is HULL[-1] else HULL_CHUNK
                _create_growing(self.file, prefix + entry.path, shape, entry.dtype, chunk)
            self.file[f"{prefix}hull/colors"].attrs["order"] = "RGB"
            self._relink = True
            self._extend(f"{prefix}hull/offsets", np.zeros(rows + 1, np.int64))  # earlier frames have no voxels
        stored = self._dataset(f"{prefix}hull/positions").shape[0]
        for hull in hulls:
            if hull is not None:
                self._extend(f"{prefix}hull/positions", hull.positions)
                self._extend(f"{prefix}hull/colors", hull.colors)
        counts = [0 if hull is None else len(hull.positions) for hull in hulls]
        self._extend(f"{prefix}hull/offsets", stored + np.cumsum(counts, dtype=np.int64))

    def _add_person(self) -> None:
        create_person(self.file, self._meta, len(self._rows))
        self._rows.append(0)
        self._relink = True

    def _drop_smoothed(self, prefix: str) -> None:
        if prefix in self._smoothed:
            del self.file[f"{prefix}smoothed"]
            self._smoothed.remove(prefix)
            self._relink = True

    def _put_state(self, state: State) -> None:
        """Overwrite `/resume` with the state after the last frame set."""
        packed = pack_state(self.count, self._rows, state)
        if "resume" not in self.file:
            _create_growing(self.file, "resume", (), "uint8", len(packed))
        dataset = self._dataset("resume")
        dataset.set_extent(packed.shape)
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, packed)

    def _extend(self, name: str, values: NDArray[Any], rows: int | None = None) -> None:
        """Append values to a dataset. ``rows`` is its current number of rows; None: ask HDF5.

        The low-level calls take a third of the time of ``resize`` and ``[n:] =``.
        """
        if len(values) == 0:
            return
        dataset = self._dataset(name)
        start = dataset.shape[0] if rows is None else rows
        dataset.set_extent((start + len(values), *values.shape[1:]))
        if values.size == 0:  # rows without columns
            return
        space = dataset.get_space()
        space.select_hyperslab((start, *(0 for _ in values.shape[1:])), values.shape)
        dataset.write(h5py.h5s.create_simple(values.shape), space, np.ascontiguousarray(values))

    def _dataset(self, name: str) -> h5py.h5d.DatasetID:
        if name not in self._open:
            self._open[name] = self.file[name].id
        return self._open[name]


def write_layout(file: h5py.File, meta: ResultMeta, people: int) -> None:
    """Write the attributes and the empty datasets of a new result."""
    file.attrs.update({name: kind(getattr(meta, source)) for name, (source, kind) in ATTRIBUTES.items()})
    file.attrs.update(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "units": "m",
            "software": f"tk-mocap {_software_version()}",
            "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
    )
    for person in range(people):
        create_person(file, meta, person)
    link_first_person(file)


def create_person(file: h5py.File, meta: ResultMeta, person: int) -> None:
    """Create the empty datasets of a person. Person 0 is at the top level."""
    prefix, rows = prefix_of(person), max(1, round(CHUNK_SECONDS * meta.fps))
    file.create_group(f"{prefix}timing").attrs["stages"] = _strings(meta.timing_stages)
    if meta.angles:
        file.create_group(f"{prefix}angles").attrs["joints"] = _strings(angles.joint for angles in meta.angles)
    for name, column in columns_of(meta).items():
        dataset = _create_growing(file, prefix + name, column.shape, column.entry.dtype, rows)
        put_attributes(dataset, column.attributes)


def link_first_person(file: h5py.File) -> None:
    """Let `/people/0`, if there are several people, hold hard links to what the top level has of person 0."""
    if "people" not in file:
        return
    if "0" in file["people"]:
        del file["people/0"]
    group = file.create_group("people/0")
    for name in PERSON:
        if name in file:
            group[name] = file[name]


def put_model(file: h5py.File, model: Mapping[str, Value], person: int = 0) -> None:
    """Write or replace `/model` of a person. A name may hold slashes."""
    name = f"{prefix_of(person)}model"
    if name in file:
        del file[name]
    group = file.create_group(name)
    for name, value in model.items():
        group[name] = value


def put_cameras(file: h5py.File, cameras: UsedCameras) -> None:
    """Write or replace `/cameras`: each dataset has one row per camera, the attribute `names` their names."""
    if "cameras" in file:
        del file["cameras"]
    file.create_group("cameras").attrs["names"] = _strings(cameras.rig.names)
    values = {
        "matrix": [camera.matrix for camera in cameras.rig],
        "distortions": [np.pad(camera.distortions, (0, 5 - len(camera.distortions))) for camera in cameras.rig],
        "rotation": [cv2.Rodrigues(camera.rotation)[0].ravel() for camera in cameras.rig],
        "translation": [camera.translation for camera in cameras.rig],
        "size": [(camera.width, camera.height) for camera in cameras.rig],
        "fisheye": [camera.fisheye for camera in cameras.rig],
        "time_offset": cameras.time_offset_s,
    }
    for entry in CAMERAS:
        file[entry.path] = np.array(values[entry.path.split("/")[1]], entry.dtype)


def put_attributes(holder: h5py.Dataset | h5py.Group, attributes: Mapping[str, str | Iterable[str]]) -> None:
    """Write attributes that are texts or lists of texts."""
    for name, value in attributes.items():
        holder.attrs[name] = value if isinstance(value, str) else _strings(value)


def pack_state(rows: int, people: Sequence[int], state: State) -> NDArray[np.uint8]:
    """Return the content of `/resume`: a NumPy archive (npz) and its CRC-32.

    Args:
        rows: number of finished frame sets.
        people: number of rows of each person.
        state: state of the run after these rows.
    """
    archive = io.BytesIO()
    content: dict[str, Any] = {f"state/{name}": value for name, value in state.items()}
    np.savez(archive, rows=rows, people=people, **content)
    data = archive.getvalue()
    return np.frombuffer(data + zlib.crc32(data).to_bytes(4, "little"), np.uint8)


def unpack_state(packed: NDArray[np.uint8]) -> tuple[int, list[int], dict[str, Value]]:
    """Return the arguments of :func:`pack_state`.

    Raises:
        ValueError: the content is damaged.
    """
    data, crc = packed[:-4].tobytes(), packed[-4:].tobytes()
    if not data or zlib.crc32(data).to_bytes(4, "little") != crc:
        raise ValueError("the state of the run is damaged")
    with np.load(io.BytesIO(data)) as archive:
        content = {name.removeprefix("state/"): archive[name][()] for name in archive.files}
    state = {name: str(value) if isinstance(value, str) else value for name, value in content.items()}
    return int(state.pop("rows")), list(state.pop("people")), state


def _create_growing(file: h5py.File, name: str, shape: tuple[int, ...], dtype: str, rows: int) -> h5py.Dataset:
    return file.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *(n or None for n in shape)),  # HDF5 has no chunks without columns
        chunks=(rows, *(max(1, n) for n in shape)),
        dtype=dtype,
    )


def _copied(hull: HullPoints | None) -> HullPoints | None:
    if hull is None:
        return None
    hull = HullPoints(np.array(hull.positions, np.float32), np.array(hull.colors, np.uint8))
    if hull.positions.shape != hull.colors.shape or hull.positions.shape[1:] != (3,):
        raise ValueError(f"hull: positions {hull.positions.shape} and colours {hull.colors.shape}, not (N, 3)")
    return hull


def _strings(values: Iterable[str]) -> NDArray[Any]:
    """Return texts as an array that can be an HDF5 attribute."""
    return np.array(list(values), dtype=h5py.string_dtype())


def _software_version() -> str:
    try:
        return version("tk-mocap")
    except PackageNotFoundError:  # run from a source tree
        return "unknown"
