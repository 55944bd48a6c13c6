"""Joint segmentation: the owner of each pixel, against two bodies that are rendered ray by ray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, walk
from tk.kernels.line_search import COLOR_BINS
from tk.kernels.mask_values import OTHERS
from tk.kernels.raycast import FAR
from tk.model.cues.part_colors import RenderedBody, color_bins
from tk.model.cues.ray_costs import RayGrid
from tk.people.share import NEAR_M, NOBODY, assign, enlarged
from tk.trackers.protocol import Frame

RIG = ring_of_cameras(4, width=160, height=200)
GRID, EXACT = RayGrid(RIG, 50), RayGrid(RIG, 200)
SHAPE = (len(RIG), 200, 160)
POSES = np.concatenate([walk(1), walk(1, first=0.4)])
POSES[:, :2] += [[0.3, -0.05], [-0.3, 0.05]]
# BGR; two people never have the same colours, except where a test says so
COLORS = np.array([[200, 40, 40], [40, 40, 200], [40, 200, 40]], np.uint8)
GREY = np.array([90, 90, 90], np.uint8)


def drawn(poses: np.ndarray, colors: np.ndarray = COLORS) -> tuple[np.ndarray, Frame]:
    """Return (V, H, W) who is in front in each pixel, -1 for nobody, and the observation of everybody."""
    met = [EXACT.render(BODY, pose[None]) for pose in poses]
    depth = np.array([one.depth[0] for one in met])
    covered = np.array([one.label[0] > 0 for one in met])
    front = np.where(covered.any(axis=0), depth.argmin(axis=0), -1)
    images = np.where(front[..., None] >= 0, colors[front], GREY)
    return front, Frame(0, images, np.where(front >= 0, np.uint8(255), np.uint8(0)))


def expected(pose: np.ndarray, color: np.ndarray | None = None) -> RenderedBody:
    """Return the body at a pose, all parts of one known colour; with None its colours are unknown."""
    met = GRID.render(BODY, pose[None])
    if color is None:
        return RenderedBody(met.label[0], met.depth[0])
    log_likelihood = np.full((2, COLOR_BINS), np.log(1e-3 / COLOR_BINS), np.float32)
    log_likelihood[:, color_bins(color)] = np.log(0.9)
    return RenderedBody(met.label[0], met.depth[0], np.zeros(len(BODY.parts), np.int32), log_likelihood)


def right(bodies: list[RenderedBody], front: np.ndarray, frame: Frame) -> float:
    """Return the share of the people's pixels with the right owner."""
    owner, shown = assign(RIG, GRID, bodies, frame).owner, front >= 0
    return np.count_nonzero((owner == front) & shown) / np.count_nonzero(shown)


def test_people_overlap_in_two_views() -> None:
    labels = [EXACT.render(BODY, pose[None]).label[0] > 0 for pose in POSES]
    assert np.count_nonzero((labels[0] & labels[1]).any(axis=(1, 2))) >= 2


def test_pixels_belong_to_the_body_in_front() -> None:
    assert right([expected(pose) for pose in POSES], *drawn(POSES)) > 0.98


def test_colors_decide_where_bodies_alone_do_not() -> None:
    """The people are not exactly where they are expected."""
    moved = POSES.copy()
    moved[:, :2] += [[0.04, 0.06], [-0.06, 0.04]]
    assert right([expected(pose) for pose in moved], *drawn(POSES)) < 0.96
    with_colors = [expected(pose, color) for pose, color in zip(moved, COLORS, strict=False)]
    assert right(with_colors, *drawn(POSES)) > 0.985


def test_people_of_one_color_are_separated_by_their_bodies() -> None:
    assert right([expected(pose, COLORS[0]) for pose in POSES], *drawn(POSES, COLORS[[0, 0]])) > 0.98


def block(left: int, right: int, depth_m: float) -> RenderedBody:
    """Return a body that covers these columns of the grid at one depth."""
    label = np.zeros(GRID.rays.shape[:3], np.uint8)
    label[:, 10:40, left:right] = 1
    return RenderedBody(label, np.where(label > 0, np.float32(depth_m), np.float32(FAR)))


def in_color(body: RenderedBody, color: np.ndarray) -> RenderedBody:
    """Return the body with all parts of one known colour."""
    colored = expected(POSES[0], color)
    return body._replace(group=colored.group, log_likelihood=colored.log_likelihood)


