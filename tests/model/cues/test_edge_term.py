"""The contour cues of a body: which points, views and weights; and that the truth explains its own pictures."""

import functools
from dataclasses import replace

import cv2
import numpy as np

from tests.kernels.test_contour import BODY, RIG, some_poses
from tests.model.figures import piece_transforms
from tk.kernels import alignment as a
from tk.kernels.nearest import SurfaceIndex
from tk.model.body.skeleton import CHAINS, SEGMENTS
from tk.model.body.strips import LIMBS
from tk.model.cameras.camera import Camera, Rig
from tk.model.cues.edge_term import VIEWS, ContourTerm
from tk.model.cues.objective import BodyObjective, FrameObjective

TRUTH = some_poses(1, seed=21)[0]
# rendered from 3 × 10⁴ triangles a piece, sampled at whole pixels, searched at half pixels
NEAR_PX = 1.5


def term_of(weight=1.0, rig=RIG):
    return ContourTerm(BODY, rig, weight)


def strips_of(term, rng=None):
    """Strips (K,) of all limbs."""
    drawn = term.draw(rng)
    return drawn[drawn >= 0]


@functools.cache
def pictures():
    """The body's pieces as filled polygons on a dark ground: each limb a colour, nearest last."""
    H, W = RIG.frame_shape
    images = np.full((len(RIG), H, W, 3), 30, np.uint8)
    colors = np.random.default_rng(0).integers(90, 256, (len(SEGMENTS), 3))
    T = piece_transforms(BODY, TRUTH)
    for c, camera in enumerate(RIG):
        for i in np.argsort([-np.linalg.norm(t[:3, 3] - camera.center) for t in T]):
            piece = BODY.pieces[i]
            eta, omega = np.linspace(*piece.eta_range, 60), np.linspace(-np.pi, np.pi, 120)
            x = piece.point(*np.meshgrid(eta, omega, indexing="ij")).reshape(-1, 3)
            hull = cv2.convexHull(camera.project(x @ T[i][:3, :3].T + T[i][:3, 3])[0].astype(np.float32))
            polygon = np.rint(hull * 16).astype(np.int32)
            cv2.fillPoly(images[c], [polygon], colors[SEGMENTS.index(piece.segment)].tolist(), shift=4)
    return images


def residual_px(entries, pose, b=0):
    """(E,) distance across the contour from each assigned entry to its target, pixels; NaN elsewhere."""
    result = np.full(len(entries[b]), np.nan)
    T = BODY.skeleton.segment_transforms(pose)
    segment_of = {int(dof): s for s, dof in enumerate(BODY.skeleton.segment_dof)}
    for e, row in enumerate(entries[b]):
        if row[a.STATE] == a.ASSIGNED:
            M = T[segment_of[int(row[a.LAST_DOF])]]
            camera = RIG[int(row[a.CAMERA])]
            ends = [M[:3, :3] @ row[first : first + 3] + M[:3, 3] for first in (a.POINT_A, a.POINT_B)]
            pixel = np.mean([camera.project(x[None])[0][0] for x in ends], axis=0)
            result[e] = abs((pixel - row[a.TARGET : a.TARGET + 2]) @ row[a.NORMAL : a.NORMAL + 2])
    return result


def assigned(term, poses, chosen=None):
    poses = np.atleast_2d(poses)
    chosen = np.repeat(strips_of(term)[None], len(poses), 0) if chosen is None else chosen
    return term.assign(pictures(), poses, chosen), term.kernel(poses, chosen)


def views_used(entries):
    """The views of a pose's entries (E, 16)."""
    return {int(c) for c in entries[entries[:, a.STATE] != a.ABSENT, a.CAMERA]}


def inside_image(points, rig=RIG):
    """(B, C, K, 2) bool, which contour points lie in the images."""
    sizes = np.array([(camera.width, camera.height) for camera in rig])[:, None, None]
    return ((points.pixels > -0.5) & (points.pixels < sizes - 0.5)).all(axis=-1)


def test_colour_edges_are_searched_in_the_views_that_show_most_points():
    poses = some_poses(6, seed=22)
    term = term_of()
    entries, points = assigned(term, poses)
    shown = np.sum(points.visible & inside_image(points), axis=(2, 3))
    more = False
    for b in range(len(poses)):
        used = views_used(entries[b])
        assert len(used) == VIEWS
        rest = set(range(len(RIG))) - used
        assert min(shown[b, list(used)]) >= max(shown[b, list(rest)])
        more |= min(shown[b, list(used)]) > max(shown[b, list(rest)])
    assert more, "all views were alike: nothing was tested"


def test_no_edges_are_searched_in_views_that_do_not_show_the_person():
    """A camera that looks the other way hides no point, nor does one whose image ends beside the person."""
    back, sideways = np.diag([-1.0, 1, -1]), np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    cameras = [*RIG][:2]
    for turn in (back, sideways, cv2.Rodrigues(np.array([0.0, np.radians(50), 0]))[0]):
        c = RIG[0]
        cameras.append(replace(c, rotation=turn @ c.rotation, translation=turn @ c.translation))
    rig = Rig(tuple(cameras))
    term = term_of(rig=rig)
    points = term.kernel(TRUTH[None], strips_of(term)[None])
    assert points.visible[0, 4].any() and not (points.visible & inside_image(points, rig))[0, 2:].any()
    assert views_used(term.pairs(points)[1]) == {0, 1}


def test_no_edges_are_searched_in_views_that_are_left_out():
    term = term_of()
    points = term.kernel(TRUTH[None], strips_of(term)[None])
    left = np.array([True, False, True, False])
    assert views_used(term.pairs(points)[1]) - {0, 2} and views_used(term.pairs(points, left)[1]) == {0, 2}


