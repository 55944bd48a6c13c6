"""Contours against dense point clouds, rays against sampling, search and normal equations against plain NumPy."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from tests.model.figures import BODY, draw_silhouettes, scaled, surface_points
from tests.model.ring import ring_of_cameras
from tk.kernels import silhouette
from tk.kernels.cone_arrays import PART_MOVED
from tk.kernels.cones import CONE, ELLIPSOID, END_FAR, END_NEAR, OUTLINE, SIDE_A, SIDE_B, curve_of, enter, point_on
from tk.kernels.line_search import COLOR_BINS, SearchSettings, search_colors
from tk.kernels.newton import LENGTHS, NewtonSteps
from tk.kernels.runtime import ensure_runtime, ti
from tk.model.body import gait_poses as gait
from tk.model.body.body_parameters import BodyFamily
from tk.model.body.cone_body import build_cone_body
from tk.model.cameras.camera import Rig
from tk.model.masks.silhouettes import Views

D = len(BODY.skeleton.names)
FAMILY = BodyFamily(BODY.dimensions, 0.01)
few = settings(max_examples=30)
sizes = st.floats(0.03, 0.4)


@ti.kernel
def _trace(
    kind: ti.i32,
    shape: ti.types.ndarray(dtype=ti.f64, ndim=1),
    eye: ti.types.ndarray(dtype=ti.f64, ndim=1),
    points: ti.types.ndarray(dtype=ti.f64, ndim=2),
    tangents: ti.types.ndarray(dtype=ti.f64, ndim=2),
) -> ti.i32:
    s = ti.Vector([shape[i] for i in ti.static(range(4))])
    c = ti.Vector([eye[i] for i in ti.static(range(3))])
    visible, q = curve_of(kind, s, c)
    for n in range(points.shape[0]):
        x, t = point_on(kind, s, c, q, ti.cast(n, ti.f64) / (points.shape[0] - 1))
        for i in ti.static(range(3)):
            points[n, i] = x[i]
            tangents[n, i] = t[i]
    return visible


@ti.kernel
def _cast(
    kind: ti.i32,
    shape: ti.types.ndarray(dtype=ti.f64, ndim=1),
    eye: ti.types.ndarray(dtype=ti.f64, ndim=1),
    rays: ti.types.ndarray(dtype=ti.f64, ndim=2),
    entered: ti.types.ndarray(dtype=ti.f64, ndim=1),
):
    for n in range(rays.shape[0]):
        s = ti.Vector([shape[i] for i in ti.static(range(4))])
        c = ti.Vector([eye[i] for i in ti.static(range(3))])
        d = ti.Vector([rays[n, i] for i in ti.static(range(3))])
        entered[n] = enter(kind, s, c, d, ti.cast(1.0, ti.f64))


def trace(kind, shape, eye, count=181):
    ensure_runtime()
    points, tangents = np.empty((count, 3)), np.empty((count, 3))
    visible = _trace(kind, np.array(shape), np.array(eye), points, tangents)
    return points if visible else np.empty((0, 3)), tangents


def cloud(kind, shape):
    """Dense points of a part's surface, caps included by their rims."""
    a, b, h, m = shape
    u, v = np.meshgrid(np.linspace(0, 1, 121), np.linspace(0, 2 * np.pi, 721))
    u, v = u.ravel(), v.ravel()
    if kind == ELLIPSOID:
        w = np.pi * u
        return np.column_stack([a * np.sin(w) * np.cos(v), b * np.sin(w) * np.sin(v), h * np.cos(w)])
    r = 1 + (m - 1) * u
    return np.column_stack([a * r * np.cos(v), b * r * np.sin(v), h * u])


