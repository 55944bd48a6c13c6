"""Damped Gauss-Newton on small problems with known answers."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tk.kernels.newton import LENGTHS, LINEAR, TOLERANCE, newton_step
from tk.kernels.runtime import ensure_runtime, ti
from tk.kernels.silhouette import Descent
from tk.optim import gauss_newton
from tk.optim.gauss_newton import GaussNewtonSettings
from tk.optim.quadratic import Quadratic

UNDAMPED = GaussNewtonSettings(scales=1, iterations=1, damping=0.0, stiffness=0.0, longest_step=100.0)
NONE = (np.full(4, -np.inf), np.full(4, np.inf))
ALL = None


@ti.kernel
def _step_kernel(
    free: ti.types.ndarray(dtype=ti.i32, ndim=1),
    terms: ti.types.ndarray(dtype=ti.f64, ndim=2),
    matrix: ti.types.ndarray(dtype=ti.f64, ndim=3),
    numbers: ti.types.ndarray(dtype=ti.f64, ndim=1),
    length: ti.f64,
    hessian: ti.types.ndarray(dtype=ti.f64, ndim=3),
    gradient: ti.types.ndarray(dtype=ti.f64, ndim=2),
    factor: ti.types.ndarray(dtype=ti.f64, ndim=3),
    state: ti.types.ndarray(dtype=ti.f64, ndim=2),
    change: ti.types.ndarray(dtype=ti.f64, ndim=1),
):
    for b in range(state.shape[0]):
        change[b] = newton_step(free, terms, matrix, numbers, b, length, hessian, gradient, ti.static(0), factor, state)


def solve(equations, start, free=ALL, lower=NONE[0], upper=NONE[1], config=None, terms=None, levels=None):
    """The solution of a problem with the given equations."""
    ensure_runtime()

    def descend(states, scale, steps):
        states, rows = states.copy(), np.arange(len(states))
        made = np.zeros(len(states), np.int32)
        for length in steps.numbers[LENGTHS:]:
            moved, change, scratch = states[rows], np.zeros(len(rows)), np.zeros((len(rows), 4, 5))
            here = equations(moved.copy(), scale, rows)
            terms = np.vstack([steps.terms[:LINEAR], steps.terms[LINEAR + rows]])
            matrix = steps.matrix[rows] if len(steps.matrix) > 1 else steps.matrix
            numbers = steps.free, terms, matrix, steps.numbers, length
            _step_kernel(*numbers, here.hessian, here.gradient, scratch, moved, change)
            states[rows] = moved
            made[rows] += 1
            rows = rows[change > steps.numbers[TOLERANCE]]
            if not len(rows):
                break
        return Descent(states, made)

    return gauss_newton.minimise(descend, start, free, lower, upper, config, terms, levels)


def minimise(*arguments, **options):
    """(B, 4) the states at the end."""
    return solve(*arguments, **options).states


class Sums(NamedTuple):
    hessian: np.ndarray
    gradient: np.ndarray
    cost: np.ndarray


def linear(A, y):
    """‖A p − y‖² for a batch of states."""

    def equations(states, *_):
        residual = y - states @ A.T
        return Sums(np.repeat((A.T @ A)[None], len(states), 0), residual @ A, (residual**2).mean(axis=1))

    return equations


def problem(seed, rows=9):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, 4)), rng.normal(size=rows), rng.normal(size=(3, 4))


@given(st.integers(0, 10**6))
@settings(max_examples=30)
def test_linear_problem_is_solved_in_one_step(seed):
    A, y, start = problem(seed)
    expected = np.linalg.lstsq(A, y, rcond=None)[0]
    found = minimise(linear(A, y), start, ALL, *NONE, UNDAMPED)
    np.testing.assert_allclose(found, np.repeat(expected[None], 3, 0), rtol=1e-4, atol=1e-5)


def test_over_relaxation_converges_faster_if_equations_predict_half_the_step():
    A, y, start = problem(2)
    expected = np.linalg.lstsq(A, y, rcond=None)[0]
    share = np.array([0.4, 0.5, 1.0, 1.0])  # of the error of each parameter that the equations predict

    def equations(states, *_):
        step = (expected - states) * share
        H = np.repeat(np.eye(4)[None], len(states), 0)
        return Sums(H, step, (step**2).sum(axis=1))

    def error(relaxation, iterations):
        config = GaussNewtonSettings(1, iterations, relaxation, damping=0.0, stiffness=0.0, longest_step=100.0)
        return np.abs(minimise(equations, start, ALL, *NONE, config) - expected).max(axis=0)

    plain, relaxed = error(1.0, 4), error(1.6, 3)  # as many equations
    assert (relaxed[:2] < 0.5 * plain[:2]).all()
    assert (relaxed[2:] < 1e-6).all() and (error(1.6, 1)[2:] < 1e-6).all()  # the last step is a plain one


def test_parameters_without_evidence_stay():
    A, y, start = problem(3)
    A[:, 2] = 0.0
    found = minimise(linear(A, y), start, ALL, *NONE, GaussNewtonSettings(scales=1, iterations=4))
    np.testing.assert_array_equal(found[:, 2], start[:, 2])
    nothing = minimise(linear(0 * A, y), start, ALL, *NONE, GaussNewtonSettings())
    np.testing.assert_array_equal(nothing, start)


def test_limit_is_a_quadratic_penalty_beyond_it():
    """The minimum of ‖p − 1‖² + w (p − 0.5)₊²: between limit and data."""
    A, y = np.eye(4), np.ones(4)
    upper = np.array([0.5, np.inf, 2.0, np.inf])
    for weight in (0.0, 1.0, 10.0):
        config = GaussNewtonSettings(
            scales=1, iterations=60, damping=0.0, stiffness=0.0, limit_weight=weight, longest_step=100.0
        )
        found = minimise(linear(A, y), np.full((1, 4), 0.9), ALL, NONE[0], upper, config)
        np.testing.assert_allclose(found[0, 0], (1 + 0.5 * weight) / (1 + weight), atol=1e-4)
        np.testing.assert_allclose(found[0, 1:], 1.0, atol=1e-4)


def test_steps_are_shortened_as_a_whole():
    goal = np.array([4.0, 2.0, 0.0, -1.0])
    config = GaussNewtonSettings(scales=1, iterations=1, damping=0.0, stiffness=0.0, longest_step=0.1)
    delta = minimise(linear(np.eye(4), goal), np.zeros((1, 4)), ALL, *NONE, config)
    np.testing.assert_allclose(delta, 0.1 * goal[None] / 4.0, rtol=1e-6)


def test_scales_run_from_coarse_to_fine():
    seen = []
    A, y, start = problem(4)

    def watched(states, scale, rows):
        seen.append(scale)
        return linear(A, y)(states)

    config = GaussNewtonSettings(scales=3, iterations=2)
    minimise(watched, start, ALL, *NONE, config)
    assert seen == [2, 2, 1, 1, 0, 0]
    seen.clear()
    solve(watched, start, ALL, *NONE, config, levels=(1,))
    assert seen == [1, 1]


@pytest.mark.parametrize("tolerance", [0.0, 0.05])
def test_states_of_a_batch_are_independent(tolerance):
    A, y, start = problem(5)
    start[0] = np.linalg.lstsq(A, y)[0]  # converged from the beginning
    config = GaussNewtonSettings(iterations=6, damping=0.5, tolerance=tolerance)
    together = minimise(linear(A, y), start, ALL, *NONE, config)
    for i in range(len(start)):
        np.testing.assert_allclose(
            minimise(linear(A, y), start[i : i + 1], ALL, *NONE, config)[0], together[i], rtol=1e-12
        )


@given(st.integers(0, 10**6))
@settings(max_examples=30)
def test_scale_ends_once_no_parameter_moves_by_more_than_the_tolerance(seed):
    A, y, start = problem(seed)
    made = []

    def watched(states, scale, rows):
        made.append(states.copy())
        return linear(A, y)(states)

    config = GaussNewtonSettings(scales=2, iterations=30, damping=0.5, longest_step=100.0, tolerance=0.01)
    found = solve(watched, start[:1], ALL, *NONE, config)
    assert found.iterations.sum() == len(made)
    steps = [np.abs(after - before).max() for before, after in pairwise([*made, found.states])]
    last = found.iterations.cumsum() - 1
    assert all((step <= 0.01) == (i in last) for i, step in enumerate(steps)) or found.iterations.max() == 30
    plain = solve(linear(A, y), start, ALL, *NONE, replace(config, tolerance=0.0))
    assert plain.iterations.tolist() == [30, 30]


def constant(term):
    return lambda _: term


@given(seed=st.integers(0, 10**6), each=st.booleans())
@settings(max_examples=30)
def test_prior_is_a_further_measurement(seed, each):
    """The minimum of ‖A p − y‖² + Σ w (p − m)², the mean shared or each state's own."""
    A, y, start = problem(seed)
    rng = np.random.default_rng(seed + 1)
    mean, precision = rng.normal(size=(3, 4) if each else 4), rng.uniform(0, 5, 4)
    prior = Quadratic.about(mean, precision)
    found = minimise(linear(A, y), start, ALL, *NONE, UNDAMPED, constant(prior))
    for state, m in zip(found, np.broadcast_to(mean, (3, 4)), strict=True):
        expected = np.linalg.solve(A.T @ A + np.diag(precision), A.T @ y + precision * m)
        np.testing.assert_allclose(state, expected, rtol=1e-4, atol=1e-5)


