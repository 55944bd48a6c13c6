"""What a result file holds, as values, and how it is read. :mod:`tk.io.result` writes it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.model.skeleton import JOINTS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

FORMAT = "tk-result"
FORMAT_VERSION = 1

Float = NDArray[np.float64]
Value = NDArray[Any] | float | int | str


class Status(IntEnum):
    """The values of `/status`."""

    TRACKED = 0
    INITIALISED = 1
    RECOVERED = 2
    LOST = 3


STATUS_MEANING = ("tracked", "initialised", "recovered after loss", "lost")


@dataclass(frozen=True)
class ResultMeta:
    """What is fixed for a whole run. A run is resumed only with an equal one.

    Attributes:
        pose_names, pose_units: names and units of the D entries of the configuration vector.
        stages: names of the optimiser's S stages, for `/iterations`.
        timing_stages: names of the timed stages. ``total``, if among them, is the frame's wall time.
        fps: frames a second of the capture.
        up: the axis that points up.
        capture, method: what was tracked, and how.
        seed: of the random generator.
        config_toml: the full configuration as TOML text.
        joint_names: J names, in the order of `/joints/position`.
    """

    pose_names: tuple[str, ...]
    pose_units: tuple[str, ...]
    stages: tuple[str, ...]
    timing_stages: tuple[str, ...]
    fps: float
    up: str
    capture: str
    method: str
    seed: int
    config_toml: str
    joint_names: tuple[str, ...] = JOINTS
    waist_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.pose_names) != len(self.pose_units):
            raise ValueError(f"{len(self.pose_names)} pose names but {len(self.pose_units)} units")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps = {self.fps} must be positive")

    def difference(self, other: ResultMeta) -> str | None:
        """In what the two differ, as ``seed is 1, not 2``; None if in nothing."""
        sizes = len(self.pose_names), len(other.pose_names)
        if sizes[0] != sizes[1]:
            return f"the pose has {sizes[0]} entries, not {sizes[1]}"
        for name in ("capture", "method", "seed", "fps", "up"):
            if getattr(self, name) != getattr(other, name):
                return f"{name} is {getattr(self, name)}, not {getattr(other, name)}"
        for name in ("pose_names", "pose_units", "stages", "timing_stages", "joint_names", "waist_names"):
            if getattr(self, name) != getattr(other, name):
                return f"{name} are {', '.join(getattr(self, name))}; not {', '.join(getattr(other, name))}"
        return _config_difference(tomllib.loads(self.config_toml), tomllib.loads(other.config_toml))


@dataclass(frozen=True)
class HullPoints:
    """A frame's surface voxels: ``positions`` (N, 3) metres, world frame; ``colors`` (N, 3) uint8 RGB."""

    positions: NDArray[np.floating]
    colors: NDArray[np.uint8]


@dataclass(frozen=True)
class FrameResult:
    """One finished frame.

    Attributes:
        frame: source frame index.
        time: seconds.
        pose: (D,) configuration vector, radians and metres.
        joints: (J, 3) joint centres, metres, world frame.
        status: a :class:`Status`.
        objective: final value of the objective.
        iterations: (S,) optimiser iterations a stage.
        timing: seconds a stage; a stage that is not mentioned took none.
        hull: the surface voxels, if they are to be stored.
        waist: (W,) angles beyond the pose's, radians; none by default.
    """

    frame: int
    time: float
    pose: Float
    joints: Float
    status: int
    objective: float
    iterations: NDArray[np.integer]
    timing: Mapping[str, float]
    hull: HullPoints | None = None
    waist: Float = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Hull:
    """Surface voxels of all frames, ragged: row i of the result has ``offsets[i]:offsets[i + 1]``.

    ``positions`` (N, 3) float32 metres, world frame; ``colors`` (N, 3) uint8 RGB; ``offsets`` (F + 1,) int64.
    """

    positions: NDArray[np.float32]
    colors: NDArray[np.uint8]
    offsets: NDArray[np.int64]

    def __getitem__(self, row: int) -> HullPoints:
        start, stop = self.offsets[row], self.offsets[row + 1]
        return HullPoints(self.positions[start:stop], self.colors[start:stop])