def seen_from(eye, target, points):
    """Perspective coordinates (N, 2) from eye, looking at target."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.linalg.svd(z[None])[2][1]
    p = (points - eye) @ np.column_stack([x, np.cross(z, x), z])
    return p[:, :2] / p[:, 2:]


def inside(kind, shape, p):
    a, b, h, m = shape
    if kind == ELLIPSOID:
        return (p[..., 0] / a) ** 2 + (p[..., 1] / b) ** 2 + (p[..., 2] / h) ** 2 < 1
    r = 1 + (m - 1) * p[..., 2] / h
    within = (p[..., 2] > 0) & (p[..., 2] < h)
    return within & ((p[..., 0] / a) ** 2 + (p[..., 1] / b) ** 2 < r**2)


shapes = st.tuples(sizes, sizes, sizes, st.floats(0.3, 1.8))
eyes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.2)


@given(shape=shapes, direction=eyes, kind=st.sampled_from([CONE, ELLIPSOID]))
@few
def test_contours_bound_the_projected_surface(shape, direction, kind):
    """The hull of a dense cloud and the hull of the contours are the same region of the image."""
    middle = np.array([0, 0, 0.5 * shape[2] if kind == CONE else 0.0])
    eye = middle + 2.5 * np.array(direction) / np.linalg.norm(direction)
    kinds = (OUTLINE,) if kind == ELLIPSOID else (SIDE_A, SIDE_B, END_NEAR, END_FAR)
    contour = np.concatenate([trace(k, shape, eye)[0] for k in kinds])
    around = ConvexHull(seen_from(eye, middle, contour))
    surface = ConvexHull(seen_from(eye, middle, cloud(kind, shape)))
    size = np.sqrt(surface.volume)
    # the cloud's facets cut 1e-4 of the size off its outline, the contour's chords as much of its own
    distances = surface.points[surface.vertices] @ around.equations[:, :2].T + around.equations[:, 2]
    assert distances.max() < 1e-3 * size
    distances = around.points[around.vertices] @ surface.equations[:, :2].T + surface.equations[:, 2]
    assert distances.max() < 1e-3 * size
    # every contour point lies on the outline, none inside
    depth = -(around.points @ surface.equations[:, :2].T + surface.equations[:, 2]).max(axis=1)
    assert depth.max() < 2e-3 * size


@given(shape=shapes, direction=eyes, kind=st.sampled_from([OUTLINE, SIDE_A, SIDE_B, END_NEAR, END_FAR]))
@few
def test_tangents_are_derivatives(shape, direction, kind):
    eye = 2.5 * np.array(direction) / np.linalg.norm(direction)
    points, tangents = trace(kind, shape, eye, 20001)
    if len(points):
        numeric = (points[2:] - points[:-2]) * 20000 / 2
        np.testing.assert_allclose(tangents[1:-1], numeric, rtol=0, atol=1e-5)


@given(shape=shapes, direction=eyes, kind=st.sampled_from([CONE, ELLIPSOID]), seed=st.integers(0, 1000))
@few
def test_rays_enter_where_the_solid_begins(shape, direction, kind, seed):
    eye = 1.5 * np.array(direction) / np.linalg.norm(direction)
    rays = np.random.default_rng(seed).normal(0, 0.25, (40, 3)) - eye
    entered = np.empty(len(rays))
    ensure_runtime()
    _cast(kind, np.array(shape), eye, rays, entered)
    t = np.linspace(0, 3, 6001)
    along = inside(kind, shape, eye + t[None, :, None] * rays[:, None, :])
    first = np.where(along.any(axis=1), t[along.argmax(axis=1)], -1.0)
    hit = entered > 0
    # what grazes the surface for less than two steps of the oracle may go either way
    sure = (along.sum(axis=1) > 1) | ~along.any(axis=1)
    missed = sure & along.any(axis=1) & ~hit
    assert not missed.any()
    both = hit & along.any(axis=1)
    np.testing.assert_allclose(entered[both], first[both], rtol=0, atol=6e-4)
    # and where only the kernel hits, the oracle's steps went past a sliver
    middle = eye + (entered[hit] + 1e-6)[:, None] * rays[hit]
    slack = 1 + 1e-4
    a, b, h, m = shape
    assert inside(kind, (a * slack, b * slack, h * (slack if kind == ELLIPSOID else 1), m), middle).all()


RIG = ring_of_cameras(3, width=160, height=200)
VIEWS = Views(RIG)


def standing(**angles):
    pose = gait.standing_pose(BODY.skeleton)
    pose[2] = 0.92
    for name, value in angles.items():
        pose[BODY.skeleton.index(name)] = value
    return pose


def seen(masks):
    return silhouette.Silhouettes(VIEWS.cameras, VIEWS.sizes, masks, 1.0)


def edgels_of(body, masks, pose, settings, dtype=np.float64):
    return silhouette.find_edgels(body.pack(dtype), seen(masks), pose[None], settings)


def equations_of(body, masks, poses, settings, dtype=np.float64):
    return silhouette.normal_equations(body.pack(dtype), seen(masks), poses, settings)


POSE = standing(hip_l_pitch=-0.5, knee_l_flexion=0.6, hip_r_pitch=0.2, torso_yaw=0.3)
MASKS = draw_silhouettes(BODY, RIG, POSE[None])[0]
PLAIN = SearchSettings(tangential=0.0, robust_px=0.0)


def rows_at(pose, edgels):
    linear, rows = FAMILY.linearised(FAMILY.mean, pose[None]), np.zeros((len(edgels.part), len(pose)))
    for part in np.unique(edgels.part):
        own = np.flatnonzero(edgels.part == part)
        dofs, by_dof = linear.pose_rows(part, edgels.of(own), linear.points(edgels.of(own)))
        rows[own[:, None], dofs] = by_dof
    return rows


def test_equations_are_the_sums_of_the_edgels_rows():
    moved = POSE + np.random.default_rng(0).normal(0, 0.02, D)
    edgels = edgels_of(BODY, MASKS, moved, PLAIN)
    assert len(edgels.view) > 200
    rows = rows_at(moved, edgels)
    total = equations_of(BODY, MASKS, moved[None], PLAIN)
    np.testing.assert_allclose(total.hessian[0], rows.T @ (edgels.weight[:, None] * rows), rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(total.gradient[0], rows.T @ (edgels.weight * edgels.distance), rtol=1e-9, atol=1e-6)


def test_displacements_of_a_segment_in_a_view_are_eliminated():
    """As with three more unknowns for each segment and view, and a prior on them."""
    precision = 3e3
    edgels = edgels_of(BODY, MASKS, POSE, PLAIN)
    rows, moved = rows_at(POSE, edgels), BODY.arrays.parts[edgels.part, PART_MOVED]
    hessian, gradient = np.zeros((D, D)), np.zeros(D)
    for of in {*zip(edgels.view.tolist(), moved.tolist(), strict=True)}:
        one = (edgels.view == of[0]) & (moved == of[1])
        both = np.hstack([rows[one], edgels.row[one]])
        A, y = both.T @ (edgels.weight[one, None] * both), both.T @ (edgels.weight * edgels.distance)[one]
        gain = A[:D, D:] @ np.linalg.inv(A[D:, D:] + precision * np.eye(3))
        hessian += A[:D, :D] - gain @ A[D:, :D]
        gradient += y[:D] - gain @ y[D:]
    found = equations_of(BODY, MASKS, POSE[None], replace(PLAIN, displacement=precision))
    np.testing.assert_allclose(found.hessian[0], hessian, rtol=1e-7, atol=1e-5 * np.abs(hessian).max())
    np.testing.assert_allclose(found.gradient[0], gradient, rtol=1e-7, atol=1e-5 * np.abs(gradient).max())
    plain = equations_of(BODY, MASKS, POSE[None], PLAIN)
    firm = equations_of(BODY, MASKS, POSE[None], replace(PLAIN, displacement=1e12))
    np.testing.assert_allclose(firm.hessian, plain.hessian, rtol=1e-4, atol=1e-5 * np.abs(hessian).max())
    single = equations_of(BODY, MASKS, POSE[None], replace(PLAIN, displacement=precision), np.float32)
    np.testing.assert_allclose(single.hessian[0], hessian, rtol=1e-3, atol=1e-3 * np.abs(hessian).max())


STEPS = NewtonSteps(
    np.arange(D, dtype=np.int32),
    np.vstack([BODY.skeleton.lower, BODY.skeleton.upper, np.tile(0.1 * POSE, (3, 1))]),
    0.1 * np.eye(D)[None],
    np.array([0.02, 5e-4, 1.0, 0.5, 0.0, 1.6, 1.6, 1.0]),
)


def descent_of(masks, poses, steps):
    return silhouette.descend(BODY.pack(np.float64), seen(masks), poses, PLAIN, steps)


def test_descent_is_single_steps_one_after_another():
    start = POSE + np.random.default_rng(1).normal(0, 0.03, (3, D))
    two = STEPS._replace(numbers=STEPS.numbers[:-1])
    whole, poses = descent_of(MASKS, start, two), start
    for length in two.numbers[LENGTHS:]:
        one = STEPS._replace(numbers=np.append(STEPS.numbers[:LENGTHS], length))
        poses = descent_of(MASKS, poses, one).poses
    np.testing.assert_array_equal(whole.poses, poses)
    np.testing.assert_array_equal(whole.steps, 2)
    off = [edgels_of(BODY, MASKS, pose, PLAIN).distance for poses in (start, whole.poses) for pose in poses]
    square = np.array([np.mean(np.minimum(np.abs(one), 8.0) ** 2) for one in off]).reshape(2, -1)
    assert (square[1] < 0.7 * square[0]).all()


def test_step_solves_the_damped_equations():
    start = POSE + np.random.default_rng(2).normal(0, 0.03, (3, D))
    here = equations_of(BODY, MASKS, start, PLAIN)
    numbers = np.array([0.02, 0.0, 0.0, 100.0, 0.0, 1.6])
    found = descent_of(MASKS, start, STEPS._replace(numbers=numbers)).poses
    index, precision = STEPS.free, np.diag(STEPS.matrix[0])
    for b, (H, g) in enumerate(zip(here.hessian, here.gradient, strict=True)):
        least = 1e-9 * np.diag(H)[np.diag(H) > 0].mean()  # which matters where there is no contour: the head's turn
        H = H + np.diag(0.02 * np.diag(H) + precision + least)
        g = g + precision * (POSE - start[b])
        expected = np.linalg.solve(H[np.ix_(index, index)], g[index])
        np.testing.assert_allclose(found[b, index] - start[b, index], 1.6 * expected, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(("tolerance", "made"), [(0.0, [4, 4, 4]), (0.012, None), (9.0, [1, 1, 1])])
def test_each_pose_stops_once_its_steps_are_short(tolerance, made):
    start = np.stack([POSE, POSE + 0.05, POSE + np.random.default_rng(3).normal(0, 0.03, D)])
    steps = STEPS._replace(numbers=np.array([0.02, 5e-4, 1.0, 0.5, tolerance, 1.6, 1.6, 1.6, 1.6]))
    together = descent_of(np.concatenate([MASKS] * 3), start, steps)
    if made is not None:
        assert together.steps.tolist() == made
    for b in range(3):
        alone = descent_of(MASKS, start[b : b + 1], steps)
        np.testing.assert_array_equal(alone.poses[0], together.poses[b])


def test_rows_are_the_normals_of_the_picture_in_the_world():
    edgels = edgels_of(BODY, MASKS, POSE, PLAIN)
    np.testing.assert_allclose(np.linalg.norm(edgels.normal, axis=1), 1.0, atol=1e-9)
    x = surface_points(BODY, POSE, edgels.part, edgels.unscaled)
    for v, camera in enumerate(RIG):
        here = edgels.view == v
        moved = [camera.project(x[here] + s * step)[0] for step in np.eye(3) for s in (1e-6, -1e-6)]
        J = np.stack([(moved[2 * a] - moved[2 * a + 1]) / 2e-6 for a in range(3)], axis=2)
        np.testing.assert_allclose(edgels.row[here], np.einsum("ni,nij->nj", edgels.normal[here], J), atol=1e-3)


@pytest.mark.parametrize("k", range(0, D, 3))
def test_rows_are_derivatives_of_the_contour(k):
    """A generator's image is a line; where it meets the old normal moves as the row says."""
    settings = SearchSettings(tangential=0.0, most_samples=3, spacing_px=0.25, window_px=12, interior=True)
    before = edgels_of(BODY, MASKS, POSE, settings)
    rows = rows_at(POSE, before)[:, k]
    h = 1e-5
    lines = {}
    for sign in (-1, 1):
        step = POSE.copy()
        step[k] += sign * h
        lines[sign] = edgels_of(BODY, MASKS, step, settings)
    tested = 0
    for i in range(len(before.view)):
        part = BODY.parts[before.part[i]]
        if part.kind != CONE or abs(before.unscaled[i, 2] - 0.5) > 1e-6:
            continue
        rotation = RIG[before.view[i]].rotation
        n = (rotation @ before.row[i])[:2]
        n = n / np.linalg.norm(n)
        ends = []
        for sign in (-1, 1):
            e = lines[sign]
            near = (e.view == before.view[i]) & (e.part == before.part[i])
            near &= np.abs(e.unscaled[:, :2] - before.unscaled[i, :2]).max(axis=1) < 1e-3
            low, high = e.pixel[near & (e.unscaled[:, 2] < 0.4)], e.pixel[near & (e.unscaled[:, 2] > 0.6)]
            if len(low) != 1 or len(high) != 1:
                break
            along = (high - low)[0]
            across = np.array([along[1], -along[0]])
            ends.append((low[0] - before.pixel[i]) @ across / (n @ across))
        if len(ends) == 2:
            assert (ends[1] - ends[0]) / (2 * h) == pytest.approx(rows[i], abs=2e-2, rel=1e-3)
            tested += 1
    assert tested >= 5


