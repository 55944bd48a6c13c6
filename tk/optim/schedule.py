"""The two passes of a frame (Kehl 2006, section 6.4): all degrees of freedom at ε₁, then the chains at ε₂ < ε₁ with the
torso held, as one batch. They see the frame's objective as a :class:`Problem`.

Beyond the paper, SMD works in directions that whiten the Gauss-Newton Hessian at the start of each pass: that of the
whole body's objective, then that of each chain's own. The paper's step sizes (2500 for most angles, 5000 for rolls,
10000 for knees and elbows) are a diagonal estimate of the inverse Hessian in its own units; here it follows from the
data, so that a step of 1 is a Newton step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.optim import smd

Float = NDArray[np.float64]

# ε₁ of eq. 20 for angles and for the displacement. The paper has 2° and 2 cm; at its n of 3 a joint that still turns by
# 5° in three iterations is stopped, and a moving person is lost.
TOLERANCE_DEG, TOLERANCE_M = 0.2, 0.002
# ε₂ / ε₁: the paper's.
REFINE = 0.5
# First step size, as a share of a Newton step.
RATE = 0.6
# Damping of each parameter, as if all points lay this far from its axis, metres: without it the roll of a straight limb
# follows noise. With 0.03 and 0.06 the mean errors of five captures (60 frames, three seeds) change by 0.02 cm at most.
LEVER_M = 0.045
# Maximum change in one iteration: a draw of samples with little evidence on a parameter yields longer steps, and
# without a bound SMD diverges. At 15 Hz a joint turns by up to 31° between frames (7.4), two steps.
MAX_STEP_DEG, MAX_STEP_M = 20.0, 0.15


class Problem(Protocol):
    """One frame's objective with D parameters and K chains."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """(K, D) the parameters of each chain."""
        ...

    @property
    def angular(self) -> NDArray[np.bool_]:
        """(D,) True for angles, False for lengths."""
        ...

    def constrain(self, poses: Float) -> Float:
        """Map poses (B, D) into the limits."""
        ...

    def full(self) -> smd.Objective:
        """Return the objective of all parameters."""
        ...

    def chains(self, owner: NDArray[np.intp], pose: Float) -> smd.Objective:
        """Return the objective whose row b is chain ``owner[b]``, the rest of the body at ``pose``."""
        ...

    def values(self, poses: Float) -> Float:
        """Return the objective (B,) at poses (B, D) on samples that do not change from call to call."""
        ...

    def curvature(self, pose: Float) -> Float:
        """Return the Gauss-Newton Hessian (D, D) of :meth:`full` at a pose."""
        ...

    def chain_curvatures(self, pose: Float) -> Float:
        """Return the Gauss-Newton Hessians (K, D, D) of :meth:`chains` at a pose."""
        ...

    def damping(self, lever_m: float) -> Float:
        """Return the curvature (D,) that each parameter would have if all points lay ``lever_m`` from its axis."""
        ...


@dataclass(frozen=True)
class ScheduleResult:
    """The result of both passes."""

    pose: Float  # (D,)
    iterations: NDArray[np.int32]  # (1 + K,) of the first pass and of each chain


def optimise(problem: Problem, starts: Float, max_iterations: int = smd.MAX_ITERATIONS) -> ScheduleResult:
    """Optimise all parameters, then the chains.

    Args:
        problem: the frame.
        starts: (S, D) predictions; the first pass begins at the best of them.
        max_iterations: of each pass.
    """
    tolerance = np.where(problem.angular, np.radians(TOLERANCE_DEG), TOLERANCE_M)
    max_step = np.where(problem.angular, np.radians(MAX_STEP_DEG), MAX_STEP_M)

    damping = problem.damping(LEVER_M)

    def descend(
        objective: smd.Objective, pose: Float, free: NDArray[np.bool_], hessians: Float, tolerance: Float
    ) -> smd.SmdResult:
        """Optimise the free parameters (B, D) from a pose (D,), row by row, with Hessians (B, D, D)."""
        bases = [descent_basis(hessian, row, damping) for hessian, row in zip(hessians, free, strict=True)]
        basis, inverse = map(np.stack, zip(*bases, strict=True))
        start = np.repeat(pose[None], len(free), axis=0)
        return smd.minimise(
            objective, start, RATE, tolerance, problem.constrain, (basis, inverse), max_step, max_iterations
        )

    starts = problem.constrain(starts)
    start = starts[0] if len(starts) == 1 else starts[int(np.argmin(problem.values(starts)))]
    every = np.ones((1, len(start)), bool)
    first = descend(problem.full(), start, every, problem.curvature(start)[None], tolerance)
    pose = first.pose[0]
    objective = problem.chains(np.arange(len(problem.free)), pose)
    chains = descend(objective, pose, problem.free, problem.chain_curvatures(pose), REFINE * tolerance)
    result = pose.copy()
    for free, found in zip(problem.free, chains.pose, strict=True):
        result[free] = found[free]
    return ScheduleResult(result, np.concatenate([first.iterations, chains.iterations]).astype(np.int32))


def descent_basis(hessian: Float, free: NDArray[np.bool_], damping: Float) -> tuple[Float, Float]:
    """Return directions (D, D) with unit curvature in the free parameters, zero elsewhere, and their pseudo-inverse."""
    index = np.flatnonzero(free)
    basis, inverse = np.zeros_like(hessian), np.zeros_like(hessian)
    L = np.linalg.cholesky(hessian[np.ix_(index, index)] + np.diag(damping[index]))
    basis[np.ix_(index, index)] = np.linalg.inv(L).T
    inverse[np.ix_(index, index)] = L.T
    return basis, inverse