@dataclass(frozen=True)
class Result:
    """A whole result file: F frames, D degrees of freedom, J joints, S optimiser stages."""

    path: Path
    meta: ResultMeta
    frames: NDArray[np.int64]  # (F,)
    time: Float  # (F,) seconds
    pose: Float  # (F, D)
    waist: Float | None  # (F, W) radians
    joints: Float  # (F, J, 3) metres
    status: NDArray[np.uint8]  # (F,)
    objective: Float  # (F,)
    iterations: NDArray[np.int32]  # (F, S)
    timing: Mapping[str, Float]  # each (F,) seconds
    model: Mapping[str, Value]  # nested groups as names with slashes
    hull: Hull | None
    state: Mapping[str, Value]  # what the tracker needs to go on after the last frame
    software: str
    created: str

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(frozen=True)
class JointTrack:
    """Joint centres over time, from a result or from a capture's truth.

    Attributes:
        path: the file.
        frames: (F,) source frame indices, each once.
        positions: (F, 15, 3) metres, world frame, in the order of :data:`tk.model.skeleton.JOINTS`.
        status: (F,) as in a result; None for a truth.
        seconds: (F,) wall time of each frame; None where the file does not tell.
    """

    path: Path
    frames: NDArray[np.int64]
    positions: Float
    status: NDArray[np.uint8] | None = None
    seconds: Float | None = None


def read_result(path: str | os.PathLike[str]) -> Result:
    """Read a whole result.

    Raises:
        ResultError: no such file, not HDF5, of other software or another version, or incomplete.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        check_format(file, path)
        meta = read_meta(file, path)
        result = Result(
            path=path,
            meta=meta,
            frames=_read(file, "frames", path),
            time=_read(file, "time", path),
            pose=_read(file, "pose", path),
            joints=_read(file, "joints/position", path),
            waist=_read(file, "waist", path) if meta.waist_names else None,
            status=_read(file, "status", path),
            objective=_read(file, "objective", path),
            iterations=_read(file, "iterations", path),
            timing={stage: _read(file, f"timing/{stage}", path) for stage in meta.timing_stages},
            model=read_values(file, "model"),
            hull=Hull(*(_read(file, f"hull/{name}", path) for name in ("positions", "colors", "offsets")))
            if "hull" in file
            else None,
            state=read_values(file, "resume/state"),
            software=str(file.attrs.get("software", "")),
            created=str(file.attrs.get("created", "")),
        )
    columns: dict[str, NDArray[Any]] = {
        "time": result.time,
        "pose": result.pose,
        **({} if result.waist is None else {"waist": result.waist}),
        "joints/position": result.joints,
        "status": result.status,
        "objective": result.objective,
        "iterations": result.iterations,
    }
    for name, column in columns.items():
        if len(column) != len(result):
            raise ResultError(f"{path}: /{name} has {len(column)} rows for {len(result)} frames; the file is damaged")
    return result


def read_joints(path: str | os.PathLike[str]) -> JointTrack:
    """Read `/frames` and `/joints/position` of a result or a truth, the joints in the contract's order.

    Raises:
        ResultError: as :func:`read_result`, or a joint is missing, a frame is there twice, or the unit is not metres.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        if "format" in file.attrs:
            check_format(file, path)
        for name in ("frames", "joints/position"):
            if not isinstance(file.get(name), h5py.Dataset):
                raise ResultError(f"{path}: has no /{name}; it is neither a tk result nor a capture's truth")
        if file.attrs.get("units", "m") != "m":
            raise ResultError(f"{path}: units = {file.attrs['units']}; joint positions must be in metres (m)")
        frames = np.asarray(_read(file, "frames", path), dtype=np.int64)
        dataset = file["joints/position"]
        names = [_text(name) for name in np.atleast_1d(dataset.attrs.get("names", []))]
        missing = [joint for joint in JOINTS if joint not in names]
        if missing:
            raise ResultError(f"{path}: /joints/position has no joint {missing[0]} in its attribute names")
        if dataset.shape != (len(frames), len(names), 3):
            raise ResultError(
                f"{path}: /joints/position has shape {dataset.shape}; {(len(frames), len(names), 3)} is expected"
            )
        positions = np.asarray(_read(file, "joints/position", path), dtype=np.float64)
        status = _column(file, "status", len(frames), path) if "status" in file else None
        stages = list(file.get("timing", ()))
        timing = {stage: _column(file, f"timing/{stage}", len(frames), path) for stage in stages}
    values, counts = np.unique(frames, return_counts=True)
    if (counts > 1).any():
        raise ResultError(f"{path}: frame {values[counts > 1][0]} is there twice; each frame must be listed once")
    seconds: Float | None = None
    if timing:
        seconds = timing["total"] if "total" in timing else np.sum(list(timing.values()), axis=0)
    order = [names.index(joint) for joint in JOINTS]
    return JointTrack(path, frames, positions[:, order], status, seconds)


