"""Stochastic Meta Descent (Kehl 2006, section 6.2, after Schraudolph 1999) for a batch of problems.

Gradient descent with a step size for every parameter, adapted during the iterations:

    a ← a ⊗ max(½, 1 + μ v ⊗ g)                  (18)
    p ← constrain(p − a ⊗ g)                     (17, 22)
    gᶜ = (p_old − p) / a                         (23)
    v ← λ v + a ⊗ (gᶜ − λ H v)                   (19)

An objective is a callable of a batch of poses. It draws new samples for each iteration number that it is called with;
``shuffle = False`` calls it with one number throughout, the deterministic variant of section 7.1.

Beyond the paper, which bounds no step: ``max_step`` bounds the update of an iteration. One factor scales the whole row,
so that its direction stays. Equations 19 and 23 take the scaled step sizes, by which p has moved. No step size grows in
such an iteration: growth would turn the direction, and on a steep objective continue without bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError

Float = NDArray[np.float64]


class Evaluation(Protocol):
    """An objective at B poses: value (B,), gradient (B, D) and Hessian-vector product (B, D)."""

    @property
    def value(self) -> Float: ...
    @property
    def gradient(self) -> Float: ...
    @property
    def hessian_vector(self) -> Float: ...


Objective = Callable[[Float, Float, int], Evaluation]
"""(poses (B, D), directions (B, D), iteration) -> Evaluation."""


@dataclass(frozen=True)
class SmdSettings:
    """Settings of SMD: the paper's values, as far as they do not depend on its units.

    Attributes:
        meta_step: μ of eq. 18, per unit of the objective, which lies between 0 and 1 here. The paper takes a tenth of
            its initial step sizes, which depends on its objective's scale.
        memory: λ of eq. 19 (paper: 0.3).
        max_iterations: i_max of eq. 21 (paper: 40).
        window: n of eq. 20 (paper: 3).
        shuffle: new samples each iteration.
        average: return the mean of the last ``window`` states, whose change eq. 20 bounds, instead of the last state,
            which has the last sample's noise. The paper is silent about this.
    """

    meta_step: float = 1.0
    memory: float = 0.3
    max_iterations: int = 40
    window: int = 3
    shuffle: bool = True
    average: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.memory <= 1:
            raise ConfigError(f"smd.memory = {self.memory} must lie between 0 and 1")
        if self.meta_step < 0 or self.max_iterations < 1 or self.window < 1:
            raise ConfigError(
                f"smd: meta_step {self.meta_step} must not be negative, max_iterations {self.max_iterations} "
                f"and window {self.window} must be at least 1"
            )


@dataclass(frozen=True)
class SmdResult:
    """The minima of B problems.

    Attributes:
        pose: (B, D).
        value: (B,) the objective of the last evaluation, on that iteration's samples.
        iterations: (B,) number of iterations.
        path: (I + 1, B, D) all states with ``keep_path``, else None; a finished row repeats its last state.
    """

    pose: Float
    value: Float
    iterations: NDArray[np.int32]
    path: Float | None = None


def minimise(
    objective: Objective,
    start: Float,
    step: Float | float,
    tolerance: Float,
    constrain: Callable[[Float], Float],
    basis: Float | None = None,
    config: SmdSettings | None = None,
    keep_path: bool = False,
    max_step: Float | float | None = None,
    basis_inverse: Float | None = None,
) -> SmdResult:
    """Minimise B objectives, each row by itself.

    Args:
        objective: see :data:`Objective`.
        start: (B, D) first states.
        step: initial step sizes a₀ > 0, (B, U), (U,) or one number.
        tolerance: (D,) ε of eq. 20, a number for every parameter in its own unit: a row stops when the change of its
            moving average is at most ε in each. The paper gives one for angles and one for the displacement.
        constrain: maps states (B, D) into the feasible region (eq. 22).
        basis: (B, D, U) directions in which SMD works, p = p_start + basis·u, with a step size for each of the U
            directions; the unit vectors of p by default, as in the paper. With a basis that whitens the Hessian the
            diagonal step sizes are unaffected by the coupling of the joints along a limb. Columns of zeros keep a row's
            parameters fixed.
        config: see :class:`SmdSettings`.
        keep_path: record every state.
        max_step: (D,) most that an iteration may change each parameter, in its own unit, positive; None for no bound.
        basis_inverse: (B, U, D) the pseudo-inverse of ``basis``, if the caller has it.

    Raises:
        ConfigError: when a step size or a bound on the update is not positive.
        FloatingPointError: when a gradient, a Hessian-vector product or a diverging state is not finite. A gradient
            replaced by zero would end the iterations as converged.
    """
    config = config or SmdSettings()
    p = constrain(np.array(start, dtype=np.float64, ndmin=2))
    B, D = p.shape
    W = np.broadcast_to(np.eye(D), (B, D, D)) if basis is None else np.asarray(basis, np.float64)
    W_inverse = np.asarray(np.linalg.pinv(W) if basis_inverse is None else basis_inverse, np.float64)
    a = np.broadcast_to(np.asarray(step, np.float64), (B, W.shape[2])).copy()
    bound = None if max_step is None else np.broadcast_to(np.asarray(max_step, np.float64), (D,))
    if not (a > 0).all():
        raise ConfigError("smd: every initial step size must be positive")
    if bound is not None and not (bound > 0).all():
        raise ConfigError("smd: every component of max_step must be positive")
    v = np.zeros_like(a)
    history = [p]
    value = np.full(B, np.nan)
    iterations = np.zeros(B, np.int32)
    active = np.ones(B, bool)
    for i in range(config.max_iterations):
        now = objective(p, _times(W, v), i if config.shuffle else 0)
        _require_finite("the objective's gradient", now.gradient, active, i)
        _require_finite("the objective's Hessian-vector product", now.hessian_vector, active, i)
        value = np.where(active, now.value, value)
        running = active[:, None]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # in finished rows; the others are checked
            g = _times(W.transpose(0, 2, 1), now.gradient)
            Hv = _times(W.transpose(0, 2, 1), now.hessian_vector)
            adapted = np.where(running, a * np.maximum(0.5, 1.0 + config.meta_step * v * g), a)
            a, scale = (adapted, 1.0) if bound is None else _bounded(W, a, adapted, g, bound)
            a_used = scale * a
            p_next = np.where(running, constrain(p - _times(W, a_used * g)), p)
            g_constrained = _times(W_inverse, p - p_next) / a_used
            v = np.where(running, config.memory * v + a_used * (g_constrained - config.memory * Hv), v)
        p = p_next
        _require_finite("the state", p, active, i)
        _require_finite("the trace v of the state's past", v, active, i)
        history.append(p)
        iterations += active
        if len(history) > config.window:
            moved = np.abs(history[-1] - history[-1 - config.window]) / config.window
            active &= ~np.all(moved <= tolerance, axis=1)
            if not active.any():
                break
    pose = p
    if config.average:
        first = np.maximum(iterations - config.window + 1, 0)
        pose = np.stack([np.mean([h[b] for h in history[first[b] : n + 1]], axis=0) for b, n in enumerate(iterations)])
        pose = constrain(pose)  # a mean of states on a limit can round to beyond it
    return SmdResult(pose, value, iterations, np.stack(history) if keep_path else None)


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
            f"SMD: {what} is not finite at iteration {iteration}, row {bad[0][0]}, component {bad[0][1]}; "
            "if it diverges, choose a smaller first step or bound the update with max_step"
        )


def _times(matrices: Float, vectors: Float) -> Float:
    """Multiply (B, D, U) by (B, U)."""
    return np.einsum("bdu,bu->bd", matrices, vectors)
