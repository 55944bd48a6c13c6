"""The datasets of a result with one row per frame: names, types, attributes. Writer and reader use this list."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tk.io.results.data import FIELDS, FrameResult, ResultMeta
from tk.io.results.status import STATUS_MEANING
from tk.model.body.joints import FOOT_POINTS

#: Largest valid values: distance from the world's origin in metres, any other number, frame index. They are far above
#: what a capture holds; a larger value means a damaged file.
MAX_DISTANCE_M, MAX_NUMBER, MAX_FRAME = 1e6, 1e12, 10**9
MAX_STATUS = len(STATUS_MEANING) - 1


@dataclass(frozen=True)
class Column:
    """A dataset with one row per frame.

    Attributes:
        shape, dtype: shape and numpy type of a row.
        attributes: attributes of the dataset; each is a text or a list of texts.
        limit: largest valid magnitude.
    """

    shape: tuple[int, ...]
    dtype: str
    attributes: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    limit: float = MAX_NUMBER

    def checked(self, name: str, values: Any, rows: int | None = None) -> NDArray[Any]:
        """Return a copy of one row, or of ``rows`` rows, in this column's type.

        Raises:
            ValueError: the shape is wrong.
        """
        array = np.array(values, dtype=self.dtype)
        expected = self.shape if rows is None else (rows, *self.shape)
        if array.shape != expected:
            raise ValueError(f"{name} has shape {array.shape}, {expected} is expected")
        return array


def columns_of(meta: ResultMeta) -> dict[str, Column]:
    """Return the columns of a result by dataset name."""
    joints = meta.joint_names
    columns = {
        "frames": Column((), "i8", limit=MAX_FRAME),
        "time": Column((), "f8"),
        "pose": Column((len(meta.pose_names),), "f8", {"names": meta.pose_names, "units": meta.pose_units}),
        "joints/position": Column((len(joints), 3), "f8", {"names": joints}, MAX_DISTANCE_M),
        "status": Column(
            (),
            "u1",
            {"meaning": tuple(f"{value}: {text}" for value, text in enumerate(STATUS_MEANING))},
            MAX_STATUS,
        ),
        "objective": Column((), "f8", {"kind": meta.objective_kind} if meta.objective_kind else {}, np.inf),
        "iterations": Column((len(meta.stages),), "i4", {"stages": meta.stages}),
        **{f"timing/{stage}": Column((), "f8") for stage in meta.timing_stages},
    }
    if meta.sigma:
        columns["joints/sigma"] = Column((len(joints),), "f8", {"names": joints}, MAX_DISTANCE_M)
    if meta.residual_cameras:
        attributes = {"cameras": meta.residual_cameras, "areas": ("missing", "surplus")}
        columns["residual"] = Column((len(meta.residual_cameras), 2), "f8", attributes)
    if meta.segment_names:
        columns["segments/rotation"] = Column((len(meta.segment_names), 4), "f8", {"names": meta.segment_names})
    if meta.feet:
        columns["feet/position"] = Column((len(FOOT_POINTS), 3), "f8", {"names": FOOT_POINTS}, MAX_DISTANCE_M)
    for angles in meta.angles:
        columns[f"angles/{angles.joint}"] = Column(
            (len(angles.names),), "f8", {"names": angles.names, "convention": angles.convention}
        )
    return columns


def row_of(frame: FrameResult, meta: ResultMeta) -> dict[str, NDArray[Any]]:
    """Return the frame's row of each column, as copies; NaN for optional values that the frame does not have.

    Raises:
        ValueError: a shape or the status is invalid, or the frame has a value that ``meta`` does not declare.
    """
    if int(frame.status) not in range(len(STATUS_MEANING)):
        raise ValueError(f"status {frame.status} has no meaning")
    values: dict[str, Any] = {"frames": frame.frame}
    values |= {name: getattr(frame, field) for name, field in FIELDS.items() if name != "frames"}
    values |= {f"angles/{joint}": degrees for joint, degrees in frame.angles.items()}
    values |= {f"timing/{stage}": seconds for stage, seconds in frame.timing.items()}
    values = {name: value for name, value in values.items() if value is not None}
    columns = columns_of(meta)
    undeclared = sorted(set(values) - set(columns))
    if undeclared:
        raise ValueError(f"{', '.join(undeclared)}: not declared for this result")
    values = {f"timing/{stage}": 0.0 for stage in meta.timing_stages} | values
    return {
        name: column.checked(name, values[name]) if name in values else np.full(column.shape, np.nan)
        for name, column in columns.items()
    }


def put_attributes(dataset: h5py.Dataset, column: Column) -> None:
    """Write a column's attributes."""
    for name, value in column.attributes.items():
        dataset.attrs[name] = value if isinstance(value, str) else strings(value)


def strings(values: Iterable[str]) -> NDArray[Any]:
    """Return texts as an array that can be an HDF5 attribute."""
    return np.array(list(values), dtype=h5py.string_dtype())
