"""The datasets of a result file. Writing, reading, checking, revising and the docs' table follow this list."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.io.results.status import STATUS_MEANING, Status
from tk.model.body.joints import FOOT_POINTS

if TYPE_CHECKING:
    from tk.io.results.data import ResultMeta

FORMAT = "tk-result"
#: version that is written, and the oldest one that is read: in version 3 person 0 was at the top level, and the others
#: had rows of their own
FORMAT_VERSION, OLDEST_VERSION = 4, 3

#: Largest valid values: distance from the world's origin in metres, any other number, frame index. They are far above
#: what a capture holds; a larger value means a damaged file.
MAX_DISTANCE_M, MAX_NUMBER, MAX_FRAME = 1e6, 1e12, 1_000_000_000

#: root attributes: field of ResultMeta and type
ATTRIBUTES = {
    "fps": ("fps", float),
    "up": ("up", str),
    "capture": ("capture", str),
    "method": ("method", str),
    "seed": ("seed", int),
    "config": ("config_toml", str),
}

#: field of ResultMeta that lists or numbers what a letter of a shape counts; `k` counts the angles of one joint
COUNTED = {
    "D": "pose_names", "J": "joint_names", "S": "segment_names", "C": "residual_cameras", "T": "stages", "k": "names",
    "L": "landmark_names", "M": "modes",
}  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """A dataset, or a family of datasets whose path ends with a variable name."""

    path: str  # path in the file, without a leading slash; `<…>` stands for a name
    # length of each axis: a number, or a letter of `COUNTED`, `F` frames, `C` cameras, `N` voxels
    shape: str
    dtype: str  # numpy type
    meaning: str  # description for the docs, with unit
    # attributes of the dataset: a field of ResultMeta, or the values themselves
    attributes: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    field: str = ""  # field of Result with the values; a mapping by name for a family
    each: str = ""  # field of ResultMeta that lists the names of a family
    optional: str = ""  # field of ResultMeta that is false or empty if the file has no such dataset
    smoothed: bool = False  # True if `/smoothed` may have a copy
    # range of valid numbers; infinity is read as NaN unless the range contains it
    valid: tuple[float, float] = (-MAX_NUMBER, MAX_NUMBER)
    finite: bool = False  # True if NaN and infinity are not valid
    of_run: bool = False  # True if it belongs to the run, not to a person

    @property
    def unknown(self) -> float:
        """Return what stands for an unknown value: NaN, or 0 where that is not valid; a stage that did not run took no
        time."""
        return 0 if self.finite or not self.dtype.startswith("float") else np.nan

    def lengths(self, counts: Mapping[str, int]) -> tuple[int, ...]:
        """Return the shape in numbers, from the number that each letter stands for."""
        return tuple(int(item) if item.isdigit() else counts[item] for item in self.shape.split())


_METRES = (-MAX_DISTANCE_M, MAX_DISTANCE_M)
_NAMES = {"names": "joint_names"}
_STATUS = tuple(f"{value}: {text}" for value, text in enumerate(STATUS_MEANING))

#: datasets with one row per frame
ROWS = (
    Dataset("frames", "F", "int64", "number of the source frame", field="frames", valid=(0, MAX_FRAME), of_run=True),
    Dataset("time", "F", "float64", "seconds", field="time", finite=True, of_run=True),
    Dataset(
        "pose", "F D", "float64",
        "the pose vector, one column per degree of freedom (32 by default, 24 with `--method volumetric`)",
        {"names": "pose_names", "units": "pose_units"}, field="pose", smoothed=True,
    ),
    Dataset(
        "joints/position", "F J 3", "float64", "joint positions, metres",
        _NAMES, field="joints", smoothed=True, valid=_METRES,
    ),
    Dataset(
        "joints/sigma", "F J", "float64",
        "one standard deviation of a joint's position along each axis, metres; NaN without evidence",
        _NAMES, field="sigma", optional="sigma", smoothed=True, valid=(0, MAX_DISTANCE_M),
    ),
    Dataset(
        "segments/rotation", "F S 4", "float64", "quaternions w, x, y, z, segment to world",
        {"names": "segment_names"}, field="segments_rotation", optional="segment_names", smoothed=True,
    ),
    Dataset(
        "angles/<joint>", "F k", "float64",
        "degrees; the group's attribute `joints` gives the order; `unmeasured` gives the angles that are NaN in every "
        "frame and the reason",
        {"names": "names", "convention": "convention", "unmeasured": "unmeasured"},
        field="angles", each="angles", smoothed=True,
    ),
    Dataset(
        "feet/position", "F 4 3", "float64", ", ".join(FOOT_POINTS),
        {"names": FOOT_POINTS}, field="feet", optional="feet", smoothed=True, valid=_METRES,
    ),
    Dataset(
        "status", "F", "uint8",
        "0 tracked, 1 initialised, 2 recovered after loss, 3 lost, 4 suspect (tracked, but the residual contradicts "
        "it), 5 absent (the person is not in the volume); lost frames hold no usable pose, absent ones hold NaN",
        {"meaning": _STATUS}, field="status", valid=(0, len(_STATUS) - 1),
    ),
    Dataset(
        "objective", "F", "float64", "final value of the objective",
        {"kind": "objective_kind"}, field="objective", valid=(-np.inf, np.inf),
    ),
    Dataset(
        "residual", "F C 2", "float64",
        "missing area and surplus area by camera, shares of the person's pixels; their sum is E_S; NaN for an "
        "excluded camera",
        {"cameras": "residual_cameras", "areas": ("missing", "surplus")}, field="residual",
        optional="residual_cameras",
    ),
    Dataset(
        "mask_source", "F C", "uint8",
        "where each camera's mask comes from, if a segmenter makes masks: 0 the learned scene, 1 the same, and the "
        "segmenter where the scene is unknown, 2 the segmenter",
        {"cameras": "residual_cameras", "meaning": "mask_sources"}, field="mask_source", optional="mask_sources",
        valid=(0, 2),
    ),
    Dataset(
        "landmarks", "F C L 3", "float32",
        "the person's landmarks in each image by a segmenter's network: x, y, pixels of the recorded image, and "
        "visibility; NaN where the network was not asked",
        {"names": "landmark_names", "cameras": "residual_cameras"}, field="landmarks", optional="landmark_names",
    ),
    Dataset(
        "landmark_depth", "F C L", "float32",
        "metres by which each landmark is behind the middle of the hips along the line of sight, as the network "
        "estimates it; NaN where it does not",
        {"names": "landmark_names", "cameras": "residual_cameras"}, field="landmark_depth", optional="depth",
    ),
    Dataset(
        "evidence/reason", "F", "uint8", "why the frame is lost, suspect or without sigma",
        {"meaning": "reasons"}, field="reason", optional="reasons",
    ),
    Dataset(
        "evidence/found", "F", "uint8", "the reason that the frame itself shows, without the others",
        {"meaning": "reasons"}, field="found", optional="judged",
    ),
    Dataset(
        "evidence/origin", "F", "uint8",
        "how the tracker came to the pose: 0, 1, 2 or 5 of `/status`, which follows from it and the reason",
        {"meaning": _STATUS}, field="origin", optional="judged", valid=(0, len(_STATUS) - 1),
    ),
    Dataset(
        "evidence/sigma", "F J", "float64",
        "`/joints/sigma` as computed, also in frames whose reason says that it is not known, metres",
        _NAMES, field="deviation", optional="deviation", valid=(0, MAX_DISTANCE_M),
    ),
    Dataset(
        "evidence/modes", "F M D", "float32",
        "other poses of the limbs that the frame leaves open, the cheapest first: angles in the columns of each limb; "
        "NaN without one",
        {"names": "pose_names"}, field="modes", optional="modes",
    ),
    Dataset(
        "evidence/camera", "F C", "uint8", "the cameras that were left out of the frame, and why; 0: used",
        {"cameras": "residual_cameras", "meaning": "camera_states"}, field="camera_state", optional="camera_states",
    ),
    Dataset(
        "evidence/shift", "F C", "float32",
        "by which share of its longer side the image has moved since the first frame; NaN if unknown",
        {"cameras": "residual_cameras"}, field="image_shift", optional="camera_states",
    ),
    Dataset("iterations", "F T", "int32", "optimiser iterations by stage", {"stages": "stages"}, field="iterations"),
    Dataset(
        "timing/<stage>", "F", "float64",
        "seconds by stage, of all people; `total` is the frame's share of the wall time",
        field="timing", each="timing_stages", finite=True, of_run=True,
    ),
)  # fmt: skip

BRIDGED = Dataset("smoothed/bridged", "F", "bool", "frames that were filled in")

#: surface voxels of all frames: row i has the voxels offsets[i] to offsets[i + 1]
HULL = (
    Dataset("hull/positions", "N 3", "float32", "surface voxels of all frames, with `--store-hull`", valid=_METRES),
    Dataset("hull/colors", "N 3", "uint8", "their colours; `order`"),
    Dataset(
        "hull/offsets", "F+1", "int64", "frame i has the voxels `offsets[i]` to `offsets[i + 1]`", valid=(0, MAX_NUMBER)
    ),
)

#: cameras as used, after refinement; the group's attribute `names` gives their order
CAMERAS = (
    Dataset("cameras/matrix", "C 3 3", "float64", "camera matrix, pixels", finite=True),
    Dataset(
        "cameras/distortions", "C 8", "float64",
        "OpenCV's order, padded with zeros; a fisheye camera uses the first four", finite=True,
    ),
    Dataset("cameras/rotation", "C 3", "float64", "Rodrigues vector, world to camera", finite=True),
    Dataset("cameras/translation", "C 3", "float64", "world to camera", finite=True),
    Dataset("cameras/size", "C 2", "int64", "width and height, pixels"),
    Dataset("cameras/fisheye", "C", "uint8", "1 for a fisheye camera"),
    Dataset(
        "cameras/time_offset", "C", "float64",
        "seconds by which the video began late: image k was taken at k / fps + `time_offset`", finite=True,
    ),
)  # fmt: skip

SCHEMA = (*ROWS, BRIDGED, *HULL, *CAMERAS)


@dataclass(frozen=True)
class Column:
    """A dataset with one row per frame in a file with certain metadata."""

    entry: Dataset  # its entry in the table
    key: str  # name within a family, such as `knee_l`; "" otherwise
    shape: tuple[int, ...]  # shape of a row
    attributes: Mapping[str, str | tuple[str, ...]]  # values of the attributes

    def checked(self, name: str, values: Any, rows: int | None = None) -> NDArray[Any]:
        """Return a copy of one row, or of ``rows`` rows, in this column's type.

        Raises:
            ValueError: the shape is wrong.
        """
        array = np.array(values, dtype=self.entry.dtype)
        expected = self.shape if rows is None else (rows, *self.shape)
        if array.shape != expected:
            raise ValueError(f"{name} has shape {array.shape}, {expected} is expected")
        return array


def prefix_of(person: int) -> str:
    """Return the start of the paths of a person's datasets."""
    return f"people/{person}/"


