"""Read a whole result file, or only the joint positions of a result or of ground truth."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.hdf5 import Hdf5Reader, open_hdf5
from tk.io.results.columns import MAX_DISTANCE_M, MAX_FRAME, MAX_NUMBER, MAX_STATUS, columns_of
from tk.io.results.data import (
    FIELDS,
    FORMAT,
    FORMAT_VERSION,
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
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Camera, Rig


def read_result(path: str | os.PathLike[str]) -> Result:
    """Read a whole result.

    Raises:
        ResultError: the file does not exist, is not a result of this format version, or is incomplete or damaged.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        check_format(file)
        meta = read_meta(file)
        rows = count_rows(file, meta)
        columns = {
            name: file.array(name, column.dtype, (rows, *column.shape), column.limit)
            for name, column in columns_of(meta).items()
        }
        _check_frames(file, columns["frames"])
        fields: dict[str, Any] = {field: columns.get(name) for name, field in FIELDS.items()}
        return Result(
            path=path,
            meta=meta,
            **fields,
            timing={stage: columns[f"timing/{stage}"] for stage in meta.timing_stages},
            angles={angles.joint: columns[f"angles/{angles.joint}"] for angles in meta.angles},
            cameras=_read_cameras(file),
            smoothed=_read_smoothed(file, meta, rows),
            model=read_values(file, "model"),
            hull=_read_hull(file, rows),
            state=read_values(file, "resume/state"),
            software=file.text("", "software", ""),
            created=file.text("", "created", ""),
            notes=file.names("", "notes") if file.attribute("", "notes") is not None else (),
        )


def read_joints(path: str | os.PathLike[str]) -> JointTrack:
    """Read the joints of a result or of ground truth, in the order of :data:`tk.model.body.joints.JOINTS`.

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
        for name in ("frames", "joints/position"):
            if name not in file.shapes:
                file.fail(f"has no /{name}; it is neither a tk result nor a capture's truth")
        frames = file.array("frames", "int64", (None,), MAX_FRAME)
        _check_frames(file, frames)
        names = file.names("joints/position", "names")
        missing = [joint for joint in JOINTS if joint not in names]
        if missing:
            file.fail(f"/joints/position has no joint {missing[0]} in its attribute names")
        order = [names.index(joint) for joint in JOINTS]
        rows, joints = len(frames), len(names)
        positions = file.array("joints/position", "float64", (rows, joints, 3), MAX_DISTANCE_M)[:, order]
        positions[~np.isfinite(positions)] = np.nan
        status = file.array("status", "uint8", (rows,), MAX_STATUS) if "status" in file else None
        sigma = (
            file.array("joints/sigma", "float64", (rows, joints), MAX_DISTANCE_M) if "joints/sigma" in file else None
        )
        if sigma is not None and (sigma < 0).any():
            file.fail("/joints/sigma holds negative numbers; the file is damaged")
        stages = [name for name in file.below("timing") if "/" not in name]
        timing = {stage: file.array(f"timing/{stage}", "float64", (rows,), MAX_NUMBER) for stage in stages}
    seconds: Float | None = None
    if timing:
        seconds = timing["total"] if "total" in timing else np.sum(list(timing.values()), axis=0)
    return JointTrack(path, frames, positions, status, seconds, None if sigma is None else sigma[:, order])


@contextlib.contextmanager
def as_damage_error(path: Path, what: str) -> Iterator[None]:
    """Convert exceptions that values of a wrong type, shape or size cause to a ResultError that names ``what``.

    It is for values that this module cannot check, such as a body or the state of a tracker.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            yield
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, AssertionError) as error:
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
        remedy = "use a newer tk" if newer else "track the capture again (--force replaces the file)"
        file.fail(f"format_version is {found}; this version of tk reads and resumes version {FORMAT_VERSION}: {remedy}")


def read_meta(file: Hdf5Reader) -> ResultMeta:
    """Return the metadata of an open result."""
    for name in ("pose", "iterations", "timing", "joints/position", "frames"):
        if name not in file:
            file.fail(f"has no /{name}; the file is damaged")
    try:
        return ResultMeta(
            pose_names=file.names("pose", "names"),
            pose_units=file.names("pose", "units"),
            stages=file.names("iterations", "stages"),
            timing_stages=file.names("timing", "stages"),
            fps=file.number("", "fps"),
            up=file.text("", "up"),
            capture=file.text("", "capture"),
            method=file.text("", "method"),
            seed=int(file.number("", "seed")),
            config_toml=file.text("", "config"),
            joint_names=file.names("joints/position", "names"),
            sigma="joints/sigma" in file,
            residual_cameras=file.names("residual", "cameras") if "residual" in file else (),
            segment_names=file.names("segments/rotation", "names") if "segments/rotation" in file else (),
            feet="feet/position" in file,
            angles=_read_angles(file),
            objective_kind=file.text("objective", "kind", "") if "objective" in file else "",
        )
    except ValueError as error:
        file.fail(f"{error}; the file is damaged")


