"""When images were taken: time stamps of the cameras, contradictions between them, and frames of a common clock.

The times are those of `timestamps/<camera>.csv`, else those in the video files, or k / `fps` if `capture.toml` says so:
the file of a video in slow motion gives the rate at which it is played. A camera's frame k is taken for the
same moment as frame k of the others, so different rates are an error, unless the images are resampled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ClockError
from tk.io.captures.calibration import Calibration, match_camera
from tk.io.captures.clip import Clip, Reader
from tk.io.toml import read_text, shown

Float = NDArray[np.float64]

#: frame intervals by which the times of two cameras, or of `fps` and a video, may differ at the end of a recording.
#: At one half, the nearest frame becomes another one.
_DRIFT_FRAMES = 0.5
#: relative difference between `fps` and a video that counts as rounding: 30 is written for 30000/1001, 0.1 % less
_ROUNDED = 0.002
#: share of an interval by which a nearest image may be farther away than half an interval: time stamps are rounded,
#: often to milliseconds
_ROUNDED_INTERVAL = 0.05


@dataclass(frozen=True)
class Stamps:
    """The times of a clip's images.

    Attributes:
        path: file that gives them.
        seconds: (N,), increasing.
        common: whether all cameras have the same clock; else the clock starts with the camera's first image.
    """

    path: Path
    seconds: Float = field(compare=False)
    common: bool

    @property
    def fps(self) -> float:
        """Mean frame rate, 1/s."""
        return float((len(self.seconds) - 1) / (self.seconds[-1] - self.seconds[0]))

    @property
    def own_rate(self) -> float:
        """Rate of the camera, 1/s, also where single images are missing."""
        return max(self.fps, 1.0 / float(np.median(np.diff(self.seconds))))

    @property
    def since_start(self) -> Float:
        """(N,) times on the common clock, else since the first image."""
        return self.seconds if self.common else self.seconds - self.seconds[0]

    @property
    def irregularity(self) -> float:
        """Largest deviation from equal intervals, in intervals."""
        even = np.linspace(self.seconds[0], self.seconds[-1], len(self.seconds))
        return float(np.abs(self.seconds - even).max() * self.fps)


def read_stamps(
    folder: Path, calibration: Calibration, clips: Sequence[Clip], regular: float | None
) -> tuple[Stamps | None, ...]:
    """Return the times of each clip; None if nothing gives them. ``regular``: without `timestamps/`, the images are
    taken at this rate, 1/s, whatever the files say.

    Raises:
        CaptureError: a file of time stamps is missing, cannot be read, or does not fit its clip.
    """
    files = {path.stem: path for path in sorted(folder.glob("timestamps/*.csv"))}
    if not files:
        return tuple(_of_container(clip, regular) for clip in clips)
    found = []
    for camera, key, clip in zip(calibration.rig, calibration.keys, clips, strict=True):
        stem = match_camera(camera.name, key, files)
        if stem is None:
            raise CaptureError(f"{folder / 'timestamps' / camera.name}.csv: is missing; give one for each camera")
        found.append(_read(files[stem], clip) if clip.frame_count > 1 else None)
    return tuple(found)


def _of_container(clip: Clip, regular: float | None) -> Stamps | None:
    times = clip.times_s if regular is None else np.arange(clip.frame_count) / regular
    return Stamps(clip.path, times, common=False) if times is not None and len(times) > 1 else None


def _read(path: Path, clip: Clip) -> Stamps:
    """Return the times in a file with a line for each image; a first line without numbers is a heading."""
    lines = [line.strip() for line in read_text(path).split("\n")]
    while lines and not lines[-1]:
        lines.pop()
    seconds = []
    for number, line in enumerate(lines):
        try:
            seconds.append(float(line))
        except ValueError:
            if number:
                raise CaptureError(f"{path}: line {number + 1}: {shown(line)} must be seconds, one number") from None
    if len(seconds) < clip.frame_count:
        raise CaptureError(f"{path}: has {len(seconds)} times, and {clip.path} has {clip.frame_count} images")
    times = np.array(seconds[: clip.frame_count])
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise CaptureError(f"{path}: its times must be finite and increase from line to line")
    return Stamps(path, times, common=True)


def check_clock(
    stamps: Sequence[Stamps | None], fps: float | None, where: Path, warn: Callable[[str], None]
) -> float | None:
    """Return the frame rate, 1/s, after a check that the cameras and ``fps`` agree; None if nothing gives one.

    Args:
        stamps: the times of each camera's images.
        fps: the rate in `capture.toml`, if it has one.
        where: path of `capture.toml`.
        warn: called with notes.

    Raises:
        ClockError: they contradict each other.
    """
    known = [each for each in stamps if each is not None]
    if not known:
        return fps
    first = known[0]
    for other in known[1:]:
        count = min(len(first.seconds), len(other.seconds))
        apart = (other.since_start[:count] - first.since_start[:count]) * first.fps
        if abs(apart[-1]) >= _DRIFT_FRAMES:
            raise _contradiction(
                f"{other.path}: {other.fps:.5g} frames/s, and {first.path.name} {first.fps:.5g} frames/s: image "
                f"{count - 1} is taken {abs(apart[-1]) / first.fps:.3g} s {'later' if apart[-1] > 0 else 'earlier'}; "
                "record all cameras at one rate",
                resample=True,
            )
        if np.abs(apart).max() >= _DRIFT_FRAMES:
            warn(
                f"{other.path}: its images are taken up to {np.abs(apart).max():.1f} frames before or after those of "
                f"{first.path.name}; the option resample corrects that"
            )
    measured = _nominal(float(np.median([each.fps for each in known])), len(first.seconds))
    if fps is not None:
        drift = (len(first.seconds) - 1) * abs(measured / fps - 1)
        if abs(fps / measured - 1) > _ROUNDED and drift >= _DRIFT_FRAMES:
            raise _contradiction(
                f"{where}: fps = {fps:g}, but {first.path} has {measured:.5g} frames/s; remove fps, or correct it; if "
                f'the videos play in slow motion what was recorded at {fps:g} frames/s, add times = "fps"',
                resample=fps < measured,
            )
    for each in known:
        if each.irregularity >= _DRIFT_FRAMES:
            warn(
                f"{each.path}: has a variable frame rate: images are up to {each.irregularity:.1f} frames away from "
                f"regular times; the option resample corrects that"
            )
    return fps or measured


def _contradiction(message: str, resample: bool) -> ClockError:
    return ClockError(message, hint="or choose frames by their time stamps with --resample" if resample else "")


def _nominal(fps: float, count: int) -> float:
    """Return a whole rate, or 1000/1001 of one, if the measured rate differs only by rounded time stamps."""
    for nominal in (round(fps), round(1.001 * fps) / 1.001):
        if abs(nominal / fps - 1) * count < _ROUNDED_INTERVAL:
            return float(nominal)
    return fps


def resample(
    clips: Sequence[Clip],
    masks: Sequence[Clip] | None,
    stamps: Sequence[Stamps | None],
    fps: float | None,
    warn: Callable[[str], None],
) -> tuple[tuple[Clip, ...], tuple[Clip, ...] | None, float]:
    """Return clips, and clips of masks, whose frame k is each camera's image nearest to time k / fps, and the rate.

    The rate is ``fps``, else that of the slowest camera. A frame without an image within half an interval is blank.

    Raises:
        CaptureError: the times of a clip are unknown, the cameras have no time in common, or ``fps`` is above the rate
            of each.
    """
    known: list[Stamps] = []
    for clip, each in zip(clips, stamps, strict=True):
        if each is None:
            raise CaptureError(
                f"{clip.path}: nothing gives the times of its images, so they cannot be resampled; add timestamps/"
            )
        known.append(each)
    fastest = max(known, key=lambda each: each.own_rate)
    if fps is not None and fps > (1 + _ROUNDED) * fastest.own_rate:
        raise ClockError(
            f"{fastest.path}: no camera has more than {fastest.own_rate:.5g} frames/s, so there is nothing to resample "
            f"to fps = {fps:g} of capture.toml; remove fps, or correct it; if the videos play in slow motion what was "
            f'recorded at {fps:g} frames/s, add times = "fps" and do not resample'
        )
    fps = fps or min(_nominal(each.fps, len(each.seconds)) for each in known)
    begin = max(float(each.since_start[0]) for each in known)
    pictures = [_nearest(each, begin, fps) for each in known]
    if not all(len(numbers) for numbers in pictures):
        raise CaptureError(f"{known[0].path}: the cameras have no time in common; check the time stamps")
    missing = [f"{clip.path.stem} {(n < 0).sum()}" for clip, n in zip(clips, pictures, strict=True) if (n < 0).any()]
    if any(not np.array_equal(numbers, np.arange(len(numbers))) for numbers in pictures):
        warn(
            f"resampled to {fps:.5g} frames/s by the time stamps"
            + (f"; frames without an image: {', '.join(missing)}" if missing else "")
        )
    new = tuple(map(Resampled.of, clips, pictures))
    if masks is not None:
        masks = tuple(Resampled.of(mask, n[n < mask.frame_count]) for mask, n in zip(masks, pictures, strict=True))
    return new, masks, fps


def _nearest(stamps: Stamps, begin: float, fps: float) -> NDArray[np.int64]:
    """Return the number of the image nearest to each frame of the clock; -1 where none is near enough."""
    times = stamps.since_start
    count = int(np.floor((times[-1] - begin) * fps + _DRIFT_FRAMES)) + 1
    clock = begin + np.arange(max(count, 0)) / fps
    after = np.clip(np.searchsorted(times, clock), 1, len(times) - 1)
    # of two equally distant images the earlier one
    nearest = np.where(clock - times[after - 1] <= times[after] - clock, after - 1, after)
    far = np.abs(times[nearest] - clock) * fps > _DRIFT_FRAMES + _ROUNDED_INTERVAL
    return np.where(far, -1, nearest)


@dataclass(frozen=True, kw_only=True)
class Resampled(Clip):
    """Images of a clip in another order of time."""

    clip: Clip  # the images
    pictures: NDArray[np.int64] = field(compare=False)  # (F,) see :meth:`shown`, never decreasing

    @staticmethod
    def of(clip: Clip, pictures: NDArray[np.int64]) -> Resampled:
        """Return a clip whose frame k shows image ``pictures[k]``; -1: it is blank."""
        return Resampled(clip.path, clip.width, clip.height, len(pictures), clip=clip, pictures=pictures)

    def open(self) -> Reader:
        return self.clip.open()

    def shown(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        return self.pictures[super().shown(frames)]

    def reduced(self, factor: int) -> Resampled:
        return Resampled.of(self.clip.reduced(factor), self.pictures)