def _number(counted: int | tuple[str, ...]) -> int:
    return counted if isinstance(counted, int) else len(counted)


def columns_of(meta: ResultMeta) -> dict[str, Column]:
    """Return the columns of a result by path."""
    columns = {}
    for entry in ROWS:
        if entry.optional and not getattr(meta, entry.optional):
            continue
        members = {str(getattr(i, "joint", i)): i for i in getattr(meta, entry.each)} if entry.each else {"": meta}
        for key, member in members.items():
            counts = {letter: _number(getattr(member, name, ())) for letter, name in COUNTED.items()} | {"F": 0}
            attributes = {
                name: getattr(member, source) if isinstance(source, str) else source
                for name, source in entry.attributes.items()
            }
            known = {name: value for name, value in attributes.items() if value != ""}
            columns[entry.path.split("<")[0] + key] = Column(entry, key, entry.lengths(counts)[1:], known)
    return columns


def smoothed_columns(columns: Mapping[str, Column]) -> dict[str, Column]:
    """Return the columns that `/smoothed` may have, by path below it."""
    copies = {path: column for path, column in columns.items() if column.entry.smoothed}
    return copies | {"bridged": Column(BRIDGED, "", (), {})}


def absent_row(columns: Mapping[str, Column]) -> dict[str, NDArray[Any]]:
    """Return the row of a person who is absent, by path."""
    row = {path: np.full(c.shape, c.entry.unknown, c.entry.dtype) for path, c in columns.items() if not c.entry.of_run}
    return row | {path: np.uint8(Status.ABSENT) for path in ("status", "evidence/origin") if path in row}


