"""The content of a result file. :mod:`tk.io.results.writer` writes it, :mod:`tk.io.results.reader` reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.results.schema import ROWS as DATASETS
from tk.io.results.schema import columns_of
from tk.io.results.status import Status, has_pose
from tk.io.toml import parse_toml
from tk.model.body.angles import ANGLES, by_reason
from tk.model.body.anthropometry import AVERAGE_BODY
from tk.model.body.expected_error import expected_errors, in_cm, mean_range
from tk.model.body.joints import JOINTS, in_joint_order
from tk.model.body.skeleton import paper_poses, skeleton_of_names
from tk.model.cameras.camera import Rig

if TYPE_CHECKING:
    import pandas
    import xarray

    from tk.model.hull.hull import HullSurface

Float = NDArray[np.float64]
Value = NDArray[Any] | float | int | str


@dataclass(frozen=True)
class JointAngles:
    """The meaning of the columns of `/angles/<joint>`."""

    joint: str  # name of the dataset, such as `knee_l`
    names: tuple[str, ...]  # names of the angles, such as `flexion`
    convention: str  # zero position and positive direction, in words
    unmeasured: str = ""  # angles that are NaN in every frame, with the reason

    @classmethod
    def of_body(cls, pose_names: Sequence[str], landmarks: bool = True) -> tuple[JointAngles, ...]:
        """Return all joints, of a body with these degrees of freedom; ``landmarks``: whether they were used."""
        return tuple(
            cls(angles.joint, angles.names, angles.convention, by_reason(angles.unmeasured(pose_names, landmarks)))
            for angles in ANGLES
        )

    def __post_init__(self) -> None:
        if not self.joint or "/" in self.joint or not self.names:
            raise ValueError(f"angles of {self.joint!r}: the name must have no slash, and at least one angle is needed")

    def __str__(self) -> str:
        return f"{self.joint} ({', '.join(self.names)}: {self.convention})"


@dataclass(frozen=True)
class ResultMeta:
    """The values that are constant during a run. A run can be resumed only with equal values.

    The fields from ``sigma`` on declare the optional datasets of the file. A value that a frame does not have is NaN.
    """

    # capture, method: name of the capture, and tracking method
    capture: str
    method: str
    seed: int  # seed of the random generator
    fps: float  # frames per second of the capture
    up: str  # world axis that points up
    config_toml: str  # the full configuration as TOML text
    # pose_names, pose_units: names and units of the D entries of the configuration vector
    pose_names: tuple[str, ...]
    pose_units: tuple[str, ...]
    stages: tuple[str, ...]  # names of the T optimiser stages of `/iterations`
    # names of the timed stages. The stage `total`, if present, is the frame's wall time.
    timing_stages: tuple[str, ...]
    joint_names: tuple[str, ...] = JOINTS  # J names in the order of `/joints/position`
    sigma: bool = False  # True if `/joints/sigma` exists
    residual_cameras: tuple[str, ...] = ()  # names of the C cameras of `/residual` and `/mask_source`
    landmark_names: tuple[str, ...] = ()  # names of the L landmarks; empty if no network sees landmarks
    depth: bool = False  # True if `/landmark_depth` exists
    mask_sources: tuple[str, ...] = ()  # meanings of the values of `/mask_source`; empty if no segmenter makes masks
    reasons: tuple[str, ...] = ()  # meanings of the values of `/evidence/reason`
    judged: bool = False  # True if `/evidence/found` and `/evidence/origin` exist
    deviation: bool = False  # True if `/evidence/sigma` exists
    modes: int = 0  # number M of the poses of a limb in `/evidence/modes`; 0 if that does not exist
    camera_states: tuple[str, ...] = ()  # meanings of the values of `/evidence/camera`
    segment_names: tuple[str, ...] = ()  # names of the segments of `/segments/rotation`
    feet: bool = False  # True if `/feet/position` exists, the points `tk.model.body.joints.FOOT_POINTS`
    angles: tuple[JointAngles, ...] = ()  # the clinical joint angles of `/angles`
    objective_kind: str = ""  # meaning of the numbers of `/objective`; empty if unknown

    def __post_init__(self) -> None:
        if len(self.pose_names) != len(self.pose_units):
            raise ValueError(f"{len(self.pose_names)} pose names but {len(self.pose_units)} units")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps = {self.fps} must be positive")
        if len({angles.joint for angles in self.angles}) != len(self.angles):
            raise ValueError("two sets of angles have the same name")

    def difference(self, other: ResultMeta) -> str | None:
        """Return the first difference, such as ``seed: 1, not 2``; None if the two are equal."""
        if len(self.pose_names) != len(other.pose_names):
            return f"the pose has {len(self.pose_names)} entries, not {len(other.pose_names)}"
        mine, others = self._texts(), other._texts()
        for name in mine | others:
            a, b = mine.get(name, "not set"), others.get(name, "not set")
            if a != b:
                return f"{name}: {a}, not {b}"
        return None

    def _texts(self) -> dict[str, str]:
        """Return all values as texts by name, the configuration entry by entry."""
        texts: dict[str, str] = {}

        def put(name: str, value: object) -> None:
            if isinstance(value, Mapping):
                for key, item in value.items():
                    put(f"{name}.{key}", item)
            else:
                texts[name] = ", ".join(map(str, value if isinstance(value, tuple) else (value,))) or "none"

        for item in fields(self):
            put(item.name, getattr(self, item.name))
        put("config", parse_toml(texts.pop("config_toml"), "config", ResultError))
        return texts


@dataclass(frozen=True)
class HullPoints:
    """Surface voxels of a frame: ``positions`` (N, 3) metres, world frame; ``colors`` (N, 3) uint8 RGB."""

    positions: NDArray[np.floating]
    colors: NDArray[np.uint8]

    @classmethod
    def of(cls, surface: HullSurface) -> HullPoints:
        """Return the voxels of a hull's surface."""
        return cls(surface.positions, surface.colors[:, ::-1].round().clip(0, 255).astype(np.uint8))


