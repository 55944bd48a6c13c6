"""Decisions on label images, on drawings small enough to know the answer."""

import numpy as np
import pytest

from tk.kernels.background import level_of
from tk.model.masks.regions import enclosed, person_parts, trim_rim, without_penumbrae

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


def test_enclosed_compares_shares_of_the_border():
    patch = boxes((slice(10, 20), slice(10, 20)))
    three_sides = boxes((slice(7, 23), slice(7, 20))) & ~patch
    assert np.array_equal(enclosed(patch, three_sides, 0.6), patch)
    assert not enclosed(patch, three_sides, 0.9).any()


def test_the_largest_part_of_each_image_is_kept_however_weak_it_is():
    body, other = boxes((slice(10, 30), slice(5, 20))), boxes((slice(18, 28), slice(26, 36)))
    strong = levels(body, 100.0)
    np.testing.assert_array_equal(parts(body | other, strong, starts=(0, 22)), body | other)
    np.testing.assert_array_equal(parts(body | other, strong), body)


def test_a_weak_smaller_part_is_removed_and_a_strong_one_kept():
    body, edge = boxes((slice(10, 30), slice(5, 20))), boxes((slice(33, 36), slice(30, 50)))
    np.testing.assert_array_equal(parts(body | edge, levels(body | edge, 10.0)), body)
    np.testing.assert_array_equal(parts(body | edge, levels(body | edge, 100.0)), body | edge)


def test_small_parts_are_removed_and_small_holes_filled():
    body, hole, speck = (boxes(at) for at in ((slice(5, 35), slice(5, 30)), (slice(12, 15), slice(10, 14)), (2, 50)))
    mask = (body & ~hole) | speck
    strong = levels(mask, 100.0)
    np.testing.assert_array_equal(parts(mask, strong, area_min=13), body)
    np.testing.assert_array_equal(parts(mask, strong, area_min=12), body & ~hole)


def test_rim_pixels_that_show_the_scene_are_removed():
    person = boxes((slice(10, 30), slice(10, 40)))
    swollen = boxes((slice(7, 33), slice(7, 43)))
    contrast = np.where(person, 80, 2).astype(np.uint8)
    np.testing.assert_array_equal(trim_rim(swollen.view(np.uint8), contrast, 0.3, 4), person)
    # pixels without contrast deep inside are kept
    contrast[18:22, 20:30] = 0
    np.testing.assert_array_equal(trim_rim(swollen.view(np.uint8), contrast, 0.3, 4), person)
