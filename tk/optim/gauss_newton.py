"""Damped Gauss-Newton over a batch of states, coarse to fine, with quadratic penalties beyond limits.

The silhouette paper's solver (eqs. 9-11 and section 4.5): a fixed number of iterations a scale, no line search, for the
correspondences are found anew at every iteration. Damping is not in the paper; without it a limb that is hidden in
every view makes its equation singular.
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
    """What a state's residuals add up to: ``hessian (B, D, D)`` is JᵀWJ, ``gradient (B, D)`` is JᵀWd."""

    @property
    def hessian(self) -> Float: ...

    @property
    def gradient(self) -> Float: ...

    @property
    def cost(self) -> Float:
        """(B,) by which states are compared."""
        ...


@dataclass(frozen=True)
class GaussNewtonConfig:
    """Settings.

    Attributes:
        scales: scales of the search, a factor of two apart; the coarsest comes first (the paper: 2).
        iterations: at each scale (the paper: 3).
        damping: share of the diagonal that is added to it.
        stiffness: what is added to the diagonal at least, as a share of its mean over the free parameters that the
            data sees; it keeps the others where they are.
        limit_weight: weight of the squared excess over a limit, as a share of the same mean (4.5, which gives no
            number).
        longest_step: largest change of a parameter in one iteration; steps are shortened to it as a whole.
    """

    scales: int = 2
    iterations: int = 3
    damping: float = 0.02
    stiffness: float = 0.0005
    limit_weight: float = 1.0
    longest_step: float = 0.5

    def __post_init__(self) -> None:
        if not 1 <= self.scales <= 5 or not 1 <= self.iterations <= 100:
            raise ConfigError(
                f"gauss_newton: scales = {self.scales} must lie in [1, 5], iterations = {self.iterations} in [1, 100]"
            )
        if min(self.damping, self.stiffness, self.limit_weight) < 0 or not self.longest_step > 0:
            raise ConfigError(
                f"gauss_newton: damping {self.damping}, stiffness {self.stiffness} and limit_weight "
                f"{self.limit_weight} must not be negative, longest_step {self.longest_step} must be positive"
            )


@dataclass(frozen=True)
class Prior:
    """A normal prior on the state, in the units of the equations.

    Attributes:
        mean: (D,) or (B, D).
        precision: (D,) zero where there is none.
    """

    mean: Float
    precision: Float


class Descent(NamedTuple):
    """Where B descents ended.

    Attributes:
        states: (B, D) after the last iteration.
        hessian: (B, D, D) JᵀWJ where the last step was taken from.
    """

    states: Float
    hessian: Float


def minimise(
    equations: Callable[[Float, int], Equations],
    start: Float,
    free: NDArray[np.bool_],
    lower: Float,
    upper: Float,
    config: GaussNewtonConfig | None = None,
    prior: Prior | None = None,
    levels: Sequence[int] | None = None,
) -> Descent:
    """Descend from B states at once.

    Args:
        equations: the normal equations at states (B, D) and a scale's index, 0 the finest.
        start: (B, D).
        free: (D,) parameters that may change.
        lower, upper: (D,) limits; infinite where there is none.
        config: see :class:`GaussNewtonConfig`.
        prior: what is known beside the equations.
        levels: the scales to go through; all from the coarsest to the finest if None.
    """
    config = config or GaussNewtonConfig()
    state = np.array(start, np.float64)
    hessian = np.zeros((*state.shape, state.shape[1]))
    for scale in range(config.scales - 1, -1, -1) if levels is None else levels:
        for _ in range(config.iterations):
            here = equations(state, scale)
            state += step(here.hessian, here.gradient, state, free, lower, upper, config, prior)
            hessian = here.hessian
    return Descent(state, hessian)


def step(
    hessian: Float,
    gradient: Float,
    state: Float,
    free: NDArray[np.bool_],
    lower: Float,
    upper: Float,
    config: GaussNewtonConfig,
    prior: Prior | None = None,
) -> Float:
    """One damped step (B, D) of each state, limits included; zero for parameters that are not free."""
    index = np.flatnonzero(free)
    H = hessian[:, index[:, None], index]
    g = gradient[:, index].copy()
    p = state[:, index]
    B, n = g.shape
    diagonal = np.einsum("bii->bi", H).copy()
    seen = diagonal > 0
    mean = diagonal.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    unit = np.where(mean > 0, mean, 1.0)[:, None]
    excess = np.clip(p, lower[index], upper[index]) - p
    beyond = excess != 0
    added = config.damping * diagonal + config.stiffness * unit + config.limit_weight * unit * beyond + 1e-9 * unit
    g += config.limit_weight * unit * excess
    if prior is not None:
        precision = prior.precision[index]
        added = added + precision
        g += precision * (np.broadcast_to(prior.mean, state.shape)[:, index] - p)
    H[:, range(n), range(n)] += added
    delta = np.linalg.solve(H, g[:, :, None])[:, :, 0]
    longest = np.abs(delta).max(axis=1, initial=0.0)
    delta *= np.minimum(1.0, config.longest_step / np.maximum(longest, 1e-12))[:, None]
    result = np.zeros((B, state.shape[1]))
    result[:, index] = delta
    return result
