"""What is wrong with a camera although its offset seems certain: the pictures say it.

A video may run at another speed, miss a part, have its chapters in another order, or belong to another camera of the
calibration. Then an offset fits a part of it, or its sound only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera
from tk.synchronise.empty import runs
from tk.synchronise.lags import correlate
from tk.synchronise.looks import GRID_HZ, SOMEBODY, Look
from tk.synchronise.person import DOUBT, NEAR_S, common_deviation, planes_sum, rays_of, shared_planes
from tk.synchronise.raw import SHORTEST_S, Recording
from tk.synchronise.sound import Heard
from tk.synchronise.ties import Clocks, Tie

Float = NDArray[np.float64]
#: own time of the first sample, seconds, and samples (N, F), as :func:`tk.synchronise.person.signals_of` returns them
Signals = tuple[float, Float]

#: rates that files say, and with which cameras record, 1/s: all common ones; one more (100) changed no answer
_RATES = (24, 25, 30, 50, 60, 120, 240)
#: how many times slower a video may be played than it was recorded
_SPEEDS = sorted({recorded / said for said in _RATES for recorded in _RATES if recorded != said})
#: seconds in which motion is summed to compare places.
_BIN_S = 0.25
#: least probability of what no line questions. Right videos of four cameras and more reached it in all folders of 11 s
#: and more, those of two and three cameras in 57 of 95 sets; exchanged ones in none.
SURE = 0.999


def other_speed_or_order(
    recordings: Sequence[Recording], signals: Sequence[Signals], clocks: Clocks, ties: Sequence[Tie]
) -> dict[int, str]:
    """Return why the motion of a camera fits the others at another speed, or in a part at another lag only: the camera
    that contradicts most, if one does. Where cameras are not synchronised, the fault is in one of these.

    A part in which a sound fits the others is where it belongs: rhythms repeat, sounds do not.

    Args:
        recordings: the cameras.
        signals: the motion in their images.
        clocks: those of the cameras that are synchronised.
        ties: those that the methods are certain of.
    """
    found: list[tuple[float, int, str]] = []
    for c in np.flatnonzero(~clocks.connected).tolist() or range(len(recordings)):
        recording = recordings[c]
        compared = _with_others(c, signals, clocks)
        if compared is None:
            continue
        reference, own, own_start, expected = compared
        others = [each.name for k, each in enumerate(recordings) if k != c and clocks.connected[k]]
        whose = "the others" if len(others) > 1 else others[0]
        least = _least(reference, own, expected)
        compared_at = {speed: _compare(reference, own, speed, least) for speed in (1.0, *_SPEEDS)}
        probability, speed = _fits(compared_at, expected)
        if probability < DOUBT and speed != 1.0:
            fps = 1 / recording.interval_s
            how = f"{speed:.3g} times slower" if speed > 1 else f"{1 / speed:.3g} times faster"
            text = (
                f"its motion is {how} than that of {whose}: its file says {fps:.3g} images/s, the camera may have "
                f"taken {fps * speed:.3g}; give the file the right rate, or record without slow motion"
            )
            found.append((probability, c, text))
        if expected is None:
            continue
        heard = _heard(c, clocks, ties)
        for part in _parts(recording, own_start, len(own)):
            first, last = _samples(part, own_start, len(own))
            if last - first <= SHORTEST_S * GRID_HZ or any(part[0] < at < part[1] for at in heard):
                continue
            probability, lag = _part_fits(reference, own[first:last], expected + first)
            if probability < DOUBT:
                begin, end = (own_start + at / GRID_HZ for at in (first, last))
                found.append((probability, c, other_order((lag - expected - first) / GRID_HZ, begin, end)))
    return {c: text for _, c, text in [min(found)]} if found else {}


def unchecked_chapters(
    recordings: Sequence[Recording], signals: Sequence[Signals], clocks: Clocks, ties: Sequence[Tie]
) -> list[str]:
    """Return a line for each camera with chapters whose place neither a sound nor the motion in them confirms."""
    lines = []
    for c, recording in enumerate(recordings):
        compared = _with_others(c, signals, clocks) if len(recording.paths) > 1 else None
        if compared is None:
            continue
        reference, own, own_start, expected = compared
        if expected is None:
            continue
        heard = _heard(c, clocks, ties)
        shared = [_span(recordings[k], clocks, k) for k in np.flatnonzero(clocks.connected).tolist() if k != c]
        unsure = []
        for path, (begin, end) in zip(recording.paths, pairwise([*recording.begins_s, recording.span[1]]), strict=True):
            low, high = clocks.common(c, begin) + recording.interval_s, clocks.common(c, end) - recording.interval_s
            if any(begin < at < end for at in heard) or not any(one < high and other > low for one, other in shared):
                continue  # a sound confirms it, or no other camera recorded at that time
            first, last = _samples((begin, end), own_start, len(own))
            if _part_fits(reference, own[first:last], expected + first)[0] < SURE:
                unsure.append(path.name)
        if unsure:
            lines.append(
                f"{recording.where}: nothing confirms when {', '.join(unsure)} was recorded: its sound and its motion "
                "there are too short, or missing; look at these pictures with tk inspect"
            )
    return lines


def other_order(apart_s: float, begin_s: float, end_s: float) -> str:
    """Return why a part of a video, own times, fits the others later or earlier than the rest."""
    return (
        f"what it shows from {begin_s:.1f} s to {end_s:.1f} s fits the others {abs(apart_s):.1f} s "
        f"{'later' if apart_s > 0 else 'earlier'} than the rest: a part of the recording is missing, or its chapters "
        "are in another order; copy all files again, and name chapters in their order"
    )


def sound_in_other_order(heard: Mapping[tuple[int, int], Heard]) -> dict[int, str]:
    """Return why a part of a camera's sound fits at another offset: the camera in most such pairs, if these are more
    than half of its pairs."""
    jumps = {pair: each.jump for pair, each in heard.items() if each.jump is not None}
    counts = Counter(c for pair in jumps for c in pair)
    if not counts:
        return {}
    c = max(counts, key=lambda c: (counts[c], c))
    if 2 * counts[c] <= sum(c in pair for pair in heard):
        return {}
    (_, j), jump = next((pair, jump) for pair, jump in jumps.items() if c in pair)
    return {c: other_order(jump.apart_s, *jump.own_j) if c == j else other_order(-jump.apart_s, *jump.own_i)}


def _mean(signals: Sequence[tuple[float, Float]]) -> tuple[float, Float]:
    """Return the common time of the first sample, and the mean of signals that begin at common times."""
    begin = min(start for start, _ in signals)
    firsts = [round((start - begin) * GRID_HZ) for start, _ in signals]
    count = max(first + len(samples) for first, (_, samples) in zip(firsts, signals, strict=True))
    total = np.zeros((count, signals[0][1].shape[1] + 1))
    for first, (_, samples) in zip(firsts, signals, strict=True):
        total[first : first + len(samples), :-1] += samples
        total[first : first + len(samples), -1] += 1
    return begin, np.asarray(total[:, :-1] / np.maximum(total[:, -1:], 1))


def _least(reference: Float, own: Float, expected: int | None) -> int:
    """Return how many samples both signals must have in common at a lag that may be the right one: half of those at the
    expected lag. Where nothing moves all signals are alike, so a second or two of a start or an end fits anywhere."""
    shared = 0 if expected is None else min(len(reference), expected + len(own)) - max(0, expected)
    return max(round(SHORTEST_S * GRID_HZ), shared // 2)


def _compare(reference: Float, own: Float, speed: float, least: int) -> tuple[NDArray[np.int64], Float]:
    """Return lags and their significances, of a signal that is played faster by ``speed``; 0 where fewer samples than
    ``least`` are in common."""
    count = int(len(own) / speed)
    if min(count, len(reference)) < least:
        return np.zeros(0, np.int64), np.zeros(0)
    if speed != 1.0:
        at = np.arange(count) * speed
        own = np.stack([np.interp(at, np.arange(len(own)), column) for column in own.T], axis=1)
        own = own - own.mean(axis=0)
    lags, _, z = correlate(reference, own, least)
    return lags, np.where(np.isfinite(z), z, 0.0)


def _with_others(c: int, signals: Sequence[Signals], clocks: Clocks) -> tuple[Float, Float, float, int | None] | None:
    """Return the mean motion of the other cameras, that of one, the own time of its first sample, and the lag at which
    the clocks expect it, None without one; None without other cameras."""
    others = [k for k in np.flatnonzero(clocks.connected).tolist() if k != c]
    if not others:
        return None
    start, reference = _mean([(clocks.common(k, signals[k][0]), signals[k][1]) for k in others])
    own_start, own = signals[c]
    expected = round((clocks.common(c, own_start) - start) * GRID_HZ) if clocks.connected[c] else None
    return reference, own, own_start, expected


def _part_fits(reference: Float, part: Float, expected: int) -> tuple[float, int]:
    """Return the probability of the expected lag of a part, 0.5 if it is too short, and the most probable lag."""
    lags, z = _compare(reference, part - part.mean(axis=0), 1.0, _least(reference, part, expected))
    if not len(z):
        return 0.5, expected
    return _fits({1.0: (lags, z)}, expected)[0], int(lags[np.argmax(z)])


def _span(recording: Recording, clocks: Clocks, c: int) -> tuple[float, float]:
    """Return the common time at which a recording begins and ends."""
    return clocks.common(c, recording.span[0]), clocks.common(c, recording.span[1])


def _fits(compared: dict[float, tuple[NDArray[np.int64], Float]], expected: int | None) -> tuple[float, float]:
    """Return the probability of the file's own speed and the expected lag, any lag if that is None, and the most
    probable speed. Where nothing can be compared, the probability is 1."""
    lags, z = compared[1.0]
    if not len(z):
        return 1.0, 1.0
    common = common_deviation(z)
    near = z if expected is None else z[np.abs(lags - expected) <= round(NEAR_S * GRID_HZ)]
    near = near if near.any() else np.zeros(1)  # too little in common at this lag
    log = {speed: np.maximum(each / common, 0.0) ** 2 / 2 for speed, (_, each) in compared.items() if len(each)}
    best = max(log, key=lambda speed: float(log[speed].max()))
    highest = float(log[best].max())
    total = sum(float(np.exp(each - highest).sum()) for each in log.values())
    return float(np.exp(np.maximum(near / common, 0.0) ** 2 / 2 - highest).sum()) / total, best


def _parts(recording: Recording, own_start: float, count: int) -> list[tuple[float, float]]:
    """Return the own times, seconds, at which parts of a recording begin and end: its chapters, or two parts that meet
    in the middle of the ``count`` samples if no chapter begins in these."""
    own_end = own_start + count / GRID_HZ
    edges = [*recording.begins_s, recording.span[1]]
    if not any(own_start < edge < own_end for edge in edges[1:-1]):
        edges = sorted([*edges, (own_start + own_end) / 2])
    return list(pairwise(edges))


def _samples(part: tuple[float, float], own_start: float, count: int) -> tuple[int, int]:
    """Return the first of ``count`` samples that is in a part of a recording, own times, and the first after it."""
    first, last = (int(np.clip(round((at - own_start) * GRID_HZ), 0, count)) for at in part)
    return first, last


def _heard(c: int, clocks: Clocks, ties: Sequence[Tie]) -> list[float]:
    """Return the own times of a camera at which a sound fits another camera, by the clocks of both."""
    return [
        tie.own_i if c == tie.i else tie.own_j
        for tie in ties
        if tie.kind == "sound"
        and c in (tie.i, tie.j)
        and abs(clocks.common(tie.i, tie.own_i) - clocks.common(tie.j, tie.own_j)) < NEAR_S
    ]


def still_parts(recordings: Sequence[Recording], looks: Sequence[Look], clocks: Clocks) -> list[str]:
    """Return a line for each camera in which nothing moves for long while something moves in half of the others."""
    known = np.flatnonzero(clocks.connected).tolist()
    begin = min(clocks.common(c, float(looks[c].times_s[0])) for c in known)
    end = max(clocks.common(c, float(looks[c].times_s[-1])) for c in known)
    step = SHORTEST_S / 4  # some images each, and several of them in the shortest time that is reported
    count = int((end - begin) / step) + 1
    seen, moving = np.zeros((2, len(looks), count), np.bool_)
    for c in known:
        bins = _bins(looks[c], clocks, c, begin, step)
        seen[c, bins] = True
        moving[c, bins[looks[c].moving > SOMEBODY]] = True
    lines = []
    for c in known:
        others = [k for k in known if k != c]
        active = 2 * moving[others].sum(axis=0) >= np.maximum(seen[others].sum(axis=0), 1)
        still = seen[c] & ~moving[c] & active
        first, last = (*runs(still), (0, 0))[0]
        if (last - first) * step >= SHORTEST_S:
            own = [(begin + b * step - clocks.offsets_s[c]) / clocks.rates[c] for b in (first, last)]
            lines.append(
                f"{recordings[c].where}: nothing moves in its picture from {own[0]:.1f} s to {own[1]:.1f} s, and "
                "something does in the others: is the picture frozen, or is the person out of view?"
            )
    return lines


def _bins(look: Look, clocks: Clocks, c: int, begin: float, step: float) -> NDArray[np.int64]:
    """Return (N - 1,) the bin of each change; bins of ``step`` seconds begin at a common time."""
    common = clocks.offsets_s[c] + clocks.rates[c] * look.middles_s
    return np.asarray(np.floor((common - begin) / step), np.int64)


def exchanged_videos(
    recordings: Sequence[Recording], looks: Sequence[Look], cameras: Sequence[Camera], clocks: Clocks
) -> tuple[float, tuple[int, int]] | None:
    """Return the probability that no two videos are exchanged, and the two whose exchange is most probable. None if the
    clocks are not known, or no two videos have images of one size.

    What moves at a time lies in the same planes through two cameras' centres for both of them only if each video is
    that of its camera.
    """
    count = len(looks)
    size = [(recording.width, recording.height) for recording in recordings]
    pairs = list(combinations(range(count), 2))
    changes = [(a, b) for a, b in pairs if size[a] == size[b]]
    if not changes or not clocks.connected.all():
        return None
    begin = max(clocks.common(c, float(look.middles_s[0])) for c, look in enumerate(looks))
    end = min(clocks.common(c, float(look.middles_s[-1])) for c, look in enumerate(looks))
    if end - begin < SHORTEST_S:
        return None
    bins = [_bins(look, clocks, c, begin, _BIN_S) for c, look in enumerate(looks)]
    moved = [_binned(look, own, int((end - begin) / _BIN_S)) for look, own in zip(looks, bins, strict=True)]

    @cache
    def rays(video: int, c: int) -> Float:
        return rays_of(looks[video], cameras[c], False)

    @cache
    def fit(i: int, j: int, c: int, d: int) -> float:
        """Return the logarithm of the likelihood of videos i and j as those of cameras c and d."""
        shared = shared_planes(looks[i], looks[j], rays(i, c), rays(j, d), cameras[c].center, cameras[d].center)
        if shared is None:
            return 0.0
        profiles = [planes_sum(moved[v], planes) for v, planes in zip((i, j), shared, strict=True)]
        one, other = (profile - profile.mean(axis=0) for profile in profiles)
        _, _, z = correlate(one, other, round(SHORTEST_S / _BIN_S))
        return max(float(z[len(other) - 1]), 0.0) ** 2 / 2  # without a lag

    def log(exchange: Mapping[int, int]) -> float:
        return 2 / count * sum(fit(i, j, exchange.get(i, i), exchange.get(j, j)) for i, j in pairs)  # C - 1 are new

    own = log({})
    others = {(a, b): log({a: b, b: a}) - own for a, b in changes}
    best = max(others, key=lambda pair: others[pair])
    return 1 / (1 + sum(float(np.exp(min(each, 700.0))) for each in others.values())), best


def _binned(look: Look, bins: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Return (B, h, w) the motion of each pixel, summed over the images of each bin."""
    total = np.zeros((count, *look.changes.shape[1:]), np.float32)
    for change, b in zip(look.changes, bins, strict=True):
        if 0 <= b < count:
            total[b] += change
    return total