def count_rows(file: Hdf5Reader, meta: ResultMeta) -> int:
    """Return the number of frames, after checking the shape of every dataset with one row per frame.

    Raises:
        ResultError: a dataset is missing or has the wrong shape.
    """
    if len(file.shapes.get("frames", ())) != 1:
        file.fail("has no /frames with one number per frame; the file is damaged")
    rows = file.shapes["frames"][0]
    for name, column in columns_of(meta).items():
        if file.shapes.get(name) != (rows, *column.shape):
            found = f"has shape {file.shapes[name]}" if name in file.shapes else "is missing"
            file.fail(f"/{name} {found}; {(rows, *column.shape)} is expected for {rows} frames")
    return rows


def check_hull(file: Hdf5Reader, rows: int) -> NDArray[np.int64] | None:
    """Return `/hull/offsets`, which divide the voxels into frames; None if there is no hull.

    Raises:
        ResultError: the offsets do not match the positions and colours.
    """
    if "hull" not in file:
        return None
    offsets = file.array("hull/offsets", "int64", (rows + 1,))
    shapes = [file.shapes.get(name) for name in ("hull/positions", "hull/colors")]
    if offsets[0] != 0 or (np.diff(offsets) < 0).any() or shapes != [(offsets[-1], 3)] * 2:
        file.fail("/hull/offsets does not divide /hull/positions and /hull/colors into frames; the file is damaged")
    return offsets


def read_values(file: Hdf5Reader, group: str) -> dict[str, Value]:
    """Return all datasets below a group as a flat mapping; {} if there is no such group.

    Raises:
        ResultError: a dataset holds neither numbers nor text, or a number above :data:`MAX_NUMBER`.
    """
    found: dict[str, Value] = {name: file.value(f"{group}/{name}") for name in file.below(group)}
    for name, value in found.items():
        numbers = np.asarray(value)
        if numbers.dtype.kind == "f" and (np.abs(numbers[np.isfinite(numbers)]) > MAX_NUMBER).any():
            file.fail(f"/{group}/{name} holds a number that is out of range; the file is damaged")
    return found


def _read_angles(file: Hdf5Reader) -> tuple[JointAngles, ...]:
    if "angles" not in file:
        return ()
    return tuple(
        JointAngles(joint, file.names(f"angles/{joint}", "names"), file.text(f"angles/{joint}", "convention"))
        for joint in file.names("angles", "joints")
    )


def _check_frames(file: Hdf5Reader, frames: NDArray[np.int64]) -> None:
    values, counts = np.unique(frames, return_counts=True)
    if (values < 0).any():
        file.fail(f"/frames holds {values[0]}; frames count from 0")
    if (counts > 1).any():
        file.fail(f"frame {values[counts > 1][0]} is listed twice; each frame must be listed once")


def _read_cameras(file: Hdf5Reader) -> UsedCameras | None:
    if "cameras" not in file:
        return None
    names = file.names("cameras", "names")
    count = len(names)
    shapes: dict[str, tuple[int, ...]] = {
        "matrix": (count, 3, 3), "distortions": (count, 5), "rotation": (count, 3), "translation": (count, 3),
        "size": (count, 2), "fisheye": (count,), "time_offset": (count,),
    }  # fmt: skip
    found = {name: file.array(f"cameras/{name}", "float64", shape, MAX_NUMBER) for name, shape in shapes.items()}
    if not all(np.isfinite(values).all() for values in found.values()) or (found["size"] < 1).any():
        file.fail("/cameras describes no cameras; the file is damaged")
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


def _read_smoothed(file: Hdf5Reader, meta: ResultMeta, rows: int) -> dict[str, NDArray[Any]] | None:
    if "smoothed" not in file:
        return None
    found = {
        name: file.array(f"smoothed/{name}", column.dtype, (rows, *column.shape), column.limit)
        for name, column in columns_of(meta).items()
        if can_be_smoothed(name) and f"smoothed/{name}" in file
    }
    return {**found, "bridged": file.array("smoothed/bridged", "bool", (rows,))}


def _read_hull(file: Hdf5Reader, rows: int) -> Hull | None:
    offsets = check_hull(file, rows)
    if offsets is None:
        return None
    shape = (int(offsets[-1]), 3)
    return Hull(
        file.array("hull/positions", "float32", shape, MAX_DISTANCE_M),
        file.array("hull/colors", "uint8", shape),
        offsets,
    )