def masks_of(*bodies: RenderedBody) -> Frame:
    """Return an observation without images whose masks show the bodies."""
    shown = np.any([body.label > 0 for body in bodies], axis=0)
    masks = np.array([enlarged(one.astype(np.uint8) * np.uint8(255), GRID.step, SHAPE[1:]) for one in shown])
    return Frame(0, np.zeros((*SHAPE[:1], 0, 0, 3), np.uint8), masks)


@pytest.mark.parametrize("first", [2.0, 3.0])
def test_the_nearer_of_two_bodies_owns_pixels_that_both_cover(first: float) -> None:
    bodies = [block(2, 25, first), block(13, 36, 5.0 - first)]
    owner = GRID.sample(assign(RIG, GRID, bodies, masks_of(*bodies)).owner)
    assert (owner[:, 20, 4:10] == 0).all() and (owner[:, 20, 28:34] == 1).all()
    assert (owner[:, 20, 17:21] == (0 if first < 2.5 else 1)).all()


def test_a_wide_body_far_in_front_of_another_owns_what_both_cover() -> None:
    """No float32 overflow or logarithm of zero: warnings are errors."""
    bodies = [block(0, 40, 4.0), block(0, 40, 40.0)]
    owner = GRID.sample(assign(RIG, GRID, bodies, masks_of(*bodies)).owner)
    assert (owner[:, 20, 2:38] == 0).all()


def test_each_pixel_is_evidence_for_one_of_two_people() -> None:
    bodies = [block(5, 20, 3.0), block(15, 30, 3.01)]
    frame = masks_of(*bodies)
    found = assign(RIG, GRID, bodies, frame)
    one, other = (found.share(frame, person).masks for person in (0, 1))
    shown = frame.masks > 0
    assert ((one == 255) ^ (other == 255))[shown].all() and (one[~shown] == 0).all()
    assert (np.where(one == 255, other, one)[shown] == OTHERS).all()


def test_pixels_that_no_body_covers_are_evidence_for_everybody_in_reach() -> None:
    """A limb of the one that is in a wrong place, near the other: it is found again only in these pixels."""
    bodies, limb = [block(2, 10, 3.0), block(22, 30, 3.0)], block(10, 20, 3.0)
    frame, step = masks_of(*bodies, limb), GRID.step
    for rows in (slice(19 * step), slice(22 * step, None)):  # a thin one: a large region would be somebody unknown
        frame.masks[:, rows, 10 * step : 20 * step] = 0
    found = assign(RIG, GRID, bodies, frame)
    one, other = (GRID.sample(found.share(frame, person).masks)[:, 20] for person in (0, 1))
    cell_m = 3.0 * GRID.step / RIG[0].matrix[0, 0]
    middle, ends = slice(15, 17), round(NEAR_M / cell_m)
    assert ends < 5 and (one[:, middle] == 255).all() and (other[:, middle] == 255).all()
    assert (other[:, 10 : 10 + ends - 1] == OTHERS).all() and (other[:, 2:10] == OTHERS).all()
    assert (one[:, 22:30] == OTHERS).all() and (GRID.sample(found.unknown(frame).masks)[:, 20, middle] == OTHERS).all()


def test_pixels_far_from_all_bodies_belong_to_somebody_unknown() -> None:
    known, stranger = block(0, 8, 2.0), block(28, 36, 2.0)
    frame = masks_of(known, stranger)
    found = assign(RIG, GRID, [known, None], frame)
    owner = GRID.sample(found.owner)
    assert (owner[:, 12:38, 1:7] == 0).all() and (owner[:, 12:38, 29:35] == NOBODY).all()
    given, lost = (GRID.sample(found.share(frame, 1, unknown).masks) for unknown in (False, True))
    assert (given[:, 20, 29:35] == OTHERS).all() and (lost[:, 20, 29:35] == 255).all()
    unknown = GRID.sample(found.unknown(frame).masks)
    assert (unknown[:, 20, 29:35] == 255).all() and (unknown[:, 20, 1:7] == OTHERS).all()
    areas = found.areas(frame.masks)
    assert areas[0].min() > 7 * 28 and areas[1].max() == 0 and areas[2].min() > 7 * 28


