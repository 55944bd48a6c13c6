"""SMD against a scalar implementation of eqs. 17-23, and on a problem whose answer is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.optim.problems import Evaluation, anywhere, bowl, box, cliff, rippled, scripted
from tk.optim import smd
from tk.optim.smd import Float, Objective, SmdResult

# two implementations of the same sums, in another order, over tens of iterations
ROUNDING = 1e-10
# a tolerance that no state meets, not even one that stands still on a limit
NEVER = -np.ones(1)


def minimise(
    objective: Objective,
    start: Float | list[list[float]],
    step: float,
    tolerance: Float,
    constrain: Callable[[Float], Float] = anywhere,
    basis: Float | None = None,
    max_step: Float | float = 1e300,
    iterations: int = smd.MAX_ITERATIONS,
) -> SmdResult:
    """SMD in a basis (B, D, U), that of the unit vectors by default, without a bound by default."""
    start = np.array(start)
    B, D = start.shape
    basis = np.tile(np.eye(D), (B, 1, 1)) if basis is None else basis
    bound = np.broadcast_to(np.asarray(max_step, float), D)
    return smd.minimise(objective, start, step, tolerance, constrain, (basis, np.linalg.pinv(basis)), bound, iterations)


@pytest.fixture
def constants(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Set μ, λ and n: ``constants(META_STEP=0)``."""

    def set_(**values: float) -> None:
        for name, value in values.items():
            monkeypatch.setattr(smd, name, value)

    return set_


def rotation(rng: np.random.Generator, n: int) -> Float:
    return np.asarray(np.linalg.qr(rng.normal(size=(n, n)))[0])


# --- the equations ----------------------------------------------------------------------------------------------------


def slow_smd(
    gradient: Callable[[list[float], int], list[float]],
    hessian: list[list[float]],
    start: list[float],
    step: float,
    limits: tuple[float, float],
    iterations: int,
    constrained_gradient: bool = True,
) -> list[list[float]]:
    """Eqs. 17-19, 22, 23 one number at a time; all states."""
    n = len(start)
    p, v, a = list(start), [0.0] * n, [step] * n
    path = [list(p)]
    for i in range(iterations):
        g = gradient(p, i)
        hv = [sum(hessian[r][c] * v[c] for c in range(n)) for r in range(n)]
        following = list(p)
        for d in range(n):
            a[d] = a[d] * max(0.5, 1 + smd.META_STEP * v[d] * g[d])
            following[d] = min(max(p[d] - a[d] * g[d], limits[0]), limits[1])
            g_used = (p[d] - following[d]) / a[d] if constrained_gradient else g[d]
            v[d] = smd.MEMORY * v[d] + a[d] * (g_used - smd.MEMORY * hv[d])
        p = following
        path.append(list(p))
    return path


@pytest.mark.parametrize("limits", [(-np.inf, np.inf), (-0.5, 0.8)])
@pytest.mark.parametrize("memory", [0.0, 0.3, 0.9])
def test_states_follow_the_equations(constants, memory: float, limits: tuple[float, float]) -> None:
    constants(META_STEP=0.7, MEMORY=memory)
    rng = np.random.default_rng(3)
    B, D, count = 4, 3, 25
    basis = rotation(rng, D)
    hessian = basis @ np.diag([0.4, 1.0, 2.5]) @ basis.T
    noise = rng.normal(scale=0.3, size=(count, B, D))
    start = rng.uniform(-0.5, 0.8, size=(B, D))

    def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
        return Evaluation(np.zeros(B), (poses - 1) @ hessian + noise[iteration], directions @ hessian)

    result = minimise(evaluate, start, 0.4, NEVER, box(*limits), iterations=count)
    for b in range(B):

        def gradient(p: list[float], i: int, b: int = b) -> list[float]:
            return [sum(hessian[r][c] * (p[c] - 1) for c in range(D)) + noise[i, b, r] for r in range(D)]

        path = slow_smd(gradient, hessian.tolist(), start[b].tolist(), 0.4, limits, count)
        np.testing.assert_allclose(result.path[:, b], path, atol=ROUNDING)


