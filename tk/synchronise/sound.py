"""Offsets from the sound of two cameras: candidates from onsets, confirmed by the phase in short windows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, find_peaks, sosfiltfilt

from tk.io.captures.packets import open_video
from tk.synchronise.lags import correlate, fast_length
from tk.synchronise.raw import SHORTEST_S, Recording
from tk.synchronise.ties import OUTLIER_SIGMA, RATE_SIGMA, Tie

Float = NDArray[np.float64]
Samples = NDArray[np.float32]
#: a window that confirms a lag: its middle, sample of the first track; lag, samples; height of the peak, deviations
Hit = tuple[float, float, float]

#: 1/s: of the samples that are compared. Speech and claps have most of their energy below half of it.
RATE = 8000
#: samples of a step of the onsets, 5 ms; borders of their bands, Hz
_HOP, _BANDS = 40, (150, 500, 1000, 2000, 3800)
#: seconds of a track that are filtered at once
_BLOCK_S = 60
#: candidates of the offset that are confirmed
_CANDIDATES = 6
#: seconds of a window, most windows, and how far the phase is searched about a candidate, without drift
_WINDOW_S, _WINDOWS, _REACH_S = 4.0, 24, 0.03
#: seconds about a peak in which the noise is measured
_LOCAL_S = 0.02
#: seconds beside that range in which no echo may be higher: the sound itself would lie there
_BESIDE_S = 0.3
#: a window confirms if its peak is so many times the noise's deviation, and so many times the second peak. Of
#: independent noise, and of two short bursts, the highest of all lags has 4 to 5 deviations.
_PEAK, _SECOND = 6.0, 1.25
#: windows that must agree, or all of fewer: loud bursts of two other sounds may fit by chance in one or two
_AGREEING = 4
#: the same limits where one window alone must convince
_LONE_PEAK, _LONE_SECOND = 8.0, 1.5
#: windows agree if they differ by less, seconds
_AGREE_S = 0.002
#: least standard deviation of a window's offset, seconds: echoes and the way of the sound change
_WINDOW_SIGMA_S = 0.0003
#: quieter tracks, of full scale, hold nothing: rounding alone is 1e-5
_SILENCE = 1e-4
#: largest drift between two cameras, relative
_MOST_DRIFT = OUTLIER_SIGMA * RATE_SIGMA


@dataclass(frozen=True)
class Track:
    """The sound of a camera.

    Attributes:
        start_s: own time of the first sample, seconds.
        samples: (N,) mono, at :data:`RATE`.
    """

    start_s: float
    samples: Samples

    @property
    def silent(self) -> bool:
        """Whether the track holds nothing."""
        return len(self.samples) < RATE or float(self.samples.std()) < _SILENCE


@dataclass(frozen=True)
class Jump:
    """A part of two tracks that fits at another offset than the rest: a part of one recording is missing, or out of
    order.

    Attributes:
        apart_s: seconds by which the part of the second track fits the first later.
        own_i, own_j: own times, seconds, of the beginning and the end of the part in both.
    """

    apart_s: float
    own_i: tuple[float, float]
    own_j: tuple[float, float]


@dataclass(frozen=True)
class Heard:
    """What the sound of a pair of cameras says.

    Attributes:
        ties: none if it is not certain.
        jump: a part at another offset; None without one.
    """

    ties: tuple[Tie, ...]
    jump: Jump | None = None


def read_track(recording: Recording) -> Track | None:
    """Return the sound of a recording; None if it has none that can be decoded."""
    import av
    import av.error

    parts: list[tuple[float, Samples]] = []
    for path, shift in zip(recording.paths, recording.shifts_s, strict=True):
        container, _ = open_video(path)
        with container:
            if not container.streams.audio:
                continue
            stream = container.streams.audio[0]
            resampler = av.AudioResampler(format="flt", layout="mono", rate=RATE)
            start: float | None = None
            chunks: list[Samples] = []
            try:
                for frame in _and_end(container.decode(stream)):
                    if start is None and frame is not None:
                        start = float(frame.time or 0.0)
                    chunks += [out.to_ndarray()[0] for out in resampler.resample(frame)]
            except (av.error.FFmpegError, ValueError):  # damaged sound: what was before it is used
                pass
            if start is not None and chunks:
                parts.append((start + shift + _edited_s(path), np.concatenate(chunks).astype(np.float32)))
    if not parts:
        return None
    begin = parts[0][0]
    length = max(round((start - begin) * RATE) + len(samples) for start, samples in parts)
    whole = np.zeros(length, np.float32)
    for start, samples in parts:
        first = max(round((start - begin) * RATE), 0)
        whole[first : first + len(samples)] = samples
    return Track(begin, whole)


def _edited_s(path: Path) -> float:
    """Return by how much later sound is, in the times of the images, than FFmpeg gives it, seconds: -0.04 to 0.

    A file that was cut without encoding it again has an edit list, which begins between two images. FFmpeg counts time
    from the first image that is shown; the sound begins where the list does.
    """
    times = []
    for options in ({}, {"advanced_editlist": "0"}):
        container, stream = open_video(path, options)
        with container:
            packets = (
                float(packet.pts * stream.time_base) for packet in container.demux(stream) if packet.pts is not None
            )
            times.append(next(packets, 0.0))
    return times[0] - times[1]


def _and_end(frames: Iterator[Any]) -> Iterator[Any]:
    yield from frames
    yield None  # flushes the resampler


def hear(tracks: Sequence[Track | None]) -> dict[tuple[int, int], Heard]:
    """Return what the sound of each pair of cameras says; pairs without sound are missing."""
    usable = {c: track for c, track in enumerate(tracks) if track is not None and not track.silent}
    onsets = {c: _onsets(track.samples) for c, track in usable.items()}
    return {
        (i, j): _compare(i, j, usable[i], usable[j], onsets[i], onsets[j])
        for i in usable for j in usable if i < j
    }  # fmt: skip


def _onsets(samples: Samples) -> Float:
    """Return (N, B) onsets: how much louder each band becomes in a step, as its logarithm."""
    count = len(samples) // _HOP
    energy = np.empty((count, len(_BANDS) - 1))
    margin, block = RATE, _BLOCK_S * RATE  # a whole track of an hour takes a gigabyte
    for k, band in enumerate(pairwise(_BANDS)):
        filter_ = butter(3, band, "bandpass", fs=RATE, output="sos")
        for first in range(0, count * _HOP, block):
            last = min(first + block, count * _HOP)
            before = min(first, margin)
            filtered = sosfiltfilt(filter_, samples[first - before : last + margin])[before : before + last - first]
            energy[first // _HOP : last // _HOP, k] = (filtered.reshape(-1, _HOP) ** 2).mean(axis=1)
    level = np.log(energy + np.median(energy, axis=0) / 4 + 1e-12)
    rise = np.maximum(np.diff(level, axis=0, prepend=level[:1]), 0.0)
    return np.asarray(rise - rise.mean(axis=0))


def _compare(i: int, j: int, a: Track, b: Track, onsets_a: Float, onsets_b: Float) -> Heard:
    lags, _, z = correlate(onsets_a, onsets_b, least=round(SHORTEST_S * RATE / _HOP))
    peaks, _ = find_peaks(z, distance=round(0.02 * RATE / _HOP))
    best = peaks[np.argsort(z[peaks])[::-1][:_CANDIDATES]]
    found: list[tuple[int, list[Hit], bool]] = []
    for lag in [int(lags[k]) * _HOP for k in best] + _by_phase(a.samples, b.samples):
        if all(abs(lag - other) > 0.01 * RATE for other, _, _ in found):
            found.append((lag, *_confirm(a.samples, b.samples, lag, (onsets_a, onsets_b))))
    found.sort(key=lambda each: (-len(each[1]), -sum(strength for _, _, strength in each[1])))
    if not found:
        return Heard(())
    hits = found[0][1]
    others = max((_apart(each[1]) for each in found[1:] if each[1] and not _alike(each[1], hits)), default=0)
    jump = _jump(a, b, hits, [each[1] for each in found[1:] if _apart(each[1]) > (1 if each[2] else 2)])
    lag = found[0][0]
    both_s = (min(len(a.samples), len(b.samples) + lag) - max(0, lag)) / RATE
    enough = min(_AGREEING, max(2, both_s // _WINDOW_S))  # all windows of a short recording
    sure = (_apart(hits) >= enough or found[0][2]) and _apart(hits) > 2 * others
    if not sure:
        return Heard((), jump)
    sigma = _sigma(hits)
    ties = tuple(Tie(i, j, a.start_s + at / RATE, b.start_s + (at - lag) / RATE, sigma, "sound") for at, lag, _ in hits)
    return Heard(ties, jump)


def _jump(a: Track, b: Track, hits: Sequence[Hit], others: Sequence[Sequence[Hit]]) -> Jump | None:
    """Return the part of two tracks in which another offset fits, before or after the windows of the best one; one of
    ten windows may fit by chance."""
    for other in others:
        at, rest = ([hit[0] for hit in each] for each in (other, hits))
        (begin, end), (first, last) = (np.quantile(each, [0.1, 0.9]) for each in (at, rest))
        if _alike(other, hits) or not (begin > last or end < first):
            continue
        lag, best = (float(np.median([hit[1] for hit in each])) for each in (other, hits))
        half = _WINDOW_S * RATE / 2
        own_i = a.start_s + (min(at) - half) / RATE, a.start_s + (max(at) + half) / RATE
        shift = b.start_s - a.start_s - lag / RATE
        return Jump((lag - best) / RATE, own_i, (own_i[0] + shift, own_i[1] + shift))
    return None


def _apart(hits: Sequence[Hit]) -> int:
    """Return the number of hits whose windows do not overlap."""
    count, last = 0, -np.inf
    for at, _, _ in sorted(hits):
        if at - last >= _WINDOW_S * RATE * 0.99:
            count, last = count + 1, at
    return count


def _alike(one: Sequence[Hit], other: Sequence[Hit]) -> bool:
    """Return whether two candidates found the same lag."""
    nearest = [min(other, key=lambda hit: abs(hit[0] - at)) for at, _, _ in one]
    apart = [abs(lag - hit[1]) for (_, lag, _), hit in zip(one, nearest, strict=True)]
    return float(np.median(apart)) < 2 * _AGREE_S * RATE


def _by_phase(a: Samples, b: Samples) -> list[int]:
    """Return the lag with the highest phase correlation of the first minutes, samples."""
    most = 180 * RATE
    short_a, short_b = a[:most], b[:most]
    phase, size = _phase(short_a, short_b)
    k = int(np.argmax(phase))
    return [k if k < size // 2 else k - size]


def _phase(a: Samples, b: Samples) -> tuple[Float, int]:
    """Return the phase correlation (GCC-PHAT) of two signals, by lag from 0, cyclic, and its length. ``a`` at n is
    ``b`` at n - lag."""
    size = fast_length(len(a) + len(b))
    cross = np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size))
    weight = np.abs(cross)
    frequency = np.fft.rfftfreq(size, 1 / RATE)
    inside = (frequency > _BANDS[0]) & (frequency < _BANDS[-1])
    cross = np.where(inside, cross / (weight + 1e-3 * weight.mean() + 1e-30), 0.0)
    return np.fft.irfft(cross, size), size


def _confirm(a: Samples, b: Samples, lag: int, onsets: tuple[Float, Float]) -> tuple[list[Hit], bool]:
    """Return the windows that confirm a lag, and whether one of them convinces alone. Windows that disagree with the
    line through most of them are left out. In long recordings, half of the windows are those with most onsets in both
    tracks: the person may come late."""
    begin, end = max(0, lag), min(len(a), len(b) + lag)
    window = min(round(_WINDOW_S * RATE), end - begin)
    if window < SHORTEST_S * RATE:
        return [], False
    count = int(np.clip(2 * (end - begin) // window - 1, 1, _WINDOWS))
    reach = _REACH_S + _MOST_DRIFT * (end - begin) / RATE
    hits: list[Hit] = []
    lone = False
    starts = np.linspace(begin, end - window, count).round().astype(int)
    if count == _WINDOWS:
        loud = [np.maximum(each, 0).sum(axis=1) for each in onsets]
        both = loud[0][begin // _HOP : end // _HOP], loud[1][(begin - lag) // _HOP : (end - lag) // _HOP]
        steps = window // _HOP
        length = min(map(len, both)) // steps
        most = np.minimum(*(each[: length * steps].reshape(length, steps).sum(axis=1) for each in both)).argsort()
        starts[1::2] = begin + most[::-1][: count // 2] * steps * _HOP
    for start in np.unique(starts).tolist():
        x, y = a[start : start + window], b[max(start - lag, 0) : start - lag + window]
        if min(x.std(), y.std()) < _SILENCE / 10:
            continue
        offset, strength, second = _peak(x - x.mean(), y - y.mean(), round((reach + _BESIDE_S) * RATE))
        if strength > _PEAK and second > _SECOND and abs(offset) < reach * RATE:
            hits.append((start + window / 2, lag + offset, strength))
            lone = lone or (strength > _LONE_PEAK and second > _LONE_SECOND)
    return _on_a_line(hits), lone


def _peak(x: Samples, y: Samples, reach: int) -> tuple[float, float, float]:
    """Return the lag of the highest peak within ``reach``, samples; its height in deviations of the noise; and its
    height as a multiple of the second peak's."""
    phase, _ = _phase(x, y)
    reach = min(reach, len(x) // 2)
    near = np.concatenate([phase[-reach:], phase[: reach + 1]])
    k = int(np.argmax(near))
    # two short bursts are unrelated to each other only at lags at which they overlap: the noise is that beside the peak
    far = np.abs(np.arange(len(near)) - k)
    beside = near[(far > _AGREE_S / 2 * RATE) & (far < _LOCAL_S * RATE)]
    noise = max(1.4826 * float(np.median(np.abs(phase))), float(beside.std()) if len(beside) else 0.0) + 1e-12
    away = far > _AGREE_S * RATE
    second = float(near[away].max()) if away.any() else 0.0
    shift = 0.0
    if 0 < k < len(near) - 1:
        left, middle, right = near[k - 1 : k + 2]
        curve = left - 2 * middle + right
        shift = 0.5 * (left - right) / curve if curve < 0 else 0.0
    return k - reach + float(np.clip(shift, -0.5, 0.5)), float(near[k]) / noise, float(near[k]) / max(second, noise)


def _on_a_line(hits: list[Hit]) -> list[Hit]:
    """Return the largest set of hits on one line with a slope that clocks can have."""
    best: list[Hit] = []
    for n, (at, lag, _) in enumerate(hits):
        for other, at_other, _ in [*hits[n + 1 :], (at + 1.0, lag, 0.0)]:
            slope = (at_other - lag) / (other - at) if other != at else 0.0
            if abs(slope) > _MOST_DRIFT + 2 * _AGREE_S * RATE / max(other - at, 1.0):
                continue
            slope = float(np.clip(slope, -_MOST_DRIFT, _MOST_DRIFT))
            on = [hit for hit in hits if abs(hit[1] - lag - slope * (hit[0] - at)) < _AGREE_S * RATE]
            if len(on) > len(best):
                best = on
    return best


def _sigma(hits: Sequence[Hit]) -> float:
    """Return the standard deviation of a window's offset, seconds."""
    at, lag, _ = np.array(hits).T
    if len(hits) < 3:
        return 2 * _WINDOW_SIGMA_S
    rest = lag - np.polyval(np.polyfit(at - at.mean(), lag, 1), at - at.mean())
    return max(_WINDOW_SIGMA_S, float(np.sqrt((rest**2).sum() / (len(hits) - 2))) / RATE)
