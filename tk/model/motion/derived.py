"""Compute joints, segment rotations, feet and angles from poses, as stored in the result file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.angles import joint_angles, standing_rotations
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.rotations import to_quaternions
from tk.model.body.skeleton import Skeleton, blocks
from tk.model.motion.segments import foot_points, joint_positions

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Derived:
    """Quantities derived from F poses."""

    joints: Float  # (F, J, 3) metres, world frame: `/joints/position`
    # (F, S, 4) quaternions (w, x, y, z), segment to world: `/segments/rotation`, the segments being
    # `tk.model.body.skeleton.SEGMENTS` with the axes of `tk.model.body.angles`
    rotations: Float
    feet: Float  # (F, 4, 3) metres, world frame: `/feet/position`, in the order of `tk.model.body.joints.FOOT_POINTS`
    # angles by joint, degrees, each (F, k): `/angles/<joint>`; names and conventions in `tk.model.body.angles.ANGLES`
    angles: dict[str, Float]


def derive(skeleton: Skeleton, dimensions: BodyDimensions, poses: Float, landmarks: bool = True) -> Derived:
    """Return the quantities derived from finite poses (F, D); ``landmarks``: whether they were used."""
    pieces = [_derive(skeleton, dimensions, block, landmarks) for block in blocks(poses)]
    return Derived(
        joints=np.concatenate([piece.joints for piece in pieces]),
        rotations=np.concatenate([piece.rotations for piece in pieces]),
        feet=np.concatenate([piece.feet for piece in pieces]),
        angles={name: np.concatenate([piece.angles[name] for piece in pieces]) for name in pieces[0].angles},
    )


def _derive(skeleton: Skeleton, dimensions: BodyDimensions, poses: Float, landmarks: bool) -> Derived:
    T = skeleton.segment_transforms(poses)
    R = standing_rotations(skeleton, T)
    return Derived(
        joints=joint_positions(skeleton, T),
        rotations=to_quaternions(R),
        feet=foot_points(skeleton, dimensions, T),
        angles=joint_angles(R, skeleton.T_world_body, pose_names=skeleton.names, landmarks=landmarks),
    )
