"""The solver over time against dense solutions by numpy."""

from time import process_time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.optim.trajectory import Chain, Equations, gauge_projection, minimise

BLOCKS, OWN, SHARED, ROWS, STEP_ROWS = 6, 4, 5, 7, 3
# The blocks that are coupled to the next one: none, all, and all but one, as at a cut.
CHAINS = [(), (0, 1, 2, 3, 4), (0, 1, 3, 4)]


class Linear:
    """Residuals y - own_b @ p_b - across_b @ s and, between the blocks of ``coupled`` and the next ones,
    y - before @ p_b - after @ p_b+1, with weights and priors; and the dense equations of the same."""

    def __init__(self, seed: int, coupled: tuple[int, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        self.coupled = np.array(coupled, np.intp)
        self.before, self.after = rng.normal(size=(2, STEP_ROWS, OWN))
        self.step_target = rng.normal(size=(BLOCKS, STEP_ROWS))
        self.step_weight = rng.uniform(0.1, 2.0, (BLOCKS, STEP_ROWS))
        self.rows = rng.normal(size=(BLOCKS, ROWS, OWN + SHARED))
        self.target, self.weight = rng.normal(size=(BLOCKS, ROWS)), rng.uniform(0.1, 2.0, (BLOCKS, ROWS))
        self.own_precision, self.shared_precision = rng.uniform(0.5, 2.0, OWN), rng.uniform(0.5, 2.0, SHARED)
        self.start = rng.normal(size=(BLOCKS, OWN)), rng.normal(size=SHARED)

    def linearise(self, state, level=0):
        p, s = state
        equations = Equations(BLOCKS, OWN, SHARED)
        for b, rows in enumerate(self.rows):
            residual = self.target[b] - rows @ np.concatenate([p[b], s])
            equations.add(np.full(ROWS, b), np.arange(OWN + SHARED), rows, self.weight[b], residual)
            equations.add_block_prior(b, self.own_precision, -p[b])
        if len(self.coupled):
            missing = (
                self.step_target[self.coupled] - p[self.coupled] @ self.before.T - p[self.coupled + 1] @ self.after.T
            )
            equations.couple(self.coupled, self.before, self.after, self.step_weight[self.coupled], missing)
        equations.prior_hessian += np.diag(self.shared_precision)
        equations.prior_gradient -= self.shared_precision * s
        return equations

    def dense(self):
        """Hessian and gradient of all unknowns at the start: blocks first, then the shared unknowns."""
        p, s = self.start
        H = np.diag(np.concatenate([np.tile(self.own_precision, BLOCKS), self.shared_precision]))
        g = -np.diag(H) * np.concatenate([p.ravel(), s])
        for b, rows in enumerate(self.rows):
            J = np.zeros((ROWS, len(g)))
            J[:, b * OWN : (b + 1) * OWN], J[:, BLOCKS * OWN :] = rows[:, :OWN], rows[:, OWN:]
            H += J.T @ (self.weight[b][:, None] * J)
            g += J.T @ (self.weight[b] * (self.target[b] - rows @ np.concatenate([p[b], s])))
        for b in self.coupled.tolist():
            J = np.zeros((STEP_ROWS, len(g)))
            J[:, b * OWN : (b + 2) * OWN] = np.hstack([self.before, self.after])
            H += J.T @ (self.step_weight[b][:, None] * J)
            g += J.T @ (self.step_weight[b] * (self.step_target[b] - J[:, : p.size] @ p.ravel()))
        return H, g


def move(state, own, shared):
    return state[0] + own, state[1] + shared


@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.3]), st.sampled_from(CHAINS))
@settings(max_examples=30)
def test_step_and_covariances_equal_the_dense_solution(seed, damping, coupled):
    problem = Linear(seed, coupled)
    H, g = problem.dense()
    H[np.diag_indices_from(H)] *= 1 + damping
    expected = np.linalg.solve(H, g)
    reduced = problem.linearise(problem.start).reduced(damping)
    own, shared = reduced.step()
    np.testing.assert_allclose(np.concatenate([own.ravel(), shared]), expected, atol=1e-9)
    inverse = np.linalg.inv(H)
    np.testing.assert_allclose(np.linalg.inv(reduced.hessian), inverse[-SHARED:, -SHARED:], atol=1e-9)
    own = reduced.chain.covariance + reduced.response @ np.linalg.inv(reduced.hessian) @ reduced.response.swapaxes(1, 2)
    for b, covariance in enumerate(own):
        own_block = slice(b * OWN, (b + 1) * OWN)
        np.testing.assert_allclose(covariance, inverse[own_block, own_block], atol=1e-9)


def test_a_cut_makes_two_problems():
    whole = Linear(5, (0, 1, 3, 4))
    p, s = whole.start
    plain = whole.linearise(whole.start).reduced().plain
    changed = whole.linearise((np.concatenate([p[:3], p[3:] + 1.0]), s)).reduced().plain
    np.testing.assert_array_equal(plain[:3], changed[:3])
    assert np.abs(plain[3:] - changed[3:]).min() > 1e-3


