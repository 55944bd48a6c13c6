"""Occluding contours: against eqs. 3-5 in NumPy, a sphere's known rim, finite differences of the projection."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernels.test_occlusion import camera_at, random_pose
from tests.model.figures import DIMENSIONS, piece_transforms, skin_of
from tk.kernels.contour import ContourKernel
from tk.kernels.projection import pack_cameras
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.strips import CIRCLES, Strips, build_strips, limb_pieces
from tk.model.cameras.camera import Camera, Rig

BODY = skin_of(DIMENSIONS, up="-y")
STRIPS = build_strips(BODY, range(len(BODY.pieces)))
LIMB_PIECES = limb_pieces(BODY)
ALL = np.arange(len(STRIPS.piece))[None]

# double precision; the kernel's powers are exp(e log |b|) with |b| held above 1e-6
EXACT_M, EXACT_PX = 1e-7, 1e-4
# float32 of coordinates of some metres, and of pixels of some hundred
SINGLE_M, SINGLE_PX = 2e-5, 0.02
# eq. 5 on strips of 32 steps: how far its point is from the rim of eq. 3
INTERPOLATION_LIMB_M = 5e-4
# the same on the box-like trunk, along its flat sides
INTERPOLATION_M = 6e-3


def cameras() -> Rig:
    """Four views with y down: pinhole, barrel distortion, fisheye, and one close overhead."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up to y down
    result = []
    for position, distortions, fisheye in (
        ([3, 0, 1.2], np.zeros(5), False),
        ([-1, 2.5, 1.8], np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01]), False),
        ([-2, -3, 0.6], np.array([0.02, -0.01, 3e-3, -1e-3]), True),
        ([0.3, 0.2, 3.2], np.array([-0.1, 0.02, 0, 0]), False),
    ):
        c = camera_at(position)
        result.append(replace(c, distortions=distortions, fisheye=fisheye, rotation=c.rotation @ turn.T))
    return Rig(tuple(result))


RIG = cameras()


def some_poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = np.array([random_pose(BODY.skeleton, rng) for _ in range(count)])
    poses[:, :3] = np.column_stack([poses[:, 0], -poses[:, 2], poses[:, 1]])
    return poses


def contour_kernel(body, strips: Strips, rig: Rig, dtype=np.float32) -> ContourKernel:
    return ContourKernel(body.arrays, strips.angles, strips.normals, strips.piece, pack_cameras(rig), dtype)


def even(count: int) -> np.ndarray:
    """``count`` strips of each limb."""
    within = ((np.arange(count) + 0.5) * CIRCLES / count).astype(int)
    return np.concatenate([i * CIRCLES + within for i in LIMB_PIECES])


@pytest.fixture(scope="module")
def kernel():
    return contour_kernel(BODY, STRIPS, RIG, np.float64)


def world_points(points, pose, b):
    """(C, K, 2, 3): the material points of pose b, carried along by the skeleton."""
    segment = [SEGMENTS.index(BODY.pieces[i].segment) for i in STRIPS.piece[points.strip[b]]]
    T = BODY.skeleton.segment_transforms(pose)[segment]
    return np.einsum("kij,cksj->cksi", T[:, :3, :3], points.points_zero[b]) + T[None, :, None, :3, 3]


def eq5(piece, angles, camera):
    """{slot: (η, ω)} of one strip: compare the signs of n·v along it, interpolate. ``camera`` in the piece's frame."""
    r, n = piece.point(angles[:, 0], angles[:, 1]), piece.normal(angles[:, 0], angles[:, 1])
    # n_d is longer than the unit normal: its length is what makes n_d · r = 1
    t = np.sum(n * (r - camera), axis=1) / np.sum(n * r, axis=1)
    found = {}
    for i in np.flatnonzero((t[:-1] < 0) != (t[1:] < 0)):
        a, b = abs(t[i]), abs(t[i + 1])
        found[0 if t[i + 1] < 0 else 1] = (angles[i] * b + angles[i + 1] * a) / (a + b)
    return found


def test_points_are_those_of_equation_5(kernel):
    pose = some_poses(1, seed=1)
    points = kernel(pose, ALL)
    T = piece_transforms(BODY, pose[0])
    p_world = world_points(points, pose[0], 0)
    for c, camera in enumerate(RIG):
        for s in range(0, len(STRIPS.piece), 3):
            i = STRIPS.piece[s]
            piece = BODY.pieces[i]
            local = T[i][:3, :3].T @ (camera.center - T[i][:3, 3])
            expected = eq5(piece, STRIPS.angles[s], local)
            assert list(points.found[0, c, s]) == [slot in expected for slot in (0, 1)]
            for slot, u in expected.items():
                x = T[i][:3, :3] @ piece.point(*u) + T[i][:3, 3]
                np.testing.assert_allclose(p_world[c, s, slot], x, rtol=0, atol=EXACT_M)
                np.testing.assert_allclose(points.pixels[0, c, s, slot], camera.project(x)[0][0], rtol=0, atol=EXACT_PX)
    assert 0.3 < points.found.mean() <= 1