@given(seed=st.integers(0, 10**6), own=st.booleans(), free=st.sampled_from([None, [0, 2], [3]]))
@settings(max_examples=30)
def test_quadratic_term_enters_with_its_whole_matrix(seed, own, free):
    """The minimum of ½‖A p − y‖² + ½ pᵀM p − lᵀp; parameters that are not free keep their part of M p."""
    A, y, start = problem(seed)
    rng = np.random.default_rng(seed + 1)
    root, linear_part = rng.normal(size=(3 if own else 1, 4, 4)), rng.normal(size=(3 if own else 1, 4))
    term = Quadratic(linear_part, root @ root.swapaxes(1, 2))
    found = minimise(linear(A, y), start, None if free is None else np.array(free), *NONE, UNDAMPED, constant(term))
    for b, state in enumerate(found):
        i = np.arange(4) if free is None else np.array(free)
        M, H = term.matrix[b % len(term.matrix)], A.T @ A
        g = A.T @ (y - A @ start[b]) + term.linear[b % len(term.linear)] - M @ start[b]
        expected = start[b].copy()
        expected[i] += np.linalg.solve((H + M)[np.ix_(i, i)], g[i])
        np.testing.assert_allclose(state, expected, rtol=1e-3, atol=1e-4)


def test_terms_are_taken_about_the_states_at_the_start_of_each_scale():
    A, y, start = problem(5)
    seen = []

    def terms(states):
        seen.append(states.copy())
        return Quadratic.about(states, np.ones(4))

    config = GaussNewtonSettings(scales=3, iterations=2)
    minimise(linear(A, y), start, ALL, *NONE, config, terms)
    assert len(seen) == 3
    np.testing.assert_array_equal(seen[0], start)
    assert np.abs(seen[1] - seen[0]).max() > 1e-3


def test_sum_and_multiple_of_quadratics_are_those_of_their_costs():
    rng = np.random.default_rng(3)
    one, other = (Quadratic(rng.normal(size=(n, 4)), rng.normal(size=(n, 4, 4))) for n in (1, 3))
    p = rng.normal(size=4)

    def cost(term):
        return 0.5 * np.einsum("i,bij,j->b", p, term.matrix, p) - term.linear @ p

    np.testing.assert_allclose(cost(one + other.scaled(2.0)), cost(one) + 2.0 * cost(other))


def test_prior_determines_parameters_without_evidence():
    A, y, start = problem(7)
    A[:, 2] = 0.0
    prior = constant(Quadratic.about(np.array([0, 0, 0.3, 0]), np.array([0, 0, 1e3, 0.0])))
    config = GaussNewtonSettings(scales=1, iterations=8, longest_step=9)
    found = minimise(linear(A, y), start, ALL, *NONE, config, prior)
    np.testing.assert_allclose(found[:, 2], 0.3, atol=1e-3)