def test_search_goes_one_way_and_knows_its_window():
    """A head before half-plane masks: outwards from the foreground, inwards from the background."""
    edgels = edgels_of(BODY, np.full_like(MASKS, 255), POSE, PLAIN)
    assert len(edgels.view) == 0  # no background anywhere
    grown = np.zeros_like(MASKS)
    body = build_cone_body(scaled(BODY.dimensions, head_radius=1.3))
    grown[:] = draw_silhouettes(body, RIG, POSE[None])[0]
    head = next(i for i, part in enumerate(BODY.parts) if part.name == "head")
    outward = edgels_of(BODY, grown, POSE, PLAIN)
    wide = outward.distance[outward.part == head]
    assert len(wide) > 10 and (wide > -0.8).all() and wide.mean() > 0.5
    inward = edgels_of(body, MASKS, POSE, PLAIN)
    assert inward.distance[inward.part == head].mean() < -0.5
    narrow = edgels_of(BODY, grown, POSE, SearchSettings(window_px=1.0))
    assert np.abs(narrow.distance).max() <= 1.0


def test_contours_of_the_pose_itself_lie_on_the_silhouette():
    edgels = edgels_of(BODY, MASKS, POSE, PLAIN)
    # a drawn silhouette is right to half a pixel; where outlines of parts meet, its corners are round
    assert np.median(np.abs(edgels.distance)) < 0.35
    assert abs(np.average(edgels.distance, weights=edgels.weight)) < 0.1


