"""Damped Gauss-Newton over a batch of states, coarse to fine, with quadratic penalties beyond limits.

The silhouette paper's solver (eqs. 9-11 and section 4.5): a fixed number of iterations a scale, no line search, for the
correspondences are found anew at every iteration. Not in the paper: a scale is left once its steps are short. Damping
is not in the paper; without it a limb that is hidden in every view makes its equation singular. Nor is over-relaxation.
Correspondences that are found anew give way less than their equations tell: an edgel that is far off weighs little, the
next edge along a normal may be another limb's, and a border between colours is told by the few pixels about it. So a
full step leaves a share of the way, the same again in the next one; longer steps leave less, and a plain one at the end
takes back what they overshot where equations are exact.
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
class GaussNewtonSettings:
    """Settings.

    Attributes:
        scales: scales of the search, a factor of two apart; the coarsest comes first (the paper: 2).
        iterations: at each scale (the paper: 3).
        relaxation: by how much steps are longer than the equations tell; beyond 1 (the paper) one plain step more
            follows at the finest scale.
        damping: share of the diagonal that is added to it.
        stiffness: what is added to the diagonal at least, as a share of its mean over the free parameters that the
            data sees; it keeps the others where they are.
        limit_weight: weight of the squared excess over a limit, as a share of the same mean (4.5, which gives no
            number).
        longest_step: largest change of a parameter in one iteration; steps are shortened to it as a whole.
        tolerance: a state is done with a scale once no parameter changes by more, radians or metres; 0 (the paper): all
            iterations are made.
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
        """How long each step at a scale is, as a share of what the equations tell."""
        plain = [1.0] if scale == 0 and self.relaxation > 1 else []
        return [self.relaxation] * self.iterations + plain


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
        iterations: (L,) made at each of the scales, in the order in which they were gone through.
    """

    states: Float
    hessian: Float
    iterations: NDArray[np.int32]


def minimise(
    equations: Callable[[Float, int], Equations],
    start: Float,
    free: NDArray[np.bool_],
    lower: Float,
    upper: Float,
    config: GaussNewtonSettings | None = None,
    prior: Prior | None = None,
    levels: Sequence[int] | None = None,
) -> Descent:
    """Descend from B states at once.

    Args:
        equations: the normal equations at states (B, D) and a scale's index, 0 the finest.
        start: (B, D).
        free: (D,) parameters that may change.
        lower, upper: (D,) limits; infinite where there is none.
        config: see :class:`GaussNewtonSettings`.
        prior: what is known beside the equations.
        levels: the scales to go through; all from the coarsest to the finest if None.
    """
    config = config or GaussNewtonSettings()
    state = np.array(start, np.float64)
    hessian = np.zeros((*state.shape, state.shape[1]))
    room = _Room(np.flatnonzero(free), lower, upper, config, prior)
    scales = range(config.scales - 1, -1, -1) if levels is None else levels
    iterations = np.zeros(len(scales), np.int32)
    for i, scale in enumerate(scales):
        moving = np.ones(len(state), np.bool_)  # what a state comes to does not depend on those beside it
        for share in config.steps(scale):
            here = equations(state, scale)
            step = share * room.step(here.hessian, here.gradient, state)
            state[:, room.index] += np.where(moving[:, None], step, 0.0)
            hessian[moving] = here.hessian[moving]
            iterations[i] += 1
            moving &= np.abs(step).max(axis=1, initial=0.0) > config.tolerance
            if not moving.any():
                break
    return Descent(state, hessian, iterations)


class _Room:
    """Where the states may go: the free parameters ``index`` (n,), their limits, and what is known of them."""

    def __init__(
        self, index: NDArray[np.intp], lower: Float, upper: Float, config: GaussNewtonSettings, prior: Prior | None
    ) -> None:
        self.index = index
        self._rows = index[:, None]
        self._lower, self._upper = lower[index], upper[index]
        self._config = config
        self._known = None if prior is None else (prior.mean[..., index], prior.precision[index])

    def step(self, hessian: Float, gradient: Float, state: Float) -> Float:
        """One damped step (B, n) of each state (B, D), the limits' pull included."""
        config = self._config
        H = hessian[:, self._rows, self.index]
        g = gradient[:, self.index]
        p = state[:, self.index]
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
            added += precision
            g += precision * (mean - p)
        diagonal += added
        delta = np.linalg.solve(H, g[:, :, None])[:, :, 0]
        longest = np.maximum(delta.max(axis=1, initial=0.0), -delta.min(axis=1, initial=0.0))
        return np.asarray(delta * np.minimum(1.0, config.longest_step / np.maximum(longest, 1e-12))[:, None])
