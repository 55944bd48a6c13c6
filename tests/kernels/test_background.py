"""The collinearity statistic against a slow, obvious oracle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.kernels.background import PAD, STRIP, Planes, level_of

SETTINGS = {"darkness_offset": 40.0, "shadow_min": 0.7, "difference_min": 4.0}
ONE_LEVEL = 1  # float32 sums in another order may cross the border between two levels


def windows(values):
    """(H, W, 3) to (H, W, 27): the 3×3 windows, zero outside the picture."""
    height, width = values.shape[:2]
    padded = np.pad(values.astype(np.float64), ((1, 1), (1, 1), (0, 0)))
    return np.stack([padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)], axis=-1).reshape(
        height, width, 27
    )


def oracle(image, plate, weight, precision, darkness_offset, shadow_min, difference_min):
    """Levels of the plain difference and of the clamped statistic, pixel by pixel."""
    a, b = windows(image), windows(plate)
    difference = np.zeros(image.shape[:2], int)
    collinearity = np.zeros(image.shape[:2], int)
    for y, x in np.ndindex(image.shape[:2]):
        p, q = np.append(a[y, x], darkness_offset), np.append(b[y, x], darkness_offset)
        scale = weight[y, x] * precision / 27
        plain = np.sum((p - q) ** 2) / 2 * scale
        if plain >= difference_min:
            gram = np.array([[p @ p, p @ q], [p @ q, q @ q]])
            vector = np.linalg.eigh(gram)[1][:, 1]
            s = np.clip(vector[0] / vector[1], shadow_min, 1)
            difference[y, x] = level_of(plain)
            collinearity[y, x] = level_of(np.sum((p - s * q) ** 2) / (1 + s * s) * scale)
    return difference, collinearity


def measure(images, plates, weights=None, precision=None, **changes):
    planes = Planes(*images.shape[:3])
    weights = np.ones(images.shape[:3], np.float32) if weights is None else weights
    precision = np.full(len(images), 0.5, np.float32) if precision is None else precision
    planes.measure(images, plates, weights, precision, **{**SETTINGS, **changes})
    return planes


def scene(seed, shape=(2, STRIP + 5, 17, 3)):
    """A plate, and a picture with noise, a shadow, something bright, something black and something coloured."""
    rng = np.random.default_rng(seed)
    plates = rng.integers(60, 200, shape)
    images = plates + rng.normal(0, 1.5, shape)
    images[:, 2:8, 2:8] *= 0.8
    images[:, 10:14, 0:5] += 40
    images[:, 15:20, 10:] = 8
    images[:, STRIP - 2 : STRIP + 3, 4:9] *= [0.4, 0.7, 1.0]
    return np.clip(images.round(), 0, 255).astype(np.uint8), plates.astype(np.uint8)


@pytest.mark.parametrize("seed", [0, 1])
def test_levels_match_the_oracle(seed):
    images, plates = scene(seed)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.3, 1.5, images.shape[:3]).astype(np.float32)
    precision = np.array([0.5, 0.2], np.float32)
    planes = measure(images, plates, weights, precision)
    for c in range(2):
        difference, collinearity = oracle(images[c], plates[c], weights[c], precision[c], **SETTINGS)
        assert 0.1 < np.mean(difference > 0) < 0.9
        near = np.abs(planes.difference[c].astype(int) - difference) <= ONE_LEVEL
        near |= np.isin(np.maximum(planes.difference[c], difference), (level_of(4.0), level_of(4.0) + 1))
        assert near.all()
        both = (difference > 0) & (planes.difference[c] > 0)
        assert np.abs(planes.collinearity[c].astype(int) - collinearity)[both].max() <= ONE_LEVEL


def test_unconfined_statistic_is_the_smaller_eigenvalue():
    images, plates = scene(3, (1, 12, 12, 3))
    images = np.minimum(images, plates)  # nothing brighter: the upper limit of s plays no part
    planes = measure(images, plates, shadow_min=1e-6)
    a, b = windows(images[0]), windows(plates[0])
    for y, x in np.argwhere(planes.difference[0] > 0):
        p, q = np.append(a[y, x], 40.0), np.append(b[y, x], 40.0)
        smaller = np.linalg.eigvalsh(np.array([[p @ p, p @ q], [p @ q, q @ q]]))[0]
        assert abs(int(planes.collinearity[0, y, x]) - level_of(smaller / 27 * 0.5)) <= ONE_LEVEL


@settings(deadline=None, max_examples=20)
@given(factor=st.floats(0.72, 0.97), seed=st.integers(0, 1000))
def test_a_shadow_stays_collinear_and_a_highlight_does_not(factor, seed):
    plates = np.random.default_rng(seed).integers(100, 180, (1, 10, 10, 3)).astype(np.uint8)
    shadow = (plates * factor).round().astype(np.uint8)
    planes = measure(shadow, plates, darkness_offset=1.0)
    assert planes.collinearity.max() <= level_of(0.5)
    highlight = np.minimum(plates / factor, 255).round().astype(np.uint8)
    planes = measure(highlight, plates)
    np.testing.assert_array_equal(planes.collinearity, planes.difference)


def test_the_offset_keeps_dark_noise_from_firing():
    rng = np.random.default_rng(0)
    dark = rng.integers(0, 4, (2, 1, 20, 20, 3)).astype(np.uint8)
    small = measure(dark[0], dark[1], darkness_offset=0.5, shadow_min=0.05, difference_min=0.1)
    large = measure(dark[0], dark[1], darkness_offset=40.0, shadow_min=0.05, difference_min=0.1)
    # with the offset the dark windows are compared by their difference
    assert np.abs(large.collinearity.astype(int) - large.difference).max() <= STRIP // 3
    assert small.collinearity.astype(int).mean() < large.collinearity.mean()


def test_equal_pictures_have_no_difference():
    images, _ = scene(0)
    planes = measure(images, images)
    assert not planes.difference.any() and not planes.collinearity.any()


def test_measuring_again_leaves_nothing_behind():
    images, plates = scene(0)
    planes = measure(images, plates)
    planes.relax(6.0, 0.5, 3)
    weights, precision = np.ones(images.shape[:3], np.float32), np.full(2, 0.5, np.float32)
    planes.measure(plates, plates, weights, precision, **SETTINGS)
    planes.relax(6.0, 0.5, 3)
    assert not planes.labels.any()


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), iterations=st.integers(0, 4))
def test_relaxation_matches_the_oracle(seed, iterations):
    rng = np.random.default_rng(seed)
    planes = Planes(2, 9, 11)
    planes.collinearity[:] = rng.choice([0, 120, 140, 150, 160, 200], (2, 9, 11))
    levels = planes.collinearity.astype(int)
    labels = levels >= level_of(6.0)
    for _ in range(iterations):
        padded = np.pad(labels, ((0, 0), (1, 1), (1, 1))).astype(int)
        count = sum(padded[:, dy : dy + 9, dx : dx + 11] for dy in range(3) for dx in range(3)) - labels
        labels = (levels > 0) & (levels + 4 * (count - 4) >= level_of(6.0))
    planes.relax(6.0, 0.5, iterations)
    np.testing.assert_array_equal(planes.labels, labels)


def test_the_frame_of_the_planes_stays_empty():
    images, plates = scene(5)
    planes = measure(255 - images, plates)
    planes.relax(6.0, 0.5, 4)
    for picture, whole in ((planes.labels, planes._labels), (planes.collinearity, planes._collinearity)):
        assert whole.sum() == picture.sum() > 0
        assert whole.size >= 2 * (picture.shape[1] + 2 * PAD) * (picture.shape[2] + 2 * PAD)


def test_levels_are_monotonic_and_eight_an_octave():
    assert level_of(1.0) == 128
    assert level_of(2.0) == 136
    assert level_of(0.5) == 120
    values = np.geomspace(1e-8, 1e8, 300)
    assert np.all(np.diff([level_of(v) for v in values]) >= 0)
    assert level_of(1e-30) == 0 and level_of(1e30) == 255
