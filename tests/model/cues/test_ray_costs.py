"""What rays cost: E_S without colours, doubts and colours on top of it, and views that see nobody."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.figures import BODY, draw_silhouettes
from tests.model.ring import ring_of_cameras
from tk.kernels.line_search import COLOR_BINS
from tk.kernels.mask_values import OTHERS
from tk.kernels.raycast import costs
from tk.model.body.cone_body import COLOR_GROUPS
from tk.model.body.gait_poses import walking_pose
from tk.model.cameras.camera import Rig
from tk.model.cues.part_colors import PartColors, color_bins
from tk.model.cues.ray_costs import UNCERTAIN_COST, Evidence, RayGrid, unpacked

RIG = ring_of_cameras(3, width=120, height=160)
FINE = RayGrid(RIG, 160)
POSE = walking_pose(BODY.skeleton, 0.2)
POSE[2] = 0.92
OTHER = POSE.copy()
OTHER[:2] += 0.08
POSES = np.stack([POSE, OTHER])
DRAWN = draw_silhouettes(BODY, RIG, POSES)
MASKS = DRAWN[0]


def share_wrong(drawn, masks):
    """E_S (V,) as the paper defines it."""
    return ((drawn > 0) ^ (masks > 0)).sum(axis=(1, 2)) / (masks > 0).sum(axis=(1, 2))


def by_view(evidence, poses=POSES):
    return evidence.shares(costs(BODY.arrays, evidence.grid.packed, evidence.rays, poses))


def test_grids_sample_the_middle_of_their_squares():
    assert FINE.step == 1 and RayGrid(RIG, 40).step == 4 and RayGrid(RIG, 10_000).step == 1
    grid = RayGrid(RIG, 40)
    pictures = np.arange(3 * 160 * 120).reshape(3, 160, 120)
    sampled = grid.sample(pictures)
    assert sampled.shape == grid.rays.shape[:3] == (3, 40, 30)
    assert sampled[1, 2, 3] == pictures[1, 2 + 8, 2 + 12]


def test_cues_are_asked_for_poses_only_that_the_rays_do_not_refuse():
    class Cue:
        def cost(self, poses):
            asked.append(len(poses))
            return poses[:, 0]

    asked, evidence = [], Evidence.of(FINE, MASKS, cues=(Cue(),))
    mismatch, poses = np.array([0.2, np.inf, 0.1]), np.repeat(POSE[None], 3, axis=0)
    poses[:, 0] = 1.0, 2.0, 3.0
    without = Evidence.of(FINE, MASKS).cost_of(mismatch, poses)
    np.testing.assert_array_equal(evidence.cost_of(mismatch, poses), without + poses[:, 0])
    assert asked == [2] and np.isinf(without[1])
    assert np.isinf(evidence.cost_of(mismatch[1:2], poses[1:2])).all() and asked == [2]


def test_without_colors_the_cost_is_the_papers_error():
    evidence = Evidence.of(FINE, MASKS)
    total, (mean, met) = by_view(evidence), evidence.cast(BODY, POSES)
    expected = np.array([share_wrong(drawn, MASKS) for drawn in DRAWN])
    np.testing.assert_allclose(total, expected, atol=1e-6)
    assert (total[1] > 0.1).all() and (total[0] < 1e-6).all()
    residual = evidence.residual(met.label[1])
    np.testing.assert_allclose(residual.sum(axis=1), expected[1], atol=1e-12)
    outside = (DRAWN[1] > 0) & (MASKS == 0)
    missing = np.count_nonzero(outside, axis=(1, 2)) / np.count_nonzero(MASKS, axis=(1, 2))
    np.testing.assert_allclose(residual[:, 0], missing, atol=1e-12)
    np.testing.assert_allclose(mean, expected.mean(axis=1), atol=1e-6)
    np.testing.assert_array_equal(mean, evidence.mismatch(BODY, POSES))


def test_coarse_grid_gives_nearly_the_same_cost():
    coarse = by_view(Evidence.of(RayGrid(RIG, 54), MASKS))
    np.testing.assert_allclose(coarse[1], share_wrong(DRAWN[1], MASKS), rtol=0.2)


def test_view_without_a_person_does_not_count():
    masks = MASKS.copy()
    masks[1] = 0
    evidence = Evidence.of(FINE, masks)
    total, (mean, met) = by_view(evidence), evidence.cast(BODY, POSES)
    assert np.isnan(total[:, 1]).all() and np.isfinite(total[:, [0, 2]]).all()
    assert np.isnan(evidence.residual(met.label[0])[:, 0]).tolist() == [False, True, False]
    np.testing.assert_allclose(mean, total[:, [0, 2]].mean(axis=1))
    nobody = Evidence.of(FINE, 0 * masks)
    assert np.isnan(by_view(nobody)).all() and np.isinf(nobody.mismatch(BODY, POSES)).all()


def test_uncertain_pixels_halve_the_cost_outside_the_mask():
    """Where the mask may have missed the person, a part that covers it costs less; what it holds costs the same."""
    whole = by_view(Evidence.of(FINE, MASKS))
    doubted = by_view(Evidence.of(FINE, MASKS, MASKS == 0))
    outside = ((DRAWN[1] > 0) & (MASKS == 0)).sum(axis=(1, 2)) / (MASKS > 0).sum(axis=(1, 2))
    np.testing.assert_allclose(whole[1] - doubted[1], (1 - UNCERTAIN_COST) * outside, atol=1e-6)
    np.testing.assert_allclose(by_view(Evidence.of(FINE, MASKS, MASKS == 255)), whole, atol=1e-6)


def test_color_of_another_part_costs():
    """A picture in the parts' own colours costs the pose nothing; with arms and trunk changed about it does."""
    label = FINE.render(BODY, POSES[:1]).label[0]
    palette = np.random.default_rng(3).permutation(15)[: len(COLOR_GROUPS)] * 17
    lookup = np.zeros((len(BODY.parts) + 1, 3), np.uint8)
    for p, g in enumerate(BODY.color_group, 1):
        level = palette[g]
        lookup[p] = (level, 255 - level, (7 * level) % 255)
    bins, colors = color_bins(lookup[label]), PartColors(BODY)
    colors.learn(bins[label > 0], label[label > 0])
    right = by_view(Evidence.of(FINE, MASKS, None, bins, colors), POSES[:1])
    assert right.max() < 0.02
    arm, trunk = (GROUP_OF[name] for name in ("forearm_l", "chest"))
    swapped = label.copy()
    is_arm, is_trunk = (np.isin(label, np.flatnonzero(BODY.color_group == g) + 1) for g in (arm, trunk))
    swapped[is_arm], swapped[is_trunk] = NAMES.index("chest") + 1, NAMES.index("forearm_l") + 1
    wrong = by_view(Evidence.of(FINE, MASKS, None, color_bins(lookup[swapped]), colors), POSES[:1])
    share = (is_arm | is_trunk).sum(axis=(1, 2)) / (MASKS > 0).sum(axis=(1, 2))
    np.testing.assert_allclose(wrong[0], UNCERTAIN_COST * share, rtol=0.1)


