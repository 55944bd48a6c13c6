"""Smoothing on synthetic motion: noise out, no lag, gaps bridged, limits kept."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import build_skeleton
from tk.model.motion import smoothing
from tk.model.motion.smoothing import SHORTEST, smooth

SKELETON = build_skeleton(BodyDimensions.from_stature(1.75), paper=True)
D = len(SKELETON.names)
FPS = 60.0
NOISE = 0.03


def motion(frames: int = 400, seed: int = 0) -> np.ndarray:
    """Swings of 0.3 to 1.2 Hz within the limits, (F, D)."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / FPS
    low, high = np.maximum(SKELETON.lower, -1.5), np.minimum(SKELETON.upper, 1.5)
    swing = np.sin(2 * np.pi * rng.uniform(0.3, 1.2, D) * t + rng.uniform(0, 6, D))
    return (low + high) / 2 + 0.35 * (high - low) * swing


def noisy(true: np.ndarray, seed: int = 1) -> np.ndarray:
    return true + np.random.default_rng(seed).normal(0, NOISE, true.shape)


def test_error_falls_and_nothing_lags() -> None:
    true = motion()
    found = smooth(SKELETON, noisy(true), np.ones(len(true), bool), FPS)
    error = found.poses - true
    assert np.sqrt((error**2).mean()) < 0.6 * NOISE
    # a lag of τ frames is an error along the velocity: by regression it is below a tenth of a frame
    velocity = np.gradient(true, axis=0)
    lag = -(error * velocity).sum(axis=0) / (velocity**2).sum(axis=0)
    assert np.abs(lag).max() < 0.1
    assert not found.bridged.any()


def test_exact_motion_is_not_changed() -> None:
    true = motion()
    found = smooth(SKELETON, true, np.ones(len(true), bool), FPS)
    np.testing.assert_allclose(found.poses, true, atol=4e-3)


def test_noise_of_a_still_person_is_reduced() -> None:
    true = np.full((200, D), 0.1)
    found = smooth(SKELETON, noisy(true), np.ones(200, bool), FPS)
    assert np.sqrt(((found.poses - true) ** 2).mean()) < 0.5 * NOISE


def test_short_gaps_are_bridged_and_long_ones_left() -> None:
    true = motion()
    known = np.ones(len(true), bool)
    known[:3] = known[60:68] = known[150:190] = False
    poses = noisy(true)
    poses[~known] = np.nan  # never looked at
    found = smooth(SKELETON, poses, known, FPS)
    np.testing.assert_array_equal(np.flatnonzero(found.bridged), np.arange(60, 68))
    assert np.sqrt(((found.poses - true)[60:68] ** 2).mean()) < 0.1
    assert np.isnan(found.poses[150:190]).all() and np.isnan(found.poses[:3]).all()
    assert np.isfinite(found.poses[known]).all()
    assert np.sqrt(((found.poses - true)[known] ** 2).mean()) < 0.7 * NOISE


@pytest.mark.parametrize(("fps", "bridged"), [(20.0, 10), (19.9, 0)])
def test_a_gap_just_as_long_as_allowed_is_bridged(fps: float, bridged: int) -> None:
    known = np.ones(60, bool)
    known[20:30] = False
    assert smooth(SKELETON, np.zeros((60, D)), known, fps).bridged.sum() == bridged


def test_smoothed_angles_stay_within_joint_limits() -> None:
    true = np.tile(np.where(np.isfinite(SKELETON.upper), SKELETON.upper, 0.0), (100, 1))
    poses = SKELETON.clip(noisy(true))
    found = smooth(SKELETON, poses, np.ones(100, bool), FPS)
    assert (found.poses <= SKELETON.upper).all() and (found.poses >= SKELETON.lower).all()


def test_a_turning_body_is_not_torn_where_the_angle_wraps() -> None:
    true = motion()
    yaw = SKELETON.index("torso_yaw")
    true[:, yaw] = np.linspace(0, 6 * np.pi, len(true))
    poses = noisy(true)
    poses[:, yaw] = (poses[:, yaw] + np.pi) % (2 * np.pi) - np.pi
    found = smooth(SKELETON, poses, np.ones(len(true), bool), FPS)
    difference = found.poses[:, yaw] - true[:, yaw]
    assert np.abs((difference + np.pi) % (2 * np.pi) - np.pi).max() < 3 * NOISE
    assert np.abs(found.poses[:, yaw]).max() <= np.pi + 1e-12


@pytest.mark.parametrize("fps", [15.0, 60.0])
def test_real_motion_is_not_attenuated(fps: float) -> None:
    """What moves at 2 Hz keeps its size; what is quicker than any motion does not, where the frame rate shows it."""
    t = np.arange(200)[:, None] / fps
    true = np.tile(0.05 * np.sin(2 * np.pi * 2.0 * t), (1, D))
    poses = noisy(true)
    found = smooth(SKELETON, poses, np.ones(200, bool), fps).poses
    wave = np.exp(2j * np.pi * 2.0 * t)
    kept = np.abs((wave * found).sum(axis=0)) / np.abs((wave * poses).sum(axis=0))
    np.testing.assert_allclose(kept, 1.0, atol=0.05)
    assert np.sqrt(((found - true) ** 2).mean()) < (1.0 if fps < 20 else 0.6) * NOISE


def test_short_sequences_are_not_changed() -> None:
    poses = noisy(motion(SHORTEST - 1))
    found = smooth(SKELETON, poses, np.ones(len(poses), bool), FPS)
    np.testing.assert_array_equal(found.poses, poses)
    nothing = smooth(SKELETON, poses, np.zeros(len(poses), bool), FPS)
    np.testing.assert_array_equal(nothing.poses, poses)


@pytest.mark.parametrize(("ratio", "frames"), [(0.01, 40), (0.1, 40), (1.0, 40), (0.1, 1100)])
def test_smoother_is_the_cubic_smoothing_spline(ratio: float, frames: int) -> None:
    """With an unknown start, the smoother of this model is the spline whose penalty is 1 / ratio² (Wahba 1978)."""
    values = np.random.default_rng(2).normal(size=(frames, 1)).cumsum(axis=0)
    found = smoothing._smooth(values, np.ones(frames, bool), np.array([ratio]))
    spline = make_smoothing_spline(np.arange(float(frames)), values[:, 0], lam=1 / ratio**2)
    np.testing.assert_allclose(found[:, 0], spline(np.arange(float(frames))), atol=1e-3)
