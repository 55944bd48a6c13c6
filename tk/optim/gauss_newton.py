"""Damped Gauss-Newton over a batch of states, coarse to fine, with quadratic penalties beyond limits.

The silhouette paper's solver (eqs. 9-11 and section 4.5): a fixed number of iterations at each scale and no line
search, because the correspondences are found anew in every iteration. Not in the paper: a scale ends once its steps are
short; damping, without which a limb hidden in every view makes its equations singular; and over-relaxation.
Correspondences found anew move less than their equations predict: an edgel far off has little weight, the next edge
along a normal may belong to another limb, and a border between colours is determined by the few pixels about it. A full
step therefore leaves a share of the error, and the next step the same share again. Longer steps leave less; a plain one
at the end corrects their overshoot where equations are exact.

A problem makes all steps of a scale in one kernel (:func:`tk.kernels.newton.newton_step`), because a launch and NumPy's
algebra cost a third of a small problem's equations.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.newton import NewtonSteps
from tk.kernels.silhouette import Descent
from tk.optim.quadratic import Quadratic

Float = NDArray[np.float64]


@dataclass(frozen=True)
class GaussNewtonSettings:
    """Settings."""

    scales: int = 2  # scales of the search, a factor of two apart; the coarsest comes first (the paper: 2)
    iterations: int = 3  # at each scale (the paper: 3)
    # length of the steps as a multiple of the equations' solution; above 1 (the paper) one plain step follows at the
    # finest scale
    relaxation: float = 1.0
    damping: float = 0.02  # share of each diagonal element that is added to it
    # least number added to the diagonal, as a share of its mean over the free parameters with evidence; it keeps
    # parameters without evidence in place
    stiffness: float = 0.0005
    # weight of the squared excess over a limit, as a share of the same mean (section 4.5, which gives no number)
    limit_weight: float = 1.0
    longest_step: float = 0.5  # largest change of a parameter in one iteration; steps are shortened to it as a whole
    # a state's iteration at a scale ends once no parameter changes by more, radians or metres; 0 (the paper): all
    # iterations are made
    tolerance: float = 0.0

    def steps(self, scale: int) -> list[float]:
        """Return the length of each step at a scale as a multiple of the equations' solution."""
        plain = [1.0] if scale == 0 and self.relaxation > 1 else []
        return [self.relaxation] * self.iterations + plain


class BatchSolution(NamedTuple):
    """Result of :func:`minimise` for B states."""

    states: Float  # (B, D) after the last iteration
    iterations: NDArray[np.int32]  # (L,) number at each scale, in order


def minimise(
    descend: Callable[[Float, int, NewtonSteps], Descent],
    start: Float,
    free: NDArray[np.intp] | None,
    lower: Float,
    upper: Float,
    config: GaussNewtonSettings | None = None,
    terms: Callable[[Float], Quadratic] | None = None,
    levels: Sequence[int] | None = None,
) -> BatchSolution:
    """Iterate from B states at once; each state's result is independent of the others.

    Args:
        descend: makes the steps of states (B, D) at a scale's index, 0 the finest.
        start: (B, D).
        free: (n,) indices of the parameters that may change; None: all.
        lower, upper: (D,) limits; infinite without a limit.
        config: see :class:`GaussNewtonSettings`.
        terms: further terms of the cost as a quadratic about states (B, D), in the units of the equations; it is
            called at the start of each scale.
        levels: the scales in order; None: all from the coarsest to the finest.
    """
    config = config or GaussNewtonSettings()
    states = np.array(start, np.float64)
    index = np.arange(len(lower), dtype=np.int32) if free is None else free.astype(np.int32)
    scales = range(config.scales - 1, -1, -1) if levels is None else levels
    iterations = np.zeros(len(scales), np.int32)
    none = Quadratic(np.zeros((1, len(lower))), np.zeros((1, len(lower), len(lower))))
    for i, scale in enumerate(scales):
        linear, matrix = none if terms is None else terms(states)
        rows = np.ascontiguousarray(np.vstack([lower, upper, np.broadcast_to(linear, states.shape)]))
        steps = NewtonSteps(index, rows, np.ascontiguousarray(matrix), _numbers(config, scale == 0))
        states, made = descend(states, scale, steps)
        iterations[i] = made.max(initial=0)
    return BatchSolution(states, iterations)


@functools.cache
def _numbers(config: GaussNewtonSettings, finest: bool) -> Float:
    """Return the settings of the steps at a scale as a kernel takes them."""
    settings = config.damping, config.stiffness, config.limit_weight, config.longest_step, config.tolerance
    return np.array([*settings, *config.steps(0 if finest else 1)])
