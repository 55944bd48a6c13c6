"""Create the datasets of a result file and append frames. :mod:`tk.io.results.writer` decides when and where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from tk.io.results.columns import columns_of, put_attributes, row_of, strings
from tk.io.results.data import FORMAT, FORMAT_VERSION, FrameResult, HullPoints, ResultMeta, UsedCameras, Value

# Duration of a chunk of rows, s. A longer chunk makes each append slower, a shorter one makes reading slower.
CHUNK_SECONDS = 1.5
HULL_CHUNK = 8192  # voxels per chunk: some seconds of frames at 64³, a few frames at 128³

State = Mapping[str, Value]


@dataclass(frozen=True)
class Row:
    """A frame to be written. It is a copy: the tracker may reuse its arrays before the second twin is written."""

    index: int
    columns: Mapping[str, NDArray[Any]]
    hull: HullPoints | None
    state: State | None

    @staticmethod
    def of(index: int, result: FrameResult, state: State | None, meta: ResultMeta) -> Row:
        """Copy and check a frame.

        Raises:
            ValueError: a shape, the status or a timing stage does not match ``meta``.
        """
        columns = row_of(result, meta)
        hull = result.hull
        if hull is not None:
            hull = HullPoints(np.array(hull.positions, dtype=np.float32), np.array(hull.colors, dtype=np.uint8))
            if hull.positions.shape != hull.colors.shape or hull.positions.shape[1:] != (3,):
                raise ValueError(f"hull: positions {hull.positions.shape} and colours {hull.colors.shape}, not (N, 3)")
        if state is not None:
            state = {name: value if isinstance(value, str) else np.array(value) for name, value in state.items()}
        return Row(index, columns, hull, state)


class Twin:
    """One of the two files and its number of rows. Datasets stay open: opening one costs more than writing a row."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self.file = file
        self.rows = int(file["frames"].shape[0])
        self.model_version = 0
        self._has_smoothed = "smoothed" in file
        self._open: dict[str, h5py.h5d.DatasetID] = {}
        self._state_names = _dataset_names(file, "resume/state")
        self._put_last: dict[str, tuple[object, bytes]] = {}  # most of the state is the same in every frame

    def append(self, new_rows: Sequence[Row]) -> None:
        """Append frames and the latest state, without flushing. `/smoothed` is deleted: it is now incomplete."""
        self._drop_smoothed()
        for name in new_rows[0].columns:
            self._extend(name, np.array([row.columns[name] for row in new_rows]), self.rows)
        if "hull" in self.file or any(row.hull is not None for row in new_rows):
            self._append_hulls([row.hull for row in new_rows])
        self.rows += len(new_rows)
        for row in reversed(new_rows):
            if row.state is not None:
                self._put_state(row.state, row.index + 1)
                break

    def drop_rows_without_state(self, meta: ResultMeta) -> None:
        """Remove the rows after the frame of the stored state."""
        rows = int(self.file["resume/rows"][()]) if "resume/rows" in self.file else self.rows
        if rows >= self.rows:
            return
        self.rows = rows
        for name in columns_of(meta):
            self.file[name].resize(self.rows, axis=0)
        self._drop_smoothed()
        if "hull" in self.file:
            voxels = int(self.file["hull/offsets"][self.rows])
            self.file["hull/offsets"].resize(self.rows + 1, axis=0)
            self.file["hull/positions"].resize(voxels, axis=0)
            self.file["hull/colors"].resize(voxels, axis=0)

    def _drop_smoothed(self) -> None:
        if self._has_smoothed:
            del self.file["smoothed"]
            self._has_smoothed = False

    def _append_hulls(self, hulls: Sequence[HullPoints | None]) -> None:
        if "hull" not in self.file:
            _create_growing(self.file, "hull/positions", (3,), "f4", HULL_CHUNK)
            _create_growing(self.file, "hull/colors", (3,), "u1", HULL_CHUNK).attrs["order"] = "RGB"
            _create_growing(self.file, "hull/offsets", (), "i8", 64)
            self._extend("hull/offsets", np.zeros(self.rows + 1, dtype=np.int64))  # earlier frames have no voxels
        stored = self._dataset("hull/positions").shape[0]
        for hull in hulls:
            if hull is not None:
                self._extend("hull/positions", hull.positions)
                self._extend("hull/colors", hull.colors)
        counts = [0 if hull is None else len(hull.positions) for hull in hulls]
        self._extend("hull/offsets", stored + np.cumsum(counts, dtype=np.int64))

    def _put_state(self, state: State, rows: int) -> None:
        """Overwrite `/resume` with the tracker's state after ``rows`` frames."""
        if self._state_names - set(state):
            self._drop("resume/state")
        self._state_names = set(state)
        self._put("resume/rows", rows)
        for name, value in state.items():
            self._put(f"resume/state/{name}", value)

    def _put(self, name: str, value: Value) -> None:
        """Overwrite a small dataset, in place if the new value fits."""
        array = np.asarray(encode(value), order="C")
        is_text = isinstance(value, str)
        content = ((array.dtype, array.shape, is_text), array.tobytes())
        if self._put_last.get(name) == content:
            return
        self._put_last[name] = content
        if name in self._open or isinstance(self.file.get(name), h5py.Dataset):
            dataset = self._dataset(name)
            growing = dataset.get_create_plist().get_layout() == h5py.h5d.CHUNKED
            if dataset.dtype == array.dtype and growing == is_text and (is_text or dataset.shape == array.shape):
                if is_text:
                    dataset.set_extent(array.shape)
                if array.size:
                    dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, array)
                return
            self._drop(name)
        elif name in self.file:  # a group, in a damaged file
            self._drop(name)
        if is_text:  # with HDF5's strings of variable length, each write would leave the old bytes in the file
            self.file.create_dataset(name, data=array, maxshape=(None,), chunks=(1024,)).attrs["encoding"] = "utf-8"
        else:
            self.file.create_dataset(name, data=array)

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

    def _drop(self, name: str) -> None:
        self._open = {key: handle for key, handle in self._open.items() if not f"{key}/".startswith(f"{name}/")}
        self._put_last = {key: last for key, last in self._put_last.items() if key in self._open}
        del self.file[name]