def walk(frames, seen, step=0.1):
    """Equations of a point that takes steps of a standard deviation in each frame, and is seen, with a standard
    deviation of 1, in the frames ``seen``, at their number."""
    equations = Equations(frames, 1, 0)
    for b in seen:
        equations.add(np.array([b]), np.array([0]), np.eye(1), np.ones(1), np.array([float(b)]))
    steps = np.zeros((frames - 1, 1))
    equations.couple(np.arange(frames - 1), -np.eye(1), np.eye(1), steps + step**-2, steps)
    return equations.reduced()


def test_frames_without_evidence_lie_between_their_neighbours_and_are_less_sure():
    found = walk(9, [0, 1, 7, 8], step=1.0)
    np.testing.assert_allclose(np.diff(found.plain[1:8, 0]), found.plain[2, 0] - found.plain[1, 0])
    deviation = np.sqrt(found.chain.covariance[:, 0, 0])
    assert deviation.argmax() == 4
    assert deviation[4] == pytest.approx(np.sqrt((3.0 + deviation_of_a_side() ** 2) / 2))


def deviation_of_a_side():
    """Standard deviation of the point in frame 1 of :func:`walk` by frames 0 and 1 alone."""
    return 1 / np.sqrt(1.0 + 1 / 2.0)


def test_time_is_linear_in_the_number_of_frames():
    rng = np.random.default_rng(6)

    def seconds(frames):
        own, coupling = np.eye(30) + np.zeros((frames, 30, 30)), 0.01 * rng.normal(size=(frames - 1, 30, 30))
        right, times = rng.normal(size=(frames, 30, 2)), []
        for _ in range(3):
            begin = process_time()
            chain = Chain.of(own, coupling)
            chain.solve(right)
            assert chain.covariance.shape == own.shape
            times.append(process_time() - begin)
        return min(times)

    assert seconds(400) < 6 * seconds(100)


@given(st.integers(0, 10**6))
@settings(max_examples=10)
def test_linear_problem_converges_in_two_iterations(seed):
    problem = Linear(seed)
    found = minimise(problem.start, problem.linearise, move, [0] * 5, (100.0, 100.0), tolerance=1e-8)
    assert found.converged
    np.testing.assert_allclose(problem.linearise(found.state).gradient[:, :OWN], 0, atol=1e-8)


def test_steps_are_limited_and_all_iterations_are_made():
    problem = Linear(1)
    found = minimise(problem.start, problem.linearise, move, [1, 0], (0.01, 0.02), tolerance=1e-8)
    assert not found.converged
    for now, before, limit in zip(found.state, problem.start, (0.02, 0.04), strict=True):
        assert np.abs(now - before).max() == pytest.approx(limit)


def test_coarse_levels_do_not_end_the_iteration():
    problem = Linear(2)
    levels = []

    def linearise(state, level):
        levels.append(level)
        return problem.linearise(state, level)

    assert minimise(problem.start, linearise, move, [1, 1, 0, 0], (9.0, 9.0), tolerance=np.inf).converged
    assert levels == [1, 1, 0]


def test_blocks_without_shared_unknowns_are_solved_each_on_its_own():
    rng = np.random.default_rng(4)
    rows, target = rng.normal(size=(BLOCKS, ROWS, OWN)), rng.normal(size=(BLOCKS, ROWS))

    def linearise(p, _):
        equations = Equations(BLOCKS, OWN, 0)
        for b in range(BLOCKS):
            equations.add(np.full(ROWS, b), np.arange(OWN), rows[b], np.ones(ROWS), target[b] - rows[b] @ p[b])
        return equations

    levels = [0] * 100
    found = minimise(np.zeros((BLOCKS, OWN)), linearise, lambda p, own, _: p + own, levels, (9.0, 9.0), damping=0.2)
    assert not found.converged
    for b in range(BLOCKS):
        np.testing.assert_allclose(found.state[b], np.linalg.lstsq(rows[b], target[b], rcond=None)[0], atol=1e-6)


def test_without_iterations_the_start_is_returned():
    found = minimise(3.0, lambda *_: pytest.fail("linearised"), lambda *_: 0.0, [], (1.0, 1.0))
    assert (found.state, found.reduced, found.converged) == (3.0, None, False)


@given(st.integers(0, 10**6))
@settings(max_examples=10)
def test_gauge_projection_removes_modes_and_keeps_what_is_orthogonal(seed):
    rng = np.random.default_rng(seed)
    modes, precision, step = rng.normal(size=(8, 3)), rng.uniform(0.5, 2.0, 8), rng.normal(size=8)
    project = gauge_projection(modes, precision)
    np.testing.assert_allclose(project @ modes, 0, atol=1e-9)
    np.testing.assert_allclose((modes.T * precision) @ (project @ step), 0, atol=1e-9)
    np.testing.assert_allclose(project @ (project @ step), project @ step, atol=1e-9)
