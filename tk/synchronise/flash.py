"""Offsets from flashes and other sudden changes of the light that all cameras see.

The images about a change show the share of their exposures that saw the light, which gives the instant of the change if
the length of the exposure is known. The length, with the readout of a rolling shutter, is unknown, and the same at all
changes of a camera: the likelihood of an offset is summed over all lengths. A time stamp counts as the middle of the
exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, groupby

import numpy as np
from numpy.typing import NDArray

from tk.synchronise.looks import Look
from tk.synchronise.ties import Tie

Float = NDArray[np.float64]

#: a change counts as sudden if it is so many times the common change from image to image, and above these grey levels
_TIMES_COMMON, _LEAST = 8.0, 4.0
#: share of the image that becomes brighter, or darker, by half the mean change: light, not somebody near a camera
_SHARE = 0.5
#: most changes of a recording that are compared; a disco is none
_MOST_EVENTS = 12
#: a lone change convinces if it is so many times the second largest of the camera
_LONE = 3.0
#: a change continues in the image before or after if that changes the same way by so many times the common change
_CONTINUES = 3.0
#: standard deviation of the share of an exposure that saw the light: rows that are read later, and the gamma of cameras
_SHARE_SIGMA = 0.1
#: seconds of changes that give one offset: clocks drift apart by 2 ms at most
_TOGETHER_S = 30.0
#: samples of an interval, and lengths of the exposure as shares of a camera's interval, in the likelihood
_STEPS, _LENGTHS = 60, np.linspace(0.1, 1.0, 10)


@dataclass(frozen=True)
class Event:
    """A sudden change of the light.

    Attributes:
        own_s: its own time, seconds, within half of an interval.
        interval_s: of the camera's images, seconds.
        change: grey levels.
        times_s: (M,) own times of the images about the change.
        lit: (M,) share of their exposures after the change; 0 for the first, 1 for the last.
        sigma: standard deviation of these shares.
    """

    own_s: float
    interval_s: float
    change: float
    times_s: Float
    lit: Float
    sigma: float

    @property
    def gap_s(self) -> float:
        """Longest interval of the images about the change, seconds."""
        return float(np.diff(self.times_s).max())

    def likelihood(self, times: Float) -> Float:
        """Return (E, N) for each length of the exposure, the likelihood that the light changed at own times (N,)."""
        open_s = (_LENGTHS * self.interval_s)[:, None, None]
        lit = np.clip(0.5 + (self.times_s - times[:, None]) / open_s, 0.0, 1.0)
        return np.asarray(np.exp(-0.5 * (((self.lit - lit) / self.sigma) ** 2).sum(axis=2)))


def find_events(look: Look) -> list[Event]:
    """Return the sudden changes of the light of a recording, in order."""
    steps = np.diff(look.brightness)
    common = 1.4826 * float(np.median(np.abs(steps - np.median(steps)))) + 0.05
    large = np.abs(steps) > max(_TIMES_COMMON * common, _LEAST)
    events = []
    k = 0
    while k < len(steps):
        if not large[k]:
            k += 1
            continue
        first = last = k  # up to three steps: images that saw the light for a part of their exposure
        along = steps * np.sign(steps[k]) > _CONTINUES * common
        first -= k > 0 and bool(along[k - 1]) and not large[k - 1]
        last += k + 1 < len(steps) and bool(along[k + 1])
        if (event := _event(look, first, last, common)) is not None:
            events.append(event)
        k = last + 1
    return events


def _event(look: Look, first: int, last: int, common: float) -> Event | None:
    """Return the event of the changes ``first`` to ``last``; None if only a part of the image changes. ``common``: the
    common change, grey levels."""
    before, after = look.greys[first].astype(np.float32), look.greys[last + 1].astype(np.float32)
    change = float((after - before).mean())
    if change == 0 or float(((after - before) * np.sign(change) > abs(change) / 2).mean()) < _SHARE:
        return None
    near = slice(first, last + 2)
    times, lit = look.times_s[near], np.clip((look.brightness[near] - look.brightness[first]) / change, 0.0, 1.0)
    partly = (lit * (1 - lit)).argmax()  # the image that saw most of the change
    own = float(times[partly]) if last > first else float(times.mean())
    sigma = float(np.hypot(_SHARE_SIGMA, common / change))
    return Event(own, float(np.median(np.diff(look.times_s))), change, times, lit, sigma)


def compare_events(looks: Sequence[Look]) -> list[Tie]:
    """Return ties of the cameras whose sudden changes of light fit together."""
    events = [find_events(look) for look in looks]
    ties = []
    for i, j in combinations(range(len(looks)), 2):
        if not 0 < len(events[i]) <= _MOST_EVENTS or not 0 < len(events[j]) <= _MOST_EVENTS:
            continue
        ties += _match(i, j, events[i], events[j])
    return ties


def _match(i: int, j: int, one: Sequence[Event], other: Sequence[Event]) -> list[Tie]:
    """Return the ties of the lag at which most changes of two cameras fit; none if another lag is as good, or if a
    single change does not stand out."""

    def fitting(lag: float) -> list[tuple[Event, Event]]:
        pairs = []
        for a in one:
            near = min(other, key=lambda b: abs(a.own_s - b.own_s - lag))
            if abs(a.own_s - near.own_s - lag) < (a.gap_s + near.gap_s) / 2 and np.sign(a.change) == np.sign(
                near.change
            ):
                pairs.append((a, near))
        return pairs

    tried = [(fitting(a.own_s - b.own_s), a.own_s - b.own_s) for a in one for b in other]
    best, lag = max(tried, key=lambda each: (len(each[0]), sum(abs(a.change * b.change) ** 0.5 for a, b in each[0])))
    width = 2 * max(event.gap_s for event in (*one, *other))
    second = max((len(pairs) for pairs, at in tried if abs(at - lag) > width), default=0)
    if not best:
        return []
    if len(best) <= second or len(best) < 2:
        rises = [
            sorted((abs(e.change) for e in events if abs(e.own_s - best[0][k].own_s) > 0.5), reverse=True)
            for k, events in enumerate((one, other))
        ]
        lone = all(abs(best[0][k].change) > _LONE * (rest[0] if rest else 0.0) for k, rest in enumerate(rises))
        if not lone:
            return []
    groups = groupby(best, lambda pair: pair[0].own_s // _TOGETHER_S)
    return [_tie(i, j, list(group), lag) for _, group in groups]


def _tie(i: int, j: int, pairs: Sequence[tuple[Event, Event]], lag_s: float) -> Tie:
    """Return the tie of some changes whose offset is near ``lag_s``: mean and deviation of their likelihood."""
    step = min(min(a.interval_s, b.interval_s) for a, b in pairs) / _STEPS
    reach = 2 * max(max(a.gap_s, b.gap_s) for a, b in pairs)
    grid = np.arange(-reach, reach, step)
    total = np.zeros((len(_LENGTHS), len(_LENGTHS), 2 * len(grid)))
    for a, b in pairs:
        times = a.own_s + grid
        one = np.fft.rfft(a.likelihood(times), 2 * len(grid))
        other = np.fft.rfft(b.likelihood(times - lag_s), 2 * len(grid))
        both = np.fft.irfft(one[:, None] * np.conj(other[None]), 2 * len(grid))
        total += np.log(np.maximum(both, 1e-12))
    density = np.exp(total - total.max()).sum(axis=(0, 1))
    lags = step * ((np.arange(len(density)) + len(grid)) % len(density) - len(grid))
    mean = float((density * lags).sum() / density.sum())
    sigma = float(np.sqrt((density * (lags - mean) ** 2).sum() / density.sum() + step**2))
    own = float(np.mean([a.own_s for a, _ in pairs]))
    return Tie(i, j, own, own - lag_s - mean, sigma, "flash")