def test_points_lie_on_the_rim_with_full_perspective(kernel):
    """How far along its strip each point is from where n·v = 0, by a search forty times as fine."""
    pose = some_poses(1, seed=2)
    points = kernel(pose, ALL)
    T = piece_transforms(BODY, pose[0])
    p_world = world_points(points, pose[0], 0)
    worst, worst_limb = 0.0, 0.0
    for c, center in enumerate(RIG.centers):
        for s in range(0, len(STRIPS.piece), 7):
            i = STRIPS.piece[s]
            piece, angles = BODY.pieces[i], STRIPS.angles[s]
            fine = np.linspace(angles[0], angles[-1], 40 * (len(angles) - 1) + 1)
            local = T[i][:3, :3].T @ (center - T[i][:3, 3])
            exact = eq5(piece, fine, local)
            if len(exact) != points.found[0, c, s].sum():
                continue  # a strip that touches the rim between two samples
            for slot, u in exact.items():
                x = T[i][:3, :3] @ piece.point(*u) + T[i][:3, 3]
                error = np.linalg.norm(p_world[c, s, slot] - x)
                worst = max(worst, error)
                if i in LIMB_PIECES:
                    worst_limb = max(worst_limb, error)
    assert worst_limb < INTERPOLATION_LIMB_M
    assert worst < INTERPOLATION_M


@settings(max_examples=25)
@given(
    radius=st.floats(0.05, 0.3),
    distance=st.floats(1.5, 8.0),
    azimuth=st.floats(0.0, 2 * np.pi),
    elevation=st.floats(-0.9, 0.9),
)
def test_a_sphere_has_the_rim_of_a_sphere(radius, distance, azimuth, elevation):
    """In the plane r²/d from the centre, towards the camera: what an orthographic shortcut misses."""
    ball = replace(
        BODY.pieces[0],
        segment="upper_arm_l",
        radii=(radius, radius, radius),
        e1=1.0,
        e2=1.0,
        z_lower=-radius,
        z_upper=radius,
    )
    body = replace(BODY, pieces=(ball,))
    pose = neutral_pose(BODY.skeleton)
    T = piece_transforms(body, pose)[0]
    d = (
        radius
        * distance
        * np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    )
    center = T[:3, 3] + d
    strips = build_strips(body, [0])
    points = contour_kernel(body, strips, Rig((camera_at(center, T[:3, 3]),)), np.float64)(
        pose[None], np.arange(CIRCLES)[None]
    )
    found = points.found[0] == 1
    assert found.any() and (points.visible == points.found).all()
    moved = body.skeleton.segment_transforms(pose)[SEGMENTS.index(ball.segment)]
    along = (points.points_zero[0][found] @ moved[:3, :3].T + moved[:3, 3] - T[:3, 3]) @ d / np.linalg.norm(d)
    np.testing.assert_allclose(along, radius**2 / np.linalg.norm(d), rtol=0, atol=0.01 * radius)


def test_pairs_are_symmetric_about_the_limb_and_never_swap(kernel):
    poses = some_poses(12, seed=3)
    points = kernel(poses, np.tile(even(5), (12, 1)))
    both = points.found.all(axis=3)
    assert (both == points.found.any(axis=3)).all(), "a circle has two contour points or none"
    assert both.mean() > 0.9
    for b, pose in enumerate(poses):
        T = piece_transforms(BODY, pose)[STRIPS.piece[points.strip[b]]]
        p = np.einsum("kji,cksj->cksi", T[:, :3, :3], world_points(points, pose, b) - T[None, :, None, :3, 3])
        view = np.einsum("kji,ckj->cki", T[:, :3, :3], RIG.centers[:, None] - T[None, :, :3, 3])[..., :2]
        first, second = p[..., 0, :2][both[b]], p[..., 1, :2][both[b]]
        view = view[both[b]]
        size = np.linalg.norm(view, axis=1) * np.linalg.norm(first, axis=1)
        dot = [np.sum(q * view, axis=1) / size for q in (first, second)]
        side = [(q[:, 0] * view[:, 1] - q[:, 1] * view[:, 0]) / size for q in (first, second)]
        np.testing.assert_allclose(dot[0], dot[1], rtol=0, atol=0.01)
        np.testing.assert_allclose(side[0], -side[1], rtol=0, atol=0.01)
        assert (side[0] > 0).all(), "slot 0 is always on the same side"
        np.testing.assert_allclose(p[..., 0, 2][both[b]], p[..., 1, 2][both[b]], rtol=0, atol=1e-12)


