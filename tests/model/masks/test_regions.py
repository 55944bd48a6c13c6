"""Decisions on label images, on drawings small enough to know the answer."""

import numpy as np
import pytest

from tk.kernels.background import level_of
from tk.model.masks.mosaic import Mosaic
from tk.model.masks.regions import person_parts, shadow_evidence, without_penumbrae

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


def evidence(image, scene, where):
    """`shadow_evidence` of the pixels of a drawing, noise variance 4."""
    pixels = np.flatnonzero(where)
    values = (each.ravel()[pixels].astype(np.float32) for each in (image, scene))
    return shadow_evidence(*values, pixels, SHAPE, np.full(len(pixels), 4.0, np.float32), 0.7, 5)


@pytest.mark.parametrize("factor, sure", [(0.5, 0.2), (0.75, 0.9), (1.0, 0.9)])
def test_a_shadow_shows_the_structure_of_the_scene(factor, sure):
    rng = np.random.default_rng(1)
    scene, where = 120 + 8 * rng.standard_normal(SHAPE), boxes((slice(5, 25), slice(8, 40)))
    found = evidence(factor * scene + 2 * rng.standard_normal(SHAPE), scene, where)
    assert np.mean(found > 4.6) > sure and np.mean(found > 0) > 0.99


@pytest.mark.parametrize("pattern", [0.0, 12.0], ids=["plain", "patterned"])
def test_cloth_does_not(pattern):
    rng = np.random.default_rng(2)
    scene, where = 120 + 8 * rng.standard_normal(SHAPE), boxes((slice(5, 25), slice(8, 40)))
    found = evidence(100 + np.hypot(pattern, 2) * rng.standard_normal(SHAPE), scene, where)
    assert found.mean() < -0.5 and np.mean(found > 4.6) < 0.02
    if not pattern:
        assert np.mean(found < -4.6) > 0.8


def test_a_plain_scene_shows_neither():
    rng = np.random.default_rng(3)
    where = boxes((slice(5, 25), slice(8, 40)))
    found = evidence(100 + 2 * rng.standard_normal(SHAPE), np.full(SHAPE, 120.0), where)
    assert np.abs(found).max() < 1e-3


def test_the_outline_of_a_shadow_is_no_sign_of_cloth():
    rng = np.random.default_rng(4)
    scene, where = 120 + 8 * rng.standard_normal(SHAPE), boxes((slice(5, 25), slice(8, 40)))
    light = np.interp(np.arange(SHAPE[1]), [16, 24], [0.75, 1.0])
    found = evidence(light * scene + 2 * rng.standard_normal(SHAPE), scene, where)
    assert np.mean(found < -4.6) < 0.02


def test_evidence_is_that_of_squares_summed_one_by_one():
    rng = np.random.default_rng(5)
    scene = 120 + 8 * rng.standard_normal(SHAPE)
    image, where = 0.8 * scene + 5 * rng.standard_normal(SHAPE), rng.random(SHAPE) < 0.7
    where[0] = where[-1] = where[:, 0] = where[:, -1] = False
    found = np.zeros(SHAPE)
    found[where] = evidence(image, scene, where)
    for y, x in ((10, 10), (20, 33), (30, 50)):
        shown, expected = [], []
        for v in range(y - 2, y + 3):
            for u in range(x - 2, x + 3):
                for w, t in ((v + 1, u), (v, u + 1)):
                    if where[v, u] and where[w, t]:
                        shown.append(image[w, t] - image[v, u])
                        expected.append(scene[w, t] - scene[v, u])
        shown, expected = np.array(shown), np.array(expected)
        factor = np.clip(shown @ expected / (expected @ expected), 0.7, 1.0)
        least = 2 * 4.0 * len(shown)
        ratio = (shown @ shown + least) / (np.sum((shown - factor * expected) ** 2) + least)
        if where[y, x]:
            assert found[y, x] == pytest.approx(len(shown) / 4 * np.log(ratio), rel=1e-3, abs=1e-3)
