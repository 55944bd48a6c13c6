"""Levenberg-Marquardt on problems with a known solution and against SciPy; the two passes of a frame by it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from scripts.paper.levenberg_marquardt import Float, LmResult, LmSettings, Quadratic, minimise, optimise

Residuals = Callable[[Float], Float]
Jacobian = Callable[[Float], Float]


def rosenbrock(p: Float) -> Float:
    return np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]])


def rosenbrock_jacobian(p: Float) -> Float:
    return np.array([[-20 * p[0], 10.0], [-1.0, 0.0]])


TIMES = np.linspace(0, 4, 30)
DECAY = 2.0 * np.exp(-0.7 * TIMES) + 0.05 * np.sin(37 * TIMES)


def decay(p: Float) -> Float:
    return np.asarray(p[0] * np.exp(-p[1] * TIMES) + p[2] - DECAY)


def decay_jacobian(p: Float) -> Float:
    e = np.exp(-p[1] * TIMES)
    return np.stack([e, -p[0] * TIMES * e, np.ones_like(e)], axis=1)


def least_squares(
    residuals: Residuals,
    jacobian: Jacobian,
    start: Float,
    limits: tuple[Float | float, Float | float] = (-np.inf, np.inf),
    floor: Float | float = 0.0,
    config: LmSettings | None = None,
) -> tuple[LmResult, list[float]]:
    """The result, and the values at the states that were accepted."""
    accepted: list[float] = []

    def value(p: Float) -> float:
        return 0.5 * float(residuals(p) @ residuals(p))

    def model(p: Float) -> Quadratic:
        J = jacobian(p)
        accepted.append(value(p))
        return Quadratic(accepted[-1], J.T @ residuals(p), J.T @ J)

    result = minimise(model, value, start, lambda p: np.clip(p, *limits), floor, config)
    return result, accepted


@pytest.mark.parametrize(
    ("residuals", "jacobian", "start", "limits"),
    [
        (rosenbrock, rosenbrock_jacobian, [-1.2, 1.0], ([-2.0, -1.0], [0.6, 2.0])),
        (rosenbrock, rosenbrock_jacobian, [2.0, 2.0], ([1.2, -1.0], [3.0, 3.0])),
        (decay, decay_jacobian, [1.0, 0.1, 0.5], ([0.0, 0.0, 0.1], [1.5, 0.6, 1.0])),
    ],
)
def test_agrees_with_scipy_on_a_box(
    residuals: Residuals, jacobian: Jacobian, start: list[float], limits: tuple[list[float], list[float]]
) -> None:
    lower, upper = np.array(limits)
    config = LmSettings(tolerance=1e-12, max_iterations=200)
    result, _ = least_squares(residuals, jacobian, np.array(start), (lower, upper), config=config)
    expected = scipy.optimize.least_squares(
        residuals, start, jacobian, bounds=(lower, upper), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert result.converged
    assert np.any((result.pose == lower) | (result.pose == upper))  # the optimum without limits is outside
    assert np.all((result.pose >= lower) & (result.pose <= upper))
    np.testing.assert_allclose(result.pose, expected.x, atol=1e-4)
    assert result.value <= expected.cost + 1e-9


def test_floor_holds_what_the_data_does_not_see() -> None:
    """The second parameter has a trace of noise for a gradient, and next to no curvature."""

    def model(p: Float) -> Quadratic:
        return Quadratic(value(p), np.array([p[0] - 1, 1e-4]), np.diag([1.0, 1e-8]))

    def value(p: Float) -> float:
        return 1 + 0.5 * (p[0] - 1) ** 2 + 1e-4 * p[1]

    def step(floor: Float | float) -> Float:
        return minimise(model, value, np.zeros(2), lambda p: p, floor, LmSettings(max_iterations=1)).pose

    assert abs(step(0.0)[1]) > 1e3
    assert abs(step(np.array([0.0, 1.0]))[1]) <= 1e-2
    assert step(np.array([0.0, 1.0]))[0] == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("start", [[-1.2, 1.0], [3.0, -4.0], [0.0, 7.0]])
def test_no_step_goes_uphill(start: list[float]) -> None:
    _, accepted = least_squares(rosenbrock, rosenbrock_jacobian, np.array(start), config=LmSettings(damping=1e-6))
    assert len(accepted) > 3
    assert np.all(np.diff(accepted) < 0)


def test_a_model_that_is_not_finite_is_an_error() -> None:
    with pytest.raises(FloatingPointError, match="not finite"):
        minimise(lambda p: Quadratic(1.0, np.array([np.nan]), np.eye(1)), lambda p: 1.0, np.zeros(1), lambda p: p)


# the two passes of a frame

D = 6
FREE = np.array([[0, 0, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1]], bool)
GOAL = np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.6])


@dataclass
class Bowl:
    """½ (p − goal)ᵀ H (p − goal), coupled."""

    goal: Float
    H: Float = field(default_factory=lambda: np.eye(D) + 0.3)
    seen: list[Float] = field(default_factory=list)

    def value(self, pose: Float) -> float:
        return float(0.5 * (pose - self.goal) @ self.H @ (pose - self.goal))

    def model(self, pose: Float) -> Quadratic:
        self.seen.append(pose.copy())
        return Quadratic(self.value(pose), self.H @ (pose - self.goal), self.H)


class Problem:
    """A bowl for each pass. The chains have another minimum, which shows what each pass moved."""

    free = FREE

    def __init__(self, limit: float = np.inf) -> None:
        self.limit = limit
        self.calls: list[Any] = []
        self.bowls: list[Bowl] = []

    def constrain(self, poses: Float) -> Float:
        return np.clip(poses, -self.limit, self.limit)

    def value(self, pose: Float) -> float:
        return float(np.sum((pose - GOAL) ** 2))

    def damping(self, lever_m: float) -> Float:
        return np.full(D, 1e-6)

    def fixed(self) -> Bowl:
        return self._bowl(("all",), GOAL)

    def fixed_chain(self, chain: int, pose: Float) -> Bowl:
        return self._bowl((chain, pose.copy()), GOAL + 1)

    def _bowl(self, call: Any, goal: Float) -> Bowl:
        self.calls.append(call)
        self.bowls.append(Bowl(goal))
        return self.bowls[-1]


FINE = LmSettings(tolerance=1e-12)


def test_each_chain_is_optimised_after_all_with_the_rest_held() -> None:
    problem = Problem()
    result = optimise(problem, np.zeros((1, D)), config=FINE)
    kinds = [call[0] for call in problem.calls]
    assert kinds == ["all", 0, 1]
    for chain in (0, 1):
        np.testing.assert_allclose(problem.calls[1 + chain][1], GOAL, atol=1e-6)
        held = ~FREE[chain]
        for pose in problem.bowls[1 + chain].seen:
            np.testing.assert_array_equal(pose[held], problem.calls[1 + chain][1][held])
    np.testing.assert_allclose(result.pose[:2], GOAL[:2], atol=1e-6)
    # a chain's own minimum with the rest at GOAL, not at GOAL + 1
    for free in FREE:
        H = np.eye(D) + 0.3
        best = GOAL[free] + 1 + np.linalg.solve(H[np.ix_(free, free)], H[np.ix_(free, ~free)] @ np.ones((~free).sum()))
        np.testing.assert_allclose(result.pose[free], best, atol=1e-5)
    assert result.iterations.shape == (3,) and (result.iterations > 0).all()
