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

from tk.errors import ConfigError

Float = NDArray[np.float64]


class Quadratic(NamedTuple):
    """A local model at p: value, gradient (D,), positive semi-definite Hessian (D, D)."""

    value: float
    gradient: Float
    hessian: Float


@dataclass(frozen=True)
class LmSettings:
    """Settings.

    Attributes:
        damping: λ at the start, as a share of the Hessian's diagonal; raised ×4 on refusal, lowered ×0.3 on success.
        max_iterations: most steps that are taken.
        tolerance: least fall of the value, relative to it, that is worth a step.
    """

    damping: float = 1e-2
    max_iterations: int = 30
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        if not self.damping > 0 or not self.tolerance >= 0 or self.max_iterations < 1:
            raise ConfigError(
                f"lm: damping {self.damping} must be positive, "
                f"tolerance {self.tolerance} not negative, max_iterations {self.max_iterations} at least 1"
            )


@dataclass(frozen=True)
class LmResult:
    """Where the descent ended.

    Attributes:
        pose: (D,).
        value: the objective there.
        iterations: steps tried, refusals not counted.
        converged: True where the last step gained, or the next could gain, less than the tolerance.
    """

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
    config: LmSettings | None = None,
) -> LmResult:
    """Minimise from ``start``.

    A parameter on a limit that the gradient pushes against is left out of the step: projected afterwards, the step of
    the others would make up for a motion that did not happen. A refused step is tried again, shorter, until its own
    model promises less than the tolerance.

    Args:
        model: the quadratic model at a state (D,).
        value: the objective alone at a state.
        start: (D,).
        constrain: maps a state into the feasible region, each parameter by itself.
        floor: (D,) least diagonal of the damping term: keeps parameters that the data does not see in place.
        config: see :class:`LmSettings`.

    Raises:
        FloatingPointError: when the model is not finite. A value that is not finite refuses its step.
    """
    config = config or LmSettings()
    p = constrain(np.asarray(start, np.float64))
    damping = config.damping
    now = _finite(model(p))
    for i in range(config.max_iterations):
        worth = config.tolerance * max(abs(now.value), 1e-12)
        D = np.maximum(np.diag(now.hessian), floor) + 1e-12
        downhill = p - now.gradient / D
        free = (constrain(downhill) != p) | (downhill == p)
        while True:
            H = now.hessian + np.diag(damping * D)
            delta = np.zeros_like(p)
            delta[free] = np.linalg.solve(H[np.ix_(free, free)], -now.gradient[free])
            candidate = constrain(p + delta)
            f = value(candidate)
            if f < now.value:
                break
            promised = -now.gradient @ delta - 0.5 * delta @ now.hessian @ delta
            if promised <= worth or np.array_equal(candidate, p):
                return LmResult(p, now.value, i + 1, True)
            damping *= 4
        fall = now.value - f
        p = candidate
        damping = max(damping * 0.3, 1e-6)
        now = _finite(model(p))
        if fall < worth:
            return LmResult(p, now.value, i + 1, True)
    return LmResult(p, now.value, config.max_iterations, False)


def _finite(quadratic: Quadratic) -> Quadratic:
    if not all(np.isfinite(part).all() for part in quadratic):
        raise FloatingPointError("Levenberg-Marquardt: the quadratic model is not finite")
    return quadratic
