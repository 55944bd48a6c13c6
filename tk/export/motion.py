"""Read a result for export: points and rotations over time."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError, ResultError
from tk.io.paths import text_of
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.io.results.status import Status
from tk.model.body.angles import standing_axes
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import FOOT_POINTS, JOINTS, ROWS, SEGMENT_ORIGIN, SEGMENTS, segment_below
from tk.model.body.rotations import to_matrices
from tk.model.body.skeleton import Skeleton, skeleton_of_names
from tk.model.motion.derived import derive
from tk.model.motion.smoothing import smooth

Float = NDArray[np.float64]

# Axes of glTF, used here for BVH too (left, up, forward), as rows in the body's axes (forward, left, up) in the zero
# configuration of the skeleton; these are (x, y, z) of a world whose z axis is up.
LEFT_UP_FORWARD = np.roll(np.eye(3), -1, axis=0)

_NOTHING = "the person is lost in every frame; there is nothing to export"


@dataclass(frozen=True)
class Motion:
    """A person's motion over F frames. An unknown frame has the values of the last known frame before it."""

    name: str  # of the files, without suffix: that of the result, `_0`, `_1`, … of several people, `_smoothed`
    result: Result  # the result, or its smoothed copy if that was requested; consecutive frames
    bridged: NDArray[np.bool_]  # (F,) True where the smoothed copy fills a gap
    known: NDArray[np.bool_]  # (F,) False where the person was lost and the gap was not bridged
    held: NDArray[np.int64]  # (F,) row of the result that each frame shows: its own, or that of the last known frame
    point_names: tuple[str, ...]  # names of the P joints and points of the feet
    points: Float  # (F, P, 3) metres, world frame
    sigma: Float  # (F, P) m, standard deviation of each point along one axis; NaN if unknown
    segments: tuple[str, ...]  # names of the S segments
    rotations: Float  # (F, S, 3, 3) segment to world, axes as in `tk.model.body.angles`
    dimensions: BodyDimensions  # dimensions of the fitted body
    T_world_body: Float  # (3, 3) the world's forward, left and up axes as columns

    def __len__(self) -> int:
        return len(self.result)

    @property
    def fps(self) -> float:
        """Return the frames per second."""
        return self.result.meta.fps

    def point(self, name: str) -> Float:
        """Return the positions (F, 3) of a point, or of a joint that is not one of the points; metres, world frame."""
        if name in self.point_names:
            return self.points[:, self.point_names.index(name)]
        return self.fixed_point(segment_below(ROWS[name].above), ROWS[name].place(self.dimensions))

    def fixed_point(self, segment: str, place: Float) -> Float:
        """Return the positions (F, 3) of a point fixed to a segment, from its place (3,) in the body frame of the zero
        configuration; metres."""
        origin = SEGMENT_ORIGIN[segment]
        offset = standing_axes()[SEGMENTS.index(segment)].T @ (place - ROWS[origin].place(self.dimensions))
        return self.point(origin) + self.rotation(segment) @ offset

    def rotation(self, segment: str) -> Float:
        """Return a segment's rotations (F, 3, 3) to the world; the file may lack a foot, which then turns with the
        calf."""
        while segment not in self.segments:
            segment = segment_below(ROWS[SEGMENT_ORIGIN[segment]].above)
        return self.rotations[:, self.segments.index(segment)]

    def status_word(self, frame: int) -> str:
        """Return the name of a frame's status, or "bridged"."""
        return "bridged" if self.bridged[frame] else Status(self.result.status[frame]).name.lower()


def read_motion(path: str | os.PathLike[str], smoothed: bool = False) -> tuple[Motion, tuple[str, ...]]:
    """Read a result for export, and return it with notes for the user.

    Args:
        smoothed: use the smoothed copy; the poses are smoothed here if the result has none.
    """
    return motion_of(read_result(path), smoothed)


