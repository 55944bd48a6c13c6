"""The passes of a frame (Kehl 2006, section 6.4): all degrees of freedom at ε₁, then the chains at ε₂ with the
torso held, as one batch. What they optimise is known only as a :class:`Problem`.

Beyond the paper:

* SMD works in directions that whiten the Gauss-Newton Hessian at the start of each pass. The paper's step sizes (2500
  for most angles, 5000 for rolls, 10000 for knees and elbows) are a diagonal guess at the inverse Hessian in its own
  units; here the same is read off the data, so that a step of 1 is a Newton step. ``whiten = False`` takes the diagonal
  alone.
* The error potential starts soft and hardens from pass to pass: with the final ν a limb that has moved by two σ since
  the last frame is all outliers and feels nothing.
* The chains start from several hypotheses at once: where the first pass left them, where the last frame had them, and a
  few at random about that. A limb that has lost its data is found again in this way; a row of a batch costs little.
* A last pass over all degrees of freedom lets the torso profit from limbs in place. The paper fixes it after the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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

    @property
    def postures(self) -> Float:
        """(L, D) where the chains may be looked for, beside random places; L may be 0."""
        ...

    def constrain(self, poses: Float) -> Float:
        """Poses (B, D) mapped into the limits."""
        ...

    def full(self, softness: float) -> smd.Objective:
        """The objective of all parameters; ``softness`` multiplies Leclerc's ν: outliers count from farther away."""
        ...

    def value(self, pose: Float) -> float:
        """The objective at a pose (D,) on samples that do not change from call to call."""
        ...

    def values(self, poses: Float) -> Float:
        """(B,) the same at poses (B, D)."""
        ...

    def gradient(self, pose: Float) -> Float:
        """(D,) the derivative of :meth:`value`."""
        ...

    def curvature(self, pose: Float, softness: float) -> Float:
        """(D, D) Gauss-Newton Hessian at a pose."""
        ...

    def damping(self, lever_m: float, softness: float) -> Float:
        """(D,) curvature that a parameter would have, were all points ``lever_m`` from its axis."""
        ...

    def chains(self, owner: NDArray[np.intp], pose: Float, softness: float) -> smd.Objective:
        """The objective whose row b is chain ``owner[b]``, the rest of the body being at ``pose``."""
        ...

    def screen(self, owner: NDArray[np.intp], pose: Float, poses: Float, softness: float) -> Float:
        """(B,) the same objectives at ``poses`` (B, D), roughly and cheaply: for very many of them."""
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
        lever_m, chain_lever_m: a parameter whose points all lie nearer to its axis is damped as if they lay this far:
            the roll of a straight limb follows noise otherwise.
        outliers: least weight of a pair in the Hessian.
        soft, chain_soft: by how much Leclerc's ν is multiplied in the first pass and for the chains; 1 is the paper's.
        iterations, chain_iterations, polish_iterations: i_max (eq. 21) of the three passes; no polish with 0, as in the
            paper.
        newton_iterations: damped Gauss-Newton steps after all, on samples that do not change: the last centimetre,
            which the draws' noise hides from SMD; 0 for the paper's.
        retries: how often a frame whose objective stays high is searched anew from other starts.
        hypotheses: starts of each chain: as the first pass left it, as the last frame had it, and the best of some
            random candidates; at least 1.
        searched: how many of the chains, drawn anew for each frame, have hypotheses in a frame that looks as usual.
        wide_hypotheses: the same when a frame is searched anew, with three times the candidates.
        candidates: random candidates of each chain, looked at once.
        spread_deg: their standard deviation.
        gain: share by which the objective must fall for a pose found by a search anew: it breaks with the past.
        margin: by how much a hypothesis must be better than the first.
        inertia: by how much more, for each radian that its angles lie from the last frame's on average.
        max_step_deg, max_step_m: greatest change in one iteration; samples that happen to see little of a parameter ask
            for more.
        hierarchical: the earlier tracker of section 6.4: the torso alone first, then the chains, and no last pass.
    """

    tolerance_deg: float = 0.2
    tolerance_m: float = 0.002
    refine: float = 0.5
    rate: float = 0.6
    whiten: bool = True
    lever_m: float = 0.03
    chain_lever_m: float = 0.06
    outliers: float = 0.1
    soft: float = 4.0
    chain_soft: float = 2.0
    iterations: int = 8
    chain_iterations: int = 6
    polish_iterations: int = 5
    newton_iterations: int = 2
    retries: int = 2
    hypotheses: int = 6
    searched: int = 3
    wide_hypotheses: int = 8
    candidates: int = 48
    spread_deg: float = 40.0
    gain: float = 0.08
    margin: float = 0.004
    inertia: float = 0.02
    max_step_deg: float = 20.0
    max_step_m: float = 0.15
    hierarchical: bool = False

    def __post_init__(self) -> None:
        lengths = ("tolerance_deg", "tolerance_m", "max_step_deg", "max_step_m", "lever_m", "chain_lever_m")
        for name in (*lengths, "refine", "soft", "chain_soft", "iterations", "chain_iterations"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"schedule.{name} = {getattr(self, name)} must be positive")
        for name in (
            "outliers",
            "spread_deg",
            "margin",
            "inertia",
            "polish_iterations",
            "newton_iterations",
            "retries",
        ):
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
    good_enough: Callable[[Float], bool] | None = None,
    alternatives: Callable[[Float, np.random.Generator, int], Float] | None = None,
    settled: Callable[[Float], bool] | None = None,
) -> ScheduleResult:
    """All passes; again from elsewhere while the objective stays high.

    Args:
        problem: the frame.
        starts: (S, D) predictions; the first pass begins at the best of them.
        previous: (D,) the last frame's pose.
        rng: for the random hypotheses.
        config, smd_config: settings.
        good_enough: whether a pose (D,) ends the search; any does by default.
        alternatives: other starts (A, D), made from the best pose so far, for when it is not good enough; the number
            of the search anew, from 0 on, is its last argument.
        settled: whether a pose (D,) after the first pass is so good that the chains need no hypotheses beside it; none
            is by default.
    """
    tolerance = np.where(problem.angular, np.radians(config.tolerance_deg), config.tolerance_m)
    starts = problem.constrain(starts)
    best = _passes(problem, _best(problem, starts), previous, tolerance, rng, config, smd_config, settled)
    value = problem.value(best.pose)
    for attempt in range(config.retries):
        if alternatives is None or good_enough is None or good_enough(best.pose):
            break
        others = problem.constrain(alternatives(best.pose, rng, attempt))
        limit = replace(smd_config, max_iterations=config.iterations)
        moved = _all(problem, others, tolerance, config.soft, config, limit)
        again = _passes(problem, _best(problem, moved.pose), previous, tolerance, rng, config, smd_config, wide=True)
        iterations = best.iterations + again.iterations
        iterations[0] += moved.iterations.max()
        found = problem.value(again.pose)
        better = found < (1 - config.gain) * value
        best = ScheduleResult(again.pose if better else best.pose, iterations)
        value = found if better else value
    return best


def _best(problem: Problem, poses: Float) -> Float:
    return poses[0] if len(poses) == 1 else poses[int(np.argmin(problem.values(poses)))]


def _passes(
    problem: Problem,
    start: Float,
    previous: Float,
    tolerance: Float,
    rng: np.random.Generator,
    config: ScheduleConfig,
    smd_config: smd.SmdConfig,
    settled: Callable[[Float], bool] | None = None,
    wide: bool = False,
) -> ScheduleResult:
    """All parameters, the chains, all parameters."""
    limit = replace(smd_config, max_iterations=config.iterations)
    first = _all(problem, start[None], tolerance, config.soft, config, limit)
    searched = np.arange(len(problem.free))
    if settled is not None and settled(first.pose[0]):
        # a limb in the wrong place can look as usual: one is looked for elsewhere in any frame
        searched = rng.permutation(searched)[: config.searched]
    pose, winners = _chains(
        problem, first.pose[0], previous, tolerance * config.refine, rng, config, smd_config, searched, wide
    )
    made = first.iterations
    if config.polish_iterations and not config.hierarchical:
        limit = replace(smd_config, max_iterations=config.polish_iterations)
        last = _all(problem, pose[None], tolerance * config.refine, 1.0, config, limit)
        pose = last.pose[0]
        made = made + last.iterations
    if config.newton_iterations:
        pose, newton = _newton(problem, pose, config)
        made = made + newton
    return ScheduleResult(pose, np.concatenate([made, winners]).astype(np.int32))


def _all(
    problem: Problem,
    starts: Float,
    tolerance: Float,
    softness: float,
    config: ScheduleConfig,
    smd_config: smd.SmdConfig,
) -> smd.SmdResult:
    """One pass over all parameters, or over the torso's, from each of the starts (B, D)."""
    torso = np.logical_not(np.asarray(problem.free.any(axis=0)))
    free = torso if config.hierarchical else np.ones_like(torso)
    damping = problem.damping(config.lever_m, softness)
    pairs = [descent_basis(problem.curvature(start, softness), free, damping, config) for start in starts]
    return smd.minimise(
        problem.full(softness),
        starts,
        config.rate,
        tolerance,
        problem.constrain,
        np.stack([basis for basis, _ in pairs]),
        smd_config,
        max_step=_max_step(problem, config),
        basis_inverse=np.stack([inverse for _, inverse in pairs]),
    )


