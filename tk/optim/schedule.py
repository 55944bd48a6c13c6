"""The two passes of a frame (Kehl 2006, section 6.4): all degrees of freedom at ε₁, then the chains at ε₂ with the
torso held, as one batch. What they optimise is known only as a :class:`Problem`.

Beyond the paper:

* SMD works in directions that whiten the Gauss-Newton Hessian at the start of each pass. The paper's step sizes (2500
  for most angles, 5000 for rolls, 10000 for knees and elbows) are a diagonal guess at the inverse Hessian in its own
  units; here the same is read off the data, so that a step of 1 is a Newton step. ``whiten = False`` takes the diagonal
  alone.
* The chains start from several hypotheses at once: where the first pass left them, where the last frame had them, and a
  few at random about that. A limb that has lost its data is found again in this way; a row of a batch costs little.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.optim import smd

Float = NDArray[np.float64]


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

    def value(self, pose: Float) -> float:
        """The objective at a pose (D,) on samples that do not change from call to call."""
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

    def chain_values(self, owner: NDArray[np.intp], poses: Float) -> Float:
        """(B,) the chains' objectives on samples that do not change from call to call."""
        ...


@dataclass(frozen=True)
class ScheduleConfig:
    """Settings of the two passes.

    Attributes:
        tolerance_deg, tolerance_m: ε₁ for angles and for the displacement. The paper stops at 2° and 2 cm, after 6
            iterations on average; here a step is made in every direction at once and costs a 500th of the paper's.
        refine: ε₂ / ε₁ (paper: ½).
        rate: first step size, as a share of a Newton step.
        whiten: see the module's docstring.
        lever_m: a parameter whose points all lie nearer to its axis is damped as if they lay this far: the roll of a
            straight limb follows noise otherwise.
        outliers: least weight of a pair in the Hessian.
        hypotheses: starts of each chain, at least 1.
        spread_deg: standard deviation of the random ones.
        margin: by how much a hypothesis must be better than the first.
        max_step_deg, max_step_m: greatest change in one iteration; samples that happen to see little of a parameter ask
            for more.
    """

    tolerance_deg: float = 0.2
    tolerance_m: float = 0.002
    refine: float = 0.5
    rate: float = 0.5
    whiten: bool = True
    lever_m: float = 0.03
    chain_lever_m: float = 0.06
    outliers: float = 0.1
    hypotheses: int = 4
    spread_deg: float = 17.0
    margin: float = 0.01
    max_step_deg: float = 20.0
    max_step_m: float = 0.15

    def __post_init__(self) -> None:
        positive = ("tolerance_deg", "tolerance_m", "refine", "lever_m", "chain_lever_m", "max_step_deg", "max_step_m")
        for name in positive:
            if not getattr(self, name) > 0:
                raise ConfigError(f"schedule.{name} = {getattr(self, name)} must be positive")
        for name in ("outliers", "spread_deg", "margin"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"schedule.{name} = {getattr(self, name)} must not be negative")
        if self.hypotheses < 1 or not 0 < self.rate <= 2:
            raise ConfigError(
                f"schedule: hypotheses {self.hypotheses} must be at least 1 and rate {self.rate} in (0, 2]"
            )


@dataclass(frozen=True)
class ScheduleResult:
    """pose (D,) and the iterations made: of the first pass and of each chain's winner, (1 + K,)."""

    pose: Float
    iterations: NDArray[np.int32]


def optimise(
    problem: Problem,
    starts: Float,
    previous: Float,
    rng: np.random.Generator,
    config: ScheduleConfig,
    smd_config: smd.SmdConfig,
) -> ScheduleResult:
    """Both passes.

    Args:
        problem: the frame.
        starts: (S, D) predictions; the first pass begins at the best of them.
        previous: (D,) the last frame's pose.
        rng: for the random hypotheses.
        config, smd_config: settings.
    """
    tolerance = np.where(problem.angular, np.radians(config.tolerance_deg), config.tolerance_m)
    max_step = np.where(problem.angular, np.radians(config.max_step_deg), config.max_step_m)
    starts = problem.constrain(starts)
    start = starts[0] if len(starts) == 1 else min(starts, key=problem.value)
    everything = np.ones(len(start), bool)
    basis, inverse = descent_basis(problem.curvature(start), everything, problem.damping(config.lever_m), config)
    first = smd.minimise(
        problem.full(), start[None], config.rate, tolerance, problem.constrain, basis[None], smd_config,
        max_step=max_step, basis_inverse=inverse[None],
    )  # fmt: skip
    pose = first.pose[0]

    free = problem.free
    K = len(free)
    owner = np.tile(np.arange(K), config.hypotheses)
    hypotheses = np.repeat(pose[None], K * config.hypotheses, axis=0)
    noise = rng.normal(scale=np.radians(config.spread_deg), size=hypotheses.shape) * problem.angular
    for row in range(K, len(owner)):
        mine = free[owner[row]]
        hypotheses[row, mine] = previous[mine] if row < 2 * K else pose[mine] + noise[row, mine]
    H = problem.curvature(pose)
    damping = problem.damping(config.chain_lever_m)
    pairs = [descent_basis(H, free[k], damping, config) for k in range(K)]
    second = smd.minimise(
        problem.chains(owner, pose),
        problem.constrain(hypotheses),
        config.rate,
        tolerance * config.refine,
        problem.constrain,
        np.stack([basis for basis, _ in pairs])[owner],
        smd_config,
        max_step=max_step,
        basis_inverse=np.stack([inverse for _, inverse in pairs])[owner],
    )
    best = np.arange(K)
    if config.hypotheses > 1:
        values = problem.chain_values(owner, second.pose).reshape(config.hypotheses, K)
        values[1:] += config.margin
        best = values.argmin(axis=0) * K + np.arange(K)
    result = pose.copy()
    for k in range(K):
        result[free[k]] = second.pose[best[k], free[k]]
    return ScheduleResult(result, np.concatenate([first.iterations, second.iterations[best]]).astype(np.int32))


def descent_basis(
    hessian: Float, free: NDArray[np.bool_], damping: Float, config: ScheduleConfig
) -> tuple[Float, Float]:
    """Directions (D, D) with unit curvature in the free parameters, zero in the others; and their pseudo-inverse."""
    index = np.flatnonzero(free)
    basis, inverse = np.zeros_like(hessian), np.zeros_like(hessian)
    H = hessian[np.ix_(index, index)] + np.diag(damping[index])
    if config.whiten:
        L = np.linalg.cholesky(H)
        basis[np.ix_(index, index)] = np.linalg.inv(L).T
        inverse[np.ix_(index, index)] = L.T
    else:
        basis[index, index] = 1 / np.sqrt(np.diag(H))
        inverse[index, index] = np.sqrt(np.diag(H))
    return basis, inverse