def test_ambiguous_edgels_are_shared():
    """Legs side by side, seen from the front: weights follow d_b / (2 (d_a + d_b))."""
    pose = standing(hip_l_yaw=0.02, hip_r_yaw=0.02)
    masks = draw_silhouettes(BODY, RIG, pose[None])[0]
    fine = {"spacing_px": 0.25, "tangential": 0.0, "most_samples": 1024, "interior": True}
    alone = edgels_of(BODY, masks, pose, SearchSettings(**fine))
    shared = edgels_of(BODY, masks, pose, SearchSettings(**fine, ambiguous_px=3.0))
    ratio = shared.weight / alone.weight
    assert (np.abs(ratio - 1) < 1e-9).any() and (ratio < 0.5).any()
    assert ((ratio <= 0.5 + 1e-9) | (np.abs(ratio - 1) < 1e-9)).all()
    segments = [BODY.parts[p].segment for p in alone.part]
    arms = np.array([i for i, s in enumerate(segments) if "arm_l" in s and ratio[i] < 0.5][::15])
    others = np.array([i for i, s in enumerate(segments) if "arm_l" not in s])
    normal = np.einsum("nab,nb->na", np.array([c.rotation for c in RIG])[alone.view], alone.row)[:, :2]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for i in arms:
        edgel = alone.pixel[i] + alone.distance[i] * normal[i]
        rivals = others[(alone.view[others] == alone.view[i]) & (normal[others] @ normal[i] > 0)]
        nearest = np.linalg.norm(alone.pixel[rivals] - edgel, axis=1).min() if len(rivals) else np.inf
        # rivals that found no edge are not listed: the true nearest one is at most as far
        expected = nearest / (2 * (abs(alone.distance[i]) + nearest)) if nearest < 3 else 0.5
        assert ratio[i] <= expected + 0.05


