"""Offsets from what moves, and from changes of the light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.synchronise.scenes import ring, wander, watch
from tk.synchronise.empty import find_empty
from tk.synchronise.flash import compare_events
from tk.synchronise.looks import GRID_HZ, Look
from tk.synchronise.person import align, compare_planes, compare_signals, signals_of
from tk.synchronise.run import is_mirrored
from tk.synchronise.ties import Clocks, solve

STARTS = [0.0, 3.217, 1.1]


@pytest.fixture(scope="module")
def looks() -> list[Look]:
    paths = [wander(0), wander(1)]
    return [
        watch(camera, paths, start, 14.0, fps, seed=c)
        for c, (camera, start, fps) in enumerate(zip(ring(3), STARTS, (25.0, 25.0, 20.0), strict=True))
    ]


def test_known_cameras_give_offsets_to_some_milliseconds(looks: list[Look]) -> None:
    aligned = align(compare_planes(looks, ring(3)), 3, [0.04, 0.04, 0.05], "cameras")
    assert aligned.groups == ({0, 1, 2},)
    assert solve(3, aligned.ties).offsets_s == pytest.approx(STARTS, abs=0.005)


def test_unknown_cameras_give_offsets_to_a_frame(looks: list[Look]) -> None:
    for pair in compare_signals([signals_of(look) for look in looks]):
        lag_s = (pair.first + int(np.argmax(pair.z))) / GRID_HZ
        offset_s = STARTS[pair.j] - STARTS[pair.i]
        assert pair.start_i - pair.start_j + lag_s == pytest.approx(offset_s, abs=0.05)


def test_two_groups_that_nothing_connects_are_not_certain_with_each_other() -> None:
    scenes = [[wander(0), wander(1)], [wander(0), wander(1)], [wander(7), wander(8)], [wander(7), wander(8)]]
    four = [watch(c, scene, 0.0, 12.0, 15.0, k) for k, (c, scene) in enumerate(zip(ring(4), scenes, strict=True))]
    aligned = align(compare_planes(four, ring(4)), 4, [0.067] * 4, "cameras")
    assert set(aligned.groups) == {frozenset({0, 1}), frozenset({2, 3})}
    assert {(tie.i, tie.j) for tie in aligned.ties} == {(0, 1), (2, 3)}


def test_somebody_else_is_not_believed(looks: list[Look]) -> None:
    other = watch(ring(3)[1], [wander(7), wander(8)], 50.0, 14.0, 25.0)
    three = [looks[0], other, looks[2]]
    for kind, pairs in (
        ("cameras", compare_planes(three, ring(3))),
        ("person", compare_signals([signals_of(look) for look in three])),
    ):
        assert not align(pairs, 3, [0.04, 0.04, 0.05], kind).sure(1)


def test_mirrored_camera_is_recognised(looks: list[Look]) -> None:
    mirrored = replace(looks[1], greys=np.ascontiguousarray(looks[1].greys[:, :, ::-1]))
    three = [looks[0], mirrored, looks[2]]
    pairs, intervals = compare_planes(three, ring(3)), [0.04, 0.04, 0.05]
    assert not align(pairs, 3, intervals, "cameras").sure(1)
    assert is_mirrored(1, three, ring(3), pairs, intervals)


def lamp(start_s: float, changes: list[float], fps: float = 25.0, seed: int = 0) -> Look:
    """Return images of a room in which a lamp is switched on and off at common times."""
    own = np.arange(round(8 * fps)) / fps
    on, off = np.array(changes[::2]), np.array(changes[1::2])
    open_s = 0.6 / fps
    begin = start_s + own[:, None] - open_s / 2
    light = np.clip(np.minimum(begin + open_s, off) - np.maximum(begin, on), 0, None).sum(axis=1) / open_s
    images = 80 + 40 * light[:, None, None] + np.random.default_rng(seed).normal(0, 2, (len(own), 45, 80))
    return Look(own, np.clip(images, 0, 255).astype(np.uint8))


def test_lamp_that_is_switched_gives_an_offset_within_a_frame() -> None:
    changes = [3.013, 3.571, 5.12, 5.9]
    ties = compare_events([lamp(0.0, changes), lamp(1.234, changes, seed=1)])
    clocks = solve(2, ties)
    assert clocks.offsets_s[1] == pytest.approx(1.234, abs=0.01)
    assert clocks.offset_sigma_s[1] < 0.01


def test_unequal_lights_are_not_matched() -> None:
    assert compare_events([lamp(0.0, [2.0, 2.7, 4.1, 5.9]), lamp(0.0, [1.1, 3.0, 3.5, 6.9])]) == []


def clocks(count: int) -> Clocks:
    zero = np.zeros(count)
    return Clocks(zero, zero + 1, zero, zero)


@pytest.mark.parametrize("there", [False, True])
def test_empty_part_is_found_and_somebody_who_stands_still_is_not_taken_for_one(there: bool) -> None:
    path = wander(3)

    def still_first(times: np.ndarray) -> np.ndarray:
        world = path(np.maximum(times, 4.0))
        world[times < 4.0] = world[-1] * 0 + path(np.array([4.0])) if there else [0.0, 0.0, 30.0]
        return world

    looks = [watch(camera, [still_first], 0.0, 12.0, 15.0, seed=c) for c, camera in enumerate(ring(3))]
    found = find_empty(looks, clocks(3))
    if there:
        assert found is None
    else:
        assert found is not None and 0 <= found[0] < 1 and 3 < found[1] < 4
