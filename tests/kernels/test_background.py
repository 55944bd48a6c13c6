"""The collinearity statistic against a slow, obvious oracle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.kernels.background import GREY, Statistic, level_of

SETTINGS = {"darkness_offset": 40.0, "shadow_min": 0.7, "difference_min": 4.0}
LABELS = {"threshold": 6.0}
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


def measure(images, plates, weights=None, precision=None, boxes=None, bright_sum=None, **changes):
    """The statistic, the boxes side by side with a column of zeros between them and a frame of zeros around."""
    count, height, width = images.shape[:3]
    weights = np.ones(images.shape[:3], np.float32) if weights is None else weights
    precision = np.full(count, 0.5, np.float32) if precision is None else precision
    boxes = np.array([[0, 0, width, height]] * count if boxes is None else boxes, np.int32)
    bright_sum = np.zeros(count, np.float32) if bright_sum is None else bright_sum
    statistic = Statistic(np.ascontiguousarray(images), np.ascontiguousarray(plates), weights)
    corners, shape = layout(boxes)
    statistic.measure(precision, bright_sum, boxes, corners, shape, **{**SETTINGS, **LABELS, **changes})
    return statistic


def layout(boxes):
    corners = np.array([[1 + sum(boxes[:c, 2] + 1), 1] for c in range(len(boxes))], np.int32)
    return corners, (int(boxes[:, 3].max()) + 2, int(sum(boxes[:, 2] + 1)) + 1)


def pictures(mosaic, width):
    """(C, H, W) out of the mosaic of whole pictures."""
    return np.stack([mosaic[1:-1, x : x + width] for x in range(1, mosaic.shape[1] - 1, width + 1)])


def scene(seed, shape=(2, 29, 17, 3)):
    """A plate, and a picture with noise, a shadow, something bright, something black and something coloured."""
    rng = np.random.default_rng(seed)
    plates = rng.integers(60, 200, shape)
    images = plates + rng.normal(0, 1.5, shape)
    images[:, 2:8, 2:8] *= 0.8
    images[:, 10:14, 0:5] += 40
    images[:, 15:20, 10:] = 8
    images[:, 22:27, 4:9] *= [0.4, 0.7, 1.0]
    return np.clip(images.round(), 0, 255).astype(np.uint8), plates.astype(np.uint8)


@pytest.mark.parametrize("seed", [0, 1])
def test_levels_match_the_oracle(seed):
    images, plates = scene(seed)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.3, 1.5, images.shape[:3]).astype(np.float32)
    precision = np.array([0.5, 0.2], np.float32)
    statistic = measure(images, plates, weights, precision)
    found = pictures(statistic.difference, 17), pictures(statistic.collinearity, 17)
    for c in range(2):
        difference, collinearity = oracle(images[c], plates[c], weights[c], precision[c], **SETTINGS)
        assert 0.1 < np.mean(difference > 0) < 0.9
        near = np.abs(found[0][c].astype(int) - difference) <= ONE_LEVEL
        near |= np.isin(np.maximum(found[0][c], difference), (level_of(4.0), level_of(4.0) + 1))
        assert near.all()
        both = (difference > 0) & (found[0][c] > 0)
        assert np.abs(found[1][c].astype(int) - collinearity)[both].max() <= ONE_LEVEL


def test_unconfined_statistic_is_the_smaller_eigenvalue():
    images, plates = scene(3, (1, 12, 12, 3))
    images = np.minimum(images, plates)  # nothing brighter: the upper limit of s plays no part
    statistic = measure(images, plates, shadow_min=1e-6)
    difference, collinearity = pictures(statistic.difference, 12)[0], pictures(statistic.collinearity, 12)[0]
    a, b = windows(images[0]), windows(plates[0])
    for y, x in np.argwhere(difference > 0):
        p, q = np.append(a[y, x], 40.0), np.append(b[y, x], 40.0)
        smaller = np.linalg.eigvalsh(np.array([[p @ p, p @ q], [p @ q, q @ q]]))[0]
        assert abs(int(collinearity[y, x]) - level_of(smaller / 27 * 0.5)) <= ONE_LEVEL


@settings(max_examples=20)
@given(factor=st.floats(0.72, 0.97), seed=st.integers(0, 1000))
def test_a_shadow_stays_collinear_and_a_highlight_does_not(factor, seed):
    plates = np.random.default_rng(seed).integers(100, 180, (1, 10, 10, 3)).astype(np.uint8)
    shadow = (plates * factor).round().astype(np.uint8)
    statistic = measure(shadow, plates, darkness_offset=1.0)
    assert statistic.collinearity.max() <= level_of(0.5)
    highlight = np.minimum(plates / factor, 255).round().astype(np.uint8)
    statistic = measure(highlight, plates)
    np.testing.assert_array_equal(statistic.collinearity, statistic.difference)


def test_darkness_offset_suppresses_the_noise_of_dark_windows():
    rng = np.random.default_rng(0)
    dark = rng.integers(0, 4, (2, 1, 20, 20, 3)).astype(np.uint8)
    small = measure(dark[0], dark[1], darkness_offset=0.5, shadow_min=0.05, difference_min=0.1)
    large = measure(dark[0], dark[1], darkness_offset=40.0, shadow_min=0.05, difference_min=0.1)
    # with the offset the dark windows are compared by their difference
    assert np.abs(large.collinearity.astype(int) - large.difference).max() <= 8
    assert small.collinearity.astype(int).mean() < large.collinearity.mean()


def test_buffers_are_cleared_between_measurements():
    images, plates = scene(0)
    statistic = measure(images, plates)
    assert statistic.labels.any()
    images[...] = plates
    boxes = np.array([[0, 0, 17, 29]] * 2, np.int32)
    again = Statistic(images, plates, np.ones(images.shape[:3], np.float32))
    for picture in (255 - plates, plates):
        images[...] = picture
        again.measure(np.ones(2, np.float32), np.zeros(2, np.float32), boxes, *layout(boxes), **SETTINGS, **LABELS)
    assert not again.labels.any() and not again.difference.any() and not again.bright.any()


@settings(max_examples=20)
@given(
    seed=st.integers(0, 100),
    box=st.tuples(st.integers(0, 10), st.integers(0, 20), st.integers(1, 7), st.integers(1, 9)),
)
def test_statistic_in_a_box_equals_that_of_the_whole_image(seed, box):
    """Windows at the edge of the box read pixels beyond it; labels do not."""
    images, plates = scene(seed)
    whole = measure(images, plates)
    left, top, w, h = box
    part = measure(images, plates, boxes=[box, (0, 0, 0, 0)])
    for name in ("difference", "collinearity", "bright"):
        mosaic = getattr(part, name)
        expected = pictures(getattr(whole, name), 17)[0, top : top + h, left : left + w]
        np.testing.assert_array_equal(mosaic[1 : 1 + h, 1 : 1 + w], expected)
        assert mosaic.sum() == expected.sum()  # the frame, and the place of the empty box, stay zero
    np.testing.assert_array_equal(part.labels, part.collinearity >= level_of(6.0))


def test_bright_windows_are_marked_and_dark_ones_are_not():
    plates = np.full((1, 12, 30, 3), 120, np.uint8)
    images = plates.copy()
    images[:, 2:10, 1:9] = 150
    images[:, 2:10, 11:19] = 90
    images[:, 2:10, 21:29] = 124  # brighter, but by less than the limit of 5 grey levels
    limit = np.array([5 * 9 * sum(GREY)], np.float32)
    statistic = measure(images, plates, bright_sum=limit, difference_min=0.5)
    bright, difference = (pictures(mosaic, 30)[0] for mosaic in (statistic.bright, statistic.difference))
    assert (
        (difference[3:9, 2:8] > 0).all() and (difference[3:9, 12:18] > 0).all() and (difference[3:9, 22:28] > 0).all()
    )
    assert (bright[3:9, 2:8] == 1).all() and not bright[:, 11:].any()


def test_levels_are_monotonic_and_eight_an_octave():
    assert level_of(1.0) == 128
    assert level_of(2.0) == 136
    assert level_of(0.5) == 120
    values = np.geomspace(1e-8, 1e8, 300)
    assert np.all(np.diff([level_of(v) for v in values]) >= 0)
    assert level_of(1e-30) == 0 and level_of(1e30) == 255
