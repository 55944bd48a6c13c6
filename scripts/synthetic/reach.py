"""Inverse kinematics within the joint limits: arm angles for a wrist position, leg angles for a toe position."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from scripts.synthetic.skeleton import LIMITS_DEG, Angles, Skeleton, forward, sole_of

Float = NDArray[np.float64]

_NAMES = ("shoulder_abd", "shoulder_flex", "shoulder_in", "elbow")
_LEG_NAMES = ("hip_open", "hip_abd", "hip_flex", "hip_in", "knee")
_LEG_GUESS_DEG = (0.0, 5.0, 15.0, 0.0, 25.0)
_LEG_WEIGHT = np.array([2e-3, 1e-3, 0.0, 2e-3, 0.0])
"""Metres per radian: of several solutions, prefer small angles of the hip about its minor axes."""


def arm_angles(
    skeleton: Skeleton, side: str, wrist_m: tuple[float, float, float], guess: Mapping[str, float]
) -> dict[str, float]:
    """Return the four arm angles of ``side``, degrees, for a wrist at ``wrist_m`` in the frame of the chest.

    Three coordinates do not fix four angles; the solution stays near ``guess`` (degrees, zero where not named).
    """
    names = [name + side for name in _NAMES]
    start = np.array([guess.get(name, 0.0) for name in _NAMES])
    limits = np.array([LIMITS_DEG[name] for name in names], dtype=np.float64)
    arm = skeleton.branch("wrist" + side)
    chest, wrist = arm.index("chest"), arm.index("wrist" + side)

    def residual(degrees: np.ndarray) -> np.ndarray:
        pose = forward(arm, {name: np.radians([value]) for name, value in zip(names, degrees, strict=True)})
        miss = pose.origin[0, wrist] - pose.origin[0, chest] - np.array(wrist_m)
        return np.concatenate([miss / 0.005, (degrees - start) / 100.0])

    margin = 1e-3
    begin = np.clip(start, limits[:, 0] + margin, limits[:, 1] - margin)
    solved = least_squares(residual, begin, bounds=(limits[:, 0], limits[:, 1]), x_scale=10.0).x
    return dict(zip(names, map(float, solved), strict=True))


def leg_angles(skeleton: Skeleton, side: str, angles: Angles, root: Float, toe: Float, heading: Float) -> Angles:
    """Return the five leg angles of ``side``, radians, at T times, by damped Newton steps from one time to the next.

    The toe tip's place and the foot's direction fix four of the five; the ankle keeps the sole level as far as it goes
    and lifts the heel beyond (see `forward`), so that one rule serves for standing, squatting and kneeling.

    Args:
        skeleton: the tree.
        side: "_l" or "_r".
        angles: (T,) radians of the pelvis and of this leg's ankle, at least.
        root: (T, 3) the pelvis, metres.
        toe: (T, 3) where the sole of the toe tip is to be, metres.
        heading: (T,) radians about z to which the foot points.
    """
    names = [name + side for name in _LEG_NAMES]
    low, high = np.radians([LIMITS_DEG[name] for name in names]).T
    leg = skeleton.branch("toes" + side)
    ankle = leg.index("ankle" + side)
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=1)
    given = {name: angles[name] for name in ("yaw", "pitch", "roll", "ankle" + side)}

    def residual(x: Float, at: int) -> Float:
        rows = np.full(len(x), at)
        legs = {name: x[:, i] for i, name in enumerate(names)}
        pose = forward(leg, {name: values[rows] for name, values in given.items()} | legs, root[rows])
        sideways = (pose.rotation[:, ankle, :, 1] * ahead[at]).sum(axis=1)
        return np.column_stack([sole_of(leg, pose, side)[:, 2] - toe[at], 0.2 * sideways, _LEG_WEIGHT * x])

    step, solved = 1e-5, np.empty((len(toe), len(names)))
    probes = np.concatenate([np.zeros((1, len(names))), step * np.eye(len(names))])
    x = np.radians(_LEG_GUESS_DEG)
    for at in range(len(toe)):  # from the previous solution, because there are others
        for _ in range(40):
            miss = residual(x + probes, at)
            jacobian = (miss[1:] - miss[0]).T / step
            change = np.linalg.solve(jacobian.T @ jacobian + 1e-7 * np.eye(len(names)), -jacobian.T @ miss[0])
            x = np.clip(x + np.clip(change, -0.1, 0.1), low, high)
            if np.abs(change).max() < 1e-4:
                break
        solved[at] = x
    return {name: solved[:, i] for i, name in enumerate(names)}
