"""Clocks from ties."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.synchronise.scenes import ring, wander, watch
from tk.synchronise.decide import timecode_ties
from tk.synchronise.raw import Recording
from tk.synchronise.ties import RATE_SIGMA, Tie, solve
from tk.synchronise.travel import SOUND_M_S, without_travel_time

OFFSETS = [0.0, 12.5, -3.25, 40.0]


def ties(rates: list[float] | None = None, sigma_s: float = 0.001, kind: str = "flash") -> list[Tie]:
    """Return exact ties of four cameras at two instants, 100 s apart."""
    rates = rates or [1.0] * 4
    found = []
    for time in (50.0, 150.0):
        own = [(time - offset) / rate for offset, rate in zip(OFFSETS, rates, strict=True)]
        found += [Tie(i, j, own[i], own[j], sigma_s, kind) for i in range(4) for j in range(i + 1, 4)]
    return found


def test_offsets_and_rates_are_recovered() -> None:
    clocks = solve(4, ties([1.0, 1.00004, 0.99998, 1.0], 1e-4))
    assert clocks.offsets_s == pytest.approx(OFFSETS, abs=1e-4)
    assert clocks.rates == pytest.approx([1.0, 1.00004, 0.99998, 1.0], abs=3e-7)
    assert (clocks.rate_sigma < 5e-6).all()


def test_rate_that_nothing_determines_is_one() -> None:
    clocks = solve(4, ties(sigma_s=0.02)[:6])
    assert (clocks.rates == pytest.approx(1.0, abs=1e-9)) and clocks.rate_sigma[1:] == pytest.approx(
        RATE_SIGMA, rel=1e-3
    )
    assert clocks.offsets_s == pytest.approx(OFFSETS, abs=1e-6)


def test_pair_that_contradicts_the_others_is_dropped() -> None:
    wrong = [Tie(1, 3, tie.own_i + 0.3, tie.own_j, tie.sigma_s, tie.kind) if (tie.i, tie.j) == (1, 3) else tie
             for tie in ties()]  # fmt: skip
    clocks = solve(4, wrong)
    assert clocks.dropped == ((1, 3, "flash"),)
    assert clocks.offsets_s == pytest.approx(OFFSETS, abs=1e-5)


def test_camera_without_ties_is_not_connected() -> None:
    clocks = solve(4, [tie for tie in ties() if 3 not in (tie.i, tie.j)])
    assert clocks.connected.tolist() == [True, True, True, False]


def test_sigma_of_sound_holds_the_way_of_the_sound_and_the_device() -> None:
    sound, flash = solve(4, ties(kind="sound")), solve(4, ties(kind="flash"))
    assert sound.offset_sigma_s[1] > 0.01 > flash.offset_sigma_s[1]


def test_timecode_passes_midnight() -> None:
    codes = (86399.5, 0.7)
    both = [
        Recording(f"cam{c}", (Path("v"),), (0.0,), np.arange(50) / 25, 64, 48, timecode_s=code)
        for c, code in enumerate(codes)
    ]
    (tie,) = timecode_ties(both)
    assert tie.own_i - tie.own_j == pytest.approx(1.2)


def test_skew_between_sound_and_pictures_does_not_move_the_clocks() -> None:
    late = [Tie(t.i, t.j, t.own_i + 0.03 * (t.i == 2), t.own_j + 0.03 * (t.j == 2), t.sigma_s, "sound") for t in ties()]
    clocks = solve(4, [*late, *ties()])
    assert clocks.offsets_s == pytest.approx(OFFSETS, abs=1e-3)


def test_known_cameras_correct_the_travel_time_of_sound_from_what_moves() -> None:
    cameras, path, aside = ring(3), wander(0), np.array([1.0, 0, 0])
    looks = [watch(camera, [lambda times: path(times) + aside], 0.0, 8.0, 10.0) for camera in cameras]
    source = path(np.linspace(3, 5, 9)).mean(axis=0) + aside
    way = np.array([np.linalg.norm(camera.center - source) for camera in cameras]) / SOUND_M_S
    heard = [Tie(i, j, 4.0 + way[i], 4.0 + way[j], 0.001, "sound") for i, j in ((0, 1), (0, 2))]
    ties = without_travel_time(heard, cameras, looks)
    before, after = (max(abs(tie.own_i - tie.own_j) for tie in each) for each in (heard, ties))
    assert after < 0.0015 and before > 0.003
