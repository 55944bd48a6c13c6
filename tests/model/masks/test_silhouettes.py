"""Cleaning and scales of masks."""

import numpy as np

from tests.model.figures import draw_silhouettes
from tests.model.ring import ring_of_cameras
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.body.gait_poses import walking_pose
from tk.model.masks.silhouettes import Views, clean

RIG = ring_of_cameras(2, width=101, height=133)
BODY = build_cone_body(BodyDimensions.from_stature(1.7))
POSE = walking_pose(BODY.skeleton, 0.2)
POSE[2] = 0.9
MASKS = draw_silhouettes(BODY, RIG, POSE[None])[0]


def test_cleaning_removes_only_specks_and_holes():
    mask = MASKS[0]
    dirty = mask.copy()
    dirty[2:4, 2:5] = 255
    y, x = (int(np.median(v)) for v in np.nonzero(mask[:50]))
    dirty[y : y + 2, x : x + 1] = 0
    np.testing.assert_array_equal(clean(dirty), mask)
    np.testing.assert_array_equal(clean(mask), mask)
    nothing = np.zeros_like(mask)
    np.testing.assert_array_equal(clean(nothing), nothing)


def test_gaps_between_limbs_stay_open():
    mask = np.zeros((100, 80), np.uint8)
    mask[10:90, 20:60] = 255
    mask[40:60, 35:45] = 0
    np.testing.assert_array_equal(clean(mask), mask)


def test_pyramid_halves_images_of_any_size():
    pyramid = Views(RIG).pyramid(MASKS, 3, False)
    assert [m.shape for m in pyramid.masks] == [(2, 133, 101), (2, 67, 51), (2, 34, 26)]
    assert pyramid.sizes[2].tolist() == [[26, 34]] * 2
    fine = MASKS[:, :132, :100].astype(float).reshape(2, 66, 2, 50, 2).mean(axis=(2, 4))
    assert np.abs(pyramid.masks[1][:, :66, :50] - fine).max() <= 1
