"""Offsets from flashes and other sudden changes of the light that all cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

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
#: share of an interval in which an image takes up light, exposure and readout of a rolling shutter; unknown, 0.3 to 1
_OPEN = 0.6
#: standard deviation of the time of a change between two images, and within one, of an interval, with that unknown
_BETWEEN, _WITHIN = 0.2, 0.12


@dataclass(frozen=True)
class Event:
    """A sudden change: own time, its standard deviation, both seconds, and the change, grey levels."""

    own_s: float
    sigma_s: float
    change: float


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
        last = k  # a change that two images share
        if k + 1 < len(steps) and np.sign(steps[k + 1]) == np.sign(steps[k]) and abs(steps[k + 1]) > 3 * common:
            last = k + 1
        if (event := _event(look, k, last)) is not None:
            events.append(event)
        k = last + 1
    return events


def _event(look: Look, first: int, last: int) -> Event | None:
    """Return the event of the changes ``first`` to ``last``; None if only a part of the image changes."""
    before, after = look.greys[first].astype(np.float32), look.greys[last + 1].astype(np.float32)
    change = float((after - before).mean())
    if change > 0 and float((after - before > change / 2).mean()) < _SHARE:
        return None
    if change < 0 and float((after - before < change / 2).mean()) < _SHARE:
        return None
    interval = float(look.times_s[first + 1] - look.times_s[first])
    if last == first:  # the light changed between the exposures
        return Event(float(look.times_s[first + 1]) - (1 - _OPEN) / 2 * interval, _BETWEEN * interval, change)
    lit = float((look.brightness[first + 1] - look.brightness[first]) / change)
    own = float(look.times_s[first + 1]) + _OPEN * float(1 - np.clip(lit, 0, 1)) * interval
    return Event(own, _WITHIN * interval, change)


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
            tolerance = 3.5 * float(np.hypot(a.sigma_s, near.sigma_s))
            if abs(a.own_s - near.own_s - lag) < tolerance and np.sign(a.change) == np.sign(near.change):
                pairs.append((a, near))
        return pairs

    tried = [(fitting(a.own_s - b.own_s), a.own_s - b.own_s) for a in one for b in other]
    best, lag = max(tried, key=lambda each: (len(each[0]), sum(abs(a.change * b.change) ** 0.5 for a, b in each[0])))
    width = 4 * max(event.sigma_s for event in (*one, *other))
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
    return [Tie(i, j, a.own_s, b.own_s, float(np.hypot(a.sigma_s, b.sigma_s)), "flash") for a, b in best]
