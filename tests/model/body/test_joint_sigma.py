"""Standard deviations of joints: from the pose's covariance, and from how far the posture is from the mean one."""

from __future__ import annotations

import numpy as np
import pytest

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joint_sigma import BENT_M, OFFSET_M, directions, pose_variance, posture_variance
from tk.model.body.skeleton import JOINTS, build_skeleton

SKELETON = build_skeleton(BodyDimensions.from_stature(1.75))
NAMES = SKELETON.names


def poses(count: int, spread: float = 0.3) -> np.ndarray:
    return np.random.default_rng(3).normal(scale=spread, size=(count, len(NAMES)))


def test_pose_variance_equals_that_of_sampled_poses() -> None:
    rng = np.random.default_rng(1)
    pose = poses(1)[0]
    D = len(pose)
    root = rng.normal(size=(D, D)) / np.sqrt(D)
    precision = (root @ root.T + np.eye(D)) * 1e6  # deviations of about a thousandth: joints move as the pose does
    drawn = pose + rng.multivariate_normal(np.zeros(D), np.linalg.inv(precision), 4000)
    moved = SKELETON.joints(drawn) - SKELETON.joints(pose)
    found = pose_variance(SKELETON, pose, np.linalg.inv(precision))
    np.testing.assert_allclose(found, (moved**2).mean(axis=(0, 2)), rtol=0.1)


def test_batched_variances_equal_single_ones() -> None:
    D = len(NAMES)
    root = np.random.default_rng(4).normal(size=(6, D, D))
    covariance = root @ root.swapaxes(1, 2) + np.eye(D)
    many = pose_variance(SKELETON, poses(6).reshape(2, 3, D), covariance.reshape(2, 3, D, D))
    each = [pose_variance(SKELETON, pose, C) for pose, C in zip(poses(6), covariance, strict=True)]
    np.testing.assert_allclose(many.reshape(6, -1), each, rtol=1e-9)


def test_directions_do_not_depend_on_place_and_heading() -> None:
    pose = poses(5)
    elsewhere = pose.copy()
    elsewhere[:, [NAMES.index(f"torso_{name}") for name in ("x", "y", "z", "yaw", "roll", "pitch")]] += 0.4
    there = directions(SKELETON, pose)
    np.testing.assert_allclose(directions(SKELETON, elsewhere), there, atol=1e-9)
    length = np.linalg.norm(there, axis=-1)
    own = np.isin(JOINTS, ("pelvis", "neck"))
    assert not length[:, own].any()
    np.testing.assert_allclose(length[:, ~own], 1.0)


def test_mean_posture_has_no_variance_and_a_turned_arm_the_largest() -> None:
    straight = np.zeros(len(NAMES))
    usual = directions(SKELETON, straight)
    assert posture_variance(SKELETON, straight, usual).max() < 1e-12
    over = usual.copy()
    arm = [JOINTS.index(f"{joint}_l") for joint in ("shoulder", "elbow")]
    over[arm] *= -3.0  # a mean is shorter than one, its length says nothing
    found = posture_variance(SKELETON, straight, over)
    np.testing.assert_allclose(found[arm], (2 * OFFSET_M) ** 2)
    assert np.delete(found, arm).max() < 1e-12


def test_bent_waist_adds_variance_to_all_joints_but_knees_and_ankles() -> None:
    pose = np.zeros(len(NAMES))
    pose[SKELETON.index("waist_pitch")] = 0.5
    found = posture_variance(SKELETON, pose, directions(SKELETON, pose))
    lower = [name[:-2] in ("knee", "ankle") for name in JOINTS]
    np.testing.assert_allclose(found, np.where(lower, 0.0, (0.5 * BENT_M) ** 2))


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_batches_equal_single_poses(shape: tuple[int, ...]) -> None:
    batch = poses(int(np.prod(shape, dtype=int))).reshape(*shape, -1)
    usual = directions(SKELETON, poses(8)).mean(axis=0)
    whole = posture_variance(SKELETON, batch, usual)
    assert whole.shape == (*shape, len(JOINTS))
    for at in np.ndindex(shape):
        np.testing.assert_allclose(whole[at], posture_variance(SKELETON, batch[at], usual), rtol=0, atol=1e-15)
