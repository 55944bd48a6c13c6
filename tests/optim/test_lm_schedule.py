"""The passes by Levenberg-Marquardt: order, what is held, starts."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tk.optim.levenberg_marquardt import LmSettings
from tk.optim.lm_schedule import optimise
from tk.optim.schedule import ScheduleSettings

D = 6
FREE = np.array([[0, 0, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1]], bool)
GOAL = np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.6])


@dataclass
class Bowl:
    """½ (p − goal)ᵀ H (p − goal), coupled."""

    goal: np.ndarray
    H: np.ndarray = field(default_factory=lambda: np.eye(D) + 0.3)
    seen: list = field(default_factory=list)

    def value(self, pose):
        return float(0.5 * (pose - self.goal) @ self.H @ (pose - self.goal))

    def model(self, pose):
        self.seen.append(pose.copy())
        return self.value(pose), self.H @ (pose - self.goal), self.H


class Problem:
    """A bowl for each pass; the chains' lie elsewhere, so that who moved what can be told."""

    free = FREE

    def __init__(self, limit=np.inf):
        self.limit = limit
        self.calls = []
        self.bowls = []

    def constrain(self, poses):
        return np.clip(poses, -self.limit, self.limit)

    def value(self, pose):
        return float(np.sum((pose - GOAL) ** 2))

    def damping(self, lever_m):
        return np.full(D, 1e-6)

    def fixed(self):
        return self._bowl(("all",), GOAL)

    def fixed_chain(self, chain, pose):
        return self._bowl((chain, pose.copy()), GOAL + 1)

    def _bowl(self, call, goal):
        self.calls.append(call)
        self.bowls.append(Bowl(goal))
        return self.bowls[-1]


TWO_PASSES = ScheduleSettings()
FINE = LmSettings(tolerance=1e-12)


def test_all_then_each_chain_with_the_rest_held():
    problem = Problem()
    result = optimise(problem, np.zeros((1, D)), TWO_PASSES, FINE)
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


def test_the_best_start_is_taken():
    problem = Problem()
    starts = np.array([np.full(D, 5.0), GOAL + 0.01, np.full(D, -5.0)])
    optimise(problem, starts, TWO_PASSES, FINE)
    np.testing.assert_array_equal(problem.bowls[0].seen[0], starts[1])


def test_limits_hold():
    result = optimise(Problem(limit=0.25), np.zeros((1, D)), TWO_PASSES, FINE)
    assert np.abs(result.pose).max() <= 0.25


@pytest.mark.parametrize("refine", [0.5, 1e-6])
def test_chains_are_held_to_the_finer_tolerance(refine):
    problem = Problem()
    rough = LmSettings(tolerance=0.5, damping=5.0)
    result = optimise(problem, np.zeros((1, D)), replace(TWO_PASSES, refine=refine), rough)
    assert result.iterations[1:].max() > 3 if refine < 0.01 else result.iterations[1:].max() <= 3
