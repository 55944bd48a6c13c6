"""When images were taken: time stamps of the cameras, and contradictions between them.

The times are those of `timestamps/<camera>.csv`, else those in the video files, or k / `fps` if `capture.toml` says so:
the file of a video in slow motion gives the rate at which it is played. Those of `[videos]` are moved and scaled to the
common time. A camera's frame k is taken for the same moment as frame k of the others, so different rates are an error,
unless frames are chosen on a clock (:mod:`tk.io.captures.clock`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ClockError
from tk.io.captures.calibration import Calibration, match_camera
from tk.io.captures.clip import Clip
from tk.io.toml import read_text, shown

Float = NDArray[np.float64]

#: frame intervals by which the times of two cameras, or of `fps` and a video, may differ at the end of a recording.
#: At one half, the nearest frame becomes another one.
DRIFT_FRAMES = 0.5
#: relative difference between `fps` and a video that counts as rounding: 30 is written for 30000/1001, 0.1 % less
ROUNDED = 0.002
#: intervals longer than the median by this factor have a missing image in them
_GAP = 1.5
# Seconds from one image to the next, at most: times in milliseconds are 33 apart, and nobody's motion is seen so.
_LONGEST_S = 2.0
#: share of an interval by which a nearest image may be farther away than half an interval: time stamps are rounded,
#: often to milliseconds
ROUNDED_INTERVAL = 0.05
#: relative difference from a nominal rate (30, or 30000/1001, which differ by 0.001) that is a camera's clock, not its
#: rate: crystals differ by 1e-4 at most
_CRYSTAL = 2e-4


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
        return 1.0 / image_interval(self.seconds)

    @property
    def since_start(self) -> Float:
        """(N,) times on the common clock, else since the first image."""
        return self.seconds if self.common else self.seconds - self.seconds[0]

    def moved(self, offset_s: float, rate: float = 1.0) -> Stamps:
        """Return the times offset_s + rate * seconds, on the common clock."""
        return Stamps(self.path, offset_s + rate * self.since_start, common=True)

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
    files = {path.stem: path for path in sorted(folder.glob("timestamps/[!.]*.csv"))}
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
    times = own_times(clip, regular)
    return Stamps(clip.path, times, common=False) if times is not None and len(times) > 1 else None


def own_times(clip: Clip, regular: float | None) -> Float | None:
    """Return the times of a clip's images as its file gives them, or at a ``regular`` rate, 1/s; None if unknown."""
    return clip.times_s if regular is None else np.arange(clip.frame_count) / regular


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
    if len(seconds) != clip.frame_count:
        raise CaptureError(f"{path}: has {len(seconds)} times, and {clip.path} has {clip.frame_count} images")
    times = np.array(seconds)
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise CaptureError(f"{path}: its times must be finite and increase from line to line")
    if (apart := float(np.median(np.diff(times)))) > _LONGEST_S:
        raise CaptureError(f"{path}: its times must be seconds, and are {apart:.4g} apart")
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
        if abs(apart[-1]) >= DRIFT_FRAMES:
            raise _contradiction(
                f"{other.path}: {other.fps:.5g} frames/s, and {first.path.name} {first.fps:.5g} frames/s: image "
                f"{count - 1} is taken {abs(apart[-1]) / first.fps:.3g} s {'later' if apart[-1] > 0 else 'earlier'}; "
                "record all cameras at one rate",
                resample=True,
            )
        if np.abs(apart).max() >= DRIFT_FRAMES:
            warn(
                f"{other.path}: its images are taken up to {np.abs(apart).max():.1f} frames before or after those of "
                f"{first.path.name}; the option resample corrects that"
            )
    measured = nominal_rate(float(np.median([each.fps for each in known])), len(first.seconds))
    if fps is not None:
        drift = (len(first.seconds) - 1) * abs(measured / fps - 1)
        if abs(fps / measured - 1) > ROUNDED and drift >= DRIFT_FRAMES:
            raise _contradiction(
                f"{where}: fps = {fps:g}, but {first.path} has {measured:.5g} frames/s; remove fps, or correct it; if "
                f'the videos play in slow motion what was recorded at {fps:g} frames/s, add times = "fps"',
                resample=fps < measured,
            )
    for each in known:
        if each.irregularity >= DRIFT_FRAMES:
            warn(
                f"{each.path}: has a variable frame rate: images are up to {each.irregularity:.1f} frames away from "
                f"regular times; the option resample corrects that"
            )
    return fps or measured


def _contradiction(message: str, resample: bool) -> ClockError:
    return ClockError(message, hint="or choose frames by their time stamps with --resample" if resample else "")


def image_interval(seconds: Float) -> float:
    """Return a camera's mean interval from one image to the next, seconds, without the gaps of missing images."""
    intervals = np.diff(seconds)
    return float(intervals[intervals < _GAP * np.median(intervals)].mean())


def slowest_rate(stamps: Sequence[Stamps]) -> float:
    """Return the rate of the slowest camera, 1/s, as cameras name it."""
    return min(nominal_rate(nominal_rate(each.own_rate), len(each.seconds)) for each in stamps)


def chapter_shifts(times: Sequence[Float]) -> list[float]:
    """Return what is added to the time stamps of each chapter of a recording, seconds: 0 for the first; a further one
    begins one interval of the chapter before it after the end of that chapter. A chapter has two images or more."""
    shifts = [0.0]
    known = next(own for own in times if len(own) > 1)
    for before, own in pairwise(times):
        known = before if len(before) > 1 else known
        shifts.append(float(before[-1] + shifts[-1] + image_interval(known) - own[0]))
    return shifts


def nominal_rate(fps: float, count: int = 0) -> float:
    """Return a whole rate, or 1000/1001 of one, if the measured rate differs only by the camera's clock; with a
    ``count`` of time stamps, by their rounding."""
    for nominal in (round(fps), round(1.001 * fps) / 1.001):
        if abs(nominal / fps - 1) < (ROUNDED_INTERVAL / count if count else _CRYSTAL):
            return float(nominal)
    return fps
