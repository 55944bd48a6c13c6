"""Decisions on label images, on drawings small enough to know the answer."""

import numpy as np
import pytest

from tk.kernels.background import level_of
from tk.model.masks.mosaic import Mosaic
from tk.model.masks.regions import person_parts, without_penumbrae

SHAPE = (40, 60)


def boxes(*slices):
    mask = np.zeros(SHAPE, bool)
    for rows, columns in slices:
        mask[rows, columns] = True
    return mask


def levels(mask, value):
    return np.where(mask, level_of(value), 0).astype(np.uint8)


def parts(mask, statistic, starts=(0,), area_min=20.0):
    return person_parts(mask, statistic, np.array(starts), 64.0, area_min).view(np.bool_)


def test_shadow_edges_are_removed_and_sharp_outlines_kept():
    labels = boxes((slice(5, 7), slice(5, 50)))
    difference = boxes((slice(5, 20), slice(5, 50)))
    plain = levels(difference, 200.0)
    assert not without_penumbrae(labels, plain, levels(labels, 20.0), 0.2, 8.0).any()
    np.testing.assert_array_equal(without_penumbrae(labels, plain, levels(labels, 80.0), 0.2, 8.0), labels)


@pytest.mark.parametrize("statistic, is_certain", [(4.0, False), (20.0, True)])
def test_a_thick_region_is_kept_where_its_statistic_is_strong(statistic, is_certain):
    labels = boxes((slice(5, 20), slice(5, 50)))
    certain = without_penumbrae(labels, levels(labels, 500.0), levels(labels, statistic), 0.2, 8.0)
    assert certain.any() == is_certain


def test_the_largest_part_of_each_image_is_kept_however_weak_it_is():
    body, other = boxes((slice(10, 30), slice(5, 20))), boxes((slice(18, 28), slice(26, 36)))
    strong = levels(body, 100.0)
    np.testing.assert_array_equal(parts(body | other, strong, starts=(0, 22)), body | other)
    np.testing.assert_array_equal(parts(body | other, strong), body)


def test_a_weak_smaller_part_is_removed_and_a_strong_one_kept():
    body, edge = boxes((slice(10, 30), slice(5, 20))), boxes((slice(33, 36), slice(30, 50)))
    np.testing.assert_array_equal(parts(body | edge, levels(body | edge, 10.0)), body)
    np.testing.assert_array_equal(parts(body | edge, levels(body | edge, 100.0)), body | edge)


def test_tightened_boxes_hold_the_set_pixels_and_a_margin():
    mosaic = Mosaic.of(np.array([[4, 2, 20, 15], [0, 0, 0, 0], [0, 0, 30, 20]], np.int32), 2)
    marks = np.zeros(mosaic.shape, np.uint8)
    mosaic.part(marks, 0)[1, 6:9] = 1
    tight = mosaic.tightened(marks, 3, 2)
    np.testing.assert_array_equal(tight.boxes, [[7, 2, 9, 5], [0, 0, 0, 0], [0, 0, 0, 0]])
    part = mosaic.part_of(marks, 0, tight.boxes[0])
    assert part.shape == (5, 9) and part.sum() == 3 and part[1, 3:6].all()
