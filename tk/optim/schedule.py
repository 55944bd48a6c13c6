"""The two passes of a frame (Kehl 2006, section 6.4): all degrees of freedom at ε₁, then the chains at ε₂ < ε₁ with the
torso held, as one batch. What they optimise is known only as a :class:`Problem`.

Beyond the paper, SMD works in directions that whiten the Gauss-Newton Hessian at the start of each pass. The paper's
step sizes (2500 for most angles, 5000 for rolls, 10000 for knees and elbows) are a diagonal guess at the inverse
Hessian in its own units; here the same is read off the data, so that a step of 1 is a Newton step. ``whiten = False``
takes the diagonal alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.optim import smd

Float = NDArray[np.float64]

# A parameter whose points all lie nearer to its axis is damped as if they lay this far, metres, in the first pass and
# for the chains: the roll of a straight limb follows noise otherwise.
LEVER_M, CHAIN_LEVER_M = 0.03, 0.06
# Greatest change in one iteration: samples that happen to see little of a parameter ask for more. At 15 Hz a joint
# turns by up to 31° between frames (7.4).
MAX_STEP_DEG, MAX_STEP_M = 20.0, 0.15


class Problem(Protocol):
    """One frame's objective, as the schedule sees it. D parameters, K chains."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """(K, D) the parameters of each chain."""
        ...

    @property
    def angular(self) -> NDArray[np.bool_]:
        """(D,) True for angles, False for lengths."""
        ...

    def constrain(self, poses: Float) -> Float:
        """Poses (B, D) mapped into the limits."""
        ...

    def full(self) -> smd.Objective:
        """The objective of all parameters."""
        ...

    def values(self, poses: Float) -> Float:
        """(B,) the objective at poses (B, D) on samples that do not change from call to call."""
        ...

    def curvature(self, pose: Float) -> Float:
        """(D, D) Gauss-Newton Hessian at a pose."""
        ...

    def damping(self, lever_m: float) -> Float:
        """(D,) curvature that a parameter would have, were all points ``lever_m`` from its axis."""
        ...

    def chains(self, owner: NDArray[np.intp], pose: Float) -> smd.Objective:
        """The objective whose row b is chain ``owner[b]``, the rest of the body being at ``pose``."""
        ...


@dataclass(frozen=True)
class ScheduleSettings:
    """Settings of the two passes. How many iterations each may take is ``smd.max_iterations``.

    Attributes:
        tolerance_deg, tolerance_m: ε₁ of eq. 20 for angles and for the displacement. The paper has 2° and 2 cm; at its
            n of 3 that stops a joint that still turns by 5° in three iterations, and a person in motion is lost.
        refine: ε₂ / ε₁ (paper: ½).
        rate: first step size, as a share of a Newton step.
        whiten: see the module's docstring.
    """

    tolerance_deg: float = 0.2
    tolerance_m: float = 0.002
    refine: float = 0.5
    rate: float = 0.6
    whiten: bool = True

    def __post_init__(self) -> None:
        for name in ("tolerance_deg", "tolerance_m", "refine"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"schedule.{name} = {getattr(self, name)} must be positive")
        if not 0 < self.rate <= 2:
            raise ConfigError(f"schedule.rate = {self.rate} must lie in (0, 2]")


@dataclass(frozen=True)
class ScheduleResult:
    """pose (D,) and the iterations made: of the first pass and of each chain, (1 + K,)."""

    pose: Float
    iterations: NDArray[np.int32]


def optimise(problem: Problem, starts: Float, config: ScheduleSettings, smd_config: smd.SmdSettings) -> ScheduleResult:
    """Both passes.

    Args:
        problem: the frame.
        starts: (S, D) predictions; the first pass begins at the best of them.
        config, smd_config: settings.
    """
    tolerance = np.where(problem.angular, np.radians(config.tolerance_deg), config.tolerance_m)
    starts = problem.constrain(starts)
    start = starts[0] if len(starts) == 1 else starts[int(np.argmin(problem.values(starts)))]
    first = _all(problem, start, tolerance, config, smd_config)
    pose = first.pose[0]
    chains = _chains(problem, pose, tolerance * config.refine, config, smd_config)
    result = pose.copy()
    for free, found in zip(problem.free, chains.pose, strict=True):
        result[free] = found[free]
    return ScheduleResult(result, np.concatenate([first.iterations, chains.iterations]).astype(np.int32))


def _all(
    problem: Problem, start: Float, tolerance: Float, config: ScheduleSettings, smd_config: smd.SmdSettings
) -> smd.SmdResult:
    """The pass over all parameters, from ``start`` (D,)."""
    free = np.ones(len(start), bool)
    basis, inverse = descent_basis(problem.curvature(start), free, problem.damping(LEVER_M), config.whiten)
    return smd.minimise(
        problem.full(),
        start[None],
        config.rate,
        tolerance,
        problem.constrain,
        basis[None],
        smd_config,
        max_step=max_step(problem.angular),
        basis_inverse=inverse[None],
    )


def _chains(
    problem: Problem, pose: Float, tolerance: Float, config: ScheduleSettings, smd_config: smd.SmdSettings
) -> smd.SmdResult:
    """The pass over the chains, a row each, with the torso at ``pose`` (D,)."""
    K = len(problem.free)
    H = problem.curvature(pose)
    damping = problem.damping(CHAIN_LEVER_M)
    pairs = [descent_basis(H, free, damping, config.whiten) for free in problem.free]
    return smd.minimise(
        problem.chains(np.arange(K), pose),
        np.repeat(pose[None], K, axis=0),
        config.rate,
        tolerance,
        problem.constrain,
        np.stack([basis for basis, _ in pairs]),
        smd_config,
        max_step=max_step(problem.angular),
        basis_inverse=np.stack([inverse for _, inverse in pairs]),
    )


def max_step(angular: NDArray[np.bool_]) -> Float:
    """(D,) most that an iteration may change each parameter."""
    return np.where(angular, np.radians(MAX_STEP_DEG), MAX_STEP_M)


def descent_basis(hessian: Float, free: NDArray[np.bool_], damping: Float, whiten: bool) -> tuple[Float, Float]:
    """Directions (D, D) with unit curvature in the free parameters, zero in the others; and their pseudo-inverse.

    Without ``whiten`` the curvature is 1 along each parameter, and their coupling stays.
    """
    index = np.flatnonzero(free)
    basis, inverse = np.zeros_like(hessian), np.zeros_like(hessian)
    H = hessian[np.ix_(index, index)] + np.diag(damping[index])
    if whiten:
        L = np.linalg.cholesky(H)
        basis[np.ix_(index, index)] = np.linalg.inv(L).T
        inverse[np.ix_(index, index)] = L.T
    else:
        basis[index, index] = 1 / np.sqrt(np.diag(H))
        inverse[index, index] = np.sqrt(np.diag(H))
    return basis, inverse
