"""Candidate poses of a limb: over its range of motion, within the limits; and the choice of different ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.figures import BODY
from tk.model.body.gait_poses import standing_pose, walking_pose
from tk.model.body.limb_candidates import DISTINCT_M, LIMBS, exchanged_limbs, limbs_of, pairs, turned
from tk.model.body.skeleton import JOINTS

SKELETON = BODY.skeleton
POSE = standing_pose(SKELETON)
LIMB = {limb.name: limb for limb in limbs_of(BODY)}
FORWARD, UP = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


def test_limbs_have_the_parts_and_angles_that_the_body_has():
    assert list(LIMB) == list(LIMBS)
    for limb in LIMB.values():
        assert limb.grid.shape[1] == len(limb.dofs) and len(np.unique(limb.grid, axis=0)) == len(limb.grid)
        assert {BODY.parts[p].segment[-1] for p in limb.parts} == {limb.name[-1]}
    found = [tuple(limb.name for limb in pair) for pair in pairs(list(LIMB.values()))]
    assert found == [("arm_l", "arm_r"), ("leg_l", "leg_r")]


@pytest.mark.parametrize("name", LIMBS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_candidates_stay_within_the_limits_and_change_the_limb_only(name, seed):
    limb, rng = LIMB[name], np.random.default_rng(seed)
    pose = SKELETON.clip(rng.normal(0, 0.6, len(POSE)))
    found = limb.candidates(pose, 40, rng)
    assert found.shape == (len(limb.grid) + 40, len(pose))
    np.testing.assert_array_equal(SKELETON.clip(found), found)
    others = np.delete(np.arange(len(pose)), limb.dofs)
    np.testing.assert_array_equal(found[:, others], np.repeat(pose[None, others], len(found), axis=0))
    # the last ones are near the present place: within four standard deviations of 25°, or at a limit
    near = np.abs(found[-40:, limb.dofs] - pose[limb.dofs])
    assert near.max() < np.radians(4.5 * 25) and near.max() > 0


def directions(name, ends):
    """(N, 3) of the upper arm or thigh, in candidates of a limb of the upright body."""
    joints = np.array([SKELETON.joints(p) for p in LIMB[name].candidates(POSE, 0, np.random.default_rng(0))])
    a, b = (joints[:, JOINTS.index(f"{end}_{name[-1]}")] for end in ends)
    return (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)


@pytest.mark.parametrize("name", ["arm_l", "arm_r"])
def test_arm_candidates_cover_all_directions(name):
    """But through the back and far across; no direction is farther than 35° from one that is tried."""
    found = directions(name, ("shoulder", "elbow"))
    wanted = np.random.default_rng(1).normal(size=(500, 3))
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    outward = wanted[:, 1] * (1 if name == "arm_l" else -1)
    wanted = wanted[(wanted[:, 0] > -0.6) & (outward > -0.65)]
    assert np.degrees(np.arccos((wanted @ found.T).max(axis=1))).max() < 35


@pytest.mark.parametrize("name", ["arm_l", "arm_r"])
def test_elbow_candidates_are_straight_and_bent_to_all_sides(name):
    elbow = list(LIMB[name].dofs).index(SKELETON.index(f"elbow_{name[-1]}_flexion"))
    bends = np.degrees(LIMB[name].grid[:, elbow])
    assert bends.min() < 20 and bends.max() > 110 and len(np.unique(bends.round())) >= 3


@pytest.mark.parametrize("name", ["leg_l", "leg_r"])
def test_leg_candidates_reach_from_behind_to_a_high_kick(name):
    found = directions(name, ("hip", "knee"))
    forward = np.degrees(np.arctan2(found @ FORWARD, -found @ UP))
    assert forward.min() < -15 and forward.max() > 90
    knees = np.degrees(LIMB[name].grid[:, 3])
    assert knees.min() < 10 and knees.max() > 120
    assert not LIMB[name].grid[:, 4:].any()


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 6))
@settings(max_examples=20)
def test_distinct_poses_differ_and_the_cheapest_is_first(seed, count):
    rng = np.random.default_rng(seed)
    limb = LIMB[list(LIMBS)[rng.integers(4)]]
    poses = limb.candidates(POSE, 20, rng)
    cost = rng.uniform(size=len(poses))
    chosen = limb.distinct(poses, cost, count)
    assert 1 <= len(chosen) <= count
    np.testing.assert_array_equal(chosen[0], poses[np.argmin(cost)])
    ends = np.array([SKELETON.joints(p)[limb.joints] for p in chosen])
    for i in range(len(ends)):
        for j in range(i):
            assert np.linalg.norm(ends[i] - ends[j], axis=1).max() > DISTINCT_M
    costs = [cost[np.flatnonzero((poses == p).all(axis=1))].min() for p in chosen]
    assert costs == sorted(costs)


def test_equal_poses_count_once():
    limb = LIMB["arm_l"]
    assert len(limb.distinct(np.repeat(POSE[None], 5, axis=0), np.arange(5.0), 3)) == 1


@pytest.mark.parametrize("phase", [0.1, 0.35, 0.6])
def test_exchanged_legs_are_at_each_other_s_places_within_the_limits(phase):
    skeleton = BODY.skeleton
    _, (left, right) = pairs(limbs_of(BODY))
    pose = walking_pose(skeleton, phase)
    result = exchanged_limbs(pose, [(left, right)])[0]
    before, after = skeleton.joints(pose), skeleton.joints(result)
    moved = left.joints + right.joints
    assert np.linalg.norm(after[moved] - before[right.joints + left.joints], axis=1).max() < 0.06
    others = np.setdiff1d(np.arange(len(JOINTS)), moved)
    np.testing.assert_allclose(after[others], before[others], atol=1e-12)
    assert (result >= np.minimum(pose, skeleton.lower)).all() and (result <= np.maximum(pose, skeleton.upper)).all()


def test_turned_person_leans_as_before_and_has_the_limbs_of_the_other_side_nearby():
    skeleton, limbs = BODY.skeleton, limbs_of(BODY)
    pose = walking_pose(skeleton, 0.1)
    for name, angle in (("torso_roll", 0.2), ("torso_pitch", 0.3), ("waist_roll", 0.1), ("torso_yaw", 0.7)):
        pose[skeleton.index(name)] = angle
    before, after = skeleton.joints(pose), skeleton.joints(turned(pose, limbs))
    other = [JOINTS.index(name[:-1] + {"l": "r", "r": "l"}[name[-1]]) if "_" in name[-2:] else i
             for i, name in enumerate(JOINTS)]  # fmt: skip
    distance = np.linalg.norm(after - before[other], axis=1)
    assert distance[[JOINTS.index(name) for name in ("pelvis", "neck", "shoulder_l", "shoulder_r")]].max() < 0.02
    assert distance.max() < 0.25  # knees and elbows bend one way
    front, turned_front = (np.cross(j[JOINTS.index("shoulder_l")] - j[JOINTS.index("shoulder_r")], [0, 0, 1])
                           for j in (before, after))  # fmt: skip
    assert front @ turned_front < -0.9 * (front @ front)
