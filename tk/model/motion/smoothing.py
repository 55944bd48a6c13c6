"""Smoothing the poses of a whole recording: noise out, short gaps bridged, nothing delayed.

The model of each degree of freedom is a constant velocity with white acceleration noise, measured with white noise. A
Kalman filter runs forward and a Rauch-Tung-Striebel smoother backward (Rauch, Tung & Striebel, AIAA J. 3 (1965)
1445-1450), so each frame is estimated from all frames and has no lag. Two reasons against a low-pass filter in both
directions: a frame without measurement needs no special treatment, and each degree of freedom is smoothed by its own
noise, which is estimated by maximum likelihood. A person does not move as the model does, and would be smoothed too
much; so the filter leaves everything slower than :data:`MOTION_HZ`. At 15 frames/s this leaves little to smooth, at 30
and more much. A tracker's error that lasts for many frames is not white noise and stays: it looks like motion.

Angles are smoothed one by one. The limits of the skeleton's ball joints keep them away from their singular directions,
where the angles would not follow the rotation smoothly. A foot that stands is not held: it may slide by what its
tracking errors leave.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.skeleton import Skeleton

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Standard deviation of the acceleration's noise over that of the measurement's, both for steps of one frame: from
# motion that is hardly seen to change within seconds to measurements that are taken as they are.
_RATIOS = np.geomspace(1e-3, 10.0, 17)
# Voluntary movement has almost no power above 6 Hz, the common cut-off in gait analysis (Winter, Biomechanics and Motor
# Control of Human Movement, 2009, chapter 3).
MOTION_HZ = 6.0
# A velocity that nothing is known of, against the measurement's noise a frame.
_UNKNOWN = 1e3
# Frames of a stretch below which there is too little to estimate noise from; it stays as it is.
SHORTEST = 8


@dataclass(frozen=True)
class Smoothed:
    """A smoothed copy of F poses.

    Attributes:
        poses: (F, D) radians and metres; as they were given where neither known nor bridged.
        bridged: (F,) True where no pose was known and one has been filled in.
        noise: (D,) the standard deviation of the measurements' noise as estimated, radians or metres; NaN where there
            was too little to estimate it from.
    """

    poses: Float
    bridged: Bool
    noise: Float


def smooth(skeleton: Skeleton, poses: Float, known: Bool, fps: float, longest_gap_s: float = 0.5) -> Smoothed:
    """Smooth the poses of a recording.

    Args:
        skeleton: whose limits the result keeps.
        poses: (F, D) tracked poses, frames at equal steps.
        known: (F,) False where the person was lost; such a pose is not looked at.
        fps: frames a second.
        longest_gap_s: a loss up to this long between known frames is bridged; a longer one divides the recording.
    """
    poses = np.asarray(poses, dtype=np.float64)
    result, bridged = poses.copy(), np.zeros(len(poses), dtype=bool)
    stretches = [stretch for stretch in _stretches(known, longest_gap_s * fps) if known[stretch].sum() >= SHORTEST]
    if not stretches:
        return Smoothed(result, bridged, np.full(poses.shape[1], np.nan))
    turning = np.array([unit == "rad" for unit in skeleton.units])
    pieces = []
    for stretch in stretches:
        values, seen = poses[stretch].copy(), known[stretch]
        values[np.ix_(seen, turning)] = np.unwrap(values[np.ix_(seen, turning)], axis=0)
        pieces.append((values, seen))
    ratio, noise = _noise(pieces)
    ratio = np.maximum(ratio, _ratio_of(MOTION_HZ / fps))
    for stretch, (values, seen) in zip(stretches, pieces, strict=True):
        smoothed = _smooth(values, seen, ratio)
        result[stretch] = skeleton.clip(_into_limits(skeleton, smoothed, turning))
        bridged[stretch] = ~seen
    return Smoothed(result, bridged, noise)


def _ratio_of(cutoff: float) -> float:
    """The ratio (as :data:`_RATIOS`) under which a swing of this frequency, in cycles a frame, is halved.

    The smoother is a filter of gain 1 / (1 + ω⁴ / ratio²): that of the cubic smoothing spline.
    """
    return float((2 * np.pi * cutoff) ** 2)


def _stretches(known: Bool, longest_gap: float) -> list[slice]:
    """Runs of frames that begin and end with a known one and hold no gap longer than ``longest_gap`` frames."""
    frames = np.flatnonzero(known)
    if not len(frames):
        return []
    ends = np.flatnonzero(np.diff(frames) - 1 > longest_gap)
    starts = frames[np.concatenate([[0], ends + 1])]
    return [slice(int(a), int(b) + 1) for a, b in zip(starts, frames[np.append(ends, -1)], strict=True)]


def _into_limits(skeleton: Skeleton, poses: Float, turning: Bool) -> Float:
    """Angles (F, D) that were unwrapped, back by whole turns to where the limits lie."""
    bounded = np.isfinite(skeleton.lower)
    middle = np.zeros(len(bounded))
    middle[bounded] = (skeleton.lower[bounded] + skeleton.upper[bounded]) / 2
    turns = np.round((poses - middle) / (2 * np.pi))
    return np.where(turning, poses - 2 * np.pi * turns, poses)


# --- the filter; values are taken in units of the measurement's noise, time in frames ---------------------------------


def _noise(pieces: list[tuple[Float, Bool]]) -> tuple[Float, Float]:
    """(D,) the ratio of :data:`_RATIOS` under which the measurements are most likely, and (D,) their noise."""
    degrees = pieces[0][0].shape[1]
    ratio = np.repeat(_RATIOS, degrees)
    squares, logs, count = np.zeros(len(ratio)), np.zeros(len(ratio)), 0
    for values, seen in pieces:
        judged = np.flatnonzero(seen)[2:]  # the first two fix the line that it starts with
        for f, step in enumerate(_filter(np.tile(values, len(_RATIOS)), seen, ratio)):
            if seen[f] and f >= judged[0]:
                squares += step.surprise**2 / step.variance
                logs += np.log(step.variance)
        count += len(judged)
    variance = (squares / count).reshape(len(_RATIOS), degrees)
    cost = count * np.log(np.maximum(variance, 1e-30)) + logs.reshape(variance.shape)
    best = cost.argmin(axis=0)
    return _RATIOS[best], np.sqrt(variance[best, np.arange(degrees)])


@dataclass(frozen=True)
class _Step:
    """A frame of the filter for N series: position and velocity (2, N), covariances (3, N) as xx, xv, vv."""

    predicted: Float
    predicted_covariance: Float
    state: Float
    covariance: Float
    surprise: Float  # (N,) measurement less prediction
    variance: Float  # (N,) what was expected of its square


def _filter(values: Float, seen: Bool, ratio: Float) -> Iterator[_Step]:
    """Forward over values (F, N), for each of N series with the noise of its acceleration, ratio (N,)."""
    series = values.shape[1]
    q = ratio**2 * np.array([[1 / 3], [1 / 2], [1.0]])  # of white acceleration over one frame: xx, xv, vv
    x, v = values[0], np.zeros(series)
    xx, xv, vv = np.ones(series), np.zeros(series), np.full(series, _UNKNOWN**2)
    for f in range(len(values)):
        if f:
            x, (xx, xv, vv) = x + v, (xx + 2 * xv + vv + q[0], xv + vv + q[1], vv + q[2])
        predicted, predicted_covariance = np.array([x, v]), np.array([xx, xv, vv])
        surprise, variance = values[f] - x, xx + 1
        if seen[f] and f:
            x, v = x + xx / variance * surprise, v + xv / variance * surprise
            xx, xv, vv = xx / variance, xv / variance, vv - xv**2 / variance
        yield _Step(predicted, predicted_covariance, np.array([x, v]), np.array([xx, xv, vv]), surprise, variance)


def _smooth(values: Float, seen: Bool, ratio: Float) -> Float:
    """(F, N) the smoothed values: forward, and back by Rauch, Tung and Striebel's gain."""
    steps = list(_filter(values, seen, ratio))
    x, v = steps[-1].state
    smoothed = [x]
    for step, after in zip(steps[-2::-1], steps[:0:-1], strict=True):
        xx, xv, vv = step.covariance
        pxx, pxv, pvv = after.predicted_covariance
        dx, dv = x - after.predicted[0], v - after.predicted[1]
        # the gain P Fᵀ P⁻¹ with F = [[1, 1], [0, 1]]: first P⁻¹ (…), then P Fᵀ
        determinant = pxx * pvv - pxv**2
        a, b = (pvv * dx - pxv * dv) / determinant, (pxx * dv - pxv * dx) / determinant
        x = step.state[0] + (xx + xv) * a + xv * b
        v = step.state[1] + (xv + vv) * a + vv * b
        smoothed.append(x)
    return np.array(smoothed[::-1])
