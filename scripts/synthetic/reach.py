"""Arm angles that bring a wrist to a place, within the joint limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import least_squares

from scripts.synthetic.skeleton import LIMITS_DEG, Skeleton, forward

_NAMES = ("shoulder_abd", "shoulder_flex", "shoulder_in", "elbow")


def arm_angles(
    skeleton: Skeleton, side: str, wrist_m: tuple[float, float, float], guess: Mapping[str, float]
) -> dict[str, float]:
    """Degrees of the four arm angles of ``side`` for a wrist at ``wrist_m`` in the frame of the chest.

    Three coordinates do not fix four angles; the solution stays near ``guess`` (degrees, zero where not named).
    """
    names = [name + side for name in _NAMES]
    start = np.array([guess.get(name, 0.0) for name in _NAMES])
    limits = np.array([LIMITS_DEG[name] for name in names], dtype=np.float64)
    chest, wrist = skeleton.index("chest"), skeleton.index("wrist" + side)

    def residual(degrees: np.ndarray) -> np.ndarray:
        pose = forward(skeleton, {name: np.radians([value]) for name, value in zip(names, degrees, strict=True)})
        miss = pose.origin[0, wrist] - pose.origin[0, chest] - np.array(wrist_m)
        return np.concatenate([miss / 0.005, (degrees - start) / 100.0])

    margin = 1e-3
    begin = np.clip(start, limits[:, 0] + margin, limits[:, 1] - margin)
    solved = least_squares(residual, begin, bounds=(limits[:, 0], limits[:, 1]), x_scale=10.0).x
    return dict(zip(names, map(float, solved), strict=True))