def test_image_normals_are_normal_to_the_contours_image(kernel):
    """Steps within the tangent plane stay on the contour's tangent, whatever the lens does; outward is outward."""
    pose = some_poses(1, seed=4)
    points = kernel(pose, ALL)
    p_world = world_points(points, pose[0], 0)
    T = piece_transforms(BODY, pose[0])
    h = 1e-5
    for c, camera in enumerate(RIG):
        s, slot = np.nonzero(points.found[0, c])
        x, m = p_world[c, s, slot], points.normals[0, c, s, slot]
        np.testing.assert_allclose(np.linalg.norm(m, axis=1), 1, atol=1e-12)
        R = T[STRIPS.piece[s]]
        q = np.einsum("nji,nj->ni", R[:, :3, :3], x - R[:, :3, 3])
        n = np.empty_like(q)
        for i, piece in enumerate(BODY.pieces):
            mine = STRIPS.piece[s] == i
            gradient = piece_gradient(piece, q[mine])
            n[mine] = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        n = np.einsum("nij,nj->ni", R[:, :3, :3], n)
        v = x - camera.center
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        tangent = np.cross(n, v)
        step = (camera.project(x + h * tangent)[0] - camera.project(x - h * tangent)[0]) / (2 * h)
        slide = np.abs(np.sum(step * m, axis=1)) / np.linalg.norm(step, axis=1)
        # n is perpendicular to the ray as far as eq. 5 found the rim; on box-like pieces that is a few degrees
        limb = np.isin(STRIPS.piece[s], LIMB_PIECES)
        assert np.quantile(slide[limb], 0.99) < 2e-3 and np.quantile(slide, 0.95) < 0.02
        out = np.sum((camera.project(x + h * n)[0] - camera.project(x)[0]) * m, axis=1)
        assert (out > 0).all()


def piece_gradient(piece, q, h=1e-6):
    """(N, 3) of the inside-outside function, by central differences."""
    step = [(piece.inside_outside(q + d) - piece.inside_outside(q - d)) / (2 * h) for d in h * np.eye(3)]
    return np.stack(step, -1)


def test_a_batch_is_its_poses_one_by_one(kernel):
    poses = some_poses(3, seed=5)
    chosen = np.random.default_rng(6).integers(-1, len(STRIPS.piece), (3, 50))
    chosen[:, 0] = -1
    together = kernel(poses, chosen)
    assert np.array_equal(together.strip, chosen)
    for b in range(3):
        alone = kernel(poses[b : b + 1], chosen[b : b + 1])
        for name in ("points_zero", "pixels", "normals", "found", "visible"):
            assert np.array_equal(getattr(together, name)[b], getattr(alone, name)[0]), name
    assert not together.found[:, :, 0].any(), "-1 is no strip"


def test_single_precision_finds_the_same_points(kernel):
    poses = some_poses(4, seed=8)
    chosen = np.tile(even(10), (4, 1))
    single, double = contour_kernel(BODY, STRIPS, RIG)(poses, chosen), kernel(poses, chosen)
    assert single.pixels.dtype == np.float32
    same = (single.found == 1) & (double.found == 1)
    assert (single.found != double.found).mean() < 2e-3, "but for strips that just touch the rim"
    # nearly end-on, a strip crosses the rim at a flat angle and rounding moves the point along it
    for name, tolerance in (("points_zero", SINGLE_M), ("pixels", SINGLE_PX)):
        error = np.abs(getattr(single, name) - getattr(double, name))[same]
        assert np.quantile(error, 0.99) < tolerance
    assert (single.visible != double.visible).mean() < 5e-3


def test_points_behind_a_camera_are_zero():
    turned = RIG[0]
    away = Camera(
        "away",
        turned.width,
        turned.height,
        turned.matrix,
        turned.distortions,
        np.diag([-1.0, 1, -1]) @ turned.rotation,
        np.diag([-1.0, 1, -1]) @ turned.translation,
    )
    np.testing.assert_allclose(away.center, turned.center, atol=1e-12)
    points = contour_kernel(BODY, STRIPS, Rig((turned, away)))(some_poses(1, seed=9), even(5)[None])
    assert points.found[0, 0].mean() > 0.9
    assert not points.found[0, 1].any() and not points.visible[0, 1].any()
    for name in ("points_zero", "pixels", "normals"):
        assert not getattr(points, name)[0, 1].any(), name


def test_no_strips_give_no_points_and_wrong_ones_are_named(kernel):
    pose = some_poses(1, seed=10)
    assert kernel(pose, np.zeros((1, 0), int)).pixels.shape == (1, len(RIG), 0, 2, 2)
    with pytest.raises(IndexError, match="there are 0 to"):
        kernel(pose, np.array([[0, len(STRIPS.piece)]]))