def _newton(problem: Problem, pose: Float, config: ScheduleConfig) -> tuple[Float, int]:
    """Damped Gauss-Newton steps on samples that do not change, as long as they lead down; how many were made."""
    damping = np.diag(problem.damping(config.lever_m, 1.0))
    limit = _max_step(problem, config)
    for made in range(config.newton_iterations):
        step = np.linalg.solve(problem.curvature(pose, 1.0) + damping, -problem.gradient(pose))
        step = np.clip(step, -limit, limit)
        tried = problem.constrain(pose + np.array([1.0, 0.4])[:, None] * step)
        values = problem.values(tried)
        if values.min() >= problem.value(pose):
            return pose, made
        pose = tried[int(values.argmin())]
    return pose, config.newton_iterations


def _max_step(problem: Problem, config: ScheduleConfig) -> Float:
    return np.where(problem.angular, np.radians(config.max_step_deg), config.max_step_m)


def _chains(
    problem: Problem,
    pose: Float,
    previous: Float,
    tolerance: Float,
    rng: np.random.Generator,
    config: ScheduleConfig,
    smd_config: smd.SmdConfig,
    searched: NDArray[np.intp],
    wide: bool = False,
) -> tuple[Float, NDArray[np.int32]]:
    """The chains with the torso at ``pose``: the pose with each chain's best hypothesis, and their iterations (K,).

    ``searched`` are the chains that are tried at more than one place.
    """
    free = problem.free
    K = len(free)
    count = config.wide_hypotheses if wide else config.hypotheses
    owners, starts = [np.arange(K)], [np.repeat(pose[None], K, axis=0)]
    if count > 1 and len(searched):
        owners.append(searched)
        starts.append(np.where(free[searched], previous, pose))
    if count > 2 and len(searched):
        owners.append(np.tile(searched, count - 2))
        candidates = (3 if wide else 1) * config.candidates
        starts.append(_screened(problem, pose, previous, searched, count - 2, candidates, rng, config))
    owner = np.concatenate(owners)
    H = problem.curvature(pose, config.chain_soft)
    damping = problem.damping(config.chain_lever_m, config.chain_soft)
    pairs = [descent_basis(H, free[k], damping, config) for k in range(K)]
    found = smd.minimise(
        problem.chains(owner, pose, config.chain_soft),
        problem.constrain(np.concatenate(starts)),
        config.rate,
        tolerance,
        problem.constrain,
        np.stack([basis for basis, _ in pairs])[owner],
        replace(smd_config, max_iterations=config.chain_iterations),
        max_step=_max_step(problem, config),
        basis_inverse=np.stack([inverse for _, inverse in pairs])[owner],
    )
    best = np.arange(K)
    if len(owner) > K:
        values = problem.chain_values(owner, found.pose) + _reluctance(problem, owner, found.pose, previous, config)
        values[K:] += config.margin
        for k in range(K):
            rows = np.flatnonzero(owner == k)
            best[k] = rows[values[rows].argmin()]
    result = pose.copy()
    for k in range(K):
        result[free[k]] = found.pose[best[k], free[k]]
    return result, found.iterations[best]