def test_robust_weights_fall_with_the_distance():
    moved = POSE + 0.02
    plain = edgels_of(BODY, MASKS, moved, PLAIN)
    robust = edgels_of(BODY, MASKS, moved, SearchSettings(tangential=0.0, robust_px=2.0))
    np.testing.assert_allclose(robust.weight, plain.weight / (1 + (plain.distance / 2) ** 2) ** 2, rtol=1e-9)


def test_equations_are_the_same_every_time_and_in_any_batch():
    poses = POSE + np.random.default_rng(1).normal(0, 0.03, (5, D))
    first = equations_of(BODY, MASKS, poses, SearchSettings(), np.float32)
    again = equations_of(BODY, MASKS, poses, SearchSettings(), np.float32)
    alone = equations_of(BODY, MASKS, poses[3:4], SearchSettings(), np.float32)
    for a, b, c in zip(first, again, alone, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a[3:4], c)


def test_poses_may_each_have_a_frame_of_their_own():
    poses = np.array([standing(torso_yaw=0.2 * k, hip_l_pitch=-0.3 * k) for k in range(3)])
    masks = draw_silhouettes(BODY, RIG, poses[::-1])
    together = equations_of(BODY, np.concatenate(masks), poses, SearchSettings())
    for k in range(3):
        alone = equations_of(BODY, masks[k], poses[k : k + 1], SearchSettings())
        for several, one in zip(together, alone, strict=True):
            np.testing.assert_array_equal(several[k], one[0])
    assert not np.array_equal(together.gradient[:1], equations_of(BODY, masks[2], poses[:1], SearchSettings()).gradient)
    with pytest.raises(ValueError, match="6 masks of 3 views: one set, or one for each frame of the 3 poses"):
        equations_of(BODY, np.concatenate(masks[:2]), poses, SearchSettings())


