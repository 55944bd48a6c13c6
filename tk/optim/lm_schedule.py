"""The passes of a frame by Levenberg-Marquardt, for the comparison of Kehl 2006, section 7.3.

All degrees of freedom, then each chain with the torso held, on the objective that :mod:`tk.optim.schedule` hands SMD:
the same terms and the same numbers of points. As in the paper, the points are drawn once for each frame and pass and
stay.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.optim import levenberg_marquardt as lm
from tk.optim.schedule import CHAIN_LEVER_M, LEVER_M, ScheduleResult, ScheduleSettings

Float = NDArray[np.float64]


class Fixed(Protocol):
    """An objective on points that stay."""

    def value(self, pose: Float) -> float:
        """At a pose (D,)."""
        ...

    def model(self, pose: Float) -> tuple[float, Float, Float]:
        """Value, gradient (D,), Gauss-Newton Hessian (D, D)."""
        ...


class FixedProblem(Protocol):
    """One frame's objective, as this schedule sees it. D parameters, K chains."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """(K, D) the parameters of each chain."""
        ...

    def constrain(self, poses: Float) -> Float:
        """Poses (B, D) mapped into the limits."""
        ...

    def value(self, pose: Float) -> float:
        """The objective at a pose (D,) on samples that do not change from call to call."""
        ...

    def damping(self, lever_m: float) -> Float:
        """(D,) curvature that a parameter would have, were all points ``lever_m`` from its axis."""
        ...

    def fixed(self) -> Fixed:
        """All parameters, on one draw of points."""
        ...

    def fixed_chain(self, chain: int, pose: Float) -> Fixed:
        """One chain, the rest of the body being at ``pose``, on one draw of points."""
        ...


def optimise(
    problem: FixedProblem, starts: Float, config: ScheduleSettings, lm_config: lm.LmSettings
) -> ScheduleResult:
    """Both passes, from the best of the starts (S, D)."""
    starts = problem.constrain(starts)
    start = starts[0] if len(starts) == 1 else min(starts, key=problem.value)
    pose, made = _descend(problem, problem.fixed(), start, np.ones(len(start), bool), LEVER_M, lm_config)
    result, iterations = pose.copy(), [made]
    # ε₂ of section 6.4: the chains are held to a finer tolerance
    finer = replace(lm_config, tolerance=config.refine * lm_config.tolerance)
    for k, free in enumerate(problem.free):
        objective = problem.fixed_chain(k, pose)
        moved, made = _descend(problem, objective, pose, free, CHAIN_LEVER_M, finer)
        result[free] = moved[free]
        iterations.append(made)
    return ScheduleResult(result, np.array(iterations, np.int32))


def _descend(
    problem: FixedProblem,
    objective: Fixed,
    start: Float,
    free: NDArray[np.bool_],
    lever_m: float,
    config: lm.LmSettings,
) -> tuple[Float, int]:
    """The pose (D,) after a descent in the free parameters, and its iterations."""

    def whole(part: Float) -> Float:
        pose = start.copy()
        pose[free] = part
        return pose

    def model(part: Float) -> lm.Quadratic:
        value, gradient, hessian = objective.model(whole(part))
        return lm.Quadratic(value, gradient[free], hessian[np.ix_(free, free)])

    found = lm.minimise(
        model,
        lambda part: objective.value(whole(part)),
        start[free],
        lambda part: problem.constrain(whole(part)[None])[0, free],
        problem.damping(lever_m)[free],
        config,
    )
    return whole(found.pose), found.iterations