@dataclass(frozen=True)
class UsedCameras:
    """The calibration that a run used, refined if the run refined it."""

    rig: Rig  # the C cameras
    time_offset_s: Float  # (C,) s, delay of each camera: its frame k was taken at k / fps + time_offset_s

    def __post_init__(self) -> None:
        if np.shape(self.time_offset_s) != (len(self.rig),) or not np.isfinite(self.time_offset_s).all():
            raise ValueError(f"time offsets {self.time_offset_s} are not {len(self.rig)} finite numbers")

    def recorded(self) -> UsedCameras:
        """Return the cameras of the recorded images, which a result stores, see :meth:`Camera.recorded`."""
        return replace(self, rig=self.rig.recorded())


@dataclass(frozen=True)
class Hull:
    """Surface voxels of all frames: row i of the result has the voxels ``offsets[i]:offsets[i + 1]``.

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
    """The result of one person: F frames, D degrees of freedom, J joints, T optimiser stages.

    A dataset that the file does not have is None; without angles, ``angles`` is an empty mapping. For a file with
    several people, :func:`~tk.io.results.reader.read_result` returns person 0, and ``people`` are all; they have the
    same frames.
    """

    path: Path
    meta: ResultMeta
    frames: NDArray[np.int64]  # (F,)
    time: Float  # (F,) seconds
    pose: Float  # (F, D)
    joints: Float  # (F, J, 3) metres
    status: NDArray[np.uint8]  # (F,)
    objective: Float  # (F,)
    iterations: NDArray[np.int32]  # (F, T)
    timing: Mapping[str, Float]  # each (F,) seconds
    model: Mapping[str, Value]  # nested groups as names with slashes
    hull: Hull | None
    state: Mapping[str, Value]  # state from which the tracker continues after the last frame
    software: str
    created: str
    sigma: Float | None = None  # (F, J) metres, NaN for a joint without evidence
    mask_source: NDArray[np.uint8] | None = None  # (F, C), meanings in meta.mask_sources
    # (F, C, L, 3) x, y, pixels of the recorded images, and visibility; NaN where no network was asked
    landmarks: NDArray[np.float32] | None = None
    landmark_depth: NDArray[np.float32] | None = None  # (F, C, L) metres behind the middle of the hips
    reason: NDArray[np.uint8] | None = None  # (F,) why a frame is lost, suspect or without sigma, see meta.reasons
    found: NDArray[np.uint8] | None = None  # (F,) the reason that each frame itself shows, as ``reason``
    origin: NDArray[np.uint8] | None = None  # (F,) the status before the frame is judged
    deviation: Float | None = None  # (F, J) metres, sigma as computed, also where it is not known
    modes: NDArray[np.float32] | None = None  # (F, M, D) other poses of the limbs that the frame leaves open
    camera_state: NDArray[np.uint8] | None = None  # (F, C) why a camera was left out, see meta.camera_states; 0: used
    image_shift: NDArray[np.float32] | None = None  # (F, C) how far each image has moved, share of its longer side
    residual: Float | None = None  # (F, C, 2) missing and surplus area, shares of the person's pixels
    segments_rotation: Float | None = None  # (F, S, 4) w, x, y, z; segment to world
    feet: Float | None = None  # (F, 4, 3) metres
    angles: Mapping[str, Float] = field(default_factory=dict)  # by joint, each (F, k) degrees
    cameras: UsedCameras | None = None
    smoothed: Mapping[str, NDArray[Any]] | None = None  # by dataset name, and "bridged" (F,) bool
    notes: tuple[str, ...] = ()  # messages of the run
    person: int = 0  # number of the person in the file
    others: tuple[Result, ...] = ()  # persons 1, 2, … of the file, if this is person 0

    @property
    def people(self) -> tuple[Result, ...]:
        """Return the results of all people of the file: only this one if the file has one person."""
        return (self, *self.others)

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        """Return file, frames and quality, in three lines."""
        counts = ", ".join(
            f"{int((self.status == s).sum())} {s.name.lower()}" for s in Status if (self.status == s).any()
        )
        first = f"{self.frames[0]} to {self.frames[-1]}, " if len(self) else ""
        expected = self.mean_error_range
        error = "no sigma" if expected is None else f"expected error {in_cm(expected)}"
        return (
            f"Result {self.path.name}: capture {self.meta.capture}, method {self.meta.method}\n"
            f"{len(self)} frames, {first}{self.meta.fps:g} frames/s, {self.joints.shape[1]} joints\n"
            f"{counts or 'no status'}; {error}"
        )

    @property
    def resampled(self) -> bool:
        """Return whether the images of the recording were chosen by their time stamps."""
        return parse_toml(self.meta.config_toml, f"{self.path}: config", ResultError).get("resample") is True

    @property
    def silhouette_error(self) -> Float | None:
        """Return E_S by camera (F, C), the sum of missing and surplus area; None if the result has no residual."""
        return None if self.residual is None else np.asarray(self.residual.sum(axis=2))

    @property
    def excluded(self) -> NDArray[np.bool_] | None:
        """Return (F, C) True for a camera that was left out of a frame with a pose; None if the result has no
        residual."""
        if self.residual is None:
            return None
        used = np.isfinite(self.residual[..., 0])
        return np.asarray(~used & (self.has_pose & used.any(axis=1))[:, None])

    @property
    def expected_error(self) -> Float | None:
        """Return the expected distance (F, J) of each joint from its true position, metres; None without sigma.

        It contains the joint's constant offset, see :mod:`tk.model.body.expected_error`.
        """
        return None if self.sigma is None else expected_errors(self.sigma, self.meta.joint_names)

    @property
    def mean_error_range(self) -> Float | None:
        """Return the range (2,) of the raw joints' mean error in the frames with a pose, metres; None without sigma.

        It holds with a probability of 90 % for a further person.
        """
        return None if (expected := self.expected_error) is None else mean_range(expected[self.has_pose])

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """Return (F,) True for frames in which the person is present and found; other frames have no usable pose."""
        return has_pose(self.status)

    @property
    def has_landmarks(self) -> bool:
        """Whether a network's landmarks were used in a frame: only they show how far the head turns."""
        return self.landmarks is not None and bool(np.isfinite(self.landmarks).any())

    def paper_pose(self) -> Float:
        """Return the pose vectors (F, 24) of Kehl & Van Gool's body: no waist, hip angles relative to the trunk.

        Raises:
            ResultError: the columns of `/pose` are not those of tk's skeleton.
        """
        try:
            skeleton = skeleton_of_names(self.meta.pose_names, AVERAGE_BODY, self.meta.up)
        except ValueError as error:
            raise ResultError(f"{self.path}: /pose: {error}") from error
        return paper_poses(skeleton, self.pose)

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with one row per frame; see :func:`tk.io.results.tables.to_pandas`."""
        from tk.io.results.tables import to_pandas

        return to_pandas(self)

    def to_xarray(self) -> xarray.Dataset:
        """Return arrays with named dimensions; see :func:`tk.io.results.tables.to_xarray`."""
        from tk.io.results.tables import to_xarray

        return to_xarray(self)

    def in_joint_order(self) -> Result:
        """Return the result with its joints in the order of :data:`~tk.model.body.joints.JOINTS`. ``smoothed`` and
        ``others`` keep their order: call :meth:`with_smoothed` first.

        Raises:
            ResultError: a joint that every result has is missing.
        """
        names = self.meta.joint_names
        try:
            joints = in_joint_order(self.joints, names)
            sigma, deviation = (
                None if values is None else in_joint_order(values, names) for values in (self.sigma, self.deviation)
            )
        except KeyError as error:
            raise ResultError(f"{self.path}: /joints/position has no joint {error.args[0]}; track anew") from None
        meta = replace(self.meta, joint_names=JOINTS)
        return replace(self, meta=meta, joints=joints, sigma=sigma, deviation=deviation)

    def at_rows(self, rows: NDArray[np.int64]) -> Result:
        """Return these rows of this person, without hull; -1 gives a row with the status ABSENT, and NaN in it."""
        there = rows >= 0

        def take(values: NDArray[Any]) -> NDArray[Any]:
            taken = np.full((len(rows), *values.shape[1:]), np.nan if values.dtype.kind == "f" else 0, values.dtype)
            taken[there] = values[rows[there]]
            return taken

        columns: dict[str, Any] = {}
        for entry in DATASETS:
            values = getattr(self, entry.field)
            if values is not None:
                columns[entry.field] = {k: take(v) for k, v in values.items()} if entry.each else take(values)
        columns["status"][~there] = Status.ABSENT
        smoothed = None if self.smoothed is None else {name: take(values) for name, values in self.smoothed.items()}
        return replace(self, smoothed=smoothed, hull=None, others=(), **columns)

    def with_smoothed(self) -> Result:
        """Return the result with each dataset replaced by its smoothed copy, if `/smoothed` has one."""
        changed: dict[str, Any] = {"angles": dict(self.angles)}
        columns = columns_of(self.meta)
        for path, values in (self.smoothed or {}).items():
            if path != "bridged" and columns[path].key:
                changed[columns[path].entry.field][columns[path].key] = values
            elif path != "bridged":
                changed[columns[path].entry.field] = values
        others = tuple(person.with_smoothed() for person in self.others)
        return replace(self, **changed, others=others, smoothed=None)


@dataclass(frozen=True)
class JointTrack:
    """Joint centres over time, from a result or from the ground truth of a capture."""

    path: Path  # the file
    frames: NDArray[np.int64]  # (F,) source frame indices without repetition
    positions: Float  # (F, J, 3) metres, world frame, in the order of `tk.model.body.joints.JOINTS`
    status: NDArray[np.uint8] | None = None  # (F,) as in a result; None for ground truth
    seconds: Float | None = None  # (F,) wall time of each frame; None if not stored
    # (F, J) m, standard deviation of each position along one axis, NaN if unknown; None if not stored
    sigma: Float | None = None
