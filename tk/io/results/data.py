"""What a result file holds, as values. :mod:`tk.io.results.writer` writes it, :mod:`tk.io.results.reader` reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.results.status import has_pose
from tk.io.toml import parse_toml
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import JOINTS
from tk.model.body.skeleton import paper_poses, skeleton_of_names
from tk.model.cameras.camera import Rig

if TYPE_CHECKING:
    import pandas
    import xarray

FORMAT = "tk-result"
FORMAT_VERSION = 3

Float = NDArray[np.float64]
Value = NDArray[Any] | float | int | str


#: fields of ResultMeta that hold names
_LISTS = (
    "pose_names", "pose_units", "stages", "timing_stages", "joint_names",
    "residual_cameras", "segment_names",
)  # fmt: skip


@dataclass(frozen=True)
class JointAngles:
    """What the columns of `/angles/<joint>` mean.

    Attributes:
        joint: the dataset's name, such as ``knee_l``.
        names: of its angles, such as ``flexion``.
        convention: where zero lies and which way is positive, in words.
    """

    joint: str
    names: tuple[str, ...]
    convention: str

    def __post_init__(self) -> None:
        if not self.joint or "/" in self.joint or not self.names:
            raise ValueError(f"angles of {self.joint!r}: a name without a slash and one angle at least are expected")


@dataclass(frozen=True)
class ResultMeta:
    """What is fixed for a whole run. A run is resumed only with an equal one.

    The fields from ``sigma`` on declare what a tracker may have or not: what is declared here is in the file, and
    each frame should bring it.

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
        sigma: whether there is a standard deviation of each joint's position.
        residual_cameras: names of the C cameras of `/residual`.
        segment_names: names of the segments whose rotation is told.
        feet: whether there are the positions of :data:`~tk.model.motion.segments.FOOT_POINTS`.
        angles: the joints' angles as a clinician reads them.
        objective_kind: what the numbers of `/objective` are; empty if nobody says.
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
    sigma: bool = False
    residual_cameras: tuple[str, ...] = ()
    segment_names: tuple[str, ...] = ()
    feet: bool = False
    angles: tuple[JointAngles, ...] = ()
    objective_kind: str = ""

    def __post_init__(self) -> None:
        if len(self.pose_names) != len(self.pose_units):
            raise ValueError(f"{len(self.pose_names)} pose names but {len(self.pose_units)} units")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps = {self.fps} must be positive")
        if len({angles.joint for angles in self.angles}) != len(self.angles):
            raise ValueError("two sets of angles have the same name")

    def difference(self, other: ResultMeta) -> str | None:
        """In what the two differ, as ``seed is 1, not 2``; None if in nothing."""
        sizes = len(self.pose_names), len(other.pose_names)
        if sizes[0] != sizes[1]:
            return f"the pose has {sizes[0]} entries, not {sizes[1]}"
        for name in ("capture", "method", "seed", "fps", "up", "sigma", "feet", "objective_kind"):
            if getattr(self, name) != getattr(other, name):
                both = ["none" if value == "" else str(value) for value in (getattr(self, name), getattr(other, name))]
                return f"{name} is {both[0]}, not {both[1]}"
        for name in _LISTS:
            if getattr(self, name) != getattr(other, name):
                both = [", ".join(getattr(meta, name)) or "none" for meta in (self, other)]
                return f"{name} are {both[0]}; not {both[1]}"
        if self.angles != other.angles:
            both = [", ".join(angles.joint for angles in meta.angles) or "none" for meta in (self, other)]
            return f"angles are {both[0]}; not {both[1]}" if both[0] != both[1] else "angles differ in their convention"
        mine, others = (parse_toml(meta.config_toml, "config", ResultError) for meta in (self, other))
        return _config_difference(mine, others)


#: fields of Result by the name of their dataset, for those that can be smoothed; `/angles` have a field for all
_SMOOTHED_FIELDS = {
    "pose": "pose",
    "joints/position": "joints",
    "joints/sigma": "sigma",
    "segments/rotation": "segments_rotation",
    "feet/position": "feet",
}


