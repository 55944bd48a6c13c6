"""How a result file is read: all of it, or the joints alone, which a capture's truth has, too."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.hdf5 import open_hdf5
from tk.io.result_columns import columns_of
from tk.io.result_data import (
    FORMAT,
    READABLE_VERSIONS,
    Float,
    Hull,
    JointAngles,
    JointTrack,
    Result,
    ResultMeta,
    UsedCameras,
    Value,
    can_be_smoothed,
)
from tk.model.camera import Camera, Rig
from tk.model.skeleton import JOINTS


def read_result(path: str | os.PathLike[str]) -> Result:
    """Read a whole result.

    Raises:
        ResultError: no such file, not HDF5, of other software or another version, or incomplete.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        check_format(file, path)
        meta = read_meta(file, path)
        columns = {name: _read(file, name, path) for name in columns_of(meta)}
        for name, column in columns.items():
            if len(column) != len(columns["frames"]):
                raise ResultError(
                    f"{path}: /{name} has {len(column)} rows for {len(columns['frames'])} frames; the file is damaged"
                )
        return Result(
            path=path,
            meta=meta,
            frames=columns["frames"],
            time=columns["time"],
            pose=columns["pose"],
            joints=columns["joints/position"],
            waist=columns.get("waist"),
            status=columns["status"],
            objective=columns["objective"],
            iterations=columns["iterations"],
            timing={stage: columns[f"timing/{stage}"] for stage in meta.timing_stages},
            ankles=columns.get("ankles"),
            sigma=columns.get("joints/sigma"),
            fit_error=columns.get("fit_error"),
            segments_rotation=columns.get("segments/rotation"),
            feet=columns.get("feet/position"),
            angles={angles.joint: columns[f"angles/{angles.joint}"] for angles in meta.angles},
            cameras=_read_cameras(file, path),
            smoothed=_read_smoothed(file, meta, len(columns["frames"]), path),
            model=read_values(file, "model"),
            hull=Hull(*(_read(file, f"hull/{name}", path) for name in ("positions", "colors", "offsets")))
            if "hull" in file
            else None,
            state=read_values(file, "resume/state"),
            software=str(file.attrs.get("software", "")),
            created=str(file.attrs.get("created", "")),
        )


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
        sigma: Float | None = None
        if "joints/sigma" in file:
            sigma = np.asarray(_read(file, "joints/sigma", path), dtype=np.float64)
            if sigma.shape != positions.shape[:2]:
                raise ResultError(f"{path}: /joints/sigma has shape {sigma.shape}; {positions.shape[:2]} is expected")
        stages = list(file.get("timing", ()))
        timing = {stage: _column(file, f"timing/{stage}", len(frames), path) for stage in stages}
    values, counts = np.unique(frames, return_counts=True)
    if (counts > 1).any():
        raise ResultError(f"{path}: frame {values[counts > 1][0]} is there twice; each frame must be listed once")
    seconds: Float | None = None
    if timing:
        seconds = timing["total"] if "total" in timing else np.sum(list(timing.values()), axis=0)
    order = [names.index(joint) for joint in JOINTS]
    return JointTrack(path, frames, positions[:, order], status, seconds, None if sigma is None else sigma[:, order])


# --- shared with the writer -------------------------------------------------------------------------------------------


def check_format(file: h5py.File, path: Path) -> None:
    """Raise ResultError unless the file says that it is a result of this format version."""
    if _text(file.attrs.get("format", "")) != FORMAT:
        raise ResultError(f"{path}: an HDF5 file of other software, not a {FORMAT}; name another file")
    found = file.attrs.get("format_version")
    if found not in READABLE_VERSIONS:
        known = ", ".join(map(str, READABLE_VERSIONS))
        raise ResultError(f"{path}: format_version is {found}, this version of tk knows {known}; use a newer tk")


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
        ankle_names=names("/ankles", "names") if "ankles" in file else (),
        sigma="joints/sigma" in file,
        fit_cameras=names("/fit_error", "cameras") if "fit_error" in file else (),
        segment_names=names("/segments/rotation", "names") if "segments/rotation" in file else (),
        feet="feet/position" in file,
        angles=tuple(
            JointAngles(joint, names(f"/angles/{joint}", "names"), attribute(f"/angles/{joint}", "convention"))
            for joint in (names("/angles", "joints") if "angles" in file else ())
        ),
        objective_kind=_text(file["objective"].attrs.get("kind", "")) if "objective" in file else "",
    )


def _read_cameras(file: h5py.File, path: Path) -> UsedCameras | None:
    if "cameras" not in file:
        return None
    names = [str(_text(name)) for name in np.atleast_1d(file["cameras"].attrs["names"])]
    count = len(names)
    shapes = {
        "matrix": (count, 3, 3), "distortions": (count, 5), "rotation": (count, 3), "translation": (count, 3),
        "size": (count, 2), "fisheye": (count,), "time_offset": (count,),
    }  # fmt: skip
    found = {name: _read(file, f"cameras/{name}", path) for name in shapes}
    for name, shape in shapes.items():
        if found[name].shape != shape:
            raise ResultError(f"{path}: /cameras/{name} has shape {found[name].shape}; {shape} is expected")
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


def _read_smoothed(file: h5py.File, meta: ResultMeta, rows: int, path: Path) -> dict[str, NDArray[Any]] | None:
    if "smoothed" not in file:
        return None
    names = [name for name in columns_of(meta) if can_be_smoothed(name) and f"smoothed/{name}" in file]
    found = {name: _read(file, f"smoothed/{name}", path) for name in names}
    found["bridged"] = _column(file, "smoothed/bridged", rows, path)
    for name in names:
        if len(found[name]) != rows:
            raise ResultError(f"{path}: /smoothed/{name} has {len(found[name])} rows for {rows} frames")
    return found


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
