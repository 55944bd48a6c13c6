"""Compute joint positions and points of the feet for many frames at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_points import sole_offset
from tk.model.body.joints import FOOT_POINTS, FOOT_SEGMENT, JOINTS, LIMBS, SEGMENTS
from tk.model.body.skeleton import Skeleton

Float = NDArray[np.float64]


def joint_positions(skeleton: Skeleton, transforms: Float) -> Float:
    """Return joint centres (F, J, 3), metres, world frame, from :meth:`Skeleton.segment_transforms`."""
    T = transforms[:, skeleton.joint_segment]
    return np.einsum("fjab,jb->fja", T[..., :3, :3], skeleton.joint_position) + T[..., :3, 3]


def foot_points(skeleton: Skeleton, dimensions: BodyDimensions, transforms: Float) -> Float:
    """Return the :data:`FOOT_POINTS` (F, 4, 3) on the sole, metres, world frame.

    ``transforms`` are those of :meth:`Skeleton.segment_transforms`. A skeleton without ankle joints has its feet fixed
    to the calves.
    """
    T = transforms[:, [SEGMENTS.index(segment) for segment in FOOT_SEGMENT.values()]]
    ankles = skeleton.joint_position[[JOINTS.index(LIMBS["leg" + name[-2:]][2]) for name in FOOT_POINTS]]
    soles = np.array([sole_offset(name, dimensions) for name in FOOT_POINTS]) @ skeleton.T_world_body.T
    return np.einsum("fpab,pb->fpa", T[..., :3, :3], ankles + soles) + T[..., :3, 3]
