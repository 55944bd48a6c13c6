"""A skeleton over many frames at once: segments, joints and feet from poses (F, D)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import FOOT_POINTS, JOINTS, LIMBS, SEGMENTS
from tk.model.body.skeleton import Skeleton

Float = NDArray[np.float64]

# Behind and ahead of the ankle's centre, as shares of the foot's length: where tk.model.body.cone_body lays the foot.
_HEEL, _TOE = -0.2, 0.8


def joint_positions(skeleton: Skeleton, transforms: Float) -> Float:
    """(F, 15, 3) joint centres, metres, world frame, from :meth:`Skeleton.segment_transforms`."""
    T = transforms[:, skeleton.joint_segment]
    return np.einsum("fjab,jb->fja", T[..., :3, :3], skeleton.joint_position) + T[..., :3, 3]


def foot_points(skeleton: Skeleton, dimensions: BodyDimensions, transforms: Float) -> Float:
    """(F, 4, 3) the :data:`FOOT_POINTS` on the sole, metres, world frame, from :meth:`Skeleton.segment_transforms`.

    The foot rides on the calf where the skeleton has no segment of its own for it.
    """
    T = transforms[:, [foot_segment(name) for name in FOOT_POINTS]]
    ankles = skeleton.joint_position[[JOINTS.index(LIMBS["leg" + name[-2:]][2]) for name in FOOT_POINTS]]
    soles = np.array([sole_offset(name, dimensions) for name in FOOT_POINTS]) @ skeleton.T_world_body.T
    return np.einsum("fpab,pb->fpa", T[..., :3, :3], ankles + soles) + T[..., :3, 3]


def sole_offset(name: str, dimensions: BodyDimensions) -> Float:
    """(3,) one of the :data:`FOOT_POINTS` from the ankle of a standing body: forward, left, up, metres."""
    share = _HEEL if name.startswith("heel") else _TOE
    return np.array([share * dimensions.foot, 0.0, -dimensions.ankle_height])


def foot_segment(name: str) -> int:
    """Return the segment that carries the foot of the side with which ``name`` ends ("_l" or "_r")."""
    return SEGMENTS.index("foot" + name[-2:])
