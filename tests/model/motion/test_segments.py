"""Many poses at once against the skeleton's own, one by one."""

from __future__ import annotations

import numpy as np

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import FOOT_POINTS
from tk.model.body.skeleton import JOINTS, build_skeleton
from tk.model.motion.segments import foot_points, joint_positions

BODY = BodyDimensions.from_stature(1.75)


def test_feet_stand_on_the_floor() -> None:
    skeleton = build_skeleton(BODY)
    T = skeleton.segment_transforms(np.zeros((1, len(skeleton.names))))
    feet = foot_points(skeleton, BODY, T)[0]
    ankle = joint_positions(skeleton, T)[0, JOINTS.index("ankle_l")]
    np.testing.assert_allclose(feet[:, 2], ankle[2] - BODY.ankle_height)
    heel, toe = feet[FOOT_POINTS.index("heel_l")], feet[FOOT_POINTS.index("toe_l")]
    np.testing.assert_allclose(toe - heel, [BODY.foot, 0, 0], atol=1e-12)
    assert heel[0] < ankle[0] < toe[0] and feet[0, 1] > 0 > feet[2, 1]
