"""A skeleton over many frames at once: segments, joints and feet from poses (F, D)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.kernels.kinematics import ARM_UP
from tk.model.anthropometry import BodyDimensions
from tk.model.skeleton import JOINTS, SEGMENTS, Skeleton

Float = NDArray[np.float64]

# The points of the feet, in the order of :func:`foot_points`.
FOOT_POINTS = ("heel_l", "toe_l", "heel_r", "toe_r")
# Behind and ahead of the ankle's centre, as shares of the foot's length: where tk.model.body lays the foot.
_HEEL, _TOE = -0.2, 0.8


def segment_transforms(skeleton: Skeleton, poses: Float) -> Float:
    """(F, S, 4, 4) of the segments, zero configuration to world: what :meth:`Skeleton.segment_transforms` gives."""
    poses = np.asarray(poses, dtype=np.float64)
    T = np.zeros((len(skeleton.names), len(poses), 4, 4))
    for k, angle in enumerate(poses.T):
        step = np.tile(np.eye(4), (len(poses), 1, 1))
        if skeleton.prismatic[k]:
            step[:, :3, 3] = angle[:, None] * skeleton.axis[k]
        else:
            K = np.cross(np.eye(3), skeleton.axis[k])  # K v = axis × v
            step[:, :3, :3] += np.sin(angle)[:, None, None] * K + (1 - np.cos(angle))[:, None, None] * (K @ K)
            step[:, :3, 3] = skeleton.point[k] - step[:, :3, :3] @ skeleton.point[k]
            if skeleton.rise[k].any():
                second = poses[:, k + 1]
                up = ARM_UP[0] * np.cos(second) * np.sin(angle) + ARM_UP[1] * np.sin(second)
                step[:, :3, 3] += up[:, None] * skeleton.rise[k]
        T[k] = step if skeleton.parent[k] < 0 else T[skeleton.parent[k]] @ step
    return np.moveaxis(T[skeleton.segment_dof], 0, 1)


def joint_positions(skeleton: Skeleton, transforms: Float) -> Float:
    """(F, 15, 3) joint centres, metres, world frame, from :func:`segment_transforms`."""
    T = transforms[:, skeleton.joint_segment]
    return np.einsum("fjab,jb->fja", T[..., :3, :3], skeleton.joint_position) + T[..., :3, 3]


def foot_points(skeleton: Skeleton, dimensions: BodyDimensions, transforms: Float) -> Float:
    """(F, 4, 3) the :data:`FOOT_POINTS` on the sole, metres, world frame, from :func:`segment_transforms`.

    The foot rides on the calf where the skeleton has no segment of its own for it.
    """
    T = transforms[:, [foot_segment(name) for name in FOOT_POINTS]]
    ankles = skeleton.joint_position[[JOINTS.index("ankle" + name[-2:]) for name in FOOT_POINTS]]
    soles = np.array([sole_offset(name, dimensions) for name in FOOT_POINTS]) @ skeleton.T_world_body.T
    return np.einsum("fpab,pb->fpa", T[..., :3, :3], ankles + soles) + T[..., :3, 3]


def sole_offset(name: str, dimensions: BodyDimensions) -> Float:
    """(3,) one of the :data:`FOOT_POINTS` from the ankle of a standing body: forward, left, up, metres."""
    share = _HEEL if name.startswith("heel") else _TOE
    return np.array([share * dimensions.foot, 0.0, -dimensions.ankle_height])


def foot_segment(name: str) -> int:
    """The segment that carries the foot of the side with which ``name`` ends ("_l" or "_r")."""
    side = name[-2:]
    return SEGMENTS.index("foot" + side if "foot" + side in SEGMENTS else "calf" + side)
