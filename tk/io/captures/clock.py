"""Frames on a regular clock: each shows the image of every camera that is nearest in time.

So are read cameras of different or variable rates, and videos that begin at different times. Nothing is encoded or
copied: a clip on the clock is a list of the numbers of its images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ClockError
from tk.io.captures.capture_toml import CaptureSettings, Span
from tk.io.captures.clip import Clip, Reader
from tk.io.captures.clip_folder import MASKS_RECORD
from tk.io.captures.referred import open_referred, referred_stamps
from tk.io.captures.timing import DRIFT_FRAMES, ROUNDED, ROUNDED_INTERVAL, Stamps, slowest_rate
from tk.io.toml import load_toml

Float = NDArray[np.float64]

#: length of the mean of unit vectors, one for each image at its phase in the clock's intervals, above which a camera
#: has a phase: 0.8 for a standard deviation of 0.1 intervals, 0.6 for a drift by half an interval
_STEADY = 0.8
#: share of an interval by which images may differ from a constant delay
_CONSTANT = 0.1
#: largest remaining delay, intervals: with one half, the nearest frame would be another one
_MOST_LATE = 0.49


@dataclass(frozen=True)
class Clock:
    """The times of a capture's frames.

    Attributes:
        begin_s: common time of frame 0, seconds.
        fps: frames in a second.
        count: number of frames.
    """

    begin_s: float
    fps: float
    count: int

    @property
    def text(self) -> str:
        """The frames' times, as `tk masks` records them."""
        return f"frame k at {self.begin_s:.4f} s + k / {self.fps:.8g}"

    @property
    def times_s(self) -> Float:
        """(F,) common times of the frames."""
        return self.begin_s + np.arange(self.count) / self.fps

    def nearest(self, stamps: Stamps) -> NDArray[np.int64]:
        """Return the number of the image nearest to each frame; -1 where none is near enough."""
        times, clock = stamps.since_start, self.times_s
        after = np.clip(np.searchsorted(times, clock), 1, len(times) - 1)
        # of two equally distant images the earlier one
        nearest = np.where(clock - times[after - 1] <= times[after] - clock, after - 1, after)
        far = np.abs(times[nearest] - clock) * self.fps > DRIFT_FRAMES + ROUNDED_INTERVAL
        return np.where(far, -1, nearest)

    def late_s(self, stamps: Stamps, pictures: NDArray[np.int64]) -> float:
        """Return by how much the images of the frames are late if that is constant, seconds; else 0."""
        shown = pictures >= 0
        late = (stamps.since_start[pictures[shown]] - self.times_s[shown]) * self.fps
        typical = float(np.median(late)) if len(late) else 0.0
        if not len(late) or np.abs(late - typical).max() > _CONSTANT:
            return 0.0
        return min(max(typical, -_MOST_LATE), _MOST_LATE) / self.fps


def choose_clock(
    stamps: Sequence[Stamps], fps: float | None, span: Span, where: Path, warn: Callable[[str], None]
) -> Clock:
    """Return the clock of a capture.

    The rate is ``fps``, else that of the slowest camera. The clock begins where all cameras have images, or at
    ``span.begin``, and ends with the first camera, or before ``span.end``. If they are not given, it leaves out
    ``span.empty``. Its phase is that from which the images of cameras with its rate are least far away.

    Args:
        stamps: of each camera.
        fps: the rate in `capture.toml`, if it has one.
        span: the part that is used.
        where: path of `capture.toml`.
        warn: called with notes.

    Raises:
        CaptureError: fewer than two frames are left, or ``fps`` is above the rate of every camera.
    """
    fastest = max(stamps, key=lambda each: each.own_rate)
    if fps is not None and fps > (1 + ROUNDED) * fastest.own_rate:
        raise ClockError(
            f"{fastest.path}: no camera has more than {fastest.own_rate:.5g} frames/s, so there is nothing to resample "
            f"to fps = {fps:g} of capture.toml; remove fps, or correct it; if the videos play in slow motion what was "
            f'recorded at {fps:g} frames/s, add times = "fps" and do not resample'
        )
    fps = fps or slowest_rate(stamps)
    last_in = max(stamps, key=lambda each: float(each.since_start[0]))
    first_out = min(stamps, key=lambda each: float(each.since_start[-1]))
    begin, end = float(last_in.since_start[0]), float(first_out.since_start[-1])
    if end < begin:
        raise CaptureError(
            f"{last_in.path}: begins at {begin:.2f} s of the common time, and {first_out.path} ends at {end:.2f} s: "
            "the cameras have no time in common; check the time stamps, or offset and rate"
        )
    low, high = _limits(begin, end, span, where, warn)
    phase = _phase(stamps, low, high, fps)
    # an image half an interval before the clock's first frame is still the nearest to it
    early = 0.0 if span.empty and low == span.empty[1] else DRIFT_FRAMES
    clock_begin = (np.ceil(low * fps - early - phase - 1e-6) + phase) / fps
    count = int(np.floor((end - clock_begin) * fps + DRIFT_FRAMES)) + 1
    if high < end:
        count = min(count, int(np.ceil((high - clock_begin) * fps - 1e-6)))
    if count < 2:
        raise CaptureError(
            f"{where}: from {low:.2f} to {high:.2f} s of the common time there are fewer than 2 frames; "
            f"{last_in.path} begins at {begin:.2f} s, {first_out.path} ends at {end:.2f} s"
        )
    return Clock(float(clock_begin), fps, count)


