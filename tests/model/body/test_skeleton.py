"""The tree of twists: anatomy, limits, mirror symmetry, directions of up."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from tk.model.body.anthropometry import FRACTIONS, RAISED_SHOULDERS, BodyDimensions
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.joints import BODIES, BY_LANDMARKS, ROWS, WAIST
from tk.model.body.skeleton import (
    CHAINS,
    JOINTS,
    SEGMENTS,
    arm_elevation,
    build_skeleton,
    convert_poses,
    paper_poses,
    shoulder_angles,
    skeleton_of_names,
)

DIMENSIONS = BodyDimensions.from_stature(1.75)
SKELETON, PAPER = build_skeleton(DIMENSIONS), build_skeleton(DIMENSIONS, paper=True)
D = len(SKELETON.names)
ADDED = ~np.isin(SKELETON.names, PAPER.names)
EXACT = 1e-12
UPS = ("x", "y", "z", "-x", "-y", "-z")
FORWARD, LEFT, UP = np.eye(3)

seeds = st.integers(0, 2**32 - 1)
many = settings(max_examples=60)


def random_pose(seed):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, D)


def posed(**degrees):
    """The zero pose but for these angles, degrees."""
    pose = np.zeros(D)
    for name, value in degrees.items():
        pose[SKELETON.index(name)] = np.radians(value)
    return pose


def joints(pose, skeleton=SKELETON):
    return dict(zip(JOINTS, skeleton.joints(pose), strict=True))


def mirrored(pose, skeleton=SKELETON):
    """The pose of the body reflected in the plane y = 0 of the zero configuration."""
    result = np.empty(len(pose))
    for k, name in enumerate(skeleton.names):
        partner = name.replace("_l_", "_#_").replace("_r_", "_l_").replace("_#_", "_r_")
        # what moves along y, or turns about an axis in the plane of symmetry, changes its sign
        odd = ("torso_y", "torso_yaw", "torso_roll", "neck_yaw", "neck_roll", "waist_roll", "waist_yaw")
        result[skeleton.index(partner)] = -pose[k] if name in odd else pose[k]
    return result


# The tree


def test_joints_parents_and_degrees_of_freedom_of_the_papers_skeleton():
    s = PAPER
    assert len(s.names) == len(set(s.names)) == 24
    assert s.units == ("m",) * 3 + ("rad",) * 21
    assert (s.parent < np.arange(24)).all() and s.parent[0] == -1
    np.testing.assert_allclose(np.linalg.norm(s.axis, axis=1), 1)
    assert [s.names[k] for k in s.segment_dof] == [
        "torso_pitch",
        "neck_yaw",
        "shoulder_l_roll",
        "elbow_l_flexion",
        "shoulder_r_roll",
        "elbow_r_flexion",
        "hip_l_roll",
        "knee_l_flexion",
        "hip_r_roll",
        "knee_r_flexion",
        "torso_pitch",  # the pelvis, part of the trunk
        "knee_l_flexion",  # the feet, parts of the calves
        "knee_r_flexion",
    ]


def test_waist_ankles_and_the_heads_turn_are_eight_more_degrees_of_freedom():
    s = SKELETON
    assert tuple(np.array(s.names)[~ADDED]) == PAPER.names
    assert (s.parent < np.arange(D)).all() and D == 32
    assert tuple(np.array(s.names)[s.is_waist]) == ROWS[WAIST].dof_names
    assert [s.names[k] for k in np.flatnonzero(s.is_by_landmarks)] == list(BY_LANDMARKS) == ["neck_roll"]
    turn = s.index("neck_roll")
    assert [SEGMENTS[k] for k in np.flatnonzero(s.ancestors[:, turn])] == ["head"]
    np.testing.assert_allclose(np.degrees([s.lower[turn], s.upper[turn]]), [-80.0, 80.0])
    legs = {"pelvis"} | {f"{segment}_{side}" for segment in ("thigh", "calf", "foot") for side in "lr"}
    moving = {WAIST: legs, "ankle_l": {"foot_l"}, "ankle_r": {"foot_r"}}
    for joint, segments in moving.items():
        moved = s.ancestors[:, np.isin(s.names, ROWS[joint].dof_names)]
        assert {SEGMENTS[k] for k in np.flatnonzero(moved.all(axis=1))} == segments
        assert (moved.any(axis=1) == moved.all(axis=1)).all()


def test_straight_waist_ankles_and_neck_change_nothing():
    poses = SKELETON.clip(np.random.default_rng(3).normal(0, 0.4, (20, D)))
    poses[:, ADDED] = 0
    found, expected = (s.segment_transforms(p) for s, p in ((SKELETON, poses), (PAPER, poses[:, ~ADDED])))
    np.testing.assert_allclose(found, expected, atol=EXACT)


@pytest.mark.parametrize("side", ["l", "r"])
def test_signs_of_the_ankles_are_anatomical(side):
    """Flexion lifts the toes, inversion turns the sole inwards; the limits are those of a foot."""
    skeleton = SKELETON
    foot = SEGMENTS.index(f"foot_{side}")

    def turned(name):
        pose = np.zeros(D)
        pose[skeleton.index(f"ankle_{side}_{name}")] = 0.2
        return skeleton.segment_transforms(pose)[foot][:3, :3]

    assert (turned("flexion") @ FORWARD)[2] == pytest.approx(np.sin(0.2))
    inward = -1 if side == "l" else 1
    assert (turned("inversion") @ -UP)[1] * inward == pytest.approx(np.sin(0.2))
    for name, low, high in (("flexion", -60, 40), ("inversion", -30, 40)):
        k = skeleton.index(f"ankle_{side}_{name}")
        np.testing.assert_allclose(np.degrees([skeleton.lower[k], skeleton.upper[k]]), [low, high])


@pytest.mark.parametrize("up", ["z", "-y"])
@given(seed=seeds)
@settings(max_examples=20)
def test_paper_pose_keeps_the_orientation_of_trunk_head_and_limbs(up, seed):
    skeleton, plain = (build_skeleton(DIMENSIONS, up, paper) for paper in (False, True))
    poses = skeleton.clip(np.random.default_rng(seed).normal(0, 0.5, (2, D)))
    turn = skeleton.index("neck_roll")
    np.testing.assert_array_equal(paper_poses(skeleton, poses), paper_poses(skeleton, poses * (np.arange(D) != turn)))
    poses[:, turn] = 0.0  # the paper's head does not turn
    paper = paper_poses(skeleton, poses)
    assert paper.shape == (2, 24)
    np.testing.assert_array_equal(paper[1], paper_poses(skeleton, poses[1]))
    R, R_paper = (s.segment_transforms(p)[..., :3, :3] for s, p in ((skeleton, poses), (plain, paper)))
    limbs = [SEGMENTS.index(s) for s in SEGMENTS if s != "pelvis" and not s.startswith("foot")]
    np.testing.assert_allclose(R_paper[:, limbs], R[:, limbs], atol=1e-9)
    # the waist moves the hip centres by less than its angle times their distance from it
    away = np.linalg.norm(plain.joints(paper) - skeleton.joints(poses), axis=-1).max(axis=1)
    assert (away < 0.25 * np.linalg.norm(poses[:, skeleton.is_waist], axis=1) + 1e-9).all()


def test_poses_of_another_skeleton_are_taken_by_name():
    pose = PAPER.clip(random_pose(3)[:24])
    full = convert_poses(pose, PAPER, SKELETON)
    assert not full[ADDED].any()
    np.testing.assert_array_equal(full[np.isin(SKELETON.names, PAPER.names)], pose)
    np.testing.assert_allclose(convert_poses(full, SKELETON, PAPER), pose, atol=1e-12)


def test_skeleton_is_found_by_the_names_of_its_pose_vector():
    for names in BODIES:
        assert skeleton_of_names(names, DIMENSIONS, "z").names == names
    with pytest.raises(ValueError, match="waist_pitch"):
        skeleton_of_names([name for name in SKELETON.names if name != "waist_pitch"], DIMENSIONS, "z")


@pytest.mark.parametrize("up", ["z", "-y"])
@given(seed=seeds)
@settings(max_examples=20)
def test_transforms_are_the_products_of_exponentials(up, seed):
    """T_k = T_parent(k) exp(ξ_k p_k), one after the other; a raised arm lifts its shoulder."""
    skeleton = build_skeleton(DIMENSIONS, up)
    pose = random_pose(seed)
    expected = []
    for k, parent in enumerate(skeleton.parent):
        step = np.eye(4)
        if skeleton.prismatic[k]:
            step[:3, 3] = skeleton.axis[k] * pose[k]
        else:
            w, q = skeleton.axis[k], skeleton.point[k]
            xi = np.zeros((4, 4))
            xi[:3] = np.column_stack([np.cross(np.eye(3), w), -np.cross(w, q)])
            step = expm(xi * pose[k])
        if skeleton.rise[k].any():
            step[:3, 3] += skeleton.rise[k] * arm_elevation(pose[k], pose[k + 1])
        expected.append(step if parent < 0 else expected[parent] @ step)
    np.testing.assert_allclose(skeleton.transforms(pose), expected, atol=1e-12)


def test_each_degree_of_freedom_belongs_to_torso_waist_or_one_chain():
    free = np.array([SKELETON.chain_dofs(c) for c in CHAINS])
    assert free.sum(axis=0).max() == 1
    assert free.sum(axis=1).tolist() == [3, 4, 4, 6, 6]
    assert [SKELETON.names[k] for k in np.flatnonzero(~free.any(axis=0))] == [
        "torso_x",
        "torso_y",
        "torso_z",
        "torso_yaw",
        "torso_roll",
        "torso_pitch",
        "waist_roll",
        "waist_pitch",
        "waist_yaw",
    ]
    for chain, moved in zip(CHAINS, free, strict=True):
        # a chain's degrees of freedom move its own segments and no others
        affected = SKELETON.ancestors[:, moved].any(axis=1)
        assert {s for s, a in zip(SEGMENTS, affected, strict=True) if a} == set(CHAINS[chain])


def test_ancestors_are_the_degrees_of_freedom_that_move_a_segment():
    pose = random_pose(0)
    before = SKELETON.segment_transforms(pose)
    for k in range(D):
        moved = np.abs(SKELETON.segment_transforms(pose + 0.1 * np.eye(D)[k]) - before).max(axis=(1, 2)) > 1e-9
        np.testing.assert_array_equal(moved, SKELETON.ancestors[:, k])


@given(seeds)
@many
def test_lengths_do_not_depend_on_the_pose(seed):
    d, j = DIMENSIONS, joints(random_pose(seed)[:24], PAPER)
    pelvis = (j["hip_l"] + j["hip_r"]) / 2
    np.testing.assert_allclose(j["pelvis"], pelvis, atol=EXACT)
    lengths = {("pelvis", "neck"): d.trunk, ("neck", "head_top"): d.head, ("hip_l", "hip_r"): 2 * d.hip_half_width}
    for s in "lr":
        lengths |= {(f"shoulder_{s}", f"elbow_{s}"): d.upper_arm, (f"elbow_{s}", f"wrist_{s}"): d.forearm}
        lengths |= {(f"hip_{s}", f"knee_{s}"): d.thigh, (f"knee_{s}", f"ankle_{s}"): d.calf}
    for (a, b), length in lengths.items():
        assert np.linalg.norm(j[a] - j[b]) == pytest.approx(length, abs=1e-12), (a, b)


def test_shoulders_rise_with_the_arms():
    """By the same amount from hanging to level as from level to upright; sideways or forward makes no difference."""
    heights = {}
    for name, direction in (("hanging", -UP), ("forward", FORWARD), ("sideways", LEFT), ("upright", UP)):
        pose = np.zeros(D)
        local = np.array([direction @ FORWARD, direction @ LEFT, direction @ UP])
        pose[SKELETON.index("shoulder_l_yaw")], pose[SKELETON.index("shoulder_l_pitch")] = shoulder_angles(local)
        heights[name] = joints(pose)["shoulder_l"] @ UP
    lift = RAISED_SHOULDERS * DIMENSIONS.trunk / FRACTIONS["trunk"]
    level = DIMENSIONS.trunk - DIMENSIONS.shoulder_drop
    np.testing.assert_allclose(list(heights.values()), [level - lift, level, level, level + lift], atol=1e-12)


@given(seeds)
@many
def test_twists_are_derivatives(seed):
    pose = random_pose(seed)
    x = SKELETON.joints(pose)
    w, v = SKELETON.twists(pose)
    h = 1e-6
    for k in range(D):
        step = h * np.eye(D)[k]
        numeric = (SKELETON.joints(pose + step) - SKELETON.joints(pose - step)) / (2 * h)
        moves = SKELETON.ancestors[SKELETON.joint_segment, k]
        np.testing.assert_allclose((np.cross(w[k], x) + v[k])[moves], numeric[moves], atol=1e-8)
        np.testing.assert_array_equal(numeric[~moves], 0)


@given(seeds)
@many
def test_point_jacobian_equals_finite_differences(seed):
    rng, pose = np.random.default_rng(seed), random_pose(seed)
    segment = rng.integers(0, len(SEGMENTS), 6).astype(np.int32)
    place, h = rng.normal(0, 0.5, (6, 3)), 1e-6
    found = SKELETON.point_jacobian(pose[None], segment, SKELETON.points(pose[None], segment, place))[0]
    steps = h * np.eye(D)
    numeric = (SKELETON.points(pose + steps, segment, place) - SKELETON.points(pose - steps, segment, place)) / (2 * h)
    np.testing.assert_allclose(found, np.moveaxis(numeric, 0, -1), atol=1e-7)


# Anatomy: which way is positive


def test_zero_configuration():
    j = joints(np.zeros(D))
    diagonal = (FORWARD + LEFT) / np.sqrt(2)
    np.testing.assert_allclose(j["wrist_l"] - j["shoulder_l"], (DIMENSIONS.upper_arm + DIMENSIONS.forearm) * diagonal)
    np.testing.assert_allclose(j["ankle_r"] - j["hip_r"], -(DIMENSIONS.thigh + DIMENSIONS.calf) * UP, atol=EXACT)
    assert j["shoulder_l"] @ LEFT > 0 > j["shoulder_r"] @ LEFT


@pytest.mark.parametrize("side", ["l", "r"])
def test_signs_are_anatomical(side):
    rest, outward = joints(np.zeros(D)), LEFT if side == "l" else -LEFT

    def moved(joint, **degrees):
        return joints(posed(**degrees))[joint] - rest[joint]

    assert moved(f"ankle_{side}", **{f"knee_{side}_flexion": 60}) @ FORWARD < -0.1, "knees bend backwards"
    assert moved(f"knee_{side}", **{f"hip_{side}_pitch": -60}) @ FORWARD > 0.1, "hip flexion is negative pitch"
    assert moved(f"knee_{side}", **{f"hip_{side}_yaw": 30}) @ outward > 0.1, "abduction is positive yaw"
    assert moved("head_top", neck_pitch=30) @ FORWARD > 0.05, "a nod is positive pitch"
    assert moved("head_top", neck_yaw=20) @ LEFT < -0.05, "the neck bends to the right with positive yaw"
    assert moved("head_top", torso_pitch=30) @ FORWARD > 0.1, "a bow is positive pitch"
    assert moved("hip_l", torso_roll=10) @ UP > 0.01, "the left side rises with positive roll"
    assert moved("hip_l", torso_yaw=20) @ FORWARD < -0.02, "a turn to the left is positive yaw"
    nose = SKELETON.segment_transforms(posed(neck_roll=30))[SEGMENTS.index("head"), :3, :3] @ FORWARD
    assert nose @ LEFT == pytest.approx(0.5), "a turn of the head to the left is positive"


@pytest.mark.parametrize("side", ["l", "r"])
@pytest.mark.parametrize(("arm", "towards"), [("hanging", FORWARD), ("raised", None)])
def test_elbow_bends_forward_when_the_arm_hangs_and_inward_when_it_is_raised(side, arm, towards):
    """By more than 45° at zero twist: where a bend begins that the optimiser knows nothing about."""
    towards = (-LEFT if side == "l" else LEFT) if towards is None else towards
    along = -UP if arm == "hanging" else UP
    yaw, pitch = np.degrees(shoulder_angles(along))
    angles = {f"shoulder_{side}_yaw": yaw, f"shoulder_{side}_pitch": pitch}
    straight, bent = joints(posed(**angles)), joints(posed(**angles, **{f"elbow_{side}_flexion": 90}))
    elbow, wrist = f"elbow_{side}", f"wrist_{side}"
    np.testing.assert_allclose(straight[wrist] - straight[elbow], DIMENSIONS.forearm * along, atol=1e-9)
    bend = (bent[wrist] - bent[elbow]) / DIMENSIONS.forearm
    assert abs(bend @ along) < 1e-9 and bend @ towards > np.cos(np.pi / 4)


@pytest.mark.parametrize("side", ["l", "r"])
@pytest.mark.parametrize(("ball", "end"), [("shoulder", "elbow"), ("hip", "knee")])
def test_ball_joints_turn_about_three_perpendicular_axes_the_last_along_the_limb(ball, end, side):
    rows = [k for k, name in enumerate(SKELETON.names) if name.startswith(f"{ball}_{side}_")]
    axis, j = SKELETON.axis[rows], joints(np.zeros(D))
    np.testing.assert_allclose(axis @ axis.T, np.eye(3), atol=1e-12)
    limb = j[f"{end}_{side}"] - j[f"{ball}_{side}"]
    assert abs(axis[-1] @ limb) == pytest.approx(np.linalg.norm(limb))


# Limits


def test_limits_hold_the_zero_and_the_neutral_pose():
    for pose in (np.zeros(D), neutral_pose(SKELETON)):
        np.testing.assert_array_equal(SKELETON.clip(pose), pose)
    assert (SKELETON.lower < SKELETON.upper).all()
    assert np.isinf(SKELETON.upper[SKELETON.prismatic]).all()


@given(seeds)
@many
def test_clip_is_a_projection(seed):
    poses = np.random.default_rng(seed).uniform(-6, 6, (5, D))
    clipped = SKELETON.clip(poses)
    assert ((clipped >= SKELETON.lower) & (clipped <= SKELETON.upper)).all()
    np.testing.assert_array_equal(SKELETON.clip(clipped), clipped)
    inside = (poses >= SKELETON.lower) & (poses <= SKELETON.upper)
    np.testing.assert_array_equal(clipped[inside], poses[inside])


def arm_directions(plane, degrees):
    """Unit vectors (forward, outward, up) of an arm raised by these angles from hanging, or swung from sideways."""
    t = np.radians(degrees)
    zero, one = np.zeros_like(t), np.ones_like(t)
    return {
        "sagittal": np.stack([np.sin(t), zero, -np.cos(t)], -1),
        "frontal": np.stack([zero, np.sin(t), -np.cos(t)], -1),
        "horizontal": np.stack([np.sin(t), np.cos(t), zero * one], -1),
    }[plane]


@pytest.mark.parametrize(
    ("plane", "lower", "upper"),
    [("sagittal", -62, 167), ("frontal", 0, 184), ("horizontal", -45, 141)],
    ids=["flexion", "abduction", "horizontal adduction"],
)
@pytest.mark.parametrize("side", ["l", "r"])
def test_limits_hold_the_shoulders_clinical_range(plane, lower, upper, side):
    """Boone & Azen's mean active ranges and 10° beyond, as directions of the arm; and the angles lead there."""
    yaw, pitch = SKELETON.index(f"shoulder_{side}_yaw"), SKELETON.index(f"shoulder_{side}_pitch")
    outward = LEFT if side == "l" else -LEFT
    for direction in arm_directions(plane, np.linspace(lower - 10, upper + 10, 60)):
        pose = np.zeros(D)
        pose[yaw], pose[pitch] = shoulder_angles(direction)
        np.testing.assert_array_equal(SKELETON.clip(pose), pose)
        j = joints(pose)
        arm = (j[f"elbow_{side}"] - j[f"shoulder_{side}"]) / DIMENSIONS.upper_arm
        np.testing.assert_allclose(arm, direction @ [FORWARD, outward, UP], atol=1e-12)


