"""Offsets from sound."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tk.synchronise.sound import RATE, Track, _confirm, hear

LENGTH_S = 16
LATE_S = 2.345


def steps(seed: int, length_s: float = LENGTH_S) -> NDArray[np.float64]:
    """Return footsteps at irregular times."""
    random = np.random.default_rng(seed)
    sound = np.zeros(round(length_s * RATE))
    for time in np.arange(0.5, length_s - 0.5, 0.6) + random.normal(0, 0.05, len(np.arange(0.5, length_s - 0.5, 0.6))):
        at = round(time * RATE)
        sound[at : at + 400] += random.standard_normal(400) * np.exp(-np.arange(400) / 60)
    return sound


def microphone(sound: NDArray[np.float64], seed: int, gain: float = 0.1) -> Track:
    """Return what a microphone records: with an echo and noise."""
    random = np.random.default_rng(seed)
    echo = random.integers(80, 300)
    heard = sound + 0.5 * np.roll(sound, echo) + 0.02 * random.standard_normal(len(sound))
    return Track(0.0, (gain * heard).astype(np.float32))


def test_offset_is_found_to_a_millisecond_despite_echoes_and_gain() -> None:
    sound = steps(0)
    a, b = microphone(sound, 1), microphone(sound[round(LATE_S * RATE) :], 2, gain=0.004)
    ties = hear([a, b])[0, 1].ties
    assert len(ties) >= 2
    assert np.abs([tie.own_i - tie.own_j - LATE_S for tie in ties]).max() < 1e-3


def test_one_clap_is_enough() -> None:
    sound = np.zeros(LENGTH_S * RATE)
    sound[9 * RATE : 9 * RATE + 400] = np.random.default_rng(3).standard_normal(400) * np.exp(-np.arange(400) / 60)
    ties = hear([microphone(sound, 1), microphone(sound[round(LATE_S * RATE) :], 2)])[0, 1].ties
    assert ties and abs(ties[0].own_i - ties[0].own_j - LATE_S) < 1e-3


def test_drift_shows_in_the_windows() -> None:
    sound = steps(0, 60.0)
    slow = np.interp(np.arange(len(sound)) * (1 + 50e-6), np.arange(len(sound)), sound)
    ties = hear([microphone(sound, 1), microphone(slow, 2)])[0, 1].ties
    late = np.polyfit([tie.own_i for tie in ties], [tie.own_i - tie.own_j for tie in ties], 1)
    assert late[0] == pytest.approx(50e-6, abs=8e-6)


def test_steps_late_in_a_long_recording_are_found() -> None:
    """Windows at equal distances meet one or two of the seconds with steps."""
    walked = steps(0, 18.0)
    one = np.concatenate([np.zeros(220 * RATE), walked]).astype(np.float32)
    one += 0.02 * np.random.default_rng(1).standard_normal(len(one)).astype(np.float32)
    other = one[2 * RATE :]
    loud = np.repeat([0.0, 1.0], [220 * RATE // 40, len(walked) // 40])[:, None]
    hits, _ = _confirm(one, other, 2 * RATE, (loud, loud[2 * RATE // 40 :]))
    assert sum(at > 220 * RATE for at, _, _ in hits) >= 4


@pytest.mark.parametrize("kind", ["other", "hum", "noise"])
def test_sound_that_is_not_the_same_is_not_believed(kind: str) -> None:
    if kind == "other":
        one, other = steps(0), steps(9)
    elif kind == "hum":
        hum = 0.3 * np.sin(2 * np.pi * 440 * np.arange(LENGTH_S * RATE) / RATE)
        one, other = hum, hum
    else:
        one, other = (np.zeros(LENGTH_S * RATE) for _ in range(2))
    assert hear([microphone(one, 1), microphone(other, 2)])[0, 1].ties == ()


def test_silence_is_compared_with_nothing() -> None:
    assert hear([None, Track(0.0, np.zeros(RATE * 5, np.float32)), microphone(steps(0), 1)]) == {}