def test_a_body_that_no_camera_sees_has_no_equations():
    away = POSE.copy()
    away[2] += 50
    total = equations_of(BODY, MASKS, away[None], SearchSettings())
    assert not total.hessian.any() and not total.gradient.any()


def test_drawn_silhouettes_are_the_hulls_of_the_parts():
    """Each part is convex: its silhouette is the convex hull of its projected cloud, lens distortion included."""
    rig = ring_of_cameras(2, width=160, height=200)
    bent = [replace(camera, distortions=np.array([-0.15, 0.03, 1e-3, -1e-3, 0])) for camera in rig]
    drawn = draw_silhouettes(BODY, Rig(tuple(bent)), POSE[None])[0]
    for camera, picture in zip(bent, drawn, strict=True):
        around, core = np.zeros_like(picture), np.zeros_like(picture)
        for p, part in enumerate(BODY.parts):
            a, b, h, m = part.shape
            x, y, z = cloud(part.kind, part.shape)[::7].T
            r = 1 + (m - 1) * z / h if part.kind == CONE else np.ones(len(z))
            unscaled = np.column_stack([x / (a * r), y / (b * r), z / h])
            pixels, _ = camera.project(surface_points(BODY, POSE, np.full(len(unscaled), p), unscaled))
            alone = np.zeros_like(picture)
            cv2.fillConvexPoly(alone, cv2.convexHull((pixels * 256).round().astype(np.int32)), 255, shift=8)
            around |= alone
            # OpenCV paints the boundary's pixels, too: up to a pixel more all around
            core |= cv2.erode(alone, np.ones((3, 3), np.uint8))
        assert not ((picture > 0) & (around == 0)).any()
        assert not ((core > 0) & (picture == 0)).any()
        assert (core > 0).sum() > 0.6 * (picture > 0).sum()


@ti.kernel
def _border(
    image: ti.types.ndarray(dtype=ti.u8, ndim=4),
    likelihood: ti.types.ndarray(dtype=ti.f32, ndim=2),
    start: ti.types.ndarray(dtype=ti.f64, ndim=1),
    normal: ti.types.ndarray(dtype=ti.f64, ndim=1),
    window: ti.f64,
    scale: ti.f64,
    step: ti.f64,
    width: ti.i32,
    height: ti.i32,
    found: ti.types.ndarray(dtype=ti.f64, ndim=1),
):
    x, n = ti.Vector([start[0], start[1]]), ti.Vector([normal[0], normal[1]])
    for _ in range(1):
        certainty, place = search_colors(image, likelihood, 0, width, height, 1.0 / step, x, n, window, scale, 0, 1)
        found[0], found[1] = certainty, place


