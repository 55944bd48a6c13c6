"""What follows from poses agrees with the parts that it is made of."""

from __future__ import annotations

import numpy as np
import pytest

from tk.model.body.angles import ANGLES, joint_angles
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import FOOT_POINTS
from tk.model.body.rotations import to_matrices
from tk.model.body.skeleton import JOINTS, SEGMENTS, build_skeleton
from tk.model.motion.derived import derive

BODY = BodyDimensions.from_stature(1.75)


@pytest.mark.parametrize("up", ["z", "-y"])
def test_derived_quantities_are_consistent(up: str) -> None:
    skeleton = build_skeleton(BODY, up)
    poses = np.random.default_rng(0).uniform(-0.7, 0.7, (5, len(skeleton.names)))
    poses[:, np.char.startswith(skeleton.names, "ankle")] = 0  # the soles at right angles to the shins
    found = derive(skeleton, BODY, poses)
    assert found.rotations.shape == (5, len(SEGMENTS), 4) and found.feet.shape == (5, 4, 3)
    for f, pose in enumerate(poses):
        np.testing.assert_allclose(found.joints[f], skeleton.joints(pose), atol=1e-12)
    R = to_matrices(found.rotations)
    for joint, degrees in joint_angles(R, skeleton.T_world_body).items():
        np.testing.assert_allclose(found.angles[joint], degrees, atol=1e-6)
    assert set(found.angles) == {angles.joint for angles in ANGLES}
    # a bone lies along its segment's third axis, the sole at a right angle to the shin
    at = {name: found.joints[:, j] for j, name in enumerate(JOINTS)}
    shin = at["knee_r"] - at["ankle_r"]
    axis = R[:, SEGMENTS.index("calf_r"), :, 2]
    np.testing.assert_allclose(shin, BODY.calf * axis, atol=1e-9)
    sole = found.feet[:, FOOT_POINTS.index("toe_r")] - found.feet[:, FOOT_POINTS.index("heel_r")]
    np.testing.assert_allclose((sole * shin).sum(axis=1), 0, atol=1e-9)
