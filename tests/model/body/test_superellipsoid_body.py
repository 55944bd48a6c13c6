"""The superellipsoid body: pieces against the cone body's parts, samples, patches, mirror symmetry."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.body.test_skeleton import UPS, mirrored
from tests.model.figures import skin_of
from tk.kernels.cones import CONE
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.skeleton import JOINTS, SEGMENTS, up_rotation
from tk.model.body.superellipsoid_body import piece_of

DIMENSIONS = BodyDimensions.from_stature(1.75)
CONES = build_cone_body(DIMENSIONS)
BODY = skin_of(DIMENSIONS)
PIECE_SEGMENT = np.array([SEGMENTS.index(p.segment) for p in BODY.pieces])
seeds = st.integers(0, 2**32 - 1)


def in_piece(body, index, points, pose):
    """World points (N, 3) in the frame of a piece at a pose."""
    B = np.eye(4)
    B[:3, :3] = body.skeleton.T_world_body
    piece = body.pieces[index]
    T = np.linalg.inv(body.skeleton.segment_transforms(pose)[SEGMENTS.index(piece.segment)] @ B @ piece.T_body_piece)
    return points @ T[:3, :3].T + T[:3, 3]


def profile(piece, z):
    """The semi-axes of a piece's section at a height of its frame."""
    (a1, a2, _), ring = piece.radii, (1 - abs(z / piece.radii[2]) ** (2 / piece.e1)) ** (piece.e1 / 2)
    return np.array([a1, a2]) * ring


@pytest.mark.parametrize("m", [0.5, 0.8, 1.0, 1.3])
def test_limb_has_the_ends_of_its_cone_and_nearly_straight_sides(m):
    part = replace(CONES.parts[[p.name for p in CONES.parts].index("thigh_l")], shape=(0.1, 0.08, 0.4, m))
    piece = piece_of(part)
    for at, factor in ((0.0, 1.0), (0.5, 0.5 * (1 + m)), (1.0, m)):
        z = piece.z_lower + at * 0.4
        tolerance = 0.09 if at == 0.5 else 1e-9
        np.testing.assert_allclose(profile(piece, z), np.array([0.1, 0.08]) * factor, rtol=tolerance)
        there = piece.T_body_piece @ [0, 0, z, 1]
        np.testing.assert_allclose(there, part.T_body_part @ [0, 0, at * 0.4, 1], atol=1e-12)
    assert piece.z_upper - piece.z_lower == pytest.approx(0.4)


def test_every_part_has_a_piece_at_its_place():
    parts = [part for part in CONES.parts if part.has_contours]
    assert [piece.segment for piece in BODY.pieces] == [part.segment for part in parts]
    for part, piece in zip(parts, BODY.pieces, strict=True):
        h = part.shape[2]
        middle = part.T_body_part @ [0, 0, 0.5 * h if part.kind == CONE else 0.0, 1]
        np.testing.assert_allclose(
            piece.T_body_piece @ [0, 0, 0.5 * (piece.z_lower + piece.z_upper), 1], middle, atol=1e-12
        )
        if part.name.startswith(("hand", "foot", "head")):  # closed: nothing is cut
            assert (piece.z_lower, piece.z_upper) == (-piece.radii[2], piece.radii[2])


def test_samples_have_the_segment_of_their_piece():
    np.testing.assert_array_equal(PIECE_SEGMENT[BODY.piece], BODY.segment)
    assert set(BODY.segment) == set(range(len(SEGMENTS)))


@given(seeds)
@settings(max_examples=10)
def test_samples_lie_on_their_pieces_at_any_pose(seed):
    pose = np.random.default_rng(seed).uniform(-np.pi, np.pi, len(BODY.skeleton.names))
    points = BODY.place(pose)
    for i, piece in enumerate(BODY.pieces):
        mine = BODY.piece == i
        q = in_piece(BODY, i, points[mine], pose)
        np.testing.assert_allclose(piece.inside_outside(q), 1, atol=1e-8)
        assert q[:, 2].min() > piece.z_lower - 1e-9 and q[:, 2].max() < piece.z_upper + 1e-9


def test_only_buried_samples_and_the_crotch_are_removed():
    """In the neutral pose the samples are all those outside other pieces."""
    pose = neutral_pose(BODY.skeleton)
    T = BODY.skeleton.segment_transforms(pose)
    points = BODY.place(pose)
    kept = buried = 0
    for i, piece in enumerate(BODY.pieces):
        at = piece.samples(0.03)
        p = piece.point(*at) @ piece.T_body_piece[:3, :3].T + piece.T_body_piece[:3, 3]
        p = p @ T[PIECE_SEGMENT[i], :3, :3].T + T[PIECE_SEGMENT[i], :3, 3]
        others = [j for j in range(len(BODY.pieces)) if j != i]
        hidden = np.any([BODY.pieces[j].contains(in_piece(BODY, j, p, pose)) for j in others], axis=0)
        downward = (piece.normal(*at) @ piece.T_body_piece[:3, :3].T)[:, 2] < -0.3
        shown = ~hidden & ~(downward & (piece.segment == "pelvis"))
        np.testing.assert_allclose(points[BODY.piece == i], p[shown], atol=1e-9)
        kept, buried = kept + np.sum(shown), buried + np.sum(hidden)
    assert kept == len(BODY.points) and buried > 50