def border(image, likelihood, start, normal, window=8.0, scale=1.0, step=1.0, columns=None):
    """(certainty, place in pixels of the scale) of the border between group 0 and group 1; ``columns``: of the image
    without the padding beside it."""
    ensure_runtime()
    found = np.empty(2)
    height, width = (-int(-step * n // scale) for n in (len(image), columns or image.shape[1]))
    start, normal = np.array(start, float), np.array(normal)
    _border(image[None], likelihood.astype(np.float32), start, normal, window, scale, step, width, height, found)
    return found


RED, BLUE = (20, 20, 200), (200, 20, 20)


def two_colors():
    """(2, COLOR_BINS) group 0 is red, group 1 is blue, and either may be anything now and then."""
    share = np.full((2, COLOR_BINS), 0.02 / COLOR_BINS)
    for row, (b, g, r) in zip(share, (RED, BLUE), strict=True):
        row[(b >> 4) << 8 | (g >> 4) << 4 | r >> 4] += 0.98
    return np.log(share)


@given(
    turn=st.floats(0, 2 * np.pi),
    place=st.floats(-4, 4),
    scale=st.sampled_from([1.0, 2.0]),
    step=st.sampled_from([1.0, 2.0]),
)
@few
def test_the_border_between_two_colors_is_found(turn, place, scale, step):
    """A half-plane of either colour, also in a reduced image: the border is found to a pixel or so, and is certain."""
    n, start = np.array([np.cos(turn), np.sin(turn)]), np.array([41.3, 38.7])
    y, x = (np.mgrid[: 80 // step, : 80 // step] + 0.5) * step - 0.5
    inside = (x - start[0]) * n[0] + (y - start[1]) * n[1] < place * scale
    image = np.where(inside[..., None], RED, BLUE).astype(np.uint8)
    certainty, found = border(image, two_colors(), start, n, scale=scale, step=step)
    # pixels along a slanting line are met up to half a diagonal off
    assert abs(found - place) < 0.5 + 0.71 * step / scale
    assert certainty > 0.8


@pytest.mark.parametrize("normal", [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
@pytest.mark.parametrize("offset", [-3, 0, 2])
def test_along_rows_and_columns_the_border_is_found_to_half_a_pixel(normal, offset):
    """The border halfway between two pixels; from the start, a pixel's centre, it is offset + 1/2 away."""
    y, x = np.mgrid[:60, :60]
    along = (x - 30) * normal[0] + (y - 30) * normal[1]
    image = np.where((along <= offset)[..., None], RED, BLUE).astype(np.uint8)
    certainty, found = border(image, two_colors(), (30, 30), normal)
    assert abs(found - (offset + 0.5)) < 0.25 and certainty > 0.8


def test_padding_beside_a_smaller_image_shows_no_color():
    """Beyond column 33 there is padding: whatever it contains, the search ends there."""
    seen = [np.full((60, 60, 3), RED, np.uint8) for _ in range(2)]
    seen[1][:, 34:] = BLUE
    one, other = (border(image, two_colors(), (30, 30), (1.0, 0.0), columns=34) for image in seen)
    np.testing.assert_array_equal(one, other)
    assert border(seen[1], two_colors(), (30, 30), (1.0, 0.0))[1] == pytest.approx(3.5, abs=0.25)


def test_equal_colors_give_no_border():
    x = np.mgrid[:60, :60][1]
    split = np.where((x < 30)[..., None], RED, BLUE).astype(np.uint8)
    plain = np.full((60, 60, 3), RED, np.uint8)
    alike = np.repeat(two_colors()[:1], 2, axis=0)
    for image, likelihood in ((split, alike), (plain, alike)):
        certainty, _ = border(image, likelihood, (30, 30), (1.0, 0.0))
        assert certainty == pytest.approx(0.0, abs=1e-4)
    # one colour that suits one group only: the border is not on the line
    assert border(plain, two_colors(), (30, 30), (1.0, 0.0))[1] > 6
    assert border(np.full((60, 60, 3), BLUE, np.uint8), two_colors(), (30, 30), (1.0, 0.0))[1] < -6
