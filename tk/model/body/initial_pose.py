"""Converts an initial pose that a person wrote down, as joint positions or angles, to a pose of the average body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.joints import HIPS, LIMBS, SHOULDERS
from tk.model.body.skeleton import JOINTS, Skeleton, build_skeleton, shoulder_angles
from tk.model.cameras.tracker_frame import TrackerFrame
from tk.optim.trajectory import Equations, minimise

Float = NDArray[np.float64]

# Statures of people, metres; no number written for a joint makes the body taller or shorter.
LEAST_STATURE, GREATEST_STATURE = 0.8, 2.4
# Standard deviation of a written joint, metres.
_JOINT_M = 0.02
# Precision that holds an angle at its limit: 0.003 rad, small against a joint's noise over a limb's length.
_LIMIT = 1e5
# Headings from which a person of unknown pose is searched for.
HEADINGS = 8
# Iterations from each heading with steps of at most this size, radians: enough to turn any joint from one limit to the
# other.
_ITERATIONS, _LONGEST_STEP = 30, 0.4


def rough_pose(
    joints: dict[str, Float], angles: dict[str, float], height_m: float, world: TrackerFrame
) -> tuple[BodyDimensions, Skeleton, Float]:
    """Return the average body, and its pose in the tracker's frame, from numbers in the capture's world.

    Args:
        joints: name → (3,) metres of some joints; or empty.
        angles: name → value of some entries of the pose vector (radians, metres); or empty.
        height_m: the subject's height.
        world: the tracker's frame.

    Returns:
        Dimensions, a skeleton of these, and its pose (D,).
    """
    dimensions = BodyDimensions.from_stature(height_m)
    if angles:
        skeleton = build_skeleton(dimensions)
        pose = neutral_pose(skeleton)
        for name, value in angles.items():
            pose[skeleton.index(name)] = value
        return dimensions, skeleton, world.poses_in(skeleton.clip(pose))
    skeleton = build_skeleton(dimensions, paper=True)
    rows = np.array([JOINTS.index(name) for name in joints])
    return dimensions, skeleton, pose_of_joints(skeleton, rows, world.points_in(list(joints.values())))


def pose_of_joints(skeleton: Skeleton, rows: NDArray[np.int64], targets: Float) -> Float:
    """Return the pose (D,) within the limits whose joints ``rows`` (N,) are closest to targets (N, 3), metres.

    The best of several headings is returned.
    """
    start = resting_figures(skeleton, np.zeros(3))
    start[:, :3] += targets.mean(axis=0) - skeleton.joints(start[0])[rows].mean(axis=0)
    D = start.shape[1]
    precision = np.where(skeleton.prismatic, 0.0, np.pi**-2.0)  # half a turn, for what the joints leave open

    def linearise(poses: Float, _: int) -> Equations:
        found = Equations(len(poses), D, 0)
        missing = targets - skeleton.joints(poses)[:, rows]
        J = skeleton.joint_jacobian(poses)[:, rows].reshape(missing.size, D)
        blocks = np.repeat(np.arange(len(poses)), missing[0].size)
        found.add(blocks, np.arange(D), J, np.full(missing.size, _JOINT_M**-2.0), missing.ravel())
        for b, pose in enumerate(poses):
            found.add_block_prior(b, precision, start[b] - pose)
            excess = skeleton.clip(pose) - pose
            found.add_block_prior(b, np.where(excess != 0, _LIMIT, 0.0), excess)
        return found

    levels = [0] * _ITERATIONS
    poses = minimise(start, linearise, lambda q, step, _: q + step, levels, (_LONGEST_STEP, 0.0), damping=0.01).state
    poses = skeleton.clip(poses)
    distance = np.linalg.norm(skeleton.joints(poses)[:, rows] - targets, axis=2)
    cost = ((distance / _JOINT_M) ** 2).sum(axis=1) + (precision * (start - poses) ** 2).sum(axis=1)
    return np.asarray(poses[np.argmin(cost)])


def resting_figures(skeleton: Skeleton, p_pelvis: Float) -> Float:
    """Return poses (B, D) to begin from, standing and seated at several headings, with the pelvis at a point (3,)."""
    rest = neutral_pose(skeleton)
    hanging = shoulder_angles(np.array([0.0, 0.2, -0.98]))
    for shoulder, hip in zip(SHOULDERS, HIPS, strict=True):  # arms down, legs together
        rest[[skeleton.index(f"{shoulder}_{angle}") for angle in ("yaw", "pitch")]] = hanging
        rest[skeleton.index(f"{hip}_yaw")] = 0.0
    seated = rest.copy()  # from a straight leg a folded one is not reached
    for hip, knee in zip(HIPS, (LIMBS[leg][1] for leg in ("leg_l", "leg_r")), strict=True):
        seated[skeleton.index(f"{hip}_pitch")], seated[skeleton.index(f"{knee}_flexion")] = -np.pi / 2, np.pi / 2
    poses = np.repeat(np.stack([rest, seated]), HEADINGS, 0)
    poses[:, skeleton.index("torso_yaw")] = np.tile(np.arange(HEADINGS) * 2 * np.pi / HEADINGS, 2)
    poses[:, :3] = p_pelvis
    return poses
