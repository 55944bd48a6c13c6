"""The outline's entries in one launch: against contour points, search and NumPy one after the other."""

from dataclasses import replace

import numpy as np
import pytest

from tests.kernels.test_contour import BODY, RIG, STRIPS, some_poses
from tk.kernels import alignment as a
from tk.kernels.edge_search import DOUBTFUL, LINE_NUMBERS, OUTLINE, search_edges
from tk.kernels.edges import EdgeConfig
from tk.kernels.outline import OutlineKernel, OutlineSettings
from tk.model.strips import contour_kernel

SIZES = np.array([(c.height, c.width) for c in RIG], np.int32)
DIAMETER = np.array([p.diameter_m for p in BODY.pieces])
SETTINGS = OutlineSettings(reach_m=0.2, sigma_m=0.07, nu=0.3, weight=1.5)
CONTOURS = contour_kernel(BODY, STRIPS, RIG)
KERNEL = OutlineKernel(CONTOURS, SIZES, DIAMETER)


def masks_of(seed: int) -> np.ndarray:
    """(C, H, W) blotches: changes from person to background in most neighbourhoods, and none in some."""
    rng = np.random.default_rng(seed)
    H, W = RIG.frame_shape
    coarse = rng.random((len(RIG), H // 24 + 1, W // 24 + 1)) < 0.3
    return (255 * np.repeat(np.repeat(coarse, 24, 1), 24, 2)[:, :H, :W]).astype(np.uint8)


def oracle(masks, poses, chosen, s):
    """(B, C·K·2, 17) from the contour points that are on the outline, and their lines."""
    points = CONTOURS(poses, chosen)
    B, K = chosen.shape
    entries = np.zeros((B, len(RIG), K, 2, a.ENTRY_NUMBERS), np.float32)
    for b, v, k, slot in np.argwhere(points.outer):
        pixel, normal = points.pixels[b, v, k, slot], points.normals[b, v, k, slot]
        pixels_a_metre = points.scale[b, v, k, slot]
        line = np.zeros((1, LINE_NUMBERS), np.float32)
        line[0] = [OUTLINE, v, *pixel, *pixel, *normal, *normal, np.float32(s.reach_m) * pixels_a_metre]
        nothing = np.zeros((*masks.shape, 3), np.uint8)
        found = search_edges(nothing, masks, SIZES, line, 0.1, 0.0, EdgeConfig())[0]
        sigma = (s.sigma_m or DIAMETER[STRIPS.piece[chosen[b, k]]]) * pixels_a_metre
        row = entries[b, v, k, slot]
        row[a.POINT_A : a.POINT_A + 3] = row[a.POINT_B : a.POINT_B + 3] = points.points_zero[b, v, k, slot]
        row[a.LAST_DOF] = BODY.skeleton.segment_dof[points.segment[b, k]]
        row[a.CAMERA] = v
        row[a.TARGET : a.TARGET + 2] = found[1:3]
        row[a.NORMAL : a.NORMAL + 2] = normal
        row[a.INV_SIGMA2] = 1 / sigma**2
        row[a.STATE] = a.ASSIGNED if found[0] else a.UNASSIGNABLE
        row[a.SCALE] = s.weight / points.outer[b].sum()
        row[a.NU] = s.nu
    return entries.reshape(B, -1, a.ENTRY_NUMBERS)


@pytest.mark.parametrize("settings", [SETTINGS, replace(SETTINGS, sigma_m=0.0, reach_m=0.05, nu=1.0)])
def test_entries_are_those_of_contour_and_search(settings):
    poses = some_poses(2, seed=31)
    chosen = STRIPS.draw(np.random.default_rng(0), batch=2, pairs=2, singles=1)
    masks = masks_of(1)
    got, expected = KERNEL(masks, poses, chosen, settings), oracle(masks, poses, chosen, settings)
    states = np.bincount(expected[..., a.STATE].astype(int).ravel(), minlength=3)
    assert states.min() > 20, "all states occur"
    np.testing.assert_allclose(got, expected, rtol=2e-6)


def test_where_the_mask_is_in_doubt_beyond_its_edge_there_is_no_entry():
    """Doubtful pixels are background for the search; an edge with one within three pixels beyond it is dropped."""
    poses, chosen = some_poses(2, seed=31), STRIPS.draw(np.random.default_rng(0), batch=2, pairs=2, singles=1)
    masks = masks_of(1)
    sure = KERNEL(masks, poses, chosen, SETTINGS)
    levels = masks.copy()
    levels[:, :, ::2][masks[:, :, ::2] == 0] = DOUBTFUL
    levels[0] = masks[0]
    found = KERNEL(levels, poses, chosen, SETTINGS)
    dropped = (sure[..., a.STATE] == a.ASSIGNED) & (found[..., a.STATE] == a.ABSENT)
    for b, e in np.argwhere(sure[..., a.STATE] == a.ASSIGNED):
        row = sure[b, e]
        beyond = row[a.TARGET : a.TARGET + 2] + np.array([[0.5], [1.5], [2.5]]) * row[a.NORMAL : a.NORMAL + 2]
        x, y = np.clip(np.rint(beyond).astype(int), 0, np.array(masks.shape[:0:-1]) - 1).T
        assert dropped[b, e] == (levels[int(row[a.CAMERA]), y, x] == DOUBTFUL).any()
    assert dropped.sum() > 20 and (found[..., a.STATE] == a.ASSIGNED).sum() > 20
    # the others share the weight among them
    np.testing.assert_allclose(found[..., a.SCALE].sum(axis=1), SETTINGS.weight, rtol=1e-5)
    same = (found[..., a.STATE] != a.ABSENT)[..., None] & (np.arange(a.ENTRY_NUMBERS) != a.SCALE)
    np.testing.assert_array_equal(found[same], sure[same])


def test_points_outside_of_a_picture_are_unassignable():
    """The search begins inside the picture proper, not in the padding that makes pictures one size."""
    small = OutlineKernel(CONTOURS, SIZES // 8, DIAMETER)
    poses, chosen = some_poses(1, seed=32), STRIPS.even(3)[None]
    full = KERNEL(masks_of(2), poses, chosen, SETTINGS)
    cut = small(masks_of(2), poses, chosen, SETTINGS)
    present = full[..., a.STATE] != a.ABSENT
    np.testing.assert_array_equal(cut[..., a.STATE] != a.ABSENT, present)
    assert (full[..., a.STATE] == a.ASSIGNED).sum() > 2 * (cut[..., a.STATE] == a.ASSIGNED).sum()


def test_no_strips_give_no_entries_and_wrong_ones_are_named():
    pose = some_poses(1, seed=33)
    assert KERNEL(masks_of(3), pose, np.zeros((1, 0), int), SETTINGS).shape == (1, 0, a.ENTRY_NUMBERS)
    with pytest.raises(IndexError, match="there are 0 to"):
        KERNEL(masks_of(3), pose, np.array([[-1]]), SETTINGS)
