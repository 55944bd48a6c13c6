"""Many poses at once against the skeleton's own, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import FOOT_POINTS
from tk.model.body.skeleton import JOINTS, build_skeleton
from tk.model.motion.segments import foot_points, joint_positions

BODY = BodyDimensions.from_stature(1.75)


@pytest.mark.parametrize("up", ["z", "-y"])
@pytest.mark.parametrize("paper", [False, True])
def test_agrees_with_the_skeleton(up: str, paper: bool) -> None:
    skeleton = build_skeleton(BODY, up, paper)
    poses = np.random.default_rng(1).uniform(-1, 1, (7, len(skeleton.names)))
    T = skeleton.segment_transforms(poses)
    joints = joint_positions(skeleton, T)
    for f, pose in enumerate(poses):
        np.testing.assert_allclose(T[f], skeleton.segment_transforms(pose), atol=1e-12)
        np.testing.assert_allclose(joints[f], skeleton.joints(pose), atol=1e-12)


def test_feet_stand_on_the_floor() -> None:
    skeleton = build_skeleton(BODY)
    T = skeleton.segment_transforms(np.zeros((1, len(skeleton.names))))
    feet = foot_points(skeleton, BODY, T)[0]
    ankle = joint_positions(skeleton, T)[0, JOINTS.index("ankle_l")]
    np.testing.assert_allclose(feet[:, 2], ankle[2] - BODY.ankle_height)
    heel, toe = feet[FOOT_POINTS.index("heel_l")], feet[FOOT_POINTS.index("toe_l")]
    np.testing.assert_allclose(toe - heel, [BODY.foot, 0, 0], atol=1e-12)
    assert heel[0] < ankle[0] < toe[0] and feet[0, 1] > 0 > feet[2, 1]