def test_a_hand_that_is_not_where_it_is_expected_is_the_person_s() -> None:
    """It is too small to be somebody unknown, and nearer than half a metre."""
    body, hand = block(0, 12, 2.0), np.zeros(GRID.rays.shape[:3], np.uint8)
    hand[:, 12:14, 12:17] = 1
    whole = body._replace(label=np.maximum(body.label, hand))
    owner = GRID.sample(assign(RIG, GRID, [body], masks_of(whole)).owner)
    assert (owner[hand > 0] == 0).all()


def test_the_only_body_gets_the_whole_masks() -> None:
    body = block(5, 15, 2.0)
    frame = masks_of(body)
    np.testing.assert_array_equal(assign(RIG, GRID, [body], frame).share(frame, 0).masks, frame.masks)


def test_a_network_s_masks_of_people_move_the_border_between_bodies() -> None:
    """The bodies are expected 0.2 m too far to the right."""
    true, bodies = [block(4, 18, 3.0), block(18, 32, 3.0)], [block(8, 22, 3.0), block(22, 36, 3.0)]
    frame = masks_of(*true)
    people = np.zeros(frame.masks.shape, np.uint8)
    for n, body in enumerate(true):
        for view, label in enumerate(body.label):
            people[view] |= enlarged(label, GRID.step, SHAPE[1:]) << n
    alone, seen = (GRID.sample(assign(RIG, GRID, bodies, f).owner) for f in (frame, replace(frame, people=people)))
    assert (alone[:, 12:38, 19:21] == 0).all()
    assert (seen[:, 12:38, 19:21] == 1).all() and (seen[:, 12:38, 5:17] == 0).all()


def test_a_network_s_mask_that_fits_no_body_shows_somebody_unknown() -> None:
    known, stranger = block(4, 18, 3.0), block(18, 32, 3.0)
    frame = masks_of(known, stranger)
    people = np.zeros(frame.masks.shape, np.uint8)
    for n, body in enumerate((known, stranger)):
        for view, label in enumerate(body.label):
            people[view] |= enlarged(label, GRID.step, SHAPE[1:]) << n
    owner = GRID.sample(assign(RIG, GRID, [known], replace(frame, people=people)).owner)
    assert (owner[:, 12:38, 6:16] == 0).all() and (owner[:, 12:38, 20:30] == NOBODY).all()


def test_a_pixel_of_another_color_is_in_doubt_for_its_owner_and_for_who_has_the_color() -> None:
    """A hand of the second person lies on the first one's trunk, where it is not expected."""
    bodies = [in_color(block(2, 18, 3.0), COLORS[0]), in_color(block(20, 36, 3.0), COLORS[1])]
    frame, hand = masks_of(*bodies), np.zeros(GRID.rays.shape[:3], np.bool_)
    hand[:, 20:24, 12:14] = True
    color = np.where(np.arange(GRID.rays.shape[2]) < 19, 0, 1)
    cells = np.where(hand, 1, color[None, None])
    images = np.array([enlarged(COLORS[view], GRID.step, SHAPE[1:]) for view in cells])
    frame = replace(frame, images=images)
    found = assign(RIG, GRID, bodies, frame)
    assert (GRID.sample(found.owner)[hand] == 0).all()
    for person in (0, 1):
        doubt = found.share(frame, person).doubt
        assert doubt is not None and (doubt[hand] == 1).all() and not doubt[~hand].any()
    far = [bodies[0], bodies[1]._replace(depth=np.where(bodies[1].label > 0, np.float32(30), np.float32(FAR)))]
    doubt = assign(RIG, GRID, far, frame).share(frame, 1).doubt  # the hand is two metres from the body
    assert doubt is not None and not doubt.any()


def test_a_color_that_suits_both_or_is_unknown_leaves_no_doubt() -> None:
    blocks = [block(2, 18, 3.0), block(20, 36, 3.0)]
    frame = replace(masks_of(*blocks), images=np.broadcast_to(COLORS[0], (*SHAPE, 3)))
    doubt = assign(RIG, GRID, [in_color(one, COLORS[0]) for one in blocks], frame).share(frame, 0).doubt
    assert doubt is not None and not doubt.any()
    one_known = [in_color(blocks[0], COLORS[0]), blocks[1]]
    doubts = [assign(RIG, GRID, one_known, frame).share(frame, person).doubt for person in (0, 1)]
    assert all(doubt is not None and not doubt.any() for doubt in doubts)
    assert assign(RIG, GRID, blocks, frame).share(frame, 0).doubt is None
