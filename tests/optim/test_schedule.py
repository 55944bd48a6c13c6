"""The passes on a body of ten numbers: a torso of three lengths and an angle, and two chains of three angles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.optim.problems import Evaluation
from tk.optim import schedule
from tk.optim.schedule import MAX_STEP_DEG, MAX_STEP_M, Float, Problem, ScheduleResult, descent_basis, optimise
from tk.optim.smd import Objective

D = 10
TORSO, CHAINS = slice(0, 4), (slice(4, 7), slice(7, 10))
TARGET = np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.3, 0.2, -0.5, 0.3, 0.6])
LIMIT = 3.0
# long enough to converge
LONG = 60


@dataclass
class Toy:
    """A bowl for the torso; for each chain a well of width ``width`` at its target, and where there is one a shallower
    well at its decoy. The forearm's place depends on the torso's, as a real one does.

    Attributes:
        decoys: per chain, (3,) or None.
        depth: of the decoys' wells, the true one being 1 deep.
        coupling: how far the chains' targets move with the torso's third length.
        noise: standard deviation of the gradient, drawn anew for each iteration.
        share: weight of a chain in the whole body's objective; its own objective is a mean over its own points.
        asked_full, asked_chains: all poses that the objectives were asked for.
        held: the poses and owners that :meth:`chains` was called with.
    """

    target: Float = field(default_factory=lambda: TARGET.copy())
    decoys: tuple[Float | None, Float | None] = (None, None)
    depth: float = 0.6
    width: float = 0.5
    coupling: float = 0.0
    noise: float = 0.0
    share: float = 1.0
    full_moves_chains: bool = True
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    asked_full: list[Float] = field(default_factory=list)
    asked_chains: list[Float] = field(default_factory=list)
    held: list[tuple[NDArray[np.intp], Float]] = field(default_factory=list)

    @property
    def free(self) -> NDArray[np.bool_]:
        free = np.zeros((2, D), bool)
        for k, chain in enumerate(CHAINS):
            free[k, chain] = True
        return free

    @property
    def angular(self) -> NDArray[np.bool_]:
        return np.arange(D) >= 3

    def constrain(self, poses: Float) -> Float:
        return np.clip(poses, -LIMIT, LIMIT)

    def damping(self, lever_m: float) -> Float:
        return np.full(D, lever_m**2)

    def _chain(self, k: int, pose: Float) -> tuple[float, Float]:
        """Value and gradient (D,) of chain k."""
        gradient = np.zeros(D)
        value = 1.0
        width2 = self.width**2
        for depth, centre in ((1.0, self.target[CHAINS[k]]), (self.depth, self.decoys[k])):
            if centre is None:
                continue
            away = pose[CHAINS[k]] - centre - self.coupling * (pose[2] - self.target[2])
            well = depth * np.exp(-0.5 * away @ away / width2)
            value -= well
            gradient[CHAINS[k]] += well * away / width2
            gradient[2] -= self.coupling * well * away.sum() / width2
        return float(value), gradient

    def _whole(self, pose: Float, chains: bool = True) -> tuple[float, Float]:
        away = np.zeros(D)
        away[TORSO] = (pose - self.target)[TORSO]
        value, gradient = 0.5 * float(away @ away), away
        for k in range(2 if chains else 0):
            f, g = self._chain(k, pose)
            value, gradient = value + self.share * f, gradient + self.share * g
        return value, gradient

    def _evaluation(self, rows: list[tuple[float, Float]], directions: Float, hessian: Float) -> Evaluation:
        values, gradients = zip(*rows, strict=True)
        noise = self.noise * self.rng.normal(size=directions.shape) if self.noise else 0.0
        return Evaluation(np.array(values), np.array(gradients) + noise, directions @ hessian)

    def full(self) -> Objective:
        def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
            self.asked_full.append(poses.copy())
            whole = [self._whole(p, self.full_moves_chains) for p in poses]
            return self._evaluation(whole, directions, self.curvature(self.target))

        return evaluate

    def chains(self, owner: NDArray[np.intp], pose: Float) -> Objective:
        self.held.append((owner.copy(), pose.copy()))

        def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
            self.asked_chains.append(poses.copy())
            rows = [self._chain(k, p) for k, p in zip(owner, poses, strict=True)]
            return self._evaluation(rows, directions, self._hessian(1.0))

        return evaluate

    def value(self, pose: Float) -> float:
        return self._whole(pose)[0]

    def values(self, poses: Float) -> Float:
        return np.array([self.value(pose) for pose in poses])

    def curvature(self, pose: Float) -> Float:
        return self._hessian(self.share)

    def chain_curvatures(self, pose: Float) -> Float:
        return np.stack([self._hessian(1.0)] * len(CHAINS))

    def _hessian(self, share: float) -> Float:
        rows = np.eye(D)  # the residuals' Jacobian: at the target the wells are bowls
        rows[4:, 2] -= self.coupling
        rows[4:] *= np.sqrt(share) / self.width
        return rows.T @ rows


def solve(toy: Toy, start: Float | None = None, iterations: int = LONG) -> ScheduleResult:
    problem: Problem = toy
    start = toy.target + 0.2 if start is None else start
    return optimise(problem, np.atleast_2d(start), iterations)


def beside(pose: Float, chain: int, place: Float | float) -> Float:
    """``pose`` with a chain put elsewhere."""
    pose = pose.copy()
    pose[CHAINS[chain]] = place
    return pose


# --- the passes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("coupling", [0.5, 0.0])
def test_finds_the_target(coupling: float) -> None:
    result = solve(Toy(coupling=coupling))
    assert np.abs(result.pose - TARGET).max() < 0.005  # a few of the second tolerance
    assert result.iterations.shape == (3,) and result.iterations.dtype == np.int32


def test_second_pass_of_a_chain_keeps_torso_and_other_chains() -> None:
    toy = Toy(coupling=0.3)
    # so short a first pass leaves the torso where the chains would like to pull it
    result = solve(toy, TARGET + 0.6, iterations=4)
    owner, pose = toy.held[-1]
    assert np.abs(pose - TARGET)[TORSO].min() > 0.01
    np.testing.assert_array_equal(result.pose[TORSO], pose[TORSO])
    for poses in toy.asked_chains:
        for k, row in zip(owner, poses, strict=True):
            np.testing.assert_array_equal(row[~toy.free[k]], pose[~toy.free[k]])
    assert np.abs(toy.asked_chains[-1] - toy.asked_chains[0]).max() > 0.01


def test_second_pass_has_a_smaller_tolerance(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a first pass that leaves the chains far to go."""
    fine = solve(Toy(full_moves_chains=False), TARGET + 0.4)
    monkeypatch.setattr(schedule, "REFINE", 1.0)
    rough = solve(Toy(full_moves_chains=False), TARGET + 0.4)
    assert fine.iterations[0] == rough.iterations[0] and (fine.iterations[1:] > rough.iterations[1:]).all()


