"""The running baseline of the residual."""

from __future__ import annotations

import numpy as np
import pytest

from tk.trackers.residual import (
    LEVEL,
    OUTLIER,
    RECENT,
    START_SPREAD,
    ResidualBaseline,
    contradicted,
    displacement,
    variance_factor,
)  # fmt: skip

VIEWS = 4


def learned(deviation: float = 0.03, frames: int = 400) -> ResidualBaseline:
    """A baseline of views with means of 0.08 to 0.14."""
    baseline, rng = ResidualBaseline(VIEWS, 0.02), np.random.default_rng(0)
    for _ in range(frames):
        baseline.learn(np.linspace(0.08, 0.14, VIEWS) + rng.normal(scale=deviation, size=VIEWS))
    return baseline


def test_mean_and_spread_of_each_view_are_learned() -> None:
    baseline = learned()
    np.testing.assert_allclose(baseline.mean, np.linspace(0.08, 0.14, VIEWS), atol=0.02)
    np.testing.assert_allclose(baseline.spread, 0.03, rtol=0.4)


def test_excess_is_counted_in_spreads() -> None:
    baseline = learned()
    np.testing.assert_allclose(baseline.excess(baseline.mean + 2 * baseline.spread), 2.0)
    assert np.isnan(baseline.excess(np.full(VIEWS, np.nan))).all()


def test_outlier_in_one_view_is_not_a_high_residual_and_one_in_all_views_is() -> None:
    baseline = learned()
    error = baseline.mean.copy()
    error[0] = 0.8
    assert not baseline.high(error) and baseline.mean_excess(error) == pytest.approx(OUTLIER / VIEWS)
    assert baseline.high(baseline.mean + 3 * baseline.spread)
    error[0] = np.nan
    assert baseline.mean_excess(error) == pytest.approx(0.0)


def test_median_of_the_first_frame_is_the_first_baseline_of_all_views() -> None:
    baseline = ResidualBaseline(VIEWS, 0.02)
    assert not baseline.high(np.full(VIEWS, 0.3))
    first = np.array([0.3, 0.3, 0.8, np.nan])
    assert baseline.excess(first)[2] > OUTLIER
    baseline.learn(first)
    assert baseline.excess(first)[2] > OUTLIER
    # a view without a baseline has that of the others
    assert baseline.excess(np.full(VIEWS, 0.3 + START_SPREAD))[3] == pytest.approx(1.0)


def test_view_with_another_level_gets_its_own_baseline_soon() -> None:
    baseline = ResidualBaseline(VIEWS, 0.02)
    for _ in range(15):
        baseline.learn(np.array([0.08, 0.08, 0.08, 0.2]))
    assert baseline.excess(np.full(VIEWS, 0.2))[3] < 2.0 and np.abs(baseline.mean[:3] - 0.08).max() < 0.01


def test_wrong_pose_raises_the_baseline_slowly() -> None:
    baseline = learned()
    before = baseline.mean.copy()
    for _ in range(10):
        assert baseline.high(before + 0.2)
        baseline.learn(before + 0.2)


def test_state_is_restored() -> None:
    baseline, other = learned(), ResidualBaseline(VIEWS, 0.02)
    other.state = baseline.state
    np.testing.assert_array_equal(other.excess(np.full(VIEWS, 0.2)), baseline.excess(np.full(VIEWS, 0.2)))


def residuals(missing: float, surplus: float, frames: int = 3 * RECENT) -> np.ndarray:
    """(F, V, 2) of equal frames."""
    return np.tile([missing, surplus], (frames, VIEWS, 1)).astype(float)


def test_residual_that_is_high_from_the_first_frame_contradicts_the_pose() -> None:
    assert contradicted(residuals(0.15, 0.2), 0.02).all()
    assert contradicted(residuals(0.15, 0.2, frames=1), 0.02).all()
    assert not contradicted(residuals(LEVEL / 2, LEVEL / 2), 0.02).any()


def test_second_person_or_torn_mask_contradicts_no_pose() -> None:
    somebody_else = residuals(0.04, 0.05)
    somebody_else[:, 0, 1] = 0.8
    assert not contradicted(somebody_else, 0.02).any()
    assert not contradicted(residuals(0.3, 0.01), 0.02).any()


def test_only_frames_about_a_lasting_high_residual_are_contradicted() -> None:
    short, lasting = residuals(0.04, 0.05), residuals(0.04, 0.05)
    short[4] = 0.2
    lasting[5:11] = 0.25
    assert not contradicted(short, 0.02).any()
    found = np.flatnonzero(contradicted(lasting, 0.02))
    assert set(range(5, 11)) <= set(found) <= set(range(2, 14))


def test_unmeasured_frames_and_views_do_not_count() -> None:
    residual = residuals(0.15, 0.2)
    residual[2], residual[:, 1] = np.nan, np.nan
    assert contradicted(residual, 0.02).tolist() == [i != 2 for i in range(len(residual))]
    assert np.isnan(displacement(residual)[2]) and variance_factor(residual)[2] == 1.0


def test_variance_grows_with_the_squared_residual_and_is_never_smaller_than_normal() -> None:
    half = LEVEL / 2
    np.testing.assert_allclose(variance_factor(residuals(3 * half, 3 * half)), 9.0)
    np.testing.assert_allclose(variance_factor(residuals(half / 5, half / 5)), 1.0)
