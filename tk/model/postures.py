"""Postures of the limbs that people take: where to look for a limb that has been lost.

Random angles about where a limb was seldom reach one that is elsewhere. These few directions of the upper arm and the
thigh, each with the elbow or knee straight and bent, cover what a limb can do to within about 45°; the optimiser does
the rest. They are no prior: nothing draws a limb to them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.skeleton import Skeleton, shoulder_angles

Float = NDArray[np.float64]

# forward, outward, up
ARM_DIRECTIONS = (
    (0.0, 0.2, -1.0),
    (0.7, 0.1, -0.7),
    (-0.6, 0.2, -0.8),
    (0.0, 0.7, -0.7),
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.7, 0.2, 0.7),
    (0.0, 0.3, 1.0),
)
# elbow's flexion and the upper arm's roll, degrees
ELBOWS = ((15.0, 0.0), (100.0, -50.0), (100.0, 30.0))
# pitch of the hip (forward is negative), its spread, flexion of the knee, degrees
LEGS = tuple(
    (pitch, spread, knee)
    for pitch, knee in ((0, 5), (-30, 15), (-60, 60), (-90, 90), (20, 15), (15, 70))
    for spread in (3, 25)
)


def limb_postures(skeleton: Skeleton) -> Float:
    """(L, D) poses; of each only the limbs' angles mean anything, left and right alike."""
    poses = np.zeros((len(ARM_DIRECTIONS) * len(ELBOWS), len(skeleton.names)))
    arms = [(direction, elbow) for direction in ARM_DIRECTIONS for elbow in ELBOWS]
    for pose, (direction, (flexion, roll)), (pitch, spread, knee) in zip(
        poses, arms, LEGS * (len(poses) // len(LEGS)), strict=True
    ):
        first, second = shoulder_angles(np.array(direction) / np.linalg.norm(direction))
        for side in ("l", "r"):
            pose[skeleton.index(f"shoulder_{side}_yaw")] = first
            pose[skeleton.index(f"shoulder_{side}_pitch")] = second
            pose[skeleton.index(f"shoulder_{side}_roll")] = np.radians(roll)
            pose[skeleton.index(f"elbow_{side}_flexion")] = np.radians(flexion)
            pose[skeleton.index(f"hip_{side}_pitch")] = np.radians(pitch)
            pose[skeleton.index(f"hip_{side}_yaw")] = np.radians(spread)
            pose[skeleton.index(f"knee_{side}_flexion")] = np.radians(knee)
    return skeleton.clip(poses)