@given(st.floats(-180, 180), st.floats(-90, 90))
@many
def test_only_a_cone_about_the_singular_diagonal_is_out_of_reach(azimuth, elevation):
    a, e = np.radians([azimuth, elevation])
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    pose = np.zeros(D)
    yaw, pitch = SKELETON.index("shoulder_l_yaw"), SKELETON.index("shoulder_l_pitch")
    pose[yaw], pose[pitch] = shoulder_angles(direction)
    from_diagonal = np.degrees(np.arccos(np.clip(np.abs(direction @ [-1, 1, 1]) / np.sqrt(3), 0, 1)))
    reachable = (SKELETON.clip(pose) == pose).all()
    assert reachable or from_diagonal < 10 + 1e-6


def test_the_singular_diagonal_lies_apart_from_plain_directions():
    """54° from hanging, raised, forward, backward and sideways, as the module says."""
    pole = SKELETON.axis[SKELETON.index("shoulder_l_yaw")]
    for plain in (-UP, UP, FORWARD, -FORWARD, LEFT):
        assert np.degrees(np.arccos(abs(pole @ plain))) > 54


# Mirror symmetry


@given(seeds)
@many
def test_mirrored_pose_gives_mirrored_joints(seed):
    pose = random_pose(seed)
    there = joints(mirrored(pose))
    for name, x in joints(pose).items():
        partner = name[:-1] + {"l": "r", "r": "l"}[name[-1]] if name[-2:] in ("_l", "_r") else name
        np.testing.assert_allclose(there[partner], x * [1, -1, 1], rtol=0, atol=EXACT, err_msg=name)
    np.testing.assert_array_equal(mirrored(mirrored(pose)), pose)


def test_limits_are_mirror_symmetric():
    spans = mirrored(SKELETON.upper), mirrored(SKELETON.lower)
    np.testing.assert_array_equal(np.maximum(*spans)[3:], SKELETON.upper[3:])
    np.testing.assert_array_equal(np.minimum(*spans)[3:], SKELETON.lower[3:])


# Up


def test_poses_of_a_long_recording_are_placed_like_single_ones():
    few = np.array([random_pose(seed) for seed in range(7)])
    many = np.tile(few, (300, 1))
    np.testing.assert_allclose(SKELETON.joints(many), np.tile(SKELETON.joints(few), (300, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(
        SKELETON.segment_transforms(many), np.tile(SKELETON.segment_transforms(few), (300, 1, 1, 1)), atol=1e-14
    )