def test_descent_in_a_basis_equals_descent_on_the_transformed_problem() -> None:
    rng = np.random.default_rng(4)
    hessian = np.diag([1.0, 3.0, 0.2])
    centre = np.array([1.0, -2.0, 0.5])
    start = rng.normal(size=(1, 3))
    basis = rng.normal(size=(3, 2))
    inside = minimise(bowl(hessian, centre), start, 0.1, np.zeros(3), basis=basis[None], iterations=20)

    def seen(u: Float, directions: Float, iteration: int) -> Evaluation:
        now = bowl(hessian, centre)(start + u @ basis.T, directions @ basis.T, iteration)
        return Evaluation(now.value, now.gradient @ basis, now.hessian_vector @ basis)

    outside = minimise(seen, np.zeros((1, 2)), 0.1, np.zeros(2), iterations=20)
    assert np.ptp(inside.path[:, 0], axis=0).min() > 0.01
    np.testing.assert_allclose(inside.path, start + outside.path @ basis.T, atol=ROUNDING)


def test_a_step_size_is_at_most_halved(constants) -> None:
    """Eq. 18: after gradients of 100 and -100 the factor 1 + μvg would be far below zero."""
    constants(META_STEP=1.0, MEMORY=0.0)
    gradients = np.array([100.0, -100.0, -100.0]).reshape(3, 1, 1)
    path = minimise(scripted(gradients), [[0.0]], 0.5, NEVER, iterations=2).path
    np.testing.assert_array_equal(np.diff(path[:, 0, 0]), [-50.0, 25.0])


def test_step_size_does_not_change_at_a_limit() -> None:
    """Eq. 23: at a limit p does not move, so there is no effect of the step size to learn from. With the plain gradient
    in eq. 19 ten iterations against the limit make the step size explode."""
    pull = [1.0] * 10 + [-1.0]
    gradients = np.array(pull).reshape(-1, 1, 1)
    path = minimise(scripted(gradients), [[0.0]], 0.5, NEVER, box(0, np.inf), iterations=11).path
    np.testing.assert_array_equal(path[:-1, 0, 0], 0)
    assert path[-1, 0, 0] == 0.5

    def gradient(p: list[float], i: int) -> list[float]:
        return [pull[i]]

    naive = slow_smd(gradient, [[0.0]], [0.0], 0.5, (0, np.inf), 11, constrained_gradient=False)
    assert naive[-1][0] > 5


@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(1e-3, 1e3),
    lower=st.floats(-2, 0),
    width=st.floats(0, 2),
)
@settings(max_examples=40)
def test_no_state_leaves_the_limits(seed: int, scale: float, lower: float, width: float) -> None:
    rng = np.random.default_rng(seed)
    gradients = scale * rng.normal(size=(12, 3, 2))
    basis = np.linalg.inv(rng.normal(size=(3, 2, 2)) + 3 * np.eye(2))
    start = rng.normal(size=(3, 2))
    limited = box(lower, lower + width)
    result = minimise(scripted(gradients), start, 0.5 / scale, NEVER, limited, basis, iterations=12)
    np.testing.assert_array_equal(result.path, limited(result.path))
    np.testing.assert_array_equal(result.pose, limited(result.pose))


# --- stopping ---------------------------------------------------------------------------------------------------------


