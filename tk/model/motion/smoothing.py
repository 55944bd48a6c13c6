"""Smooth the poses of a whole recording without delay, and bridge short gaps.

Each degree of freedom is modelled by a constant velocity with white acceleration noise, measured with white noise. A
Kalman filter runs forward and a Rauch-Tung-Striebel smoother backward (Rauch, Tung & Striebel, AIAA J. 3 (1965)
1445-1450), so each frame is estimated from all frames and has no lag. It has two advantages over a low-pass filter in
both directions: a frame without measurement needs no special treatment, and each degree of freedom is smoothed
according to its own noise, which is estimated by maximum likelihood. Human motion does not follow the model exactly and
would be smoothed too much, so at least half the amplitude of motion at :data:`MOTION_HZ` remains, and 94 % at half this
frequency. At 15 frames/s there is little smoothing, at 30 frames/s and more it is strong. A tracking error that lasts
for many frames is not white noise and stays.

Angles are smoothed separately. The limits of the skeleton's ball joints keep them away from the singular directions,
where angles do not change smoothly with the rotation. Standing feet are not fixed: tracking errors may let them slide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.skeleton import Skeleton

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Candidate ratios of the standard deviations of acceleration noise and measurement noise, per frame. At the smallest,
# motion hardly changes within seconds; at the largest, measurements stay unchanged.
_RATIOS = np.geomspace(1e-3, 10.0, 17)
# Voluntary movement has almost no power above 6 Hz, the common cut-off in gait analysis (Winter, Biomechanics and Motor
# Control of Human Movement, 2009, chapter 3).
MOTION_HZ = 6.0
# Standard deviation of the unknown initial velocity, in units of the measurement noise per frame; in effect infinite.
_UNKNOWN = 1e3
# Frames whose filter states are kept at once, 2.5 kB each: of the others those at the begin of every block are.
_BLOCK = 512
# Longest gap that is bridged, seconds; a longer one divides the recording. Half a step: the person may do anything in
# between.
LONGEST_GAP_S = 0.5
# Frames. Shorter sections have too few measurements to estimate noise; they stay unchanged.
SHORTEST = 8


@dataclass(frozen=True)
class Smoothed:
    """A smoothed copy of F poses."""

    poses: Float  # (F, D) radians and metres; unchanged in frames that are neither known nor bridged
    bridged: Bool  # (F,) True where the pose was unknown and has been filled in


def smooth(skeleton: Skeleton, poses: Float, known: Bool, fps: float) -> Smoothed:
    """Smooth the poses of a recording.

    Args:
        skeleton: skeleton of the poses; the smoothed poses respect its joint limits.
        poses: (F, D) tracked poses at equal time steps.
        known: (F,) False where the person was lost; these poses are ignored.
        fps: frames per second.
    """
    poses = np.asarray(poses, dtype=np.float64)
    result, bridged = poses.copy(), np.zeros(len(poses), dtype=bool)
    sections = [section for section in _sections(known, LONGEST_GAP_S * fps) if known[section].sum() >= SHORTEST]
    if not sections:
        return Smoothed(result, bridged)
    turning = np.array([unit == "rad" for unit in skeleton.units])
    pieces = []
    for section in sections:
        values, seen = poses[section].copy(), known[section]
        values[np.ix_(seen, turning)] = np.unwrap(values[np.ix_(seen, turning)], axis=0)
        pieces.append((values, seen))
    ratio = np.maximum(_likeliest(pieces), _ratio_of(MOTION_HZ / fps))
    for section, (values, seen) in zip(sections, pieces, strict=True):
        smoothed = _smooth(values, seen, ratio)
        result[section] = skeleton.clip(_into_limits(skeleton, smoothed, turning))
        bridged[section] = ~seen
    return Smoothed(result, bridged)


def _ratio_of(cutoff: float) -> float:
    """Return the ratio (see :data:`_RATIOS`) with which the smoother has gain 0.5 at ``cutoff``, cycles per frame.

    The smoother has the gain 1 / (1 + ω⁴ / ratio²) of a cubic smoothing spline.
    """
    return float((2 * np.pi * cutoff) ** 2)


def _sections(known: Bool, longest_gap: float) -> list[slice]:
    """Return the sections that start and end with a known frame and have no gap longer than ``longest_gap`` frames."""
    frames = np.flatnonzero(known)
    if not len(frames):
        return []
    ends = np.flatnonzero(np.diff(frames) - 1 > longest_gap)
    starts = frames[np.concatenate([[0], ends + 1])]
    return [slice(int(a), int(b) + 1) for a, b in zip(starts, frames[np.append(ends, -1)], strict=True)]


def _into_limits(skeleton: Skeleton, poses: Float, turning: Bool) -> Float:
    """Return poses (F, D) with angles shifted by whole turns to within half a turn of the middle of their limits."""
    bounded = np.isfinite(skeleton.lower)
    middle = np.zeros(len(bounded))
    middle[bounded] = (skeleton.lower[bounded] + skeleton.upper[bounded]) / 2
    turns = np.round((poses - middle) / (2 * np.pi))
    return np.where(turning, poses - 2 * np.pi * turns, poses)


# --- the filter; values are in units of the measurement noise, time in frames -----------------------------------------


def _likeliest(pieces: list[tuple[Float, Bool]]) -> Float:
    """Return the maximum likelihood estimate of the ratio (D,), one of :data:`_RATIOS`."""
    degrees = pieces[0][0].shape[1]
    ratio = np.repeat(_RATIOS, degrees)
    squares, logs, count = np.zeros(len(ratio)), np.zeros(len(ratio)), 0
    for values, seen in pieces:
        judged = np.flatnonzero(seen)[2:]  # the first two initialise the filter
        for f, step in enumerate(_filter(values, seen, ratio)):
            if seen[f] and f >= judged[0]:
                squares += step.innovation**2 / step.variance
                logs += np.log(step.variance)
        count += len(judged)
    variance = (squares / count).reshape(len(_RATIOS), degrees)
    cost = count * np.log(np.maximum(variance, 1e-30)) + logs.reshape(variance.shape)
    return np.asarray(_RATIOS[cost.argmin(axis=0)])


@dataclass(frozen=True)
class _Step:
    """A frame of the filter for N series: position and velocity (2, N), covariances (3, N) as xx, xv, vv."""

    predicted: Float
    predicted_covariance: Float
    state: Float
    covariance: Float
    innovation: Float  # (N,) measurement minus prediction
    variance: Float  # (N,) expected square of innovation


def _filter(values: Float, seen: Bool, ratio: Float, before: _Step | None = None) -> Iterator[_Step]:
    """Filter values (F, N) forward, with noise ratios (R N,): R for each series, all of the first ratio come first.

    ``before``: the step of the frame before the first; None: the filter begins here.
    """
    copies = len(ratio) // values.shape[1]
    q = ratio**2 * np.array([[1 / 3], [1 / 2], [1.0]])  # covariance of white acceleration over one frame: xx, xv, vv
    for f, row in enumerate(values):
        measured = np.tile(row, copies)
        if before is None:
            x, v = measured, np.zeros(len(ratio))
            xx, xv, vv = np.ones(len(ratio)), np.zeros(len(ratio)), np.full(len(ratio), _UNKNOWN**2)
        else:
            (x, v), (xx, xv, vv) = before.state, before.covariance
            x, (xx, xv, vv) = x + v, (xx + 2 * xv + vv + q[0], xv + vv + q[1], vv + q[2])
        predicted, predicted_covariance = np.array([x, v]), np.array([xx, xv, vv])
        innovation, variance = measured - x, xx + 1
        if seen[f] and before is not None:
            x, v = x + xx / variance * innovation, v + xv / variance * innovation
            xx, xv, vv = xx / variance, xv / variance, vv - xv**2 / variance
        before = _Step(predicted, predicted_covariance, np.array([x, v]), np.array([xx, xv, vv]), innovation, variance)
        yield before


def _smooth(values: Float, seen: Bool, ratio: Float) -> Float:
    """Return the smoothed values (F, N): filter forward, then smooth backward with the Rauch-Tung-Striebel gain."""
    begins = range(0, len(values), _BLOCK)
    # the last step of every block; its blocks are filtered again on the way back
    ends = [
        step for f, step in enumerate(_filter(values, seen, ratio)) if (f + 1) % _BLOCK == 0 or f + 1 == len(values)
    ]
    x, v = ends[-1].state
    smoothed, after = np.empty(values.shape), None
    for begin, before in zip(reversed(begins), [*ends[-2::-1], None], strict=True):
        block = slice(begin, begin + _BLOCK)
        steps = list(_filter(values[block], seen[block], ratio, before))
        for f, step in zip(range(begin + len(steps) - 1, begin - 1, -1), reversed(steps), strict=True):
            if after is not None:
                xx, xv, vv = step.covariance
                pxx, pxv, pvv = after.predicted_covariance
                dx, dv = x - after.predicted[0], v - after.predicted[1]
                # the gain P Fᵀ P⁻¹ with F = [[1, 1], [0, 1]]: first P⁻¹ (…), then P Fᵀ
                determinant = pxx * pvv - pxv**2
                a, b = (pvv * dx - pxv * dv) / determinant, (pxx * dv - pxv * dx) / determinant
                x = step.state[0] + (xx + xv) * a + xv * b
                v = step.state[1] + (xv + vv) * a + vv * b
            smoothed[f], after = x, step
    return smoothed
