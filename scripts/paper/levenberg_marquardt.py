"""The volumetric tracker with Levenberg-Marquardt instead of SMD, for the comparison of Kehl 2006, section 7.3.

Levenberg-Marquardt minimises the objective of SMD: the same terms, numbers of points and two passes. As in the paper,
the points are drawn once for each frame and pass and stay. Voxels and edges are assigned again at every evaluation, so
a step is accepted by the value that the objective returns with its new assignments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from tk.kernels.objective import Evaluation
from tk.model.cues.objective import OUTLIERS, FrameObjective, Ints
from tk.optim.schedule import LEVER_M, REFINE, ScheduleResult
from tk.trackers.volumetric import VolumetricTracker

Float = NDArray[np.float64]


class Quadratic(NamedTuple):
    """A local model at p: value, gradient (D,), positive semi-definite Hessian (D, D)."""

    value: float
    gradient: Float
    hessian: Float


@dataclass(frozen=True)
class LmSettings:
    """Settings.

    Attributes:
        damping: λ at the start, as a share of the Hessian's diagonal; ×4 after a refused step, ×0.3 after an accepted.
        max_iterations: maximum number of steps.
        tolerance: a step that lowers the value by less, relative to the value, is the last.
    """

    damping: float = 1e-2
    max_iterations: int = 30
    tolerance: float = 1e-4


@dataclass(frozen=True)
class LmResult:
    """The minimum found.

    Attributes:
        pose: (D,).
        value: the objective there.
        iterations: number of steps, refused steps not counted.
        converged: True where the last step lowered the value, or the next step could lower it, by less than the
            tolerance.
    """

    pose: Float
    value: float
    iterations: int
    converged: bool


def minimise(
    model: Callable[[Float], Quadratic],
    value: Callable[[Float], float],
    start: Float,
    constrain: Callable[[Float], Float],
    floor: Float | float = 0.0,
    config: LmSettings | None = None,
) -> LmResult:
    """Minimise a robust least-squares objective on a box.

    A parameter at a limit that the gradient pushes against is excluded from the step: with a projection afterwards, the
    other parameters would compensate for a motion that did not happen. A refused step is repeated with more damping
    until its own model promises less than the tolerance.

    Args:
        model: the quadratic model at a state (D,).
        value: the objective alone at a state.
        start: (D,).
        constrain: maps a state into the feasible region, each parameter by itself.
        floor: (D,) minimum of the damping term's diagonal: parameters without evidence stay in place.
        config: see :class:`LmSettings`.

    Raises:
        FloatingPointError: when the model is not finite. A value that is not finite refuses its step.
    """
    config = config or LmSettings()
    p = constrain(np.asarray(start, np.float64))
    damping = config.damping
    now = _finite(model(p))
    for i in range(config.max_iterations):
        worth = config.tolerance * max(abs(now.value), 1e-12)
        D = np.maximum(np.diag(now.hessian), floor) + 1e-12
        downhill = p - now.gradient / D
        free = (constrain(downhill) != p) | (downhill == p)
        while True:
            H = now.hessian + np.diag(damping * D)
            delta = np.zeros_like(p)
            delta[free] = np.linalg.solve(H[np.ix_(free, free)], -now.gradient[free])
            candidate = constrain(p + delta)
            f = value(candidate)
            if f < now.value:
                break
            promised = -now.gradient @ delta - 0.5 * delta @ now.hessian @ delta
            if promised <= worth or np.array_equal(candidate, p):
                return LmResult(p, now.value, i + 1, True)
            damping *= 4
        fall = now.value - f
        p = candidate
        damping = max(damping * 0.3, 1e-6)
        now = _finite(model(p))
        if fall < worth:
            return LmResult(p, now.value, i + 1, True)
    return LmResult(p, now.value, config.max_iterations, False)


def _finite(quadratic: Quadratic) -> Quadratic:
    if not all(np.isfinite(part).all() for part in quadratic):
        raise FloatingPointError("Levenberg-Marquardt: the quadratic model is not finite")
    return quadratic


class FixedObjective(Protocol):
    """An objective on points that stay the same."""

    def value(self, pose: Float) -> float:
        """Return the objective at a pose (D,)."""
        ...

    def model(self, pose: Float) -> Quadratic:
        """Return the quadratic model at a pose (D,)."""
        ...


class FixedProblem(Protocol):
    """One frame's objective with D parameters and K chains."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """(K, D) the parameters of each chain."""
        ...

    def constrain(self, poses: Float) -> Float:
        """Map poses (B, D) into the limits."""
        ...

    def value(self, pose: Float) -> float:
        """Return the objective at a pose (D,) on samples that do not change from call to call."""
        ...

    def damping(self, lever_m: float) -> Float:
        """Return the curvature (D,) that each parameter would have if all points lay ``lever_m`` from its axis."""
        ...

    def fixed(self) -> FixedObjective:
        """Return the objective of all parameters on one draw of points."""
        ...

    def fixed_chain(self, chain: int, pose: Float) -> FixedObjective:
        """Return the objective of one chain on one draw of points, the rest of the body at ``pose``."""
        ...


