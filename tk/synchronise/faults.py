"""What is wrong with a camera although its offset seems certain: the pictures say it.

A video may run at another speed, miss a part, have its chapters in another order, or belong to another camera of the
calibration. Then an offset fits a part of it, or its sound only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera
from tk.model.cameras.common_view import closest_to_lines
from tk.synchronise.lags import correlate
from tk.synchronise.looks import Look
from tk.synchronise.person import DOUBT, GRID_HZ, common_deviation, rays_of
from tk.synchronise.raw import Recording
from tk.synchronise.sound import Heard
from tk.synchronise.ties import Clocks

Float = NDArray[np.float64]
#: own time of the first sample, seconds, and samples (N, F), as :func:`tk.synchronise.person.signals_of` returns them
Signals = tuple[float, Float]

#: 1/s: of the samples that are compared here
_HZ = 30
#: seconds that are compared at least, and by which a lag may differ: twice the width of most motions
_LEAST_S, _NEAR_S = 3.0, 0.4
#: rates that files say, and those with which cameras may have recorded, 1/s
_SAID, _RECORDED = (24, 25, 30, 50, 60), (24, 25, 30, 50, 60, 100, 120, 240)
#: how many times slower a video may be played than it was recorded; below the least it would be a time lapse
_SPEEDS = sorted({true / said for said in _SAID for true in _RECORDED if true != said and true / said >= 0.4})
#: seconds of a bin in which motion is summed, and seconds in which a camera must show none to be reported
_BIN_S, _STILL_S = 0.5, 2.0
#: share of the pixels that move at least while something moves
_MOVES = 0.002
#: exchanged videos: the rays to what moves miss each other by more than this, degrees; the exchange lowers that to less
#: than this share. Of exchanged videos it is 0.2 to 0.5, of right ones 1.15 and more.
_MISS_DEG, _LOWER = 1.0, 0.6


def other_speed_or_order(
    recordings: Sequence[Recording], looks: Sequence[Look], signals: Sequence[Signals], clocks: Clocks
) -> dict[int, str]:
    """Return why the motion of a camera fits the others at another speed, or in a part at another lag only: the camera
    that contradicts most, if one does.

    Args:
        recordings: the cameras.
        looks: their images.
        signals: the motion in them.
        clocks: those of the cameras that are synchronised.
    """
    found: list[tuple[float, int, str]] = []
    known = np.flatnonzero(clocks.connected).tolist()
    for c, recording in enumerate(recordings):
        others = [k for k in known if k != c]
        if not others:
            continue
        start, reference = _mean([(clocks.common(k, signals[k][0]), signals[k][1]) for k in others])
        whose = "the others" if len(others) > 1 else recordings[others[0]].name
        own_start, own = signals[c][0], _thinned(signals[c][1])
        expected = round((clocks.common(c, own_start) - start) * _HZ) if c in known else None
        compared = {speed: _compare(reference, own, speed) for speed in (1.0, *_SPEEDS)}
        probability, speed = _fits(compared, expected)
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
        for first, last in _parts(recording, own_start, len(own)):
            if not _moves(looks[c], own_start + first / _HZ, own_start + last / _HZ):
                continue
            part = own[first:last] - own[first:last].mean(axis=0)
            lags, z = _compare(reference, part, 1.0)
            probability, _ = _fits({1.0: (lags, z)}, expected + first)
            if probability < DOUBT:
                apart = (int(lags[np.argmax(z)]) - expected - first) / _HZ
                found.append((probability, c, other_order(apart, own_start + first / _HZ, own_start + last / _HZ)))
    return {c: text for _, c, text in [min(found)]} if found else {}


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


def _thinned(samples: Float) -> Float:
    """Return samples at the lower rate, without their mean."""
    step = GRID_HZ // _HZ
    count = len(samples) // step
    thin = samples[: count * step].reshape(count, step, -1).mean(axis=1)
    return np.asarray(thin - thin.mean(axis=0))


def _mean(signals: Sequence[tuple[float, Float]]) -> tuple[float, Float]:
    """Return the common time of the first sample, and the mean of signals that begin at common times."""
    thin = [(start, _thinned(samples)) for start, samples in signals]
    begin = min(start for start, _ in thin)
    firsts = [round((start - begin) * _HZ) for start, _ in thin]
    total = np.zeros((max(first + len(x) for first, (_, x) in zip(firsts, thin, strict=True)), thin[0][1].shape[1] + 1))
    for first, (_, samples) in zip(firsts, thin, strict=True):
        total[first : first + len(samples), :-1] += samples
        total[first : first + len(samples), -1] += 1
    return begin, np.asarray(total[:, :-1] / np.maximum(total[:, -1:], 1))


def _compare(reference: Float, own: Float, speed: float) -> tuple[NDArray[np.int64], Float]:
    """Return lags and their significances, of a signal that is played faster by ``speed``; 0 where too little is in
    common."""
    count = int(len(own) / speed)
    least = round(_LEAST_S * _HZ)
    if min(count, len(reference)) < least:
        return np.zeros(0, np.int64), np.zeros(0)
    if speed != 1.0:
        at = np.arange(count) * speed
        own = np.stack([np.interp(at, np.arange(len(own)), column) for column in own.T], axis=1)
        own = own - own.mean(axis=0)
    lags, _, z = correlate(reference, own, least)
    return lags, np.where(np.isfinite(z), z, 0.0)


def _fits(compared: dict[float, tuple[NDArray[np.int64], Float]], expected: int | None) -> tuple[float, float]:
    """Return the probability of the file's own speed and the expected lag, any lag if that is None, and the most
    probable speed. Where nothing can be compared, the probability is 1."""
    lags, z = compared[1.0]
    if not len(z):
        return 1.0, 1.0
    common = common_deviation(z)
    near = z if expected is None else z[np.abs(lags - expected) <= round(_NEAR_S * _HZ)]
    near = near if near.any() else np.zeros(1)  # too little in common at this lag
    log = {speed: np.maximum(each / common, 0.0) ** 2 / 2 for speed, (_, each) in compared.items() if len(each)}
    best = max(log, key=lambda speed: float(log[speed].max()))
    highest = float(log[best].max())
    total = sum(float(np.exp(each - highest).sum()) for each in log.values())
    return float(np.exp(np.maximum(near / common, 0.0) ** 2 / 2 - highest).sum()) / total, best


def _parts(recording: Recording, own_start: float, count: int) -> list[tuple[int, int]]:
    """Return the samples of parts of a recording: its chapters, or its halves."""
    begins = [recording.times_s[0] + shift - own_start for shift in recording.shifts_s[1:]]
    borders = [round(begin * _HZ) for begin in begins if 0 < begin * _HZ < count] or [count // 2]
    ends = [0, *borders, count]
    return [(a, b) for a, b in pairwise(ends) if b - a > _LEAST_S * _HZ]


def _moves(look: Look, begin_s: float, end_s: float) -> bool:
    """Return whether something moves in half of the images between two own times."""
    inside = (look.middles_s >= begin_s) & (look.middles_s < end_s)
    return bool(inside.any() and np.mean((look.changes[inside] > 0).mean(axis=(1, 2)) > _MOVES) > 0.5)


def still_parts(recordings: Sequence[Recording], looks: Sequence[Look], clocks: Clocks) -> list[str]:
    """Return a line for each camera in which nothing moves for long while something moves in half of the others."""
    known = np.flatnonzero(clocks.connected).tolist()
    begin = min(clocks.common(c, float(looks[c].times_s[0])) for c in known)
    end = max(clocks.common(c, float(looks[c].times_s[-1])) for c in known)
    count = int((end - begin) / _BIN_S) + 1
    seen, moving = np.zeros((2, len(looks), count), np.bool_)
    for c in known:
        bins = _bins(looks[c], clocks, c, begin)
        seen[c, bins] = True
        moving[c, bins[(looks[c].changes > 0).mean(axis=(1, 2)) > _MOVES]] = True
    lines = []
    for c in known:
        others = [k for k in known if k != c]
        active = 2 * moving[others].sum(axis=0) >= np.maximum(seen[others].sum(axis=0), 1)
        still = seen[c] & ~moving[c] & active
        edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
        runs = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        first, last = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
        if (last - first) * _BIN_S >= _STILL_S:
            own = [(begin + b * _BIN_S - clocks.offsets_s[c]) / clocks.rates[c] for b in (first, last)]
            lines.append(
                f"{recordings[c].where}: nothing moves in its picture from {own[0]:.1f} s to {own[1]:.1f} s, and "
                "something does in the others: is the picture frozen, or is the person out of view?"
            )
    return lines


def _bins(look: Look, clocks: Clocks, c: int, begin: float) -> NDArray[np.int64]:
    """Return (N - 1,) the bin of each change."""
    common = clocks.offsets_s[c] + clocks.rates[c] * look.middles_s
    return np.asarray((common - begin) / _BIN_S, np.int64)


def exchanged(
    recordings: Sequence[Recording], looks: Sequence[Look], cameras: Sequence[Camera], clocks: Clocks
) -> tuple[int, int] | None:
    """Return two cameras whose videos are exchanged: only then do the rays to what moves meet. None if no two are.

    Three cameras or more are needed: two rays often nearly meet.
    """
    count = len(looks)
    if count < 3 or not clocks.connected.all():
        return None
    begin = max(clocks.common(c, float(look.middles_s[0])) for c, look in enumerate(looks))
    end = min(clocks.common(c, float(look.middles_s[-1])) for c, look in enumerate(looks))
    if end - begin < _LEAST_S:
        return None
    binned = [_binned(look, _bins(look, clocks, c, begin), int((end - begin) / _BIN_S)) for c, look in enumerate(looks)]
    size = [(recording.width, recording.height) for recording in recordings]
    rays = {
        (video, c): binned[video] @ rays_of(looks[video], cameras[c], False).reshape(-1, 3).astype(np.float32)
        for video in range(count) for c in range(count) if size[video] == size[c]
    }  # fmt: skip
    centers = np.array([camera.center for camera in cameras])
    own = _miss_deg(centers, [rays[c, c] for c in range(count)])
    if not own > _MISS_DEG:
        return None
    tried: list[tuple[float, tuple[int, int]]] = []
    for a, b in combinations(range(count), 2):
        if size[a] == size[b]:
            videos = {a: b, b: a}
            tried.append((_miss_deg(centers, [rays[videos.get(c, c), c] for c in range(count)]), (a, b)))
    least, pair = min(tried, default=(np.inf, (0, 0)))
    return pair if least < _LOWER * own else None


def _binned(look: Look, bins: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Return (B, h w) the motion of each pixel, summed over the images of each bin."""
    total = np.zeros((count, look.changes[0].size), np.float32)
    for change, b in zip(look.changes, bins, strict=True):
        if 0 <= b < count:
            total[b] += change.ravel()
    return total


def _miss_deg(centers: Float, rays: Sequence[NDArray[np.float32]]) -> float:
    """Return the mean over the cameras of the angle between their rays (B, 3) to what moves and the point where the
    rays of all cameras nearly meet, degrees, the median over bins in which all see motion."""
    found = np.asarray(rays, np.float64)
    length = np.linalg.norm(found, axis=2)
    usable = (length > 0.2 * np.median(length, axis=1, keepdims=True)).all(axis=0) & (length > 0).all(axis=0)
    angles = []
    for b in np.flatnonzero(usable):
        ray = found[:, b] / length[:, b, None]
        point = closest_to_lines(centers, ray)
        if point is not None:
            way = (point - centers) / np.linalg.norm(point - centers, axis=1)[:, None]
            angles.append(np.degrees(np.arccos(np.clip((way * ray).sum(axis=1), -1, 1))))
    return float(np.median(angles, axis=0).mean()) if angles else np.nan
