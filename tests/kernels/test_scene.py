"""The empty scene of one camera from images in which a person covers changing pixels, against an oracle."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.kernels.scene import learn_scene

RULES = {"tolerance": 16, "least": 3, "darkest": 0.4, "spread": 0.12}


def oracle(values, weights, tolerance, least, darkest, spread):
    """Scene and support of one pixel: values (K, 3), weights (K,)."""
    agree = np.abs(values[:, None] - values[None]).max(axis=2) <= tolerance
    support = np.where(weights > 0, (agree * weights).sum(axis=1), 0)
    best = int(np.argmax(support))
    if 2 * support.max() <= weights.sum() or support.max() < weights.sum():
        majority = np.flatnonzero(2 * support > weights.sum())
        best = int(majority[0]) if len(majority) else best
        for i in np.flatnonzero(weights):
            factors = values[best] / np.maximum(values[i], 1)
            if not agree[best, i] and factors.min() >= darkest and factors.max() < 1 and np.ptp(factors) <= spread:
                best = i if support[i] >= least else best
    chosen = weights * agree[best]
    return (chosen @ values + chosen.sum() // 2) // max(chosen.sum(), 1), support[best]


@given(st.integers(0, 10**6))
@settings(max_examples=20)
def test_scene_equals_the_oracle(seed):
    rng = np.random.default_rng(seed)
    scene = rng.integers(40, 220, (4, 5, 3))
    images = np.clip(scene + rng.integers(-5, 6, (7, 4, 5, 3)), 0, 255)
    shaded = rng.random((7, 4, 5, 1)) < 0.4
    images = np.where(shaded, (0.6 * images).astype(int), images)
    images = np.where(rng.random((7, 4, 5, 1)) < 0.2, rng.integers(0, 256, (7, 4, 5, 3)), images)
    weights = rng.integers(0, 3, (7, 4, 5))
    plate, support = learn_scene(images.astype(np.uint8), weights.astype(np.uint8), **RULES)
    for y, x in np.ndindex(4, 5):
        if weights[:, y, x].any():
            expected, total = oracle(images[:, y, x], weights[:, y, x], **RULES)
            assert support[y, x] == total
            np.testing.assert_array_equal(plate[y, x], expected)
        else:
            assert support[y, x] == 0


def test_a_shadow_in_most_images_is_not_the_scene():
    images = np.full((8, 1, 1, 3), (120, 100, 80), np.uint8)
    images[2:] = (72, 60, 48)
    plate, support = learn_scene(images, np.full((8, 1, 1), 2, np.uint8), **RULES)
    assert plate[0, 0].tolist() == [120, 100, 80] and support[0, 0] == 4
