"""Levenberg-Marquardt for robust least squares on a box, on the same objective that SMD sees (Kehl 2006, section 7.3).

The caller gives value, gradient and Gauss-Newton Hessian in one; pairs may be found anew at every evaluation, so a step
is accepted by the value that the objective reports, whatever its pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class Quadratic(NamedTuple):
    """A local model at p: value, gradient (D,), positive semi-definite Hessian (D, D)."""

    value: float
    gradient: Float
    hessian: Float


@dataclass(frozen=True)
class LmConfig:
    """damping: λ at the start, as a share of the Hessian's diagonal; raised ×4 on refusal, lowered ×0.3 on success.
    max_iterations: evaluations of the quadratic model. tolerance: least relative fall of the value."""

    damping: float = 1e-2
    max_iterations: int = 30
    tolerance: float = 1e-4


@dataclass(frozen=True)
class LmResult:
    """pose (D,), its value, the iterations made, and whether the tolerance was met."""

    pose: Float
    value: float
    iterations: int
    converged: bool


def minimise(
    model: Callable[[Float], Quadratic],
    value: Callable[[Float], float],
    start: Float,
    constrain: Callable[[Float], Float],
    floor: Float | float = 0.0,
    config: LmConfig | None = None,
) -> LmResult:
    """Minimise from ``start``.

    Args:
        model: the quadratic model at a state (D,).
        value: the objective alone at a state.
        start: (D,).
        constrain: maps a state into the feasible region.
        floor: (D,) least diagonal of the damping term: keeps parameters that the data does not see in place.
        config: see :class:`LmConfig`.
    """
    config = config or LmConfig()
    p = constrain(np.asarray(start, np.float64))
    damping = config.damping
    now = model(p)
    for i in range(config.max_iterations):
        accepted = False
        for _ in range(6):
            D = np.diag(np.maximum(np.diag(now.hessian), floor) + 1e-12)
            candidate = constrain(p - np.linalg.solve(now.hessian + damping * D, now.gradient))
            f = value(candidate)
            if f < now.value:
                accepted = True
                break
            damping *= 4
        if not accepted:
            return LmResult(p, now.value, i + 1, True)
        fall = (now.value - f) / max(abs(now.value), 1e-12)
        p = candidate
        damping = max(damping * 0.3, 1e-6)
        now = model(p)
        if fall < config.tolerance:
            return LmResult(p, now.value, i + 1, True)
    return LmResult(p, now.value, config.max_iterations, False)
