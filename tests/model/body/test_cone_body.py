"""The cone body: its parts, presets and symmetry."""

from dataclasses import replace

import numpy as np
import pytest

from tk.errors import ConfigError
from tk.kernels.cone_arrays import MOST_PARTS, PART_DOF, PART_FRAME
from tk.kernels.cones import CONE, ELLIPSOID
from tk.model.body.anthropometry import HAIR, BodyDimensions
from tk.model.body.cone_body import PRESETS, ConePart, build_cone_body
from tk.model.body.gait_poses import standing_pose, walking_pose
from tk.model.body.skeleton import JOINTS, up_rotation

DIMENSIONS = BodyDimensions.from_stature(1.75)


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
    return owner, body.place(pose, owner, np.concatenate(pieces))


@pytest.mark.parametrize(("preset", "components"), [("full", 15), ("limbs", 10), ("walker", 6)])
def test_presets_have_the_papers_components(preset, components):
    """The full body has one more: the pelvis."""
    body = build_cone_body(DIMENSIONS, preset=preset)
    assert len({part.component for part in body.parts}) == components
    assert [part.component for part in body.parts if part.kind == ELLIPSOID] == ["head"]


def test_walker_has_the_papers_seven_degrees_of_freedom():
    body = build_cone_body(DIMENSIONS, preset="walker")
    free = {name for name, is_free in zip(body.skeleton.names, body.free, strict=True) if is_free}
    legs = {f"{joint}_{side}_{axis}" for joint, axis in (("hip", "pitch"), ("knee", "flexion")) for side in "lr"}
    assert free == {"torso_x", "torso_y", "torso_z", *legs}
    assert build_cone_body(DIMENSIONS).free.all()


@pytest.mark.parametrize("preset", PRESETS)
def test_standing_body_has_the_stature_of_its_dimensions(preset):
    body = build_cone_body(DIMENSIONS, preset=preset)
    pose = standing_pose(body.skeleton)
    for name in ("knee_l_flexion", "knee_r_flexion"):
        pose[body.skeleton.index(name)] = 0.0
    z = points_of(body, pose)[1][:, 2]
    hair = HAIR * 1.75 if preset == "full" else 0.0
    assert np.ptp(z) == pytest.approx(DIMENSIONS.stature + hair, abs=0.01)


@pytest.mark.parametrize("preset", PRESETS)
def test_frames_of_parts_are_rotations(preset):
    for part in build_cone_body(DIMENSIONS, preset=preset).parts:
        R = part.T_body_part[:3, :3]
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12, err_msg=part.name)
        assert np.linalg.det(R) > 0


def test_left_and_right_are_mirror_images():
    body = build_cone_body(DIMENSIONS)
    owner, points = points_of(body, walking_pose(body.skeleton, 0.3))
    _, other = points_of(body, walking_pose(body.skeleton, 0.8))
    names = [part.name for part in body.parts]
    for p, name in enumerate(names):
        twin = names.index(name.replace("_l", "_?").replace("_r", "_l").replace("_?", "_r"))
        a = points[owner == p] * [1, -1, 1]
        b = other[owner == twin]
        # mirrored rings have the opposite order
        nearest = np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1)
        assert nearest.max() < 1e-9


def test_axes_of_limbs_end_near_joints():
    body = build_cone_body(DIMENSIONS)
    pose = walking_pose(body.skeleton, 0.6)
    joints = dict(zip(JOINTS, body.skeleton.joints(pose), strict=True))
    ends = {"upper_arm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"), "thigh": ("hip", "knee")}
    for p, part in enumerate(body.parts):
        limb, _, side = part.name.rpartition("_")
        if limb in ends:
            axis = body.place(pose, np.array([p, p]), np.array([[0, 0, 0.0], [0, 0, 1.0]]))
            expected = [joints[f"{joint}_{side}"] for joint in ends[limb]]
            # a thigh's surface lies in front of the hip and behind the knee, an arm's in the elbow's crook
            offset = (0.02 if limb == "thigh" else 0.003) * DIMENSIONS.stature
            np.testing.assert_allclose(axis, expected, atol=offset)


def test_body_turns_with_the_up_direction():
    upright, lying = build_cone_body(DIMENSIONS), build_cone_body(DIMENSIONS, up="y")
    pose = np.zeros(len(upright.skeleton.names))
    _, a = points_of(upright, pose)
    _, b = points_of(lying, pose)
    np.testing.assert_allclose(a @ up_rotation("y").T, b, atol=1e-12)


def test_packed_frames_place_parts_like_the_body():
    body = build_cone_body(DIMENSIONS)
    packed = body.pack(np.float64)
    pose = walking_pose(body.skeleton, 0.1)
    T = body.skeleton.transforms(pose)
    for p, part in enumerate(body.parts):
        local = part.surface(surface_of(part))
        own = packed.parts[p, PART_FRAME : PART_FRAME + 12].reshape(3, 4)
        frame = T[int(packed.parts[p, PART_DOF])] @ np.vstack([own, [0, 0, 0, 1]])
        expected = body.place(pose, np.full(len(local), p), surface_of(part))
        np.testing.assert_allclose(local @ frame[:3, :3].T + frame[:3, 3], expected, atol=1e-12)


def test_unknown_preset_and_impossible_size_are_refused():
    with pytest.raises(ConfigError, match="choose one of full, limbs, walker"):
        build_cone_body(DIMENSIONS, preset="stick")
    with pytest.raises(ConfigError, match="part spike"):
        ConePart("spike", "torso", CONE, (0.1, 0.1, -1.0, 1.0), np.eye(4))


def test_body_with_too_many_parts_for_the_kernels_is_refused():
    body = build_cone_body(DIMENSIONS)
    parts = body.parts * (MOST_PARTS // len(body.parts) + 1)
    with pytest.raises(ConfigError, match=f"{len(parts)} parts"):
        replace(body, parts=parts).pack(np.float32)
    assert len(replace(body, parts=parts[:MOST_PARTS]).pack(np.float32).parts) == MOST_PARTS
