"""The frames in which other poses are compared, and the probabilities of poses."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tk.trackers.alternatives import APART, apart, probabilities


def chosen(frames: list[int], share: list[float], needed: tuple[int, ...] = ()) -> list[int]:
    must = np.isin(np.arange(len(frames)), needed)
    return apart(np.array(frames), np.array(share), must).tolist()


def test_every_frame_of_a_fast_motion_is_compared() -> None:
    assert chosen([3, 4, 5, 6], [0.6] * 4) == [0, 1, 2, 3]


def test_frames_of_a_slow_motion_are_compared_as_far_apart_as_allowed() -> None:
    step = 0.99 * APART / 3  # three of them say less than the limit, four more
    assert chosen(list(range(10)), [step] * 10) == [0, 3, 6, 9]


@given(st.lists(st.tuples(st.integers(1, 2), st.floats(0.01, 1.0), st.booleans()), min_size=1, max_size=40))
def test_between_compared_frames_little_is_said(rows: list[tuple[int, float, bool]]) -> None:
    gaps, share, must = zip(*rows, strict=True)
    frames, said, needed = np.cumsum(gaps), np.array(share), np.array(must)
    found = apart(frames, said, needed)
    assert (np.diff(found) > 0).all() and found[0] == 0 and found[-1] == len(frames) - 1
    assert set(np.flatnonzero(needed)) <= set(found.tolist())
    for a, b in pairwise(found.tolist()):
        assert b == a + 1 or said[a + 1 : b + 1].sum() <= APART + 1e-9
        assert b == a + 1 or (np.diff(frames[a : b + 1]) == 1).all()


@pytest.mark.parametrize("seed", range(5))
def test_probability_of_a_state_is_that_of_all_paths_through_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = rng.integers(1, 4, size=6)
    costs = [rng.normal(scale=2.0, size=n) for n in count]
    before = [1, *count]
    before[3] = 1  # the velocity is not known in every frame
    steps = [rng.exponential(size=(before[k], count[k], count[k + 1])) for k in range(5)]
    expected = [np.zeros(n) for n in count]
    for path in product(*map(range, count)):
        cost = sum(one[state] for one, state in zip(costs, path, strict=True))
        for k, step in enumerate(steps):
            cost += step[path[k - 1] if len(step) > 1 else 0, path[k], path[k + 1]]
        for one, state in zip(expected, path, strict=True):
            one[state] += np.exp(-cost)
    for found, weight in zip(probabilities(costs, steps), expected, strict=True):
        np.testing.assert_allclose(found, weight / weight.sum(), rtol=1e-9)


def test_costs_of_thousands_are_no_overflow() -> None:
    found = probabilities([np.array([0.0, 1e4]), np.array([0.0, -1e4])], [np.zeros((1, 2, 2))])
    np.testing.assert_allclose(found, [[1.0, 0.0], [0.0, 1.0]], atol=1e-100)