# --- shared with the writer -------------------------------------------------------------------------------------------


def open_hdf5(path: Path) -> h5py.File:
    """Open for reading. Without locks: a published result is never written to."""
    if not path.is_file():
        raise ResultError(f"{path}: is a folder; name a file" if path.is_dir() else f"{path}: no such file")
    try:
        return h5py.File(path, "r", locking=False)
    except PermissionError:
        raise ResultError(f"{path}: no permission to read it") from None
    except OSError:
        raise ResultError(f"{path}: is not an HDF5 file, or is damaged") from None


def check_format(file: h5py.File, path: Path) -> None:
    """Raise ResultError unless the file says that it is a result of this format version."""
    if _text(file.attrs.get("format", "")) != FORMAT:
        raise ResultError(f"{path}: an HDF5 file of other software, not a {FORMAT}; name another file")
    found = file.attrs.get("format_version")
    if found != FORMAT_VERSION:
        raise ResultError(
            f"{path}: format_version is {found}, this version of tk knows {FORMAT_VERSION}; track the capture again"
        )


def read_meta(file: h5py.File, path: Path) -> ResultMeta:
    """The metadata of an open result."""

    def attribute(holder: str, name: str) -> Any:
        if holder not in file or name not in file[holder].attrs:
            raise ResultError(f"{path}: has no attribute {name} on {holder}; the file is damaged")
        return _text(file[holder].attrs[name])

    def names(holder: str, name: str) -> tuple[str, ...]:
        values: Iterable[Any] = np.atleast_1d(attribute(holder, name))
        return tuple(str(_text(value)) for value in values)

    return ResultMeta(
        pose_names=names("/pose", "names"),
        pose_units=names("/pose", "units"),
        stages=names("/iterations", "stages"),
        timing_stages=names("/timing", "stages"),
        fps=float(attribute("/", "fps")),
        up=attribute("/", "up"),
        capture=attribute("/", "capture"),
        method=attribute("/", "method"),
        seed=int(attribute("/", "seed")),
        config_toml=attribute("/", "config"),
        joint_names=names("/joints/position", "names"),
        waist_names=names("/waist", "names") if "waist" in file else (),
    )


def encode(value: Value) -> NDArray[Any]:
    """A value as an array that HDF5 can hold in place: text becomes its UTF-8 bytes."""
    return np.frombuffer(value.encode(), dtype=np.uint8) if isinstance(value, str) else np.asarray(value)


def read_values(file: h5py.File, group: str) -> dict[str, Value]:
    """All datasets below a group as a flat mapping; {} if there is no such group."""
    found: dict[str, Value] = {}

    def visit(name: str, item: h5py.HLObject) -> None:
        if isinstance(item, h5py.Dataset):
            value = item[()]
            is_text = item.attrs.get("encoding") == "utf-8"
            found[name] = value.tobytes().decode() if is_text else _text(value)

    if group in file:
        file[group].visititems(visit)
    return found


def _text(value: Any) -> Any:
    return value.decode() if isinstance(value, bytes) else value


def _read(file: h5py.File, name: str, path: Path) -> NDArray[Any]:
    if not isinstance(file.get(name), h5py.Dataset):
        raise ResultError(f"{path}: has no /{name}; the file is damaged")
    try:
        return file[name][()]
    except OSError:
        raise ResultError(f"{path}: /{name} cannot be read; the file is damaged") from None


def _column(file: h5py.File, name: str, rows: int, path: Path) -> NDArray[Any]:
    values = _read(file, name, path)
    if values.shape != (rows,):
        raise ResultError(f"{path}: /{name} has shape {values.shape} for {rows} frames; the file is damaged")
    return values


def _config_difference(mine: Mapping[str, Any], other: Mapping[str, Any], prefix: str = "") -> str | None:
    for key in [*mine, *(key for key in other if key not in mine)]:
        a, b = mine.get(key), other.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            found = _config_difference(a, b, f"{prefix}{key}.")
            if found:
                return found
        elif a != b:
            shown = ["not set" if value is None else str(value) for value in (a, b)]
            return f"config {prefix}{key} is {shown[0]}, not {shown[1]}"
    return None
