"""The datasets of a result with one row a frame: names, types, attributes. Writer and reader both go by this list."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tk.io.results.data import FrameResult, ResultMeta
from tk.io.results.status import STATUS_MEANING
from tk.model.body.joints import FOOT_POINTS

#: no number in a result makes sense beyond these: metres from the world's origin, anything else, a frame's number
FAR_M, LARGE, LAST_FRAME = 1e6, 1e12, 10**9
LAST_STATUS = len(STATUS_MEANING) - 1


@dataclass(frozen=True)
class Column:
    """A dataset with one row a frame.

    Attributes:
        shape, dtype: of a row.
        attributes: of the dataset: a text, or a list of texts.
        most: the largest magnitude of a number that makes sense.
    """

    shape: tuple[int, ...]
    dtype: str
    attributes: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    most: float = LARGE

    def checked(self, name: str, values: Any, rows: int | None = None) -> NDArray[Any]:
        """A copy of a row (or of so many rows) in this column's type.

        Raises:
            ValueError: the shape is another.
        """
        array = np.array(values, dtype=self.dtype)
        expected = self.shape if rows is None else (rows, *self.shape)
        if array.shape != expected:
            raise ValueError(f"{name} has shape {array.shape}, {expected} is expected")
        return array


def columns_of(meta: ResultMeta) -> dict[str, Column]:
    """The columns of a result, by the names of their datasets."""
    joints = meta.joint_names
    columns = {
        "frames": Column((), "i8", most=LAST_FRAME),
        "time": Column((), "f8"),
        "pose": Column((len(meta.pose_names),), "f8", {"names": meta.pose_names, "units": meta.pose_units}),
        "joints/position": Column((len(joints), 3), "f8", {"names": joints}, FAR_M),
        "status": Column(
            (),
            "u1",
            {"meaning": tuple(f"{value}: {text}" for value, text in enumerate(STATUS_MEANING))},
            LAST_STATUS,
        ),
        "objective": Column((), "f8", {"kind": meta.objective_kind} if meta.objective_kind else {}, np.inf),
        "iterations": Column((len(meta.stages),), "i4", {"stages": meta.stages}),
        **{f"timing/{stage}": Column((), "f8") for stage in meta.timing_stages},
    }
    if meta.sigma:
        columns["joints/sigma"] = Column((len(joints),), "f8", {"names": joints}, FAR_M)
    if meta.residual_cameras:
        attributes = {"cameras": meta.residual_cameras, "areas": ("missing", "surplus")}
        columns["residual"] = Column((len(meta.residual_cameras), 2), "f8", attributes)
    if meta.segment_names:
        columns["segments/rotation"] = Column((len(meta.segment_names), 4), "f8", {"names": meta.segment_names})
    if meta.feet:
        columns["feet/position"] = Column((len(FOOT_POINTS), 3), "f8", {"names": FOOT_POINTS}, FAR_M)
    for angles in meta.angles:
        columns[f"angles/{angles.joint}"] = Column(
            (len(angles.names),), "f8", {"names": angles.names, "convention": angles.convention}
        )
    return columns


def row_of(frame: FrameResult, meta: ResultMeta) -> dict[str, NDArray[Any]]:
    """A frame's row in each column: copies, NaN where the frame does not know.

    Raises:
        ValueError: a shape or the status is not what it should be, or the frame brings what ``meta`` does not declare.
    """
    if int(frame.status) not in range(len(STATUS_MEANING)):
        raise ValueError(f"status {frame.status} has no meaning")
    optional = {
        "joints/sigma": frame.sigma,
        "residual": frame.residual,
        "segments/rotation": frame.segments_rotation,
        "feet/position": frame.feet,
        **{f"angles/{joint}": values for joint, values in frame.angles.items()},
    }
    brought = {name for name, values in optional.items() if values is not None}
    brought |= {f"timing/{stage}" for stage in frame.timing}
    columns = columns_of(meta)
    if brought - set(columns):
        raise ValueError(f"{', '.join(sorted(brought - set(columns)))}: not declared for this result")
    values: dict[str, Any] = {
        "frames": frame.frame,
        "time": frame.time,
        "pose": frame.pose,
        "joints/position": frame.joints,
        "status": int(frame.status),
        "objective": frame.objective,
        "iterations": frame.iterations,
        **{f"timing/{stage}": frame.timing.get(stage, 0.0) for stage in meta.timing_stages},
        **{name: values for name, values in optional.items() if values is not None},
    }
    return {
        name: column.checked(name, values[name]) if name in values else np.full(column.shape, np.nan)
        for name, column in columns.items()
    }


def put_attributes(dataset: h5py.Dataset, column: Column) -> None:
    """Write a column's attributes."""
    for name, value in column.attributes.items():
        dataset.attrs[name] = value if isinstance(value, str) else strings(value)


def strings(values: Iterable[str]) -> NDArray[Any]:
    """Texts as HDF5 keeps them in an attribute."""
    return np.array(list(values), dtype=h5py.string_dtype())
