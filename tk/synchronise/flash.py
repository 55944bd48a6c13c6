"""Offsets from flashes and other sudden changes of the light that all cameras see.

The images about a change show the share of their exposures that saw the light, which gives the instant of the change if
the length of the exposure is known. The length, with the readout of a rolling shutter, is unknown, and the same at all
changes of a camera: the likelihood of an offset is summed over all lengths. A time stamp counts as the middle of the
exposure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tk.io.captures.timing import image_interval
from tk.synchronise.looks import Look
from tk.synchronise.ties import Tie

Float = NDArray[np.float64]

#: a change counts as sudden if it is so many times the common change from image to image, and above these grey levels
_TIMES_COMMON, _LEAST = 8.0, 4.0
#: share of the image that becomes brighter, or darker, by half the mean change: light, not somebody near a camera
_SHARE = 0.5
#: most changes of a recording that are compared; a disco is none
_MOST_EVENTS = 12
#: a lone change convinces if it is so many times the second largest of the camera; a change continues in the image
#: before or after if that changes the same way by so many times the common change
_CLEARLY = 3.0
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
        along = steps * np.sign(steps[k]) > _CLEARLY * common
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
    return Event(own, image_interval(look.times_s), change, times, lit, sigma)


def compare_events(looks: Sequence[Look]) -> list[Tie]:
    """Return ties of the cameras whose sudden changes of light fit together."""
    events = [find_events(look) for look in looks]
    links: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in combinations(range(len(looks)), 2):
        if 0 < len(events[i]) <= _MOST_EVENTS and 0 < len(events[j]) <= _MOST_EVENTS:
            links[i, j] = _match(events[i], events[j])
    ties: list[Tie] = []
    changes = _same_changes(links)
    first = {k: min(events[c][n].own_s for c, n in change.items()) for k, change in enumerate(changes)}
    for _, group in groupby(sorted(first, key=lambda k: first[k]), lambda k: first[k] // _TOGETHER_S):
        ties += ties_of_changes([{c: events[c][n] for c, n in changes[k].items()} for k in group])
    return ties


def _same_changes(links: Mapping[tuple[int, int], Sequence[tuple[int, int]]]) -> list[dict[int, int]]:
    """Return for each change of the light the number of its event in each camera, from those that match in pairs."""
    found: list[dict[int, int]] = []
    for (i, j), matches in links.items():
        for n, m in matches:
            one = next((each for each in found if each.get(i) == n), None)
            other = next((each for each in found if each.get(j) == m), None)
            if one is None and other is None:
                found.append({i: n, j: m})
            elif one is None or other is None:
                known = one if other is None else other
                assert known is not None
                known.setdefault(i, n)
                known.setdefault(j, m)
            elif one is not other:
                found.remove(other)
                one.update({c: k for c, k in other.items() if c not in one})
    return found


def _match(one: Sequence[Event], other: Sequence[Event]) -> list[tuple[int, int]]:
    """Return the events of two cameras at the lag at which most fit, by their numbers; none if another lag is as good,
    or if a single change does not stand out."""

    def fitting(lag: float) -> list[tuple[int, int]]:
        pairs = []
        for n, a in enumerate(one):
            m = min(range(len(other)), key=lambda m: abs(a.own_s - other[m].own_s - lag))
            near = other[m]
            same = np.sign(a.change) == np.sign(near.change)
            if abs(a.own_s - near.own_s - lag) < (a.gap_s + near.gap_s) / 2 and same:
                pairs.append((n, m))
        return pairs

    def strength(pairs: Sequence[tuple[int, int]]) -> tuple[int, float]:
        return len(pairs), sum(abs(one[n].change * other[m].change) ** 0.5 for n, m in pairs)

    tried = [(fitting(a.own_s - b.own_s), a.own_s - b.own_s) for a in one for b in other]
    best, lag = max(tried, key=lambda each: strength(each[0]))
    width = 2 * max(event.gap_s for event in (*one, *other))
    second = max((len(pairs) for pairs, at in tried if abs(at - lag) > width), default=0)
    if best and (len(best) <= second or len(best) < 2):
        for event, events in ((one[best[0][0]], one), (other[best[0][1]], other)):
            rest = [abs(each.change) for each in events if abs(each.own_s - event.own_s) > 0.5]
            if abs(event.change) <= _CLEARLY * max(rest, default=0.0):
                return []
    return best


def ties_of_changes(changes: Sequence[Mapping[int, Event]]) -> list[Tie]:
    """Return a tie of each two cameras that some changes of the light give together."""
    ties = []
    for i, j in combinations(sorted(set[int]().union(*changes)), 2):
        both = [(change[i], change[j]) for change in changes if i in change and j in change]
        if both:
            ties.append(_tie(i, j, both))
    return ties


def _tie(i: int, j: int, both: Sequence[tuple[Event, Event]]) -> Tie:
    """Return the tie of two cameras by changes that both saw: mean and deviation of the likelihood of its lag, which is
    summed over the instants of the changes and over the lengths of both exposures."""
    own_i, own_j = np.mean([[a.own_s, b.own_s] for a, b in both], axis=0).tolist()
    every = [event for pair in both for event in pair]
    step = min(event.interval_s for event in every) / _STEPS
    reach = round(2 * max(event.gap_s for event in every) / step)
    lags, wide = step * np.arange(-reach, reach + 1), step * np.arange(-2 * reach, 2 * reach + 1)
    log: Float | float = 0.0
    for a, b in both:
        middle = (a.own_s + b.own_s + own_i - own_j) / 2
        later = sliding_window_view(b.likelihood(middle - own_i + own_j + wide), len(lags), axis=1)
        log = log + np.log(np.tensordot(a.likelihood(middle + lags), later, (1, 2)) + 1e-300)
    density = np.exp(log - np.max(log)).sum(axis=(0, 1))
    density /= density.sum()
    mean = float(density @ lags)
    sigma = float(np.sqrt(density @ (lags - mean) ** 2 + step**2))
    return Tie(i, j, own_i - mean, own_j, sigma, "flash")