@given(
    moves=st.lists(st.tuples(*[st.integers(-4, 4)] * 4), min_size=12, max_size=12),
    window=st.integers(1, 5),
    limits=st.tuples(st.integers(0, 4), st.integers(0, 4)),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_stops_when_the_moving_average_changes_by_less_than_the_tolerance(
    constants, moves: list[tuple[int, ...]], window: int, limits: tuple[int, int]
) -> None:
    """Eq. 20 in its long form, with the means, for two rows of two parameters."""
    steps = np.array(moves, float).reshape(12, 2, 2)
    tolerance = (np.array(limits) + 0.5) / window  # whole steps, so never a tie that rounding would decide
    constants(META_STEP=0, MEMORY=0, WINDOW=window)
    result = minimise(scripted(-steps), np.zeros((2, 2)), 1.0, tolerance, iterations=12)
    for b in range(2):
        states = np.vstack([np.zeros((1, 2)), np.cumsum(steps[:, b], axis=0)])
        stop = 12
        for i in range(window - 1, 12):
            change = np.mean(states[i - window + 1 : i + 1], 0) - np.mean(states[i - window + 2 : i + 2], 0)
            if np.all(np.abs(change) <= tolerance):
                stop = i + 1
                break
        assert result.iterations[b] == stop
        np.testing.assert_array_equal(result.path[-1, b], states[stop])


def test_change_equal_to_the_tolerance_stops(constants) -> None:
    constants(META_STEP=0, MEMORY=0, WINDOW=1)
    gradients = np.full((10, 1, 1), 0.25)
    exact = minimise(scripted(gradients), [[0.0]], 1.0, np.array([0.25]), iterations=10)
    less = minimise(scripted(gradients), [[0.0]], 1.0, np.array([0.25 - 1e-12]), iterations=10)
    assert (exact.iterations[0], less.iterations[0]) == (1, 10)


@pytest.mark.parametrize("window", [1, 3, 50])
def test_returns_the_mean_of_the_last_states(constants, window: int) -> None:
    """All there are where the descent was shorter than the window, the start among them."""
    constants(WINDOW=window)
    gradients = np.random.default_rng(0).normal(size=(9, 2, 2))
    result = minimise(scripted(gradients), np.zeros((2, 2)), 0.1, NEVER, iterations=9)
    np.testing.assert_allclose(result.pose, result.path[-window:].mean(axis=0), atol=1e-15)


# --- batches and bases ------------------------------------------------------------------------------------------------


def test_a_row_does_not_depend_on_other_rows() -> None:
    rng = np.random.default_rng(6)
    B, count = 5, 30
    phases = rng.uniform(0, 2 * np.pi, size=(count, B, 6))
    start = rng.uniform(-3, 3, size=(B, 1))
    tolerance = np.array([0.02])
    company = minimise(rippled(phases), start, 0.05, tolerance, box(-4, 4), iterations=count)
    assert len(set(company.iterations.tolist())) > 2  # some wait for others
    for b in range(B):
        alone = minimise(rippled(phases[:, [b]]), start[[b]], 0.05, tolerance, box(-4, 4), iterations=count)
        n = alone.iterations[0]
        assert n == company.iterations[b]
        np.testing.assert_allclose(alone.path[: n + 1, 0], company.path[: n + 1, b], rtol=1e-12)
        np.testing.assert_array_equal(np.ptp(company.path[n:, b], axis=0), 0)
        np.testing.assert_allclose(alone.pose[0], company.pose[b], rtol=1e-12)


def test_finished_row_is_not_evaluated_again(constants) -> None:
    """Row 0 is done after the first window; what its gradient is from then on must not matter, not even NaN."""
    gradients = np.ones((20, 2, 1))
    gradients[:, 0] = 0
    gradients[5:, 0] = np.nan
    constants(META_STEP=0)
    result = minimise(scripted(gradients), np.full((2, 1), 7.0), 0.1, np.array([0.01]), iterations=20)
    assert result.iterations.tolist() == [3, 20]
    assert result.pose[0, 0] == 7.0


def test_direction_of_a_finished_row_stays_bounded(constants) -> None:
    """Eq. 19 alone would go on: with λ|1 − aH| above 1, v grows without bound where p stands still."""
    directions: list[float] = []

    def evaluate(poses: Float, along: Float, iteration: int) -> Evaluation:
        directions.append(along[0, 0])
        gradient = np.array([[0.0 if iteration else 1e-3], [1.0]])
        return Evaluation(np.zeros(2), gradient, 100 * along)

    constants(META_STEP=0)
    result = minimise(evaluate, np.zeros((2, 1)), 0.1, np.array([1e-3]), iterations=30)
    assert result.iterations.tolist() == [3, 30]
    assert directions[3] != 0
    np.testing.assert_array_equal(directions[3:], directions[3])


def test_parameters_outside_the_basis_do_not_change() -> None:
    rng = np.random.default_rng(8)
    factor = rng.normal(size=(4, 4))
    hessian = factor @ factor.T + np.eye(4)
    centre = rng.normal(size=4)
    start = rng.normal(size=(2, 4))
    free = np.array([[True, True, False, False], [False, True, False, True]])
    bases = np.zeros((2, 4, 4))
    for b in range(2):
        index = np.flatnonzero(free[b])
        bases[b][np.ix_(index, index)] = np.linalg.inv(np.linalg.cholesky(hessian[np.ix_(index, index)])).T
    result = minimise(bowl(hessian, centre), start, 0.5, np.full(4, 1e-9), basis=bases, iterations=60)
    for b in range(2):
        held = ~free[b]
        np.testing.assert_array_equal(np.ptp(result.path[:, b, held], axis=0), 0)
        # the others reach the minimum given those
        gradient = hessian @ (result.pose[b] - centre)
        np.testing.assert_allclose(gradient[free[b]], 0, atol=1e-6)


def test_whitening_basis_makes_any_quadratic_isotropic() -> None:
    """A bowl of condition 10⁵, askew: along its valley the unit vectors' step sizes get nowhere."""
    rng = np.random.default_rng(5)
    axes = rotation(rng, 4)
    hessian = axes @ np.diag([1e3, 30.0, 1.0, 1e-2]) @ axes.T
    centre = rng.normal(size=4)
    start = np.zeros((1, 4))
    tolerance = np.full(4, 1e-9)
    whitening = np.linalg.inv(np.linalg.cholesky(hessian)).T
    round_ = minimise(bowl(hessian, centre), start, 1.0, tolerance, basis=whitening[None], iterations=60)
    plain = minimise(bowl(hessian, centre), start, 1 / np.linalg.norm(hessian, 2), tolerance, iterations=60)
    assert round_.iterations[0] < 30
    np.testing.assert_allclose(round_.pose[0], centre, atol=1e-7)
    assert np.linalg.norm(plain.pose[0] - centre) > 0.1


# --- divergence -------------------------------------------------------------------------------------------------------


def test_divergence_is_an_error_and_a_bound_prevents_it() -> None:
    start = [[30.0, -20.0]]
    with (
        pytest.raises(FloatingPointError, match=r"not finite at iteration \d+, row 0"),
        np.errstate(all="ignore"),
    ):
        minimise(cliff, start, 1.0, np.full(2, 1e-3))
    result = minimise(cliff, start, 1.0, np.full(2, 1e-3), max_step=np.array([0.5, 0.4]), iterations=400)
    assert result.iterations[0] < 400
    np.testing.assert_allclose(result.pose[0], 0, atol=0.1)


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(1e-3, 1e6))
@settings(max_examples=40)
def test_the_bound_scales_an_update_as_a_whole(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    gradients = scale * rng.normal(size=(1, 3, 4))
    basis = rng.normal(size=(3, 4, 4))
    bound = np.array([0.1, 0.2, np.inf, 0.4])
    free, bounded = (
        minimise(scripted(gradients), np.zeros((3, 4)), 0.5, NEVER, basis=basis, max_step=most, iterations=1).path[-1]
        for most in (np.inf, bound)
    )
    factor = np.minimum(1, (bound / np.abs(free)).min(axis=1, keepdims=True))
    np.testing.assert_allclose(bounded, factor * free, rtol=1e-12)


def test_step_sizes_do_not_grow_while_the_bound_holds(constants) -> None:
    """A steep slope, then a gentle one: on the first the bound sets the pace, on the second it is out of the way again,
    and the step size goes on from where it began."""
    gradients = np.array([1e6] * 5 + [0.1]).reshape(6, 1, 1)
    constants(META_STEP=1e-3, MEMORY=0.0)
    path = minimise(scripted(gradients), [[0.0]], 2.0, NEVER, max_step=0.5, iterations=6).path
    moves = -np.diff(path[:, 0, 0])
    np.testing.assert_allclose(moves[:5], 0.5)
    np.testing.assert_allclose(moves[5], 0.1 * 2.0 * (1 + 1e-3 * 0.5 * 0.1))  # eqs. 17, 18 with v = the last move


@pytest.mark.parametrize("which", ["gradient", "hessian_vector"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_gradient_that_is_not_finite_is_an_error(which: str, value: float) -> None:
    def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
        now = Evaluation(np.zeros(3), np.ones((3, 2)), np.zeros((3, 2)))
        if iteration == 4:
            getattr(now, which)[1, 0] = value
        return now

    with pytest.raises(FloatingPointError, match="not finite at iteration 4, row 1, component 0"):
        minimise(evaluate, np.zeros((3, 2)), 0.1, NEVER)