def write_layout(file: h5py.File, meta: ResultMeta) -> None:
    """Write the attributes and the empty datasets of a new result."""
    file.attrs.update(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "fps": float(meta.fps),
            "units": "m",
            "up": meta.up,
            "capture": meta.capture,
            "method": meta.method,
            "seed": int(meta.seed),
            "config": meta.config_toml,
            "software": f"tk-mocap {_software_version()}",
            "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
    )
    rows = max(1, round(CHUNK_SECONDS * meta.fps))
    file.create_group("timing").attrs["stages"] = strings(meta.timing_stages)
    if meta.angles:
        file.create_group("angles").attrs["joints"] = strings(angles.joint for angles in meta.angles)
    for name, column in columns_of(meta).items():
        put_attributes(_create_growing(file, name, column.shape, column.dtype, rows), column)


def put_model(file: h5py.File, model: Mapping[str, Value]) -> None:
    """Write or replace `/model`. A name may hold slashes."""
    if "model" in file:
        del file["model"]
    group = file.create_group("model")
    for name, value in model.items():
        group[name] = value


def put_cameras(file: h5py.File, cameras: UsedCameras) -> None:
    """Write or replace `/cameras`: each dataset has one row per camera, the attribute `names` their names."""
    if "cameras" in file:
        del file["cameras"]
    group = file.create_group("cameras")
    group.attrs["names"] = strings(cameras.rig.names)
    group["matrix"] = np.array([camera.matrix for camera in cameras.rig])
    group["distortions"] = np.array([np.pad(c.distortions, (0, 5 - len(c.distortions))) for c in cameras.rig])
    group["rotation"] = np.array([cv2.Rodrigues(camera.rotation)[0].ravel() for camera in cameras.rig])
    group["translation"] = np.array([camera.translation for camera in cameras.rig])
    group["size"] = np.array([(camera.width, camera.height) for camera in cameras.rig], dtype=np.int64)
    group["fisheye"] = np.array([camera.fisheye for camera in cameras.rig], dtype=np.uint8)
    group["time_offset"] = np.array(cameras.time_offset_s, dtype=np.float64)


def encode(value: Value) -> NDArray[Any]:
    """Return a value as an array that can be overwritten in place: text as its UTF-8 bytes."""
    return np.frombuffer(value.encode(), dtype=np.uint8) if isinstance(value, str) else np.asarray(value)


def _dataset_names(file: h5py.File, group: str) -> set[str]:
    names: set[str] = set()
    if group in file:
        file[group].visititems(lambda name, item: names.add(name) if isinstance(item, h5py.Dataset) else None)
    return names


def _create_growing(file: h5py.File, name: str, shape: tuple[int, ...], dtype: str, rows: int) -> h5py.Dataset:
    return file.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *(n or None for n in shape)),  # HDF5 has no chunks without columns
        chunks=(rows, *(max(1, n) for n in shape)),
        dtype=dtype,
    )


def _software_version() -> str:
    try:
        return version("tk-mocap")
    except PackageNotFoundError:  # run from a source tree
        return "unknown"
