"""The range of the expected error of raw joints."""

from __future__ import annotations

import numpy as np
import pytest

from tk.model.body.expected_error import expected_errors, in_cm, mean_range
from tk.model.body.joints import JOINTS, ROWS

OFFSETS = np.array([ROWS[name].offset_m for name in JOINTS])


def test_expected_error_is_the_mean_distance_of_offset_and_noise() -> None:
    """Exact without noise, and without an offset; between them within 4 %."""
    rng = np.random.default_rng(0)
    assert (OFFSETS > 0.005).all()
    np.testing.assert_allclose(expected_errors(np.zeros((1, 15)), JOINTS), OFFSETS[None])
    for sigma, most in ((0.2, 0.01), (OFFSETS[0], 0.04), (0.1 * OFFSETS[0], 0.01)):
        drawn = rng.normal([OFFSETS[0], 0, 0], sigma, (100_000, 3))
        expected = expected_errors(np.full(1, sigma), ("pelvis",))[0]
        assert expected == pytest.approx(np.linalg.norm(drawn, axis=1).mean(), rel=most)


def test_people_whose_offsets_vary_have_their_mean_error_in_the_range() -> None:
    """As in the recordings with ground truth: by a third from person to person, by a half from joint to joint."""
    rng, sigma = np.random.default_rng(1), 0.005
    expected = mean_range(expected_errors(np.full((40, 15), sigma), JOINTS))
    assert expected is not None
    inside = []
    for _ in range(300):
        length = OFFSETS * np.exp(rng.normal(-0.1, 0.3) + rng.normal(0, 0.5, 15))
        direction = rng.normal(size=(15, 3))
        offset = length[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        error = np.linalg.norm(offset + rng.normal(0, sigma, (40, 15, 3)), axis=2).mean()
        inside.append(expected[0] <= error <= expected[1])
    assert 0.85 < np.mean(inside) < 0.99


def test_unknown_joints_are_left_out() -> None:
    sigma = np.full((3, 15), 0.01)
    known = mean_range(expected_errors(sigma, JOINTS))
    assert known is not None
    sigma[1] = np.nan
    np.testing.assert_allclose(mean_range(expected_errors(sigma, JOINTS)), known)
    assert mean_range(np.full((3, 15), np.nan)) is None and mean_range(np.zeros((0, 15))) is None
    assert np.isnan(expected_errors(np.ones((1, 1)), ("tail",))).all()
    one = mean_range(expected_errors(sigma, JOINTS)[:, 0])
    assert one is not None and one[1] / one[0] > known[1] / known[0], "a single joint varies more than the mean"
    assert in_cm(np.array([0.0091, 0.0296])) == "0.9 to 3.0 cm"