def _reluctance(
    problem: Problem, owner: NDArray[np.intp], poses: Float, previous: Float, config: ScheduleConfig
) -> Float:
    """(B,) what hypotheses (B, D) must make up for by their objective: the farther from the last frame, the more."""
    free = problem.free[owner]
    turned = np.abs(np.where(problem.angular & free, poses - previous, 0.0))
    cost: Float = config.inertia * turned.sum(axis=1) / free.sum(axis=1)
    return cost


def _screened(
    problem: Problem,
    pose: Float,
    previous: Float,
    searched: NDArray[np.intp],
    count: int,
    candidates: int,
    rng: np.random.Generator,
    config: ScheduleConfig,
) -> Float:
    """(count · S, D) the best of many hypotheses of each of S chains; row b is of chain ``searched[b mod S]``.

    Half of them are common postures, drawn for this frame, the others random places about the pose.
    """
    free = problem.free
    candidates = max(candidates, count)
    drawn = rng.permutation(len(problem.postures))[: candidates // 2]
    owner = np.tile(searched, candidates)
    noise = rng.normal(scale=np.radians(config.spread_deg), size=(len(owner), len(pose))) * problem.angular
    places = pose + noise
    places[: len(drawn) * len(searched)] = np.repeat(problem.postures[drawn], len(searched), axis=0)
    tried = problem.constrain(np.where(free[owner], places, pose))
    values = problem.screen(owner, pose, tried, config.soft)
    values = values + _reluctance(problem, owner, tried, previous, config)
    order = np.argsort(values.reshape(candidates, -1), axis=0, kind="stable")[:count]
    return tried[order * len(searched) + np.arange(len(searched))].reshape(-1, len(pose))


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