def test_first_step_of_a_chain_is_a_share_of_a_newton_step_in_its_own_objective() -> None:
    """Its weight in the whole body's objective, which the first pass whitens, makes no difference."""
    moved = []
    for share in (1.0, 1 / 8):
        toy = Toy(full_moves_chains=False, share=share)
        solve(toy, TARGET + 0.02)
        moved.append((toy.asked_chains[1] - toy.asked_chains[0])[0, CHAINS[0]])
    np.testing.assert_allclose(moved, -schedule.RATE * 0.02, rtol=0.02)


def test_a_chain_does_not_depend_on_the_other() -> None:
    """With a first pass that moves the torso only, so that the second begins at the same pose."""
    here = Toy(full_moves_chains=False)
    there = Toy(full_moves_chains=False, target=beside(TARGET, 1, 0.0))
    start = TARGET + 0.2
    first, second = (solve(toy, start) for toy in (here, there))
    np.testing.assert_array_equal(first.pose[CHAINS[0]], second.pose[CHAINS[0]])
    assert first.iterations[1] == second.iterations[1]
    assert np.abs(first.pose - second.pose)[CHAINS[1]].max() > 0.2


def test_begins_at_the_best_of_the_predictions() -> None:
    toy = Toy()
    starts = np.stack([TARGET + 0.5, TARGET + 0.2, TARGET - 0.3])
    solve(toy, starts)
    np.testing.assert_array_equal(toy.asked_full[0], starts[[1]])


def test_prediction_outside_the_limits_is_clipped_before_it_is_evaluated() -> None:
    """Far outside, the first would be the worst of the two."""
    toy = Toy(target=np.where(np.arange(D) == 0, LIMIT, TARGET))
    beyond, near = toy.target.copy(), toy.target + 0.1
    beyond[0] += 10
    assert toy.value(beyond) > toy.value(near)
    solve(toy, np.stack([near, beyond]))
    np.testing.assert_array_equal(toy.asked_full[0], [toy.target])


def test_iterations_are_those_of_the_first_pass_and_of_each_chain_in_turn() -> None:
    """One chain is there already and stops after the first window; the other has far to go. The first pass, which
    moves neither, is somewhere between."""
    for slow in (0, 1):
        toy = Toy(full_moves_chains=False)
        result = solve(toy, beside(TARGET, slow, TARGET[CHAINS[slow]] + 0.4))
        assert len(toy.asked_full) == result.iterations[0] == 3
        assert result.iterations[1 + (1 - slow)] == 3
        assert len(toy.asked_chains) == result.iterations[1 + slow] > 6


# --- seeds, bounds, settings ------------------------------------------------------------------------------------------


def test_no_iteration_moves_further_than_its_bound() -> None:
    """Neither in the first pass nor in the second, which the first leaves far to go."""
    toy = Toy(width=3.0)
    solve(toy, TARGET + 3.0, iterations=6)
    bound = np.where(toy.angular, np.radians(MAX_STEP_DEG), MAX_STEP_M)
    for path in (np.array(toy.asked_full)[:, 0], np.array(toy.asked_chains)[:, 0], np.array(toy.asked_chains)[:, 1]):
        share = np.max(np.abs(np.diff(path, axis=0)) / bound, axis=1)
        assert np.all(share <= 1 + 1e-9)
        np.testing.assert_allclose(share[:4], 1)


@given(seed=st.integers(0, 2**32 - 1), free=st.lists(st.booleans(), min_size=6, max_size=6).filter(any))
@settings(max_examples=40)
def test_the_descent_basis_makes_the_curvature_of_the_free_parameters_one(seed: int, free: list[bool]) -> None:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(4, 6))  # fewer residuals than parameters: the damping makes up for what they do not see
    hessian, damping = J.T @ J, rng.uniform(0.1, 1, 6)
    mask = np.array(free)
    basis, inverse = descent_basis(hessian, mask, damping)
    held = np.diag(mask.astype(float))
    np.testing.assert_allclose(basis.T @ (hessian + np.diag(damping)) @ basis, held, atol=1e-9)
    np.testing.assert_allclose(inverse, np.linalg.pinv(basis), atol=1e-9)
    assert not basis[~mask].any() and not basis[:, ~mask].any()
