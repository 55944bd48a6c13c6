"""Joint angles: known poses, left and right, there and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tk.model.body.angles import (
    ANGLES,
    FORWARD_UP_RIGHT,
    MIRROR,
    UNMEASURED,
    UNSEEN,
    by_reason,
    joint_angles,
    standing_rotations,
)
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import BODIES
from tk.model.body.rotations import compose
from tk.model.body.skeleton import JOINTS, SEGMENTS, Skeleton, build_skeleton, shoulder_angles, skeleton_of_names

BODY = BodyDimensions.from_stature(1.75)
SKELETON = build_skeleton(BODY)
BY_JOINT = {angles.joint: angles for angles in ANGLES}


def pose_of(skeleton: Skeleton = SKELETON, **degrees: float) -> np.ndarray:
    """A pose in which these degrees of freedom have these values, and both arms hang."""
    pose = np.zeros(len(skeleton.names))
    for side, outward in (("l", 1.0), ("r", -1.0)):
        point_arm(pose, skeleton, side, np.array([0.0, 0.0, -1.0]), outward)
    for name, value in degrees.items():
        pose[skeleton.index(name)] = np.radians(value)
    return pose


def point_arm(pose: np.ndarray, skeleton: Skeleton, side: str, direction: np.ndarray, outward: float) -> None:
    """Turn an arm to ``direction`` (forward, left, up)."""
    yaw, pitch = shoulder_angles(direction * [1.0, outward, 1.0])
    pose[skeleton.index(f"shoulder_{side}_yaw")] = yaw
    pose[skeleton.index(f"shoulder_{side}_pitch")] = pitch


def joint_rotation(joint: str, degrees: np.ndarray) -> np.ndarray:
    """(..., 3, 3) the child's axes in the parent's: the inverse of joint_angles, with 0 for angles not given."""
    angles = BY_JOINT[joint]
    turns = np.zeros((*np.shape(degrees)[:-1], 3))
    for column, (_, k, sign) in enumerate(angles.columns):
        turns[..., k] = sign * np.radians(np.nan_to_num(degrees[..., column]))
    R = compose(angles.sequence, turns)
    R = MIRROR @ R @ MIRROR if angles.mirrored else R
    return FORWARD_UP_RIGHT.T @ R @ FORWARD_UP_RIGHT


def segment_rotations(skeleton: Skeleton, poses: np.ndarray) -> np.ndarray:
    return standing_rotations(skeleton, skeleton.segment_transforms(poses))


def angles_of(pose: np.ndarray, skeleton: Skeleton = SKELETON) -> dict[str, dict[str, float]]:
    found = joint_angles(segment_rotations(skeleton, pose[None]), skeleton.T_world_body)
    names = {joint: angles.names for joint, angles in BY_JOINT.items()}
    return {
        joint: {name: float(value) for name, value in zip(names[joint], values[0], strict=True) if np.isfinite(value)}
        for joint, values in found.items()
    }


KNOWN = [
    ({"knee_l_flexion": 30.0}, "knee_l", "flexion", 30.0),
    ({"knee_r_flexion": 30.0}, "knee_r", "flexion", 30.0),
    ({"elbow_l_flexion": 75.0}, "elbow_l", "flexion", 75.0),
    ({"elbow_r_flexion": 75.0}, "elbow_r", "flexion", 75.0),
    ({"hip_l_pitch": -40.0}, "hip_l", "flexion", 40.0),
    ({"hip_r_pitch": -40.0}, "hip_r", "flexion", 40.0),
    ({"hip_l_yaw": 25.0}, "hip_l", "adduction", -25.0),
    ({"hip_r_yaw": 25.0}, "hip_r", "adduction", -25.0),
    ({"hip_l_roll": 20.0}, "hip_l", "rotation", 20.0),
    ({"hip_r_roll": 20.0}, "hip_r", "rotation", 20.0),
    ({"ankle_l_flexion": 20.0}, "ankle_l", "dorsiflexion", 20.0),
    ({"ankle_r_flexion": 20.0}, "ankle_r", "dorsiflexion", 20.0),
    ({"ankle_l_inversion": 10.0}, "ankle_l", "inversion", 10.0),
    ({"ankle_r_inversion": 10.0}, "ankle_r", "inversion", 10.0),
    ({"waist_pitch": 15.0}, "lumbar", "flexion", 15.0),
    ({"neck_pitch": 20.0}, "neck", "flexion", 20.0),
    ({"neck_yaw": 12.0}, "neck", "lateral_bending", 12.0),
    ({"neck_roll": 40.0}, "neck", "rotation", 40.0),
    ({"waist_yaw": -10.0}, "lumbar", "rotation", 10.0),
    ({"torso_pitch": 8.0}, "pelvis", "tilt", 8.0),
    ({"torso_roll": 5.0}, "pelvis", "obliquity", 5.0),
    ({"torso_yaw": 170.0}, "pelvis", "rotation", 170.0),
]


@pytest.mark.parametrize(("degrees", "joint", "name", "expected"), KNOWN)
def test_known_poses(degrees: dict[str, float], joint: str, name: str, expected: float) -> None:
    found = angles_of(pose_of(**degrees))
    assert found[joint][name] == pytest.approx(expected, abs=1e-9)
    for other, value in found[joint].items():
        if other != name:
            assert value == pytest.approx(0, abs=1e-9), other


@pytest.mark.parametrize("side", ["l", "r"])
@pytest.mark.parametrize(
    ("direction", "plane", "elevation"),
    [((0, 1, 0), 0, 90), ((1, 0, 0), 90, 90), ((0, 1, -1), 0, 45), ((1, 1, 0), 45, 90), ((-1, 0, -2), -90, 26.565)],
)
def test_shoulder_points_where_it_says(
    side: str, direction: tuple[float, float, float], plane: float, elevation: float
) -> None:
    outward = 1.0 if side == "l" else -1.0
    pose = pose_of()
    unit = np.array(direction) * [1.0, outward, 1.0] / np.linalg.norm(direction)
    point_arm(pose, SKELETON, side, unit, outward)
    joints = dict(zip(JOINTS, SKELETON.joints(pose), strict=True))
    arm = joints[f"elbow_{side}"] - joints[f"shoulder_{side}"]
    np.testing.assert_allclose(arm / np.linalg.norm(arm), unit, atol=1e-9)
    found = angles_of(pose)[f"shoulder_{side}"]
    assert found["plane"] == pytest.approx(plane, abs=1e-3)
    assert found["elevation"] == pytest.approx(elevation, abs=1e-3)


@pytest.mark.parametrize("side", ["l", "r"])
def test_internal_rotation_of_a_level_arm_lowers_the_hand(side: str) -> None:
    """An arm out to the side, the elbow bent: internal rotation takes the hand from up over forward to down."""
    outward = 1.0 if side == "l" else -1.0
    hands, rotations = [], []
    for roll in np.linspace(-60, 60, 5):
        pose = pose_of(**{f"elbow_{side}_flexion": 90.0})
        point_arm(pose, SKELETON, side, np.array([0.0, outward, 0.0]), outward)
        pose[SKELETON.index(f"shoulder_{side}_roll")] = np.radians(roll)
        joints = dict(zip(JOINTS, SKELETON.joints(pose), strict=True))
        hands.append(joints[f"wrist_{side}"][2] - joints[f"elbow_{side}"][2])
        rotations.append(angles_of(pose)[f"shoulder_{side}"]["rotation"])
    np.testing.assert_allclose(np.abs(np.diff(rotations)), 30, atol=1e-6)
    hands_in_order = np.array(hands)[np.argsort(rotations)]
    assert (np.diff(hands_in_order) < 0.02).all() and hands_in_order[0] - hands_in_order[-1] > 0.1


@given(seed=st.integers(0, 2**32 - 1))
def test_mirrored_poses_have_mirrored_angles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = np.zeros(len(SKELETON.names))
    free = [k for k, name in enumerate(SKELETON.names) if name.startswith(("shoulder", "elbow", "hip", "knee"))]
    pose[free] = rng.uniform(-0.6, 0.6, len(free))
    mirrored = pose.copy()
    for name in SKELETON.names:
        if "_l_" in name:
            other = name.replace("_l_", "_r_")
            mirrored[[SKELETON.index(name), SKELETON.index(other)]] = pose[
                [SKELETON.index(other), SKELETON.index(name)]
            ]
    a, b = angles_of(pose), angles_of(mirrored)
    for joint in BY_JOINT:
        if joint.endswith("_l"):
            assert a[joint] == pytest.approx(b[joint[:-2] + "_r"], abs=1e-6)


@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_angles_do_not_depend_on_the_axis_that_is_up(up: str) -> None:
    pose = np.random.default_rng(3).uniform(-0.5, 0.5, len(SKELETON.names))
    skeleton = build_skeleton(BODY, up)
    a, b = angles_of(pose), angles_of(pose, skeleton)
    for joint in BY_JOINT:
        assert a[joint] == pytest.approx(b[joint], abs=1e-6)


@given(seed=st.integers(0, 2**32 - 1))
def test_angles_give_the_rotation_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = np.zeros((1, len(SKELETON.names)))
    low, high = np.maximum(SKELETON.lower, -1.5), np.minimum(SKELETON.upper, 1.5)
    pose[0] = rng.uniform(low, high)
    R = segment_rotations(SKELETON, pose)
    for joint, degrees in joint_angles(R, SKELETON.T_world_body).items():
        angles = BY_JOINT[joint]
        if angles.child not in SEGMENTS:
            continue
        parent = np.eye(3) if angles.parent is None else R[:, SEGMENTS.index(angles.parent)]
        child = R[:, SEGMENTS.index(angles.child)]
        np.testing.assert_allclose(parent @ joint_rotation(joint, degrees), child, atol=1e-6)


def test_feet_that_ride_on_the_shins_have_no_angle() -> None:
    found = joint_angles(segment_rotations(SKELETON, pose_of()[None]), np.eye(3), SEGMENTS[:11])
    np.testing.assert_array_equal(found["ankle_l"], [[np.nan, np.nan]])


@pytest.mark.parametrize("names", BODIES)
def test_angle_without_a_degree_of_freedom_is_nan(names: tuple[str, ...]) -> None:
    """An angle is a number if and only if it differs between poses."""
    skeleton = skeleton_of_names(names, BODY, "z")
    paper = names == BODIES[-1]
    low, high = np.maximum(skeleton.lower, -1.0), np.minimum(skeleton.upper, 1.0)
    R = segment_rotations(skeleton, np.random.default_rng(0).uniform(low, high, (9, len(low))))
    missing = [(a.joint, *a.unmeasured(names)) for a in ANGLES if a.unmeasured(names)]
    bent = [("lumbar", "flexion", "lateral_bending", "rotation")] * paper
    ankles = [(f"ankle_{side}", "dorsiflexion", "inversion") for side in "lr"] * paper
    assert sorted(missing) == sorted([*bent, *[("neck", "rotation")] * ("neck_roll" not in names), *ankles])
    everything = joint_angles(R, skeleton.T_world_body)
    for joint, degrees in joint_angles(R, skeleton.T_world_body, pose_names=names).items():
        unmeasured = np.isin(BY_JOINT[joint].names, list(BY_JOINT[joint].unmeasured(names)))
        assert np.isnan(degrees[:, unmeasured]).all() and (np.ptp(degrees[:, ~unmeasured], axis=0) > 1).all()
        assert (np.abs(everything[joint][:, unmeasured]) < 1e-9).all()


def test_turn_of_the_head_is_a_number_only_if_landmarks_were_used() -> None:
    R = segment_rotations(SKELETON, pose_of(neck_roll=30.0, neck_pitch=10.0)[None])
    seen, unseen = (joint_angles(R, np.eye(3), landmarks=used) for used in (True, False))
    np.testing.assert_allclose(seen["neck"], [[10.0, 0.0, 30.0]], atol=1e-9)
    np.testing.assert_array_equal(unseen["neck"], [[seen["neck"][0, 0], seen["neck"][0, 1], np.nan]])
    assert BY_JOINT["neck"].unmeasured(SKELETON.names, landmarks=False) == {"rotation": UNSEEN}
    assert BY_JOINT["neck"].unmeasured(BODIES[1], landmarks=False) == {"rotation": UNMEASURED}
    assert by_reason({"a": "x", "b": "y", "c": "x"}) == "a, c: x; b: y"
