"""The two passes of a frame (Kehl 2006, section 6.4): all degrees of freedom at ε₁, then the chains at ε₂ < ε₁ with the
torso held, as one batch. They see the frame's objective as a :class:`Problem`.

Beyond the paper, SMD works in directions that whiten the Gauss-Newton Hessian at the start of each pass. The paper's
step sizes (2500 for most angles, 5000 for rolls, 10000 for knees and elbows) are a diagonal estimate of the inverse
Hessian in its own units; here it follows from the data, so that a step of 1 is a Newton step. ``whiten = False`` takes
the diagonal only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.optim import smd

Float = NDArray[np.float64]

# Damping of each parameter, as if all points lay this far from its axis, metres, in the first pass and for the chains:
# without it the roll of a straight limb follows noise. Chosen on the
# development captures; sensitivity not measured.
LEVER_M, CHAIN_LEVER_M = 0.03, 0.06
# Maximum change in one iteration: a draw of samples with little evidence on a parameter yields longer steps. At 15 Hz a
# joint turns by up to 31° between frames (7.4), two steps. Chosen; sensitivity not measured.
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

    def values(self, poses: Float) -> Float:
        """Return the objective (B,) at poses (B, D) on samples that do not change from call to call."""
        ...

    def curvature(self, pose: Float) -> Float:
        """Return the Gauss-Newton Hessian (D, D) at a pose."""
        ...

    def damping(self, lever_m: float) -> Float:
        """Return the curvature (D,) that each parameter would have if all points lay ``lever_m`` from its axis."""
        ...

    def chains(self, owner: NDArray[np.intp], pose: Float) -> smd.Objective:
        """Return the objective whose row b is chain ``owner[b]``, the rest of the body at ``pose``."""
        ...


@dataclass(frozen=True)
class ScheduleSettings:
    """Settings of the two passes. ``smd.max_iterations`` limits the iterations of each.

    Attributes:
        tolerance_deg: ε₁ of eq. 20 for angles. The paper has 2° and 2 cm; at its n of 3 a joint that still turns by 5°
            in three iterations is stopped, and a moving person is lost.
        tolerance_m: ε₁ for the displacement, metres.
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
    """The result of both passes.

    Attributes:
        pose: (D,).
        iterations: (1 + K,) of the first pass and of each chain.
    """

    pose: Float
    iterations: NDArray[np.int32]


def optimise(problem: Problem, starts: Float, config: ScheduleSettings, smd_config: smd.SmdSettings) -> ScheduleResult:
    """Optimise all parameters, then the chains.

    Args:
        problem: the frame.
        starts: (S, D) predictions; the first pass begins at the best of them.
        config: settings of the passes.
        smd_config: settings of SMD.
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
    """Optimise all parameters from ``start`` (D,)."""
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
    """Optimise the chains, one row each, with the torso at ``pose`` (D,)."""
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
    """Return the maximum change (D,) of each parameter in an iteration."""
    return np.where(angular, np.radians(MAX_STEP_DEG), MAX_STEP_M)


def descent_basis(hessian: Float, free: NDArray[np.bool_], damping: Float, whiten: bool) -> tuple[Float, Float]:
    """Return directions (D, D) with unit curvature in the free parameters, zero elsewhere, and their pseudo-inverse.

    Without ``whiten`` the curvature is 1 along each parameter, and the coupling of parameters remains.
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
