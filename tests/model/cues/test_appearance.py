"""Colour models of the patches: learning, fitting, eq. 16 and its guards."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.model.cues.appearance import FLOOR_YUV, RATE, Appearance, to_yuv

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


def test_learns_a_gaussian_a_channel():
    model, patch, colors = learned()
    for p in (0, 1):
        np.testing.assert_allclose(model.mean[p], np.median(to_yuv(colors[patch == p]), axis=0))
    np.testing.assert_array_equal(model.known, [True, True, False])


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
    fits = model.segment(colors, np.array([1, 1, 1, 0]))
    # the untaught patch fits everything, and what no camera sees fits every patch
    np.testing.assert_array_equal(fits, [0b101, 0b110, 0b100, 0b111])


# Eq. 16


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_update_is_equation_16(seed):
    model, _, _ = learned()
    rng = np.random.default_rng(seed)
    patch, colors = rng.integers(0, 2, 60), rng.uniform(0, 255, (60, 3))
    updated = model.updated(patch, colors)
    for p in (0, 1):
        incoming = to_yuv(colors[patch == p]).mean(axis=0)
        np.testing.assert_allclose(updated.mean[p], (1 - RATE) * model.mean[p] + RATE * incoming, atol=1e-9)
    np.testing.assert_array_equal(updated.deviation, model.deviation)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_samples_teach_nothing(count):
    model, _, _ = learned()
    updated = model.updated(np.zeros(count, int), np.tile(BLUE, (count, 1)))
    np.testing.assert_allclose(updated.mean, model.mean, atol=1e-12)


def test_an_untaught_patch_stays_untaught():
    model, _, _ = learned()
    updated = model.updated(np.full(20, 2), np.tile(BLUE, (20, 1)))
    np.testing.assert_allclose(updated.mean, model.mean, atol=1e-12)
    assert not updated.known[2]
