"""Damped Gauss-Newton over a batch of states, coarse to fine, with quadratic penalties beyond limits.

The silhouette paper's solver (eqs. 9-11 and section 4.5): a fixed number of iterations at each scale and no line
search, because the correspondences are found anew in every iteration. Not in the paper: a scale ends once its steps are
short; damping, without which a limb hidden in every view makes its equations singular; and over-relaxation.
Correspondences found anew move less than their equations predict: an edgel far off has little weight, the next edge
along a normal may belong to another limb, and a border between colours is determined by the few pixels about it. A full
step therefore leaves a share of the error, and the next step the same share again. Longer steps leave less; a plain one
at the end corrects their overshoot where equations are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError

Float = NDArray[np.float64]


class Equations(Protocol):
    """Normal equations of B states: ``hessian (B, D, D)`` is JᵀWJ, ``gradient (B, D)`` is JᵀWd."""

    @property
    def hessian(self) -> Float: ...

    @property
    def gradient(self) -> Float: ...

    @property
    def cost(self) -> Float:
        """(B,) cost of each state."""
        ...


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Settings.

    Attributes:
        scales: scales of the search, a factor of two apart; the coarsest comes first (the paper: 2).
        iterations: at each scale (the paper: 3).
        relaxation: length of the steps as a multiple of the equations' solution; above 1 (the paper) one plain step
            follows at the finest scale.
        damping: share of each diagonal element that is added to it.
        stiffness: least number added to the diagonal, as a share of its mean over the free parameters with evidence; it
            keeps parameters without evidence in place.
        limit_weight: weight of the squared excess over a limit, as a share of the same mean (section 4.5, which gives
            no number).
        longest_step: largest change of a parameter in one iteration; steps are shortened to it as a whole.
        tolerance: a state's iteration at a scale ends once no parameter changes by more, radians or metres; 0 (the
            paper): all iterations are made.
    """

    scales: int = 2
    iterations: int = 3
    relaxation: float = 1.0
    damping: float = 0.02
    stiffness: float = 0.0005
    limit_weight: float = 1.0
    longest_step: float = 0.5
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.scales <= 5 or not 1 <= self.iterations <= 100:
            raise ConfigError(
                f"gauss_newton: scales = {self.scales} must lie in [1, 5], iterations = {self.iterations} in [1, 100]"
            )
        if not 0 < self.relaxation < 2:
            raise ConfigError(f"gauss_newton: relaxation = {self.relaxation} must lie in (0, 2)")
        weights = self.damping, self.stiffness, self.limit_weight, self.tolerance
        if not all(value >= 0 for value in weights) or not self.longest_step > 0:
            raise ConfigError(
                f"gauss_newton: damping {self.damping}, stiffness {self.stiffness}, limit_weight "
                f"{self.limit_weight} and tolerance {self.tolerance} must not be negative, longest_step "
                f"{self.longest_step} must be positive"
            )

    def steps(self, scale: int) -> list[float]:
        """Return the length of each step at a scale as a multiple of the equations' solution."""
        plain = [1.0] if scale == 0 and self.relaxation > 1 else []
        return [self.relaxation] * self.iterations + plain


@dataclass(frozen=True)
class Prior:
    """A normal prior on the state, in the units of the equations.

    Attributes:
        mean: (D,) or (B, D).
        precision: (D,) zero without a prior.
    """

    mean: Float
    precision: Float


class BatchSolution(NamedTuple):
    """Result of :func:`minimise` for B states.

    Attributes:
        states: (B, D) after the last iteration.
        hessian: (B, D, D) JᵀWJ before the last step.
        iterations: (L,) number at each scale, in order.
    """

    states: Float
    hessian: Float
    iterations: NDArray[np.int32]


def minimise(
    equations: Callable[[Float, int, NDArray[np.intp]], Equations],
    start: Float,
    free: NDArray[np.intp] | None,
    lower: Float,
    upper: Float,
    config: GaussNewtonSettings | None = None,
    prior: Prior | None = None,
    levels: Sequence[int] | None = None,
) -> BatchSolution:
    """Iterate from B states at once; each state's result is independent of the others.

    Args:
        equations: the normal equations at states (N, D), a scale's index, 0 the finest, and the rows (N,) of ``start``
            that these states come from: states that have converged at a scale are left out.
        start: (B, D).
        free: (n,) indices of the parameters that may change; None: all.
        lower, upper: (D,) limits; infinite without a limit.
        config: see :class:`GaussNewtonSettings`.
        prior: of the states.
        levels: the scales in order; None: all from the coarsest to the finest.
    """
    config = config or GaussNewtonSettings()
    state = np.array(start, np.float64)
    hessian = np.zeros((*state.shape, state.shape[1]))
    parameters = _FreeParameters(np.arange(len(lower)) if free is None else free, lower, upper, config, prior)
    scales = range(config.scales - 1, -1, -1) if levels is None else levels
    iterations = np.zeros(len(scales), np.int32)
    for i, scale in enumerate(scales):
        rows = np.arange(len(state))  # states do not depend on each other
        for share in config.steps(scale):
            here = equations(state[rows], scale, rows)
            step = share * parameters.step(here.hessian, here.gradient, state, rows)
            state[rows[:, None], parameters.index] += step
            hessian[rows] = here.hessian
            iterations[i] += 1
            rows = rows[np.abs(step).max(axis=1, initial=0.0) > config.tolerance]
            if not len(rows):
                break
    return BatchSolution(state, hessian, iterations)


class _FreeParameters:
    """The free parameters ``index`` (n,), with their limits and prior."""

    def __init__(
        self, index: NDArray[np.intp], lower: Float, upper: Float, config: GaussNewtonSettings, prior: Prior | None
    ) -> None:
        self.index = index
        self._rows = index[:, None]
        self._lower, self._upper = lower[index], upper[index]
        self._config = config
        self._known = None if prior is None else (np.atleast_2d(prior.mean)[:, index], prior.precision[index])

    def step(self, hessian: Float, gradient: Float, states: Float, rows: NDArray[np.intp]) -> Float:
        """Return one damped step (N, n) of rows (N,) of the states (B, D), limits included."""
        config = self._config
        H = hessian[:, self._rows, self.index]
        g = gradient[:, self.index]
        p = states[rows[:, None], self.index]
        diagonal = np.einsum("bii->bi", H)  # a view
        count = np.count_nonzero(diagonal > 0, axis=1)
        unit = diagonal.sum(axis=1) / np.maximum(count, 1)
        unit[unit <= 0] = 1.0
        unit = unit[:, None]
        excess = np.minimum(np.maximum(p, self._lower), self._upper) - p
        pull = config.limit_weight * unit
        g += pull * excess
        added = config.damping * diagonal + (config.stiffness + 1e-9) * unit + pull * (excess != 0)
        if self._known is not None:
            mean, precision = self._known
            mean = mean if len(mean) == 1 else mean[rows]
            added += precision
            g += precision * (mean - p)
        diagonal += added
        delta = np.linalg.solve(H, g[:, :, None])[:, :, 0]
        longest = np.maximum(delta.max(axis=1, initial=0.0), -delta.min(axis=1, initial=0.0))
        return np.asarray(delta * np.minimum(1.0, config.longest_step / np.maximum(longest, 1e-12))[:, None])
