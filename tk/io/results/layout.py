"""The datasets of a result file that is open for writing."""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from tk import __version__
from tk.io.results.data import ResultMeta, UsedCameras, Value
from tk.io.results.schema import (
    ATTRIBUTES,
    CAMERAS,
    FORMAT,
    FORMAT_VERSION,
    HULL,
    Column,
    absent_row,
    columns_of,
    prefix_of,
    smoothed_columns,
)

# Duration of a chunk of rows, s. A longer chunk makes each append slower, a shorter one makes reading slower.
CHUNK_SECONDS = 1.5
HULL_CHUNK = 8192  # voxels per chunk: some seconds of frames at 64³, a few frames at 128³

#: values by path in the file: of one frame, or of several frames with a leading axis
Values = Mapping[str, NDArray[Any]]


class Layout:
    """The datasets of a result.

    Args:
        file: the open file.
        meta: the metadata, the same for every person.

    Attributes:
        run, person: the columns of the run, and those of each person, by path.
    """

    def __init__(self, file: h5py.File, meta: ResultMeta) -> None:
        self.file = file
        self.meta = meta
        columns = columns_of(meta)
        self.run = {name: column for name, column in columns.items() if column.entry.of_run}
        self.person = {name: column for name, column in columns.items() if not column.entry.of_run}
        self._open: dict[str, h5py.h5d.DatasetID] = {}  # opening a dataset costs more than writing a row

    def begin(self) -> None:
        """Write what a new result has before its first frame: root attributes, and the empty datasets of the run."""
        values = {name: kind(getattr(self.meta, source)) for name, (source, kind) in ATTRIBUTES.items()}
        self.file.attrs.update(values | file_attributes(FORMAT, FORMAT_VERSION))
        put_attributes(self.file.create_group("timing"), {"stages": self.meta.timing_stages})
        self._create(self.run)

    def add_person(self, person: int) -> None:
        """Create the datasets of a person, unless they exist; the person is absent in the frames so far."""
        prefix, count = prefix_of(person), len(self.file["frames"])
        if prefix in self.file:
            return
        group = self.file.create_group(prefix)
        if self.meta.angles:
            joints = [angles.joint for angles in self.meta.angles]
            put_attributes(group.create_group("angles"), {"joints": joints})
        self._create(self.person, prefix)
        for name, value in absent_row(self.person).items():
            self._extend(prefix + name, np.broadcast_to(value, (count, *value.shape)))
        self._link(person, self.person)

    def append(self, rows: Sequence[Values], people: Mapping[int, Sequence[Values]]) -> None:
        """Append frames, of :func:`~tk.io.results.schema.checked_row`, and remove `/smoothed`, which does not have
        them.

        Args:
            rows: of the run.
            people: rows of every person.
        """
        for person, own in people.items():
            prefix = prefix_of(person)
            self._remove(f"{prefix}smoothed")
            if f"{prefix}hull" in self.file or any("hull/positions" in row for row in own):
                self._append_hulls(person, own)
            for name in self.person:
                self._extend(prefix + name, np.array([row[name] for row in own]))
        for name in self.run:
            self._extend(name, np.array([row[name] for row in rows]))

    def keep(self, count: int, people: int) -> None:
        """Remove all frames but the first ``count``, and all people but the first ``people``."""
        for person in range(people, len(self.file["people"])):
            self._remove(prefix_of(person))
        if len(self.file["frames"]) == count:
            return
        for name in self.run:
            self.file[name].resize(count, axis=0)
        for prefix in map(prefix_of, range(people)):
            self._remove(f"{prefix}smoothed")
            lengths = dict.fromkeys(self.person, count)
            if f"{prefix}hull" in self.file:
                voxels = int(self.file[f"{prefix}hull/offsets"][count])
                lengths |= {"hull/positions": voxels, "hull/colors": voxels, "hull/offsets": count + 1}
            for name, length in lengths.items():
                self.file[prefix + name].resize(length, axis=0)

    def replace(self, person: int, columns: Values, smoothed: Values) -> None:
        """Replace columns of a person, and all of `/smoothed`, which belongs to the old columns."""
        prefix, copies = prefix_of(person), smoothed_columns(self.person)
        for name, values in columns.items():
            self.file[prefix + name][...] = values
        if columns or smoothed:
            self._remove(f"{prefix}smoothed")
        if smoothed:
            self._link(person, ["smoothed"])
        for name, values in smoothed.items():
            put_attributes(self.file.create_dataset(f"{prefix}smoothed/{name}", data=values), copies[name].attributes)

    def put_model(self, person: int, model: Mapping[str, Value]) -> None:
        """Write or replace `/model` of a person. A name may contain slashes."""
        path = f"{prefix_of(person)}model"
        self._remove(path)
        group = self.file.create_group(path)
        for name, value in model.items():
            group[name] = value
        self._link(person, ["model"])

    def put_cameras(self, cameras: UsedCameras) -> None:
        """Write or replace `/cameras`: each dataset has one row per camera, the attribute `names` their names."""
        self._remove("cameras")
        put_attributes(self.file.create_group("cameras"), {"names": cameras.rig.names})
        values = {
            "matrix": [camera.matrix for camera in cameras.rig],
            "distortions": [np.pad(camera.distortions, (0, 8 - len(camera.distortions))) for camera in cameras.rig],
            "rotation": [cv2.Rodrigues(camera.rotation)[0].ravel() for camera in cameras.rig],
            "translation": [camera.translation for camera in cameras.rig],
            "size": cameras.rig.sizes,
            "fisheye": [camera.fisheye for camera in cameras.rig],
            "time_offset": cameras.time_offset_s,
        }
        for entry in CAMERAS:
            self.file[entry.path] = np.array(values[entry.path.split("/")[1]], entry.dtype)

    def put_state(self, packed: NDArray[np.uint8]) -> None:
        """Write or replace `/resume`, see :func:`pack_state`."""
        if "resume" not in self.file:
            create_growing(self.file, "resume", (), "uint8", len(packed))
        dataset = self._dataset("resume")
        dataset.set_extent(packed.shape)
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, packed)

    def _create(self, columns: Mapping[str, Column], prefix: str = "") -> None:
        """Create empty datasets."""
        chunk = max(1, round(CHUNK_SECONDS * self.meta.fps))
        for name, column in columns.items():
            dataset = create_growing(self.file, prefix + name, column.shape, column.entry.dtype, chunk)
            put_attributes(dataset, column.attributes)

    def _link(self, person: int, names: Iterable[str]) -> None:
        """Let the top level have links to the groups and datasets of person 0 with these paths."""
        for name in {name.split("/")[0] for name in names} if person == 0 else ():
            if self.file.get(name, getlink=True) is None:
                self.file[name] = h5py.SoftLink(f"/{prefix_of(0)}{name}")

    def _append_hulls(self, person: int, rows: Sequence[Values]) -> None:
        prefix = prefix_of(person)
        if f"{prefix}hull" not in self.file:
            for entry in HULL:
                shape, chunk = entry.lengths({"N": 0, "F+1": 0})[1:], 64 if entry is HULL[-1] else HULL_CHUNK
                create_growing(self.file, prefix + entry.path, shape, entry.dtype, chunk)
            self.file[f"{prefix}hull/colors"].attrs["order"] = "RGB"
            self.file[f"{prefix}hull/offsets"].resize(1 + len(self.file["frames"]), axis=0)
            self._link(person, ["hull"])
        counts = [len(row.get("hull/positions", ())) for row in rows]
        stored = self._dataset(f"{prefix}hull/positions").shape[0]
        self._extend(f"{prefix}hull/offsets", stored + np.cumsum(counts, dtype=np.int64))
        for name in ("hull/positions", "hull/colors"):
            for row in rows:
                self._extend(prefix + name, row.get(name, np.empty(0)))

    def _extend(self, path: str, values: NDArray[Any]) -> None:
        """Append rows. These low-level calls take a third of the time of ``resize`` and ``[n:] =``."""
        if len(values) == 0:
            return
        dataset = self._dataset(path)
        start = dataset.shape[0]
        dataset.set_extent((start + len(values), *values.shape[1:]))
        if values.size:  # rows may have no columns
            space = dataset.get_space()
            space.select_hyperslab((start, *(0 for _ in values.shape[1:])), values.shape)
            dataset.write(h5py.h5s.create_simple(values.shape), space, np.ascontiguousarray(values))

    def _dataset(self, path: str) -> h5py.h5d.DatasetID:
        if path not in self._open:
            self._open[path] = self.file[path].id
        return self._open[path]

    def _remove(self, path: str) -> None:
        if path in self.file:
            del self.file[path]