def test_points_outside_the_image_cost_and_pull_nowhere():
    narrow = Rig(tuple(replace(c, width=c.width // 2 + 10) for c in RIG))
    term = term_of(rig=narrow)
    points = term.kernel(TRUTH[None], strips_of(term)[None])
    outside = points.visible.astype(bool) & ~inside_image(points, narrow)
    assert outside.any()
    _, entries, lines = term.pairs(points)
    assert len(lines) == np.sum(entries[:, a.STATE] == a.ASSIGNED) < len(entries)  # hidden points have no line
    width = np.array([c.width for c in narrow])[lines[:, 1].astype(int)]
    assert (lines[:, [2, 4]] < width[:, None] - 0.5).all()


def test_limbs_only_have_edges():
    limbs = {int(BODY.skeleton.segment_dof[SEGMENTS.index(s)]) for s in LIMBS}
    term = term_of()
    head = list(CHAINS).index("head")
    for chosen in (strips_of(term)[None], term.draw(None)[[head]]):
        entries = term.assign(pictures(), TRUTH[None], chosen)[0]
        found = {int(k) for k in entries[entries[:, a.STATE] != a.ABSENT, a.LAST_DOF]}
        assert found == (limbs if len(chosen[0]) > 20 else set())


def test_hidden_points_cost_and_pull_nowhere():
    """6.1.2: 1 each. A circle with both points hidden is two points and counts as a pair does."""
    term = term_of()
    poses = some_poses(6, seed=23)
    entries, points = assigned(term, poses)
    lost = 0
    for b in range(len(poses)):
        rows = entries[b][entries[b, :, a.STATE] != a.ABSENT]
        used = sorted({int(c) for c in rows[:, a.CAMERA]})
        shown = points.visible[b].astype(bool) & inside_image(points)[b]
        both_hidden = (points.found[b].any(axis=2) & ~shown.any(axis=2))[used].sum()
        lost += both_hidden
        per_pair = rows[:, a.SCALE].max()
        assert rows[rows[:, a.STATE] == a.UNASSIGNABLE][:, a.SCALE].sum() >= per_pair * both_hidden - 1e-6
    assert lost > 0


def test_weights_sum_to_the_terms_weight():
    entries, _ = assigned(term_of(0.7), some_poses(3, seed=24))
    scale = np.where(entries[..., a.STATE] == a.ABSENT, 0, entries[..., a.SCALE])
    np.testing.assert_allclose(scale.sum(axis=1), 0.7, rtol=1e-5)
    assert (scale >= 0).all()


def test_edge_cost_is_least_at_the_true_pose():
    term = term_of()
    entries, points = assigned(term, TRUTH)
    distance = residual_px(entries, TRUTH)
    visible = np.sum(term.pairs(points)[1][:, a.STATE] == a.ASSIGNED)
    assert np.isfinite(distance).sum() >= 0.8 * visible
    assert np.mean(distance[~np.isnan(distance)] < NEAR_PX) > 0.6


def test_pictures_pull_a_displaced_body_back():
    """The value grows, and its gradient points uphill, as an arm is turned away."""
    index = SurfaceIndex.build(np.full((1, 3), 50.0), np.full(1, -1), 0.1)
    body = BodyObjective(BODY, 0.0, term_of())
    frame = FrameObjective(body, index, np.random.default_rng(0), images=pictures())
    for axis in (0, 2):
        for sign in (-1, 1):
            pose = TRUTH.copy()
            pose[axis] += sign * 0.04
            assert frame.value(pose) > frame.value(TRUTH)
            gradient = frame.full()(pose[None], np.zeros((1, len(pose))), 0).gradient[0]
            assert sign * gradient[axis] > 0, (axis, sign)


def test_a_batch_equals_its_poses_one_by_one():
    term = term_of()
    poses = some_poses(3, seed=25)
    chosen = np.stack([strips_of(term, np.random.default_rng(i)) for i in range(3)])
    together = term.assign(pictures(), poses, chosen)
    for b in range(3):
        alone = term.assign(pictures(), poses[b : b + 1], chosen[b : b + 1])[0]
        np.testing.assert_array_equal(together[b, : len(alone)], alone)
        assert not together[b, len(alone) :].any()


def test_strips_of_the_chains_are_their_own():
    term = term_of()
    for generator in (None, np.random.default_rng(0)):
        drawn = term.draw(generator)
        for row, chain in zip(drawn, CHAINS.values(), strict=True):
            if set(chain) & {*LIMBS}:
                assert {BODY.pieces[i].segment for i in term.strips.piece[row]} == set(chain) & {*LIMBS}
                assert len(set(row.tolist())) == len(row)
            else:
                assert (row == -1).all()
    np.testing.assert_array_equal(term.draw(None), term.draw(None))
    draws = [term.draw(np.random.default_rng(i)) for i in (0, 0, 1)]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])


def test_a_body_that_nobody_sees_has_no_entries():
    looks_away = RIG[0]
    turned = Camera(
        "away",
        looks_away.width,
        looks_away.height,
        looks_away.matrix,
        looks_away.distortions,
        np.diag([-1.0, 1, -1]) @ looks_away.rotation,
        np.diag([-1.0, 1, -1]) @ looks_away.translation,
    )
    term = term_of(rig=Rig((turned,)))
    entries = term.assign(pictures()[:1], TRUTH[None], strips_of(term)[None])
    assert not (entries[..., a.STATE] != a.ABSENT).any()