def can_be_smoothed(name: str) -> bool:
    """Whether a dataset may stand below `/smoothed`."""
    return name in _SMOOTHED_FIELDS or name.startswith("angles/")


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

    What follows may be None: nothing is known in this frame, which the file tells by NaN. It is refused where
    :class:`ResultMeta` does not declare it.

        sigma: (J,) one standard deviation of each joint's position, metres; NaN where a joint has no evidence.
        residual: (C, 2) missing and surplus area by camera, shares of the person's pixels; their sum is E_S.
        segments_rotation: (S, 4) quaternions (w, x, y, z), segment to world.
        feet: (4, 3) the :data:`~tk.model.motion.segments.FOOT_POINTS`, metres, world frame.
        angles: degrees by joint; a joint that is not mentioned is NaN.
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
    sigma: Float | None = None
    residual: Float | None = None
    segments_rotation: Float | None = None
    feet: Float | None = None
    angles: Mapping[str, Float] = field(default_factory=dict)


@dataclass(frozen=True)
class UsedCameras:
    """The calibration as a run used it, after refinement where there was one.

    Attributes:
        rig: the C cameras.
        time_offset_s: (C,) seconds by which a camera's frame k was taken later than k / fps.
    """

    rig: Rig
    time_offset_s: Float

    def __post_init__(self) -> None:
        if np.shape(self.time_offset_s) != (len(self.rig),) or not np.isfinite(self.time_offset_s).all():
            raise ValueError(f"time offsets {self.time_offset_s} are not {len(self.rig)} finite numbers")


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
    """A whole result file: F frames, D degrees of freedom, J joints, S optimiser stages.

    What the file does not have is None (no angles: an empty mapping).
    """

    path: Path
    meta: ResultMeta
    frames: NDArray[np.int64]  # (F,)
    time: Float  # (F,) seconds
    pose: Float  # (F, D)
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
    sigma: Float | None = None  # (F, J) metres, NaN where a joint has no evidence
    residual: Float | None = None  # (F, C, 2) missing and surplus area, shares of the person's pixels
    segments_rotation: Float | None = None  # (F, S, 4) w, x, y, z; segment to world
    feet: Float | None = None  # (F, 4, 3) metres
    angles: Mapping[str, Float] = field(default_factory=dict)  # by joint, each (F, k) degrees
    cameras: UsedCameras | None = None
    smoothed: Mapping[str, NDArray[Any]] | None = None  # by the datasets' names, and "bridged" (F,) bool
    notes: tuple[str, ...] = ()  # what the run said

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def silhouette_error(self) -> Float | None:
        """(F, C) E_S by camera: the sum of missing and surplus area; None if the result has no residual."""
        return None if self.residual is None else np.asarray(self.residual.sum(axis=2))

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(F,) True where the person is present and found; the rows of other frames hold no usable pose."""
        return has_pose(self.status)

    def paper_pose(self) -> Float:
        """(F, 24) the pose vectors of Kehl & Van Gool's body: no waist, hips as angles against the trunk.

        Raises:
            ResultError: `/pose` is not a pose vector of this program's body.
        """
        try:
            skeleton = skeleton_of_names(self.meta.pose_names, BodyDimensions.from_stature(1.75), self.meta.up)
        except ValueError as error:
            raise ResultError(f"{self.path}: /pose: {error}") from error
        return paper_poses(skeleton, self.pose)

    def to_pandas(self) -> pandas.DataFrame:
        """A table, one row a frame; see :func:`tk.io.results.tables.to_pandas`."""
        from tk.io.results.tables import to_pandas

        return to_pandas(self)

    def to_xarray(self) -> xarray.Dataset:
        """Arrays with named dimensions; see :func:`tk.io.results.tables.to_xarray`."""
        from tk.io.results.tables import to_xarray

        return to_xarray(self)

    def with_smoothed(self) -> Result:
        """The same result with what is below `/smoothed` in its place; as it is where nothing was smoothed."""
        smoothed = self.smoothed or {}
        fields: dict[str, Any] = {field: smoothed[name] for name, field in _SMOOTHED_FIELDS.items() if name in smoothed}
        angles = {joint: smoothed.get(f"angles/{joint}", values) for joint, values in self.angles.items()}
        return replace(self, **fields, angles=angles, smoothed=None)


@dataclass(frozen=True)
class JointTrack:
    """Joint centres over time, from a result or from a capture's truth.

    Attributes:
        path: the file.
        frames: (F,) source frame indices, each once.
        positions: (F, 15, 3) metres, world frame, in the order of :data:`tk.model.body.skeleton.JOINTS`.
        status: (F,) as in a result; None for a truth.
        seconds: (F,) wall time of each frame; None where the file does not tell.
        sigma: (F, 15) one standard deviation of each position, metres, NaN where unknown; None where there is none.
    """

    path: Path
    frames: NDArray[np.int64]
    positions: Float
    status: NDArray[np.uint8] | None = None
    seconds: Float | None = None
    sigma: Float | None = None


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