def file_attributes(name: str, version: int) -> dict[str, Any]:
    """Return the root attributes that every HDF5 file of tk has."""
    return {
        "format": name,
        "format_version": version,
        "units": "m",
        "software": f"tk-mocap {__version__}",
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def create_growing(file: h5py.File, path: str, shape: tuple[int, ...], dtype: str, chunk: int) -> h5py.Dataset:
    """Create an empty dataset for rows of this shape, with ``chunk`` rows per chunk."""
    return file.create_dataset(
        path,
        shape=(0, *shape),
        maxshape=(None, *(n or None for n in shape)),  # HDF5 has no chunks without columns
        chunks=(chunk, *(max(1, n) for n in shape)),
        dtype=dtype,
    )


def put_attributes(holder: h5py.Dataset | h5py.Group, attributes: Mapping[str, str | Iterable[str]]) -> None:
    """Write attributes that are texts or lists of texts."""
    for name, value in attributes.items():
        holder.attrs[name] = value if isinstance(value, str) else np.array(list(value), h5py.string_dtype())


def pack_state(frames: int, people: int, state: Mapping[str, Value]) -> NDArray[np.uint8]:
    """Return the content of `/resume`: a NumPy archive (npz) and its CRC-32.

    Args:
        frames: number of finished frames.
        people: number of people in them.
        state: state of the run after these frames.
    """
    archive = io.BytesIO()
    content: dict[str, Any] = {f"state/{name}": value for name, value in state.items()}
    np.savez(archive, rows=frames, people=people, **content)
    data = archive.getvalue()
    return np.frombuffer(data + zlib.crc32(data).to_bytes(4, "little"), np.uint8)


def unpack_state(packed: NDArray[np.uint8]) -> tuple[int, int, dict[str, Value]]:
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
    return int(state.pop("rows")), int(state.pop("people")), state