def test_doubt_costs_what_neither_the_other_person_nor_the_part_explains():
    """Each ray against the definition: the other one's mismatch, or that of the part that is hit, whichever is less."""
    rng = np.random.default_rng(5)
    label = FINE.render(BODY, POSES[:1]).label[0]
    images = rng.integers(0, 256, (*label.shape, 3), np.uint8)
    masks = np.where((label > 0) & (np.arange(120) > 60), OTHERS, MASKS).astype(np.uint8)
    colors, doubt = PartColors(BODY), rng.random(label.shape, np.float32)
    bins = color_bins(images)
    colors.learn(bins[label > 0], label[label > 0])
    sure, doubted = (Evidence.of(FINE, masks, None, bins, colors, doubt=d) for d in (None, doubt))
    others = masks == OTHERS
    assert not sure.rays[others].any() and others.any()
    np.testing.assert_array_equal(doubted.rays[~others], sure.rays[~others])
    for ray in np.argwhere(others)[::37]:
        d, own = doubt[tuple(ray)], colors.mismatch[bins[tuple(ray)]]
        expected = UNCERTAIN_COST * np.array([d, *(min(d, one) for one in own)], np.float32)
        np.testing.assert_allclose(doubted.rays[tuple(ray)], expected, rtol=1e-6)


def test_packed_colors_say_what_the_rays_through_the_masks_say():
    """Of all colours, and of doubts between no doubt and a full one, nothing is lost but a fifteenth of the doubt."""
    rng = np.random.default_rng(7)
    shape = FINE.rays.shape[:3]
    masks = rng.choice(np.array([0, OTHERS, 255], np.uint8), shape)
    bins, doubt = rng.integers(0, COLOR_BINS, shape, np.int32), rng.random(shape, np.float32)
    doubt[0], doubt[1] = 0.0, 1.0
    evidence, shown = Evidence.of(FINE, masks, None, bins, doubt=doubt), masks > 0
    found_bins, found_doubt = unpacked(evidence.packed_colors())
    np.testing.assert_array_equal(found_bins[shown], bins[shown])
    np.testing.assert_allclose(found_doubt[shown], doubt[shown], atol=0.5 / 15 + 1e-6)
    np.testing.assert_array_equal(found_doubt[:2][shown[:2]], doubt[:2][shown[:2]])
    assert not found_bins[~shown].any() and not found_doubt[~shown].any()
    assert Evidence.of(FINE, masks).packed_colors() is None and unpacked(None) == (None, None)


@pytest.mark.parametrize("rows", [40, 54, 160])
def test_squares_of_a_finer_grid_are_found_at_the_rays_of_a_coarser_one(rows):
    fine, coarse = RayGrid(RIG, 80), RayGrid(RIG, rows)
    height, width = RIG.frame_shape
    of_pixel = np.arange(height)[:, None] // fine.step * 1000 + np.arange(width) // fine.step
    cells = np.broadcast_to(of_pixel[:: fine.step, :: fine.step], fine.rays.shape[:3])
    expected = coarse.sample(np.broadcast_to(of_pixel, (len(RIG), height, width)))
    np.testing.assert_array_equal(coarse.nearest(fine, cells), expected)


NAMES = [part.name for part in BODY.parts]
GROUP_OF = dict(zip(NAMES, BODY.color_group.tolist(), strict=True))


def test_images_of_different_sizes_are_handled():
    narrow = Rig((RIG[0], replace(RIG[1], width=80, height=100), RIG[2]))
    masks = MASKS.copy()
    masks[1, 100:], masks[1, :, 80:] = 0, 0
    drawn = draw_silhouettes(BODY, narrow, POSES)
    total = by_view(Evidence.of(RayGrid(narrow, 160), masks))
    np.testing.assert_allclose(total, [share_wrong(d, masks) for d in drawn], atol=1e-6)
