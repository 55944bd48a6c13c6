"""The running baseline of the residual."""

from __future__ import annotations

import numpy as np
import pytest

from tk.trackers.residual import (
    LEAST_SPREAD,
    LEVEL,
    OUTLIER,
    ResidualBaseline,
    variance_factor,
)  # fmt: skip

VIEWS = 4


def halves(error: np.ndarray) -> np.ndarray:
    """Residuals (V, 2) of E_S (V,): missing and surplus area are equal."""
    return np.stack([error, error], axis=1) / 2


def learned(deviation: float = 0.03, frames: int = 400) -> ResidualBaseline:
    """A baseline of views with means of 0.08 to 0.14."""
    baseline, rng = ResidualBaseline(VIEWS, 0.02), np.random.default_rng(0)
    for _ in range(frames):
        baseline.learn(halves(np.linspace(0.08, 0.14, VIEWS) + rng.normal(scale=deviation, size=VIEWS)))
    return baseline


def test_mean_and_spread_of_each_view_are_learned() -> None:
    baseline = learned()
    np.testing.assert_allclose(baseline.mean.sum(axis=1), np.linspace(0.08, 0.14, VIEWS), atol=0.02)
    np.testing.assert_allclose(baseline.spread, 0.03, rtol=0.4)


def test_excess_is_counted_in_spreads() -> None:
    baseline = learned()
    np.testing.assert_allclose(baseline.excess(baseline.mean.sum(axis=1) + 2 * baseline.spread), 2.0)
    areas = baseline.mean + baseline.spread[:, None] * (3.0, 1.0)
    np.testing.assert_allclose(baseline.excess(areas), np.tile((3.0, 1.0), (VIEWS, 1)))
    assert np.isnan(baseline.excess(np.full(VIEWS, np.nan))).all()


def test_outlier_in_one_view_is_not_a_high_residual_and_one_in_all_views_is() -> None:
    baseline = learned()
    error = baseline.mean.sum(axis=1)
    error[0] = 0.8
    assert not baseline.high(error) and baseline.mean_excess(error) == pytest.approx(OUTLIER / VIEWS)
    assert baseline.high(baseline.mean.sum(axis=1) + 3 * baseline.spread)
    error[0] = np.nan
    assert baseline.mean_excess(error) == pytest.approx(0.0)


def test_median_of_the_first_frame_is_the_first_baseline_of_all_views() -> None:
    baseline = ResidualBaseline(VIEWS, 0.02)
    assert not baseline.high(np.full(VIEWS, 0.3))
    first = np.array([0.3, 0.3, 0.8, np.nan])
    assert baseline.excess(first)[2] > OUTLIER
    baseline.learn(halves(first))
    assert baseline.excess(first)[2] > OUTLIER
    # a view without a baseline has that of the others
    assert baseline.excess(np.full(VIEWS, 0.3 + LEAST_SPREAD))[3] == pytest.approx(1.0)


def test_view_with_another_level_gets_its_own_baseline_soon() -> None:
    baseline = ResidualBaseline(VIEWS, 0.02)
    for _ in range(15):
        baseline.learn(halves(np.array([0.08, 0.08, 0.08, 0.2])))
    assert baseline.excess(np.full(VIEWS, 0.2))[3] < 2.0 and np.abs(baseline.mean[:3].sum(axis=1) - 0.08).max() < 0.01


def test_wrong_pose_raises_the_baseline_slowly() -> None:
    baseline = learned()
    before = baseline.mean.sum(axis=1)
    for _ in range(10):
        assert baseline.high(before + 0.2)
        baseline.learn(halves(before + 0.2))


def test_variance_grows_with_the_squared_residual_and_is_never_smaller_than_normal() -> None:
    half = LEVEL / 2
    np.testing.assert_allclose(variance_factor(np.full((3, VIEWS, 2), 3 * half)), 9.0)
    np.testing.assert_allclose(variance_factor(np.full((3, VIEWS, 2), half / 5)), 1.0)
