"""Initial poses written by a person."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.ring import ring_of_cameras
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.initial_pose import rough_pose
from tk.model.body.skeleton import JOINTS, build_skeleton, shoulder_angles
from tk.model.cameras.tracker_frame import TrackerFrame

WORLD = TrackerFrame.of(ring_of_cameras(3, width=160, height=200), "z")
seeds = st.integers(0, 2**32 - 1)


@given(seeds)
@settings(max_examples=3)
def test_joints_of_the_rough_pose_are_near_the_written_ones(seed):
    """A body of average proportions in an everyday pose."""
    rng = np.random.default_rng(seed)
    skeleton = build_skeleton(BodyDimensions.from_stature(1.8), paper=True)
    rest = neutral_pose(skeleton)
    for side in ("l", "r"):
        hanging = shoulder_angles(np.array([0.1, 0.3, -0.95]))
        rest[[skeleton.index(f"shoulder_{side}_{a}") for a in ("yaw", "pitch")]] = hanging
        rest[skeleton.index(f"elbow_{side}_flexion")] = 0.4
        rest[skeleton.index(f"knee_{side}_flexion")] = 0.3
    pose = skeleton.clip(rest + rng.normal(0, 0.12, len(rest)) * ~skeleton.prismatic)
    pose[:4] = [*rng.uniform(-1, 1, 3), rng.uniform(-np.pi, np.pi)]
    joints = dict(zip(JOINTS, skeleton.joints(pose), strict=True))
    dimensions, _, found = rough_pose(joints, {}, 1.8, WORLD)
    error = np.linalg.norm(
        build_skeleton(dimensions, paper=True).joints(WORLD.poses_out(found)) - skeleton.joints(pose), axis=1
    )
    assert error.max() < 0.04 and error.mean() < 0.02


def test_written_angles_are_clipped_to_the_limits():
    angles = {"torso_x": 0.4, "torso_yaw": 1.0, "knee_l_flexion": 9.0}
    world = TrackerFrame.of(ring_of_cameras(2, width=160, height=200), "-y")
    dimensions, skeleton, pose = rough_pose({}, angles, 1.7, world)
    written = world.poses_out(pose)
    np.testing.assert_allclose(
        written[[skeleton.index("torso_x"), skeleton.index("torso_yaw")]], [0.4, 1.0], atol=1e-12
    )
    k = skeleton.index("knee_l_flexion")
    assert pose[k] == skeleton.upper[k]
    assert dimensions == BodyDimensions.from_stature(1.7)
