"""The frames in which other poses are compared."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tk.trackers.alternatives import APART, apart


def chosen(frames: list[int], share: list[float], needed: tuple[int, ...] = ()) -> list[int]:
    must = np.isin(np.arange(len(frames)), needed)
    return apart(np.array(frames), np.array(share), must).tolist()


def test_every_frame_of_a_fast_motion_is_compared() -> None:
    assert chosen([3, 4, 5, 6], [0.6] * 4) == [0, 1, 2, 3]


def test_frames_of_a_slow_motion_are_compared_as_far_apart_as_allowed() -> None:
    step = 0.99 * APART / 3  # three of them say less than the limit, four more
    assert chosen(list(range(10)), [step] * 10) == [0, 3, 6, 9]


def test_needed_frames_and_the_ends_of_stretches_are_compared() -> None:
    frames = [0, 1, 2, 3, 4, 8, 9, 10]
    assert chosen(frames, [0.01] * 8, needed=(2,)) == [0, 2, 4, 5, 7]


def test_a_single_frame_is_compared() -> None:
    assert chosen([7], [1.0]) == [0]


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
