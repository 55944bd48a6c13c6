"""Colour models of the patches: learning, fitting, eq. 16 and its guards."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.model.cues.appearance import FLOOR_YUV, MOST_DRIFT, Appearance, to_yuv
from tk.settings import AppearanceSettings

CONFIG = AppearanceSettings()
RED, GREEN, BLUE = np.array([30.0, 30, 200]), np.array([30.0, 200, 30]), np.array([200.0, 30, 30])


def learned(noise=3.0, seed=0):
    """Three patches, red, green and one that no voxel taught."""
    rng = np.random.default_rng(seed)
    patch = np.repeat([0, 1], 50)
    colors = np.array([RED, GREEN])[patch] + rng.normal(0, noise, (100, 3))
    return Appearance.learn(3, patch, colors), patch, colors


def test_to_yuv_is_opencvs():
    colors = np.random.default_rng(0).integers(0, 256, (200, 3)).astype(np.uint8)
    expected = cv2.cvtColor(colors[None], cv2.COLOR_BGR2YUV)[0].astype(float)
    inside = ((expected > 0) & (expected < 255)).all(axis=1)  # OpenCV clips U and V to a byte
    # V is scaled by 0.877 in both, U by 0.492, their constants rounded differently
    np.testing.assert_allclose(to_yuv(colors)[inside], expected[inside] - [0, 128, 128], atol=1.5)


def test_grey_has_no_colour():
    yuv = to_yuv(np.repeat([[10.0], [128.0], [255.0]], 3, axis=1))
    np.testing.assert_allclose(yuv, [[10, 0, 0], [128, 0, 0], [255, 0, 0]], atol=1e-9)


def test_learns_a_gaussian_a_channel():
    model, patch, colors = learned()
    for p in (0, 1):
        np.testing.assert_allclose(model.mean[p], np.median(to_yuv(colors[patch == p]), axis=0))
    np.testing.assert_array_equal(model.known, [True, True, False])
    np.testing.assert_array_equal(model.initial, model.mean)


def test_a_few_voxels_of_another_colour_do_not_spoil_a_patch():
    clean, patch, colors = learned()
    colors[:10] = BLUE
    spoilt = Appearance.learn(3, patch, colors)
    assert np.abs(spoilt.mean - clean.mean).max() < 3
    assert np.abs(spoilt.deviation - clean.deviation).max() < 3


def test_deviations_have_a_floor_and_otherwise_follow_the_colours():
    np.testing.assert_array_equal(learned(noise=0.0)[0].deviation[:2], [FLOOR_YUV, FLOOR_YUV])
    patch = np.zeros(4000, int)
    wide = np.random.default_rng(1).normal(128, 40, (4000, 3))
    model = Appearance.learn(1, patch, wide)
    np.testing.assert_allclose(model.deviation[0], to_yuv(wide).std(axis=0), rtol=0.08)


def test_voxels_fit_their_own_patch():
    model, _, _ = learned()
    colors = np.array([RED, GREEN, BLUE, BLUE])
    fits = model.segment(colors, np.array([1, 1, 1, 0]), CONFIG)
    # the untaught patch fits everything, and what no camera sees fits every patch
    np.testing.assert_array_equal(fits, [0b101, 0b110, 0b100, 0b111])


def test_without_colour_every_voxel_fits():
    model, _, _ = learned()
    fits = model.segment(np.array([BLUE, RED]), np.ones(2, int), replace(CONFIG, enabled=False))
    np.testing.assert_array_equal(fits, -1)


@pytest.mark.parametrize(("red", "fits_all"), [(0, True), (9, True), (10, False), (500, False)])
def test_a_patch_that_hardly_any_voxel_fits_constrains_nothing(red, fits_all):
    """1 % of 1000 voxels is 10."""
    model, _, _ = learned()
    colors = np.concatenate([np.tile(RED, (red, 1)), np.tile(GREEN, (1000 - red, 1))])
    fits = model.segment(colors, np.ones(1000, int), CONFIG)
    assert ((fits & 1) == 1).all() == fits_all
    assert (fits[red:] >> 1 & 1 == 1).all()


# Eq. 16


@given(st.floats(0, 1), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_update_is_equation_16_within_its_bound(rate, seed):
    config = replace(CONFIG, rate=rate)
    model, _, _ = learned()
    rng = np.random.default_rng(seed)
    patch, colors = rng.integers(0, 2, 60), rng.uniform(0, 255, (60, 3))
    updated = model.updated(patch, colors, config)
    for p in (0, 1):
        incoming = to_yuv(colors[patch == p]).mean(axis=0)
        expected = (1 - rate) * model.mean[p] + rate * incoming
        expected = np.clip(expected, model.mean[p] - MOST_DRIFT, model.mean[p] + MOST_DRIFT)
        np.testing.assert_allclose(updated.mean[p], expected, atol=1e-9)
    np.testing.assert_array_equal(updated.initial, model.initial)
    np.testing.assert_array_equal(updated.deviation, model.deviation)


def test_the_bound_holds_against_a_steady_pull():
    """Section 7.2's failure: a patch taught the wrong colour frame after frame."""
    model, _, _ = learned()
    start = model.mean.copy()
    for _ in range(50):
        model = model.updated(np.zeros(20, int), np.tile(BLUE, (20, 1)), CONFIG)
    distance = np.abs(model.mean - start)
    assert distance[0].max() == pytest.approx(MOST_DRIFT)
    np.testing.assert_allclose(distance[1:], 0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_samples_teach_nothing(count):
    model, _, _ = learned()
    updated = model.updated(np.zeros(count, int), np.tile(BLUE, (count, 1)), CONFIG)
    np.testing.assert_allclose(updated.mean, model.mean, atol=1e-12)


def test_an_untaught_patch_stays_untaught():
    model, _, _ = learned()
    updated = model.updated(np.full(20, 2), np.tile(BLUE, (20, 1)), CONFIG)
    np.testing.assert_allclose(updated.mean, model.mean, atol=1e-12)
    assert not updated.known[2]


def test_nothing_seen_or_switched_off_changes_nothing():
    model, patch, colors = learned()
    assert model.updated(np.zeros(0, int), np.zeros((0, 3)), CONFIG) is model
    assert model.updated(patch, colors, replace(CONFIG, enabled=False)) is model
