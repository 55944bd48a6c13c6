"""Decisions on label pictures, on drawings small enough to see the answer."""

import numpy as np
import pytest

from tk.kernels.background import level_of
from tk.model.masks.regions import beyond_shadows, enclosed, joined, trim_rim, without_penumbrae

SHAPE = (40, 60)


def boxes(*slices):
    mask = np.zeros(SHAPE, bool)
    for rows, columns in slices:
        mask[rows, columns] = True
    return mask


def levels(mask, value):
    return np.where(mask, level_of(value), 0).astype(np.uint8)


def join(mask, seen, statistic, reach=20.0, starts=(0,), hole=0.0):
    person = joined(mask, seen, statistic, np.array(starts), seed=64.0, least=20, hole=hole, reach=reach, width=4)
    return person.view(np.bool_)


def test_edges_of_shadows_are_unsure_and_sharp_outlines_certain():
    labels = boxes((slice(5, 7), slice(5, 50)))
    difference = boxes((slice(5, 20), slice(5, 50)))
    plain = levels(difference, 200.0)
    assert not without_penumbrae(labels, plain, levels(labels, 20.0), 0.2, 8.0).any()
    np.testing.assert_array_equal(without_penumbrae(labels, plain, levels(labels, 80.0), 0.2, 8.0), labels)


@pytest.mark.parametrize("statistic, is_certain", [(4.0, False), (20.0, True)])
def test_a_thick_region_is_certain_where_it_is_strong(statistic, is_certain):
    labels = boxes((slice(5, 20), slice(5, 50)))
    certain = without_penumbrae(labels, levels(labels, 500.0), levels(labels, statistic), 0.2, 8.0)
    assert certain.any() == is_certain


def test_a_faint_sleeve_is_no_shadow_and_a_dark_one_may_be():
    hand = boxes((slice(10, 20), slice(40, 50)))
    sleeve = boxes((slice(10, 20), slice(30, 40)))
    assert np.array_equal(beyond_shadows(sleeve, hand, np.zeros(SHAPE, bool), 9, 0.2), sleeve)
    assert not beyond_shadows(sleeve, hand, sleeve, 9, 0.2).any()
    assert not beyond_shadows(sleeve, np.zeros(SHAPE, bool), np.zeros(SHAPE, bool), 9, 0.2).any()


def test_enclosure_counts_the_border():
    patch = boxes((slice(10, 20), slice(10, 20)))
    three_sides = boxes((slice(7, 23), slice(7, 20))) & ~patch
    assert np.array_equal(enclosed(patch, three_sides, 0.6), patch)
    assert not enclosed(patch, three_sides, 0.9).any()


def test_a_hand_is_joined_through_what_differs_only():
    body = boxes((slice(10, 30), slice(5, 20)))
    hand = boxes((slice(18, 24), slice(36, 44)))
    arm = boxes((slice(18, 24), slice(20, 36)))
    strong = levels(body | hand, 100.0)
    bridged = join(body | hand, arm, strong)
    assert bridged[21, 20:36].all() and not (bridged & ~(body | hand | arm)).any()
    for seen, reach in ((arm & False, 20.0), (arm, 10.0)):
        np.testing.assert_array_equal(join(body | hand, seen, strong, reach), body | hand)


def test_pictures_side_by_side_are_not_joined():
    """Each has a largest part of its own, which stays however weak it is."""
    body, other = boxes((slice(10, 30), slice(5, 20))), boxes((slice(18, 28), slice(26, 36)))
    seen = boxes((slice(0, 40), slice(0, 60)))
    mask = body | other
    np.testing.assert_array_equal(join(mask, seen, levels(body, 100.0), starts=(0, 22)), mask)
    np.testing.assert_array_equal(join(mask, seen, levels(body, 100.0)), body)
    assert join(mask, seen, levels(mask, 100.0)).sum() > mask.sum()
    np.testing.assert_array_equal(join(mask, seen, levels(mask, 100.0), starts=(0, 22)), mask)


def test_weak_parts_go_but_never_the_largest():
    body, edge = boxes((slice(10, 30), slice(5, 20))), boxes((slice(33, 36), slice(30, 50)))
    weak = levels(body | edge, 10.0)
    np.testing.assert_array_equal(join(body | edge, body, weak, 5.0), body)
    strong = levels(body | edge, 100.0)
    np.testing.assert_array_equal(join(body | edge, body, strong, 5.0), body | edge)


def test_specks_go_and_small_holes_close_as_the_parts_are_joined():
    body, hole, speck = (boxes(at) for at in ((slice(5, 35), slice(5, 30)), (slice(12, 15), slice(10, 14)), (2, 50)))
    mask = (body & ~hole) | speck
    strong = levels(mask, 100.0)
    np.testing.assert_array_equal(join(mask, mask, strong, hole=13), body)
    np.testing.assert_array_equal(join(mask, mask, strong, hole=12), body & ~hole)


def test_the_rim_goes_where_it_shows_the_scene():
    person = boxes((slice(10, 30), slice(10, 40)))
    swollen = boxes((slice(7, 33), slice(7, 43)))
    contrast = np.where(person, 80, 2).astype(np.uint8)
    np.testing.assert_array_equal(trim_rim(swollen.view(np.uint8), contrast, 0.3, 4), person)
    # a dark patch inside is no rim
    contrast[18:22, 20:30] = 0
    np.testing.assert_array_equal(trim_rim(swollen.view(np.uint8), contrast, 0.3, 4), person)