def _limits(begin: float, end: float, span: Span, where: Path, warn: Callable[[str], None]) -> tuple[float, float]:
    """Return the part of the common time, ``begin`` to ``end``, that is used."""
    if span.begin is not None and span.begin > end:
        raise CaptureError(f"{where}: from = {span.begin:g} is after the end of the videos, {end:.2f} s")
    if span.end is not None and span.end <= begin:
        raise CaptureError(f"{where}: to = {span.end:g} is before the videos have begun, {begin:.2f} s")
    if (span.begin is not None and span.begin < begin) or (span.end is not None and span.end > end):
        warn(f"{where}: from and to reach beyond the videos, which all have images from {begin:.2f} to {end:.2f} s")
    low = begin if span.begin is None else max(begin, span.begin)
    high = end if span.end is None else min(end, span.end)
    if span.empty is None or span.empty[1] <= low or span.empty[0] >= high:
        return low, high
    after_is_longer = high - span.empty[1] >= span.empty[0] - low
    if after_is_longer and span.begin is None:
        return max(low, span.empty[1]), high
    if not after_is_longer and span.end is None:
        return low, span.empty[0]
    warn(f"{where}: the frames from {low:g} to {high:g} s include the empty scene, [background]; people are absent")
    return low, high


def _phase(stamps: Sequence[Stamps], low: float, high: float, fps: float) -> float:
    """Return the phase of the clock, 0 to 1, from which the phases of the cameras' images are least far away."""
    phases = []
    for each in stamps:
        times = each.since_start
        turn = np.exp(2j * np.pi * fps * times[(times >= low - 1 / fps) & (times <= high + 1 / fps)])
        if len(turn) and abs(turn.mean()) > _STEADY:
            phases.append(float(np.angle(turn.mean()) / (2 * np.pi)) % 1.0)
    if not phases:
        return (low * fps) % 1.0
    ordered = np.sort(phases)
    gaps = np.diff(ordered, append=ordered[0] + 1)
    first = ordered[(int(np.argmax(gaps)) + 1) % len(ordered)]  # of the shortest arc with all phases
    return float(first + (1 - gaps.max()) / 2) % 1.0


@dataclass(frozen=True)
class OnClock:
    """A recording whose frames are on a clock.

    Attributes:
        clock: the frames' times.
        clips, masks: of each camera; ``masks`` None without any.
        late_s: (C,) constant delay of each camera's images, less than half an interval, seconds; 0 if it varies.
        empty: images of the empty scene of each camera; None if no part of the recording shows it.
    """

    clock: Clock
    clips: tuple[Clip, ...]
    masks: tuple[Clip, ...] | None
    late_s: tuple[float, ...]
    empty: tuple[Clip, ...] | None


