"""A rough pose that somebody wrote down, as a body of average proportions in that pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.anthropometry import (
    CALF_LENGTH,
    FOREARM_LENGTH,
    HEAD_LENGTH,
    SHOULDER_HALF_WIDTH,
    THIGH_LENGTH,
    TRUNK_LENGTH,
    UPPER_ARM_LENGTH,
    BodyDimensions,
)
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.skeleton import JOINTS, build_skeleton, shoulder_angles
from tk.model.cameras.tracker_frame import TrackerFrame

Float = NDArray[np.float64]

# A person is between these two tall, standing on the feet (metres).
LEAST_STATURE, GREATEST_STATURE = 0.8, 2.4


def rough_pose(
    joints: dict[str, Float], angles: dict[str, float], height_m: float | None, world: TrackerFrame
) -> tuple[BodyDimensions, Float]:
    """Average body, and its pose in the cameras' own world, from what a person wrote down in the capture's.

    Args:
        joints: name → (3,) metres of some joints; or empty.
        angles: name → value of some entries of the configuration vector (radians, metres); or empty.
        height_m: the subject's height; without it, the joints' distances tell, else 1.72 m.
        world: the cameras'.

    Returns:
        Dimensions and pose (D,).
    """
    stature = height_m or _stature_of(joints) or 1.72
    dimensions = BodyDimensions.from_stature(stature)
    skeleton = build_skeleton(dimensions)
    pose = np.zeros(len(skeleton.names))
    if angles:
        pose = neutral_pose(skeleton)
        for name, value in angles.items():
            pose[skeleton.index(name)] = value
        return dimensions, world.poses_in(skeleton.clip(pose))
    rows = [JOINTS.index(name) for name in joints]
    targets = world.points_in(list(joints.values()))

    def residual(p: Float) -> Float:
        # a little weight on plain angles settles what the joints leave open
        return np.concatenate([((skeleton.joints(p)[rows] - targets) / 0.02).ravel(), 0.2 * (p[3:] - rest[3:])])

    from scipy.optimize import least_squares  # takes half a second to import

    lower, upper = skeleton.lower - 1e-9, skeleton.upper + 1e-9
    best = None
    for yaw in np.arange(8) * np.pi / 4:
        rest = neutral_pose(skeleton)
        for side in ("l", "r"):  # arms down, legs together
            hanging = shoulder_angles(np.array([0.0, 0.2, -0.98]))
            rest[skeleton.index(f"shoulder_{side}_yaw")], rest[skeleton.index(f"shoulder_{side}_pitch")] = hanging
            rest[skeleton.index(f"hip_{side}_yaw")] = 0.0
        rest[:3] = targets.mean(axis=0) - skeleton.joints(rest)[rows].mean(axis=0)
        rest[skeleton.index("torso_yaw")] = yaw
        fit = least_squares(residual, rest, bounds=(lower, upper), max_nfev=60)
        if best is None or fit.cost < best.cost:
            best = fit
    assert best is not None
    return dimensions, skeleton.clip(best.x)


def _stature_of(joints: dict[str, Float]) -> float | None:
    """Median stature that the distances of neighbouring joints stand for; None where there are too few."""
    table = {
        ("pelvis", "neck"): TRUNK_LENGTH,
        ("neck", "head_top"): HEAD_LENGTH,
        ("shoulder_l", "shoulder_r"): 2 * SHOULDER_HALF_WIDTH,
    }
    for side in ("l", "r"):
        table |= {
            (f"shoulder_{side}", f"elbow_{side}"): UPPER_ARM_LENGTH,
            (f"elbow_{side}", f"wrist_{side}"): FOREARM_LENGTH,
            (f"hip_{side}", f"knee_{side}"): THIGH_LENGTH,
            (f"knee_{side}", f"ankle_{side}"): CALF_LENGTH,
        }
    known = [(a, b, ratio) for (a, b), ratio in table.items() if a in joints and b in joints]
    found = [np.linalg.norm(joints[a] - joints[b]) / ratio for a, b, ratio in known]
    return float(np.clip(np.median(found), LEAST_STATURE, GREATEST_STATURE)) if len(found) >= 3 else None