def optimise(
    problem: FixedProblem, starts: Float, refine: float = REFINE, config: LmSettings | None = None
) -> ScheduleResult:
    """Optimise all degrees of freedom from the best of the starts (S, D), then each chain with the torso held.

    Args:
        problem: the frame.
        starts: (S, D).
        refine: ε₂ / ε₁ of section 6.4: the tolerance of the chains relative to the tolerance of the first pass.
        config: see :class:`LmSettings`.
    """
    config = config or LmSettings()
    starts = problem.constrain(starts)
    start = starts[0] if len(starts) == 1 else min(starts, key=problem.value)
    pose, made = _minimise_free(problem, problem.fixed(), start, np.ones(len(start), bool), config)
    result, iterations = pose.copy(), [made]
    finer = replace(config, tolerance=refine * config.tolerance)
    for k, free in enumerate(problem.free):
        objective = problem.fixed_chain(k, pose)
        moved, made = _minimise_free(problem, objective, pose, free, finer)
        result[free] = moved[free]
        iterations.append(made)
    return ScheduleResult(result, np.array(iterations, np.int32))


def _minimise_free(
    problem: FixedProblem,
    objective: FixedObjective,
    start: Float,
    free: NDArray[np.bool_],
    config: LmSettings,
) -> tuple[Float, int]:
    """Return the pose (D,) optimised in the free parameters, and the number of iterations."""

    def whole(part: Float) -> Float:
        pose = start.copy()
        pose[free] = part
        return pose

    def model(part: Float) -> Quadratic:
        value, gradient, hessian = objective.model(whole(part))
        return Quadratic(value, gradient[free], hessian[np.ix_(free, free)])

    found = minimise(
        model,
        lambda part: objective.value(whole(part)),
        start[free],
        lambda part: problem.constrain(whole(part)[None])[0, free],
        problem.damping(LEVER_M)[free],
        config,
    )
    return whole(found.pose), found.iterations


class FramePoints:
    """The objective of a frame on points that stay the same.

    Args:
        frame: the frame.
        samples: (M,).
        voxels: (Q,).
        strips: (K,) strips of the edge term.
    """

    def __init__(self, frame: FrameObjective, samples: Ints, voxels: Ints, strips: Ints) -> None:
        self._frame = frame
        self._points = samples, voxels
        self._strips = strips

    def value(self, pose: Float) -> float:
        """Return the objective at ``pose`` (D,)."""
        return float(self._evaluate(pose)[0].value[0])

    def model(self, pose: Float) -> Quadratic:
        """Return the quadratic model at ``pose`` (D,); outliers weigh as in the Hessian of SMD."""
        found, entries = self._evaluate(pose)
        body = self._frame.objective
        linear = body.kernel.linearise(
            self._frame.index, *self._points, pose, found.held, body.settings, OUTLIERS, entries=entries
        )
        return Quadratic(float(found.value[0]), found.gradient[0], linear.hessian)

    def _evaluate(self, pose: Float) -> tuple[Evaluation, NDArray[np.floating] | None]:
        frame, (samples, voxels), body = self._frame, self._points, self._frame.objective
        entries = frame.edge_entries(pose[None], self._strips[None])
        rows = samples[None], voxels[None]
        return body.kernel.evaluate(frame.index, *rows, pose[None], None, body.settings, entries=entries), entries


class FrameProblem:
    """A frame's objective as :func:`optimise` needs it."""

    def __init__(self, frame: FrameObjective) -> None:
        self._frame = frame
        self.free = frame.free
        self.constrain, self.value, self.damping = frame.constrain, frame.value, frame.damping

    def fixed(self) -> FramePoints:
        """Return the objective of all parameters on one draw of points."""
        return FramePoints(self._frame, *self._frame.draw_all())

    def fixed_chain(self, chain: int, pose: Float) -> FramePoints:
        """Return the objective of one chain on one draw of points, the rest of the body at ``pose``."""
        frame = self._frame
        return FramePoints(frame, *(rows[chain] for rows in frame.draw_chains(frame.chain_voxels(pose))))


@contextmanager
def instead_of_smd() -> Iterator[None]:
    """Let volumetric trackers optimise by Levenberg-Marquardt within the context."""

    def optimised(self: VolumetricTracker, problem: FrameObjective, starts: Float) -> ScheduleResult:
        return optimise(FrameProblem(problem), starts)

    with patch.object(VolumetricTracker, "optimise", optimised):
        yield