def checked_row(values: Mapping[str, ArrayLike], columns: Mapping[str, Column]) -> dict[str, NDArray[Any]]:
    """Return a copy of a frame's values by path, for all columns; :attr:`Dataset.unknown` for missing optional values.

    Args:
        values: values by path; with ``hull/positions`` and ``hull/colors`` (N, 3) the frame has a hull.
        columns: those of the run, or those of a person.

    Raises:
        ValueError: a shape or the status is invalid, a value is missing, or no column takes a value.
    """
    hull = {entry.path: entry for entry in HULL[:2] if entry.path in values}
    undeclared = sorted(values.keys() - columns.keys() - hull.keys())
    if undeclared:
        raise ValueError(f"{', '.join(undeclared)}: not declared for this result")
    row = {}
    for path, column in columns.items():
        if path in values:
            row[path] = column.checked(path, values[path])
        elif column.entry.optional or column.entry.each:
            row[path] = np.full(column.shape, column.entry.unknown, column.entry.dtype)
        else:
            raise ValueError(f"{path} is missing")
    if "status" in row and row["status"] not in range(len(STATUS_MEANING)):
        raise ValueError(f"status {row['status']} has no meaning")
    for path, entry in hull.items():
        row[path] = Column(entry, "", (3,), {}).checked(path, values[path], len(np.asarray(values["hull/positions"])))
    return row
