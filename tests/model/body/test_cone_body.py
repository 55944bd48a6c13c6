"""The cone body: its parts and symmetry."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.figures import BODY, DIMENSIONS, surface_points
from tk.errors import ConfigError
from tk.kernels.cone_arrays import MOST_PARTS, PART_DOF, PART_FRAME
from tk.kernels.cones import CONE, ELLIPSOID
from tk.model.body.anthropometry import HAIR, BodyDimensions
from tk.model.body.cone_body import SHAPE_NUMBERS, ConePart, build_cone_body, part_arrays
from tk.model.body.gait_poses import standing_pose, walking_pose
from tk.model.body.skeleton import JOINTS, build_skeleton


def surface_of(part: ConePart) -> np.ndarray:
    """Unscaled coordinates of points of the rims, or of the ellipsoid's poles."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    if part.kind == ELLIPSOID:
        return np.vstack([np.column_stack([ring, 0 * angle]), [[0, 0, 1], [0, 0, -1]]])
    return np.vstack([np.column_stack([ring, 0 * angle]), np.column_stack([ring, 1 + 0 * angle])])


def points_of(body, pose):
    pieces = [surface_of(part) for part in body.parts]
    owner = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    return owner, surface_points(body, pose, owner, np.concatenate(pieces))


def test_components_are_those_of_the_paper_and_the_pelvis():
    assert len({part.component for part in BODY.parts}) == 15
    assert [part.component for part in BODY.parts if part.kind == ELLIPSOID] == ["head", "thigh_l", "thigh_r"]


def test_a_bent_knee_is_round_and_its_ball_has_no_contours():
    pose = standing_pose(BODY.skeleton)
    pose[BODY.skeleton.index("knee_l_flexion")] = np.radians(120)
    owner, points = points_of(BODY, pose)
    names = [part.name for part in BODY.parts]
    knee = BODY.skeleton.joints(pose)[JOINTS.index("knee_l")]
    out = np.array([0.5, 0.0, -np.sqrt(0.75)])  # halfway between the axes of thigh and calf, away from both
    reach = {n: ((points[owner == names.index(n)] - knee) @ out).max() for n in ("thigh_l", "calf_l", "knee_l")}
    assert max(reach["thigh_l"], reach["calf_l"]) + 0.01 < reach["knee_l"] < DIMENSIONS.knee_radius
    drawn = {names[p] for p in BODY.arrays.curves[:, 0]}
    assert set(names) - drawn == {"knee_l", "knee_r"}


def test_standing_body_has_the_stature_of_its_dimensions():
    pose = standing_pose(BODY.skeleton)
    for name in ("knee_l_flexion", "knee_r_flexion"):
        pose[BODY.skeleton.index(name)] = 0.0
    z = points_of(BODY, pose)[1][:, 2]
    assert np.ptp(z) == pytest.approx(DIMENSIONS.stature + HAIR * 1.75, abs=0.01)


def test_frames_of_parts_are_rotations():
    for part in BODY.parts:
        R = part.T_body_part[:3, :3]
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12, err_msg=part.name)
        assert np.linalg.det(R) > 0


def test_left_and_right_are_mirror_images():
    owner, points = points_of(BODY, walking_pose(BODY.skeleton, 0.3))
    _, other = points_of(BODY, walking_pose(BODY.skeleton, 0.8))
    names = [part.name for part in BODY.parts]
    for p, name in enumerate(names):
        twin = names.index(name.replace("_l", "_?").replace("_r", "_l").replace("_?", "_r"))
        a = points[owner == p] * [1, -1, 1]
        b = other[owner == twin]
        # mirrored rings have the opposite order
        nearest = np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1)
        assert nearest.max() < 1e-9


def test_axes_of_limbs_end_near_joints():
    pose = walking_pose(BODY.skeleton, 0.6)
    joints = dict(zip(JOINTS, BODY.skeleton.joints(pose), strict=True))
    ends = {"upper_arm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"), "thigh": ("hip", "knee")}
    for p, part in enumerate(BODY.parts):
        limb, _, side = part.name.rpartition("_")
        if limb in ends:
            axis = surface_points(BODY, pose, np.array([p, p]), np.array([[0, 0, 0.0], [0, 0, 1.0]]))
            expected = [joints[f"{joint}_{side}"] for joint in ends[limb]]
            # a thigh's surface lies in front of the hip and behind the knee, an arm's in the elbow's crook
            offset = (0.02 if limb == "thigh" else 0.003) * DIMENSIONS.stature
            np.testing.assert_allclose(axis, expected, atol=offset)


def test_packed_frames_place_parts_like_the_body():
    packed = BODY.pack(np.float64)
    pose = walking_pose(BODY.skeleton, 0.1)
    T = BODY.skeleton.transforms(pose)
    for p, part in enumerate(BODY.parts):
        unscaled = surface_of(part)
        owner = np.full(len(unscaled), p)
        local = BODY.local(owner, unscaled)
        own = packed.parts[p, PART_FRAME : PART_FRAME + 12].reshape(3, 4)
        frame = T[int(packed.parts[p, PART_DOF])] @ np.vstack([own, [0, 0, 0, 1]])
        expected = surface_points(BODY, pose, owner, unscaled)
        np.testing.assert_allclose(local @ frame[:3, :3].T + frame[:3, 3], expected, atol=1e-12)


def test_impossible_size_is_refused():
    with pytest.raises(ConfigError, match="part spike"):
        ConePart("spike", "torso", CONE, (0.1, 0.1, -1.0, 1.0), np.eye(4))


def test_body_with_too_many_parts_for_the_kernels_is_refused():
    parts = BODY.parts * (MOST_PARTS // len(BODY.parts) + 1)
    with pytest.raises(ConfigError, match=f"{len(parts)} parts"):
        replace(BODY, parts=parts).pack(np.float32)
    assert len(replace(BODY, parts=parts[:MOST_PARTS]).pack(np.float32).parts) == MOST_PARTS


@pytest.mark.parametrize("up", ["z", "x"])
def test_many_bodies_at_once_equal_each_alone(up):
    rng = np.random.default_rng(4)
    values = DIMENSIONS.values * np.exp(rng.normal(0, 0.1, (5, len(DIMENSIONS.values))))
    change = rng.normal(0, 0.02, (len(BODY.shape_groups), SHAPE_NUMBERS))
    several = BodyDimensions.of(values)
    np.testing.assert_array_equal(several.values, values)
    shapes, frames = BODY.reshape(*part_arrays(several), change)
    skeletons = build_skeleton(several, up)
    for n, row in enumerate(values):
        alone = build_cone_body(BodyDimensions.of(row), up).reshaped(change)
        np.testing.assert_allclose(shapes[n], alone.shape, rtol=1e-14)
        np.testing.assert_allclose(frames[n], [part.T_body_part for part in alone.parts], atol=1e-14)
        for name in ("point", "rise", "joint_position"):
            expected = getattr(alone.skeleton, name)
            np.testing.assert_allclose(getattr(skeletons, name)[n], expected, atol=1e-14, err_msg=name)


def test_an_impossible_dimension_of_one_of_many_bodies_is_named():
    values = np.tile(DIMENSIONS.values, (3, 1))
    values[1, 9] = -0.4
    with pytest.raises(ConfigError, match=r"body dimension calf = -0.4 m must lie between"):
        BodyDimensions.of(values)