def motion_of(result: Result, smoothed: bool = False) -> tuple[Motion, tuple[str, ...]]:
    """Return the motion of one person; see :func:`read_motion`."""
    path, notes = result.path, list[str]()
    name = text_of(path.stem)
    if result.person or result.others:
        name += f"_{result.person}"
    name += "_smoothed" * smoothed
    bridged = np.zeros(len(result), dtype=bool)
    if is_made_here := smoothed and result.smoothed is None:
        notes.append(f"{path}: has no smoothed copy; the poses were smoothed for this export")
    elif smoothed and result.smoothed is not None:
        bridged = np.asarray(result.smoothed["bridged"], dtype=bool)
        result = result.with_smoothed()
    joint_names = tuple(name for name in JOINTS if name in result.meta.joint_names)
    result = result.in_joint_order()
    dimensions = _dimensions(result)
    try:
        skeleton = skeleton_of_names(result.meta.pose_names, dimensions, result.meta.up)
    except ValueError as error:
        raise ResultError(f"{path}: /pose: {error}; track the capture again") from error
    if is_made_here:
        result, bridged = _smooth(result, skeleton)
    if (
        result.segments_rotation is None
        or result.feet is None
        or not np.isfinite(result.feet[bridged | result.has_pose]).all()
    ):
        result = _derived(result, skeleton, dimensions, joints=is_made_here)
    assert result.segments_rotation is not None and result.feet is not None
    segments = result.meta.segment_names
    missing = [ROWS[name].carrier for name in JOINTS if ROWS[name].carrier not in segments]
    if missing:
        raise ResultError(f"{path}: /segments/rotation has no segment {missing[0]}; track the capture again")
    joints = [JOINTS.index(name) for name in joint_names]
    known = bridged | result.has_pose
    for values in (result.joints[:, joints], result.segments_rotation):
        known &= np.isfinite(values).all(axis=(1, 2))
    known &= np.linalg.norm(result.segments_rotation, axis=2).min(axis=1) > 0  # a quaternion of zeros is no rotation
    if not known.any():
        raise ResultError(f"{path}: {_NOTHING}")
    if (np.diff(result.frames) != 1).any():
        raise ResultError(
            f"{path}: its frames are not consecutive, which other formats cannot represent; track all of them"
        )
    held = _held(known)
    sigma = np.full((len(result), len(joints) + len(FOOT_POINTS)), np.nan)
    if result.sigma is not None:
        sigma[:, : len(joints)] = result.sigma[:, joints]
    return Motion(
        name=name,
        result=result,
        bridged=bridged,
        known=known,
        held=held,
        point_names=(*joint_names, *FOOT_POINTS),
        points=np.concatenate([result.joints[held][:, joints], result.feet[held]], axis=1),
        sigma=sigma,
        segments=tuple(segments),
        rotations=to_matrices(result.segments_rotation[held]),
        dimensions=dimensions,
        T_world_body=skeleton.T_world_body,
    ), tuple(notes)


def _held(known: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return for each frame (F,) the last known frame up to it; before the first known frame, the first known one."""
    latest = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    return np.where(latest < 0, int(np.argmax(known)), latest)


def _dimensions(result: Result) -> BodyDimensions:
    values = {field.name: result.model.get(f"dimensions/{field.name}") for field in fields(BodyDimensions)}
    missing = [name for name, value in values.items() if value is None]
    if missing:
        raise ResultError(f"{result.path}: has no /model/dimensions/{missing[0]}; track the capture again")
    try:
        return BodyDimensions(**{name: float(np.asarray(value)) for name, value in values.items()})
    except (ConfigError, TypeError, ValueError) as error:
        raise ResultError(f"{result.path}: /model/dimensions: {error}; the file is damaged") from None


def _smooth(result: Result, skeleton: Skeleton) -> tuple[Result, NDArray[np.bool_]]:
    """Return the result with smoothed poses and without what others were derived from, and the bridged frames (F,)."""
    known = result.has_pose & np.isfinite(result.pose).all(axis=1)
    found = smooth(skeleton, result.pose, known, result.meta.fps)
    pose = np.where((known | found.bridged)[:, None], found.poses, np.nan)
    return replace(result, pose=pose, segments_rotation=None, feet=None), found.bridged


def _derived(result: Result, skeleton: Skeleton, dimensions: BodyDimensions, joints: bool) -> Result:
    """Return the result with rotations and feet where it has none, and with ``joints`` if requested, of its poses."""
    rows = np.isfinite(result.pose).all(axis=1)
    if not rows.any():
        raise ResultError(f"{result.path}: {_NOTHING}")
    found = derive(skeleton, dimensions, result.pose[rows])

    def spread(values: Float) -> Float:
        whole = np.full((len(result), *values.shape[1:]), np.nan)
        whole[rows] = values
        return whole

    if result.segments_rotation is None:
        meta = replace(result.meta, segment_names=SEGMENTS)
        result = replace(result, meta=meta, segments_rotation=spread(found.rotations))
    feet = spread(found.feet)
    if result.feet is not None:
        feet = np.where(np.isfinite(result.feet), result.feet, feet)
    return replace(result, feet=feet, joints=spread(found.joints) if joints else result.joints)
