"""Where lost limbs are looked for."""

import numpy as np

from tk.model.anthropometry import BodyDimensions
from tk.model.postures import ARM_DIRECTIONS, limb_postures
from tk.model.skeleton import JOINTS, build_skeleton

SKELETON = build_skeleton(BodyDimensions.from_stature(1.75))


def joint(pose, name):
    return SKELETON.joints(pose)[JOINTS.index(name)]


def test_postures_are_within_the_limits_and_mirrored():
    poses = limb_postures(SKELETON)
    np.testing.assert_array_equal(SKELETON.clip(poses), poses)
    for pose in poses:
        for name in ("elbow", "wrist", "knee", "ankle"):
            np.testing.assert_allclose(joint(pose, f"{name}_r"), joint(pose, f"{name}_l") * [1, -1, 1], atol=1e-12)


def test_upper_arms_point_where_they_are_said_to():
    seen = set()
    for pose in limb_postures(SKELETON):
        arm = joint(pose, "elbow_l") - joint(pose, "shoulder_l")
        cosine = [arm @ d / np.linalg.norm(arm) / np.linalg.norm(d) for d in np.array(ARM_DIRECTIONS)]
        assert max(cosine) > 1 - 1e-9
        seen.add(int(np.argmax(cosine)))
    assert seen == set(range(len(ARM_DIRECTIONS)))


def test_every_downward_or_forward_direction_of_the_arm_is_near_one():
    """Within 45°, over the quarter of the sphere in which arms mostly are."""
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    common = directions[(directions[:, 0] > -0.3) & (directions[:, 1] > -0.1) & (directions[:, 2] < 0.7)]
    known = np.array(ARM_DIRECTIONS) / np.linalg.norm(ARM_DIRECTIONS, axis=1, keepdims=True)
    assert np.degrees(np.arccos(np.clip((common @ known.T).max(axis=1), -1, 1))).max() < 45