def test_patches_fit_an_integer_of_63_bits_and_cover_the_body():
    assert len(BODY.patch_names) == len(set(BODY.patch_names)) <= 63
    assert sorted(set(BODY.patch)) == list(range(len(BODY.patch_names)))
    for patch, name in enumerate(BODY.patch_names):
        mine = BODY.patch == patch
        assert {SEGMENTS[s] for s in BODY.segment[mine]} == {name.removesuffix("_front").removesuffix("_back")[:-2]}
        if name.endswith("_front"):
            behind = BODY.patch == BODY.patch_names.index(name.replace("_front", "_back"))
            assert BODY.points[mine, 0].mean() > BODY.points[behind, 0].mean() + 0.05


@pytest.mark.parametrize("stature", [1.2, 1.6, 2.0])
def test_patches_do_not_depend_on_the_stature(stature):
    assert skin_of(BodyDimensions.from_stature(stature)).patch_names == BODY.patch_names


def mirror_pieces():
    """Index of each piece's mirror image: the same rank in the mirrored segment."""
    swap = {name: name.replace("_l", "_#").replace("_r", "_l").replace("_#", "_r") for name in SEGMENTS}
    ranks = [sum(q.segment == p.segment for q in BODY.pieces[:i]) for i, p in enumerate(BODY.pieces)]
    places = {(p.segment, rank): i for i, (p, rank) in enumerate(zip(BODY.pieces, ranks, strict=True))}
    return [places[swap[p.segment], rank] for p, rank in zip(BODY.pieces, ranks, strict=True)]


@given(seeds)
@settings(max_examples=10)
def test_mirrored_pose_gives_the_mirrored_surface(seed):
    """Every sample, reflected, lies on the partner of its piece at the reflected pose."""
    pose = np.random.default_rng(seed).uniform(-np.pi, np.pi, len(BODY.skeleton.names))
    there = mirrored(pose, BODY.skeleton)
    points = BODY.place(pose)
    partners = mirror_pieces()
    for i in range(len(BODY.pieces)):
        q = in_piece(BODY, partners[i], points[BODY.piece == i] * [1, -1, 1], there)
        np.testing.assert_allclose(BODY.pieces[partners[i]].inside_outside(q), 1, atol=1e-8)


@pytest.mark.parametrize("up", UPS)
def test_another_up_direction_gives_the_rotated_body(up):
    body, B = skin_of(DIMENSIONS, up), up_rotation(up)
    np.testing.assert_allclose(body.points, BODY.points @ B.T, atol=1e-12)
    np.testing.assert_array_equal(body.patch, BODY.patch)
    pose = neutral_pose(BODY.skeleton)
    np.testing.assert_allclose(body.place(pose), BODY.place(pose) @ B.T, atol=1e-12)


def test_neutral_pose_is_the_da_vinci_pose():
    """Upright, arms level and sideways, legs 15° apart from the vertical, toes forward."""
    pose = neutral_pose(BODY.skeleton)
    j = dict(zip(JOINTS, BODY.skeleton.joints(pose), strict=True))
    for side, outward in (("l", 1.0), ("r", -1.0)):
        arm = j[f"wrist_{side}"] - j[f"shoulder_{side}"]
        np.testing.assert_allclose(arm / np.linalg.norm(arm), [0, outward, 0], atol=1e-9)
        leg = j[f"ankle_{side}"] - j[f"hip_{side}"]
        tilt = np.radians(15)
        np.testing.assert_allclose(leg / np.linalg.norm(leg), [0, outward * np.sin(tilt), -np.cos(tilt)], atol=1e-9)
    np.testing.assert_allclose(j["head_top"] - j["pelvis"], [0, 0, DIMENSIONS.trunk + DIMENSIONS.head], atol=1e-9)


def test_surface_reaches_from_the_sole_to_the_crown():
    z = BODY.place(np.zeros(len(BODY.skeleton.names)))[:, 2]
    assert z.max() - z.min() == pytest.approx(DIMENSIONS.stature, abs=0.02)


def test_number_of_samples_follows_the_spacing():
    counts = [len(skin_of(DIMENSIONS, spacing_m=s).points) for s in (0.02, 0.04)]
    assert counts[0] / counts[1] == pytest.approx(4, rel=0.15)


def test_every_piece_has_a_rigid_frame():
    for piece in BODY.pieces:
        R = piece.T_body_piece[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
