"""Stochastic Meta Descent (Kehl 2006, section 6.2, after Schraudolph 1999) for a batch of problems.

Gradient descent with a step size for every parameter, adapted during the iterations:

    a ← a ⊗ max(½, 1 + μ v ⊗ g)                  (18)
    p ← constrain(p − a ⊗ g)                     (17, 22)
    gᶜ = (p_old − p) / a                         (23)
    v ← λ v + a ⊗ (gᶜ − λ H v)                   (19)

An objective is a callable of a batch of poses, which draws new samples for each iteration number.

Beyond the paper: the result is the mean of the last states, whose change eq. 20 bounds, because the last state has the
last sample's noise. And SMD works in given directions, see :func:`minimise`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

# μ of eq. 18, per unit of the objective, which lies between 0 and 1 here. The paper takes a tenth of its initial step
# sizes, which depends on its objective's scale.
META_STEP = 1.0
# λ of eq. 19, i_max of eq. 21 and n of eq. 20: the paper's.
MEMORY, MAX_ITERATIONS, WINDOW = 0.3, 40, 3


class Evaluation(Protocol):
    """An objective at B poses: gradient (B, D) and Hessian-vector product (B, D)."""

    @property
    def gradient(self) -> Float: ...
    @property
    def hessian_vector(self) -> Float: ...


Objective = Callable[[Float, Float, int], Evaluation]
"""(poses (B, D), directions (B, D), iteration) -> Evaluation."""


@dataclass(frozen=True)
class SmdResult:
    """The minima of B problems."""

    pose: Float  # (B, D)
    iterations: NDArray[np.int32]  # (B,) number of iterations
    path: Float  # (I + 1, B, D) all states; a finished row repeats its last state


def minimise(
    objective: Objective,
    start: Float,
    step: float,
    tolerance: Float,
    constrain: Callable[[Float], Float],
    basis: tuple[Float, Float],
    max_step: Float,
    max_iterations: int = MAX_ITERATIONS,
) -> SmdResult:
    """Minimise B objectives, each row by itself.

    Args:
        objective: see :data:`Objective`.
        start: (B, D) first states.
        step: initial step size a₀ of every direction, positive.
        tolerance: (D,) ε of eq. 20, a number for every parameter in its own unit: a row stops when the change of its
            moving average is at most ε in each. The paper gives one for angles and one for the displacement.
        constrain: maps states (B, D) into the feasible region (eq. 22).
        basis: (B, D, U) directions in which SMD works, p = p_start + basis·u, with a step size for each, and their
            pseudo-inverse (B, U, D). The paper's are the unit vectors. If they whiten the Hessian, the coupling of the
            joints along a limb does not affect the step sizes. Columns of zeros keep a row's parameters fixed.
        max_step: (D,) most that an iteration may change each parameter, in its own unit. The paper bounds no step. One
            factor scales a row's whole update; eqs. 19 and 23 take the scaled step sizes. No step size grows in such an
            iteration: growth would turn the direction, and on a steep objective continue without bound.
        max_iterations: i_max of eq. 21.

    Raises:
        FloatingPointError: when a gradient, a Hessian-vector product or a diverging state is not finite. A gradient
            replaced by zero would end the iterations as converged.
    """
    W, W_inverse = basis
    p = constrain(np.array(start, dtype=np.float64))
    a = np.full((len(p), W.shape[2]), float(step))
    v = np.zeros_like(a)
    history = [p]
    iterations = np.zeros(len(p), np.int32)
    active = np.ones(len(p), bool)
    for i in range(max_iterations):
        now = objective(p, _times(W, v), i)
        _require_finite("the objective's gradient", now.gradient, active, i)
        _require_finite("the objective's Hessian-vector product", now.hessian_vector, active, i)
        running = active[:, None]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # in finished rows; the others are checked
            g = _times(W.transpose(0, 2, 1), now.gradient)
            Hv = _times(W.transpose(0, 2, 1), now.hessian_vector)
            adapted = np.where(running, a * np.maximum(0.5, 1.0 + META_STEP * v * g), a)
            a, scale = _bounded(W, a, adapted, g, max_step)
            a_used = scale * a
            p_next = np.where(running, constrain(p - _times(W, a_used * g)), p)
            g_constrained = _times(W_inverse, p - p_next) / a_used
            v = np.where(running, MEMORY * v + a_used * (g_constrained - MEMORY * Hv), v)
        p = p_next
        _require_finite("the state", p, active, i)
        _require_finite("the trace v of the state's past", v, active, i)
        history.append(p)
        iterations += active
        if len(history) > WINDOW:
            moved = np.abs(history[-1] - history[-1 - WINDOW]) / WINDOW
            active &= ~np.all(moved <= tolerance, axis=1)
            if not active.any():
                break
    path = np.stack(history)
    mean = [path[max(n + 1 - WINDOW, 0) : n + 1, b].mean(axis=0) for b, n in enumerate(iterations)]
    return SmdResult(constrain(np.stack(mean)), iterations, path)  # a mean of states on a limit can round to beyond it


def _bounded(W: Float, a: Float, adapted: Float, g: Float, bound: Float) -> tuple[Float, Float]:
    """Return step sizes (B, U) and the factor (B, 1), at most 1, that keeps the update within ``bound`` (D,)."""

    def factor(a: Float) -> Float:
        excess = np.max(np.abs(_times(W, a * g)) / bound, axis=1, keepdims=True)
        return 1.0 / np.maximum(excess, 1.0)

    a = np.where(factor(adapted) < 1.0, np.minimum(adapted, a), adapted)
    return a, factor(a)


def _require_finite(what: str, values: Float, active: NDArray[np.bool_], iteration: int) -> None:
    """Raise FloatingPointError for NaN or infinity in the active rows of ``values`` (B, ·)."""
    bad = np.argwhere(active[:, None] & ~np.isfinite(values))
    if len(bad):
        raise FloatingPointError(
            f"SMD: {what} is not finite at iteration {iteration}, row {bad[0][0]}, component {bad[0][1]}"
        )


def _times(matrices: Float, vectors: Float) -> Float:
    """Multiply (B, D, U) by (B, U)."""
    return np.einsum("bdu,bu->bd", matrices, vectors)