def put_on_clock(
    recorded: Mapping[str, tuple[Clip, Stamps | None]],
    masks: Sequence[Clip] | None,
    settings: CaptureSettings,
    where: Path,
    warn: Callable[[str], None],
) -> OnClock:
    """Return a recording on the clock that its `capture.toml` asks for.

    Args:
        recorded: images and times of each camera, by its name.
        masks: of the images; or of the frames, which `tk masks` has made and recorded.
        settings: of `capture.toml`.
        where: its path.
        warn: called with notes.

    Raises:
        CaptureError: times are unknown, or as :func:`choose_clock` and :func:`_empty_scene` say.
    """
    clips, stamps = [clip for clip, _ in recorded.values()], list[Stamps]()
    for clip, given in recorded.values():
        if given is None and settings.fps and clip.times_s is None and clip.frame_count > 1:
            given = Stamps(clip.path, np.arange(clip.frame_count) / settings.fps, common=False)
        if given is None:
            raise CaptureError(
                f"{clip.path}: nothing gives the times of its images, so they cannot be resampled; add timestamps/, "
                'or, if its rate is regular, fps and times = "fps" in capture.toml'
                if clip.frame_count > 1
                else f"{clip.path}: holds one image; put a video in its place"
            )
        stamps.append(given)
    clock = choose_clock(stamps, settings.fps, settings.span, where, warn)
    pictures = [clock.nearest(each) for each in stamps]
    missing = [f"{name} {(n < 0).sum()}" for name, n in zip(recorded, pictures, strict=True) if (n < 0).any()]
    if round(clock.begin_s, 3) or any(not np.array_equal(numbers, np.arange(len(numbers))) for numbers in pictures):
        spans = {name: each.since_start[[0, -1]] for name, each in zip(recorded, stamps, strict=True)}
        first, last = max(spans, key=lambda name: spans[name][0]), min(spans, key=lambda name: spans[name][1])
        warn(
            f"resampled to {clock.fps:.5g} frames/s by the time stamps, from {clock.times_s[0]:.3f} s to "
            f"{clock.times_s[-1]:.3f} s of the common time; {first} begins last, at {spans[first][0]:.3f} s, "
            f"{last} ends first, at {spans[last][1]:.3f} s"
            + (f"; frames without an image: {', '.join(missing)}" if missing else "")
        )
    if masks is not None:
        by_frame = recorded_clock(masks[0].path.parent, clock)
        masks = [
            mask if by_frame else Resampled.of(mask, n[n < mask.frame_count])
            for mask, n in zip(masks, pictures, strict=True)
        ]
    return OnClock(
        clock,
        tuple(map(Resampled.of, clips, pictures)),
        None if masks is None else tuple(masks),
        tuple(map(clock.late_s, stamps, pictures)),
        _empty_scene(clips, stamps, settings.span, where),
    )


def clips_on_clock(folder: Path, settings: CaptureSettings, warn: Callable[[str], None]) -> dict[str, Clip]:
    """Return the clips of `[videos]` in a folder, on their common clock, without a calibration.

    Raises:
        CaptureError: see :func:`~tk.io.captures.referred.open_referred` and :func:`put_on_clock`.
    """
    clips = open_referred(folder, settings.videos)
    regular = settings.fps if settings.times == "fps" else None
    stamps = referred_stamps(list(clips.values()), list(settings.videos.values()), regular)
    recorded = {name: (clip, own) for (name, clip), own in zip(clips.items(), stamps, strict=True)}
    timed = put_on_clock(recorded, None, settings, folder / "capture.toml", warn)
    return dict(zip(clips, timed.clips, strict=True))


def recorded_clock(folder: Path, clock: Clock) -> bool:
    """Return whether `tk masks` has made the masks in a folder from the frames of a clock.

    Raises:
        CaptureError: it was another clock.
    """
    record = folder / MASKS_RECORD
    made = load_toml(record).get("clock") if record.is_file() else None
    if made not in (None, clock.text):
        raise CaptureError(
            f"{record}: these masks are of other frames: {made}, not {clock.text}; delete the folder, and make them "
            "again with tk masks"
        )
    return made is not None


def _empty_scene(clips: Sequence[Clip], stamps: Sequence[Stamps], span: Span, where: Path) -> tuple[Clip, ...] | None:
    """Return the images of each camera in ``span.empty``; None if it is not given.

    Raises:
        CaptureError: a camera has none.
    """
    if span.empty is None:
        return None
    found = []
    for clip, each in zip(clips, stamps, strict=True):
        times = each.since_start
        inside = np.flatnonzero((times >= span.empty[0]) & (times < span.empty[1]))
        if not len(inside):
            raise CaptureError(
                f"{where}: [background]: {clip.path} has no image from {span.empty[0]:g} to {span.empty[1]:g} s; "
                f"it has images from {times[0]:.2f} to {times[-1]:.2f} s of the common time"
            )
        found.append(Resampled.of(clip, inside))
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class Resampled(Clip):
    """Images of a clip in another order of time."""

    clip: Clip  # the images
    pictures: NDArray[np.int64] = field(compare=False)  # (F,) see :meth:`shown`, never decreasing

    @staticmethod
    def of(clip: Clip, pictures: NDArray[np.int64]) -> Resampled:
        """Return a clip whose frame k shows image ``pictures[k]``; -1: it is blank."""
        return Resampled(clip.path, clip.width, clip.height, len(pictures), clip=clip, pictures=pictures)

    @property
    def parts(self) -> tuple[Clip, ...]:
        return self.clip.parts

    def open(self) -> Reader:
        return self.clip.open()

    def shown(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        return self.pictures[super().shown(frames)]

    def reduced(self, factor: int) -> Resampled:
        return Resampled.of(self.clip.reduced(factor), self.pictures)
