"""Videos that stay where they are: the files that `[videos]` in `capture.toml` names, also in chapters."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, VideoError
from tk.io.captures.calibration import Calibration, match_camera
from tk.io.captures.capture_toml import GivenVideo
from tk.io.captures.clip import Clip, Image, Reader
from tk.io.captures.clip_folder import check_calibrated
from tk.io.captures.timing import Stamps, chapter_shifts, own_times
from tk.io.captures.video import as_calibrated, probe_video

Float = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Chapters(Clip):
    """The images of several files, one after the other."""

    clips: tuple[Clip, ...]

    @staticmethod
    def of(clips: Sequence[Clip]) -> Chapters:
        """Return the chapters of one video, in order.

        Raises:
            VideoError: they differ in size.
        """
        first = clips[0]
        for clip in clips:
            if (clip.width, clip.height) != (first.width, first.height):
                raise VideoError(
                    f"{clip.path}: is {clip.width}×{clip.height}, but the chapter {first.path} "
                    f"{first.width}×{first.height}; give chapters of one recording"
                )
        count = sum(clip.frame_count for clip in clips)
        times = _joined([clip.times_s for clip in clips])
        return Chapters(first.path, first.width, first.height, count, times_s=times, clips=tuple(clips))

    @property
    def parts(self) -> tuple[Clip, ...]:
        return self.clips

    def open(self) -> Reader:
        return _ChapterReader(self)

    def reduced(self, factor: int) -> Chapters:
        return Chapters.of([clip.reduced(factor) for clip in self.clips])


def _joined(times: Sequence[Float | None]) -> Float | None:
    """Return the times of all chapters, one after the other; None if a file gives none."""
    known = [own for own in times if own is not None and len(own)]
    if len(known) < len(times) or max(map(len, known)) < 2:
        return None
    return np.concatenate([own + shift for own, shift in zip(known, chapter_shifts(known), strict=True)])


class _ChapterReader:
    def __init__(self, clip: Chapters) -> None:
        self._clips = clip.clips
        self._first = 0  # number of the first image of the current chapter
        self._chapter = 0
        self._index = 0  # of the next image in the current chapter
        self._reader: Reader | None = None

    def _current(self) -> Reader:
        while self._index >= self._clips[self._chapter].frame_count and self._chapter + 1 < len(self._clips):
            self.close()
            self._first += self._clips[self._chapter].frame_count
            self._index -= self._clips[self._chapter].frame_count
            self._chapter += 1
        self._reader = self._reader or self._clips[self._chapter].open()
        return self._reader

    def skip(self) -> None:
        self._current().skip()
        self._index += 1

    def read(self, out: Image) -> None:
        self._current().read(out)
        self._index += 1

    def jump(self, number: int) -> int:
        if number - self._first >= self._clips[self._chapter].frame_count:
            # later chapters are opened at their first image
            while (rest := number - self._first - self._clips[self._chapter].frame_count) >= 0:
                if self._chapter + 1 == len(self._clips):
                    break
                self.close()
                self._first = number - rest
                self._chapter, self._index = self._chapter + 1, 0
        self._index = self._current().jump(number - self._first)
        return self._first + self._index

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def open_video_files(paths: Sequence[Path], size: tuple[int, int] | None = None) -> Clip:
    """Return the clip of a video file, or of several chapters. PyAV decodes it, which can begin in the middle.

    Args:
        paths: the files.
        size: of the calibrated images, pixels: turned files of which only the coded images have this size are not
            turned.

    Raises:
        VideoError: a file cannot be read.
    """
    clips: list[Clip] = []
    for path in paths:
        clip = replace(probe_video(path), first=None)
        clips.append(clip if size is None else as_calibrated(clip, size))
    return clips[0] if len(clips) == 1 else Chapters.of(clips)


def open_referred(
    folder: Path, videos: Mapping[str, GivenVideo], sizes: Mapping[str, tuple[int, int]] | None = None
) -> dict[str, Clip]:
    """Return the clips of `[videos]` by name, read side by side; ``sizes``: of the calibrated images, for those that
    are wanted.

    Raises:
        CaptureError: a file is missing, is given twice, or cannot be read, or a folder of the capture contradicts them.
    """
    for name in ("videos", "images", "timestamps"):
        if (folder / name).is_dir():
            raise CaptureError(
                f"{folder / 'capture.toml'}: has [videos], and the folder {name}/ is there, too; keep one of them"
            )
    files: dict[str, list[Path]] = {}
    users: dict[Path, str] = {}
    gone = "does not exist; put the video back, correct the path, or run tk sync again"
    for name, video in videos.items():
        where = f"{folder / 'capture.toml'}: [videos.{name}]"
        files[name] = [folder / path for path in video.paths]
        for path, given in zip(files[name], video.paths, strict=True):
            if not path.is_file():
                what = "is a folder; name its video, or a list of its chapters" if path.is_dir() else gone
                raise VideoError(f"{where}: path {given} {what}")
            other = users.setdefault(path.resolve(), name)
            if other != name or files[name].count(path) > 1:
                raise VideoError(f"{where}: {given} is given twice, also in [videos.{other}]; name each file once")
    wanted = [name for name in files if sizes is None or name in sizes]
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        clips = threads.map(lambda name: open_video_files(files[name], (sizes or {}).get(name)), wanted)
        return dict(zip(wanted, clips, strict=True))


def referred_clips(
    folder: Path, videos: Mapping[str, GivenVideo], calibration: Calibration, known: Calibration
) -> tuple[tuple[Clip, ...], tuple[GivenVideo, ...]]:
    """Return each camera's clip, and its entry in `[videos]`.

    Args:
        folder: of the capture.
        videos: `[videos]` of its `capture.toml`.
        calibration: of the cameras that are used.
        known: of all cameras.

    Raises:
        CaptureError: a name belongs to no camera, a camera has no video, or a video cannot be read or has another size.
    """
    where = folder / "capture.toml"
    names: dict[str, str] = {}  # of the tables, by camera
    for camera, key in zip(known.rig, known.keys, strict=True):
        try:
            table = match_camera(camera.name, key, videos)
        except CaptureError as ambiguous:
            raise CaptureError(f"{where}: [videos]: {ambiguous}") from None
        if table in names.values():
            raise CaptureError(f"{where}: [videos.{table}]: fits several cameras; rename it to its camera")
        if table is not None:
            names[camera.name] = table
    for table in videos:
        if table not in names.values():
            raise CaptureError(
                f"{where}: [videos.{table}]: {known.path.name} has no such camera; it has {', '.join(known.rig.names)}"
            )
    sizes = {}
    for camera in calibration.rig:
        if camera.name not in names:
            raise VideoError(f"{where}: camera {camera.name!r} has no table in [videos]; add [videos.{camera.name}]")
        sizes[names[camera.name]] = camera.width, camera.height
    opened = open_referred(folder, videos, sizes)
    for camera in calibration.rig:
        check_calibrated(opened[names[camera.name]], camera, known.path.name)
    chosen = [names[name] for name in calibration.rig.names]
    return tuple(opened[table] for table in chosen), tuple(videos[table] for table in chosen)


def referred_stamps(
    clips: Sequence[Clip], videos: Sequence[GivenVideo], regular: float | None
) -> tuple[Stamps | None, ...]:
    """Return the common times of each clip's images; None if its file gives none. ``regular``: own times are those of
    this rate, 1/s."""
    found: list[Stamps | None] = []
    for clip, video in zip(clips, videos, strict=True):
        times = own_times(clip, regular)
        found.append(
            None
            if times is None or len(times) < 2
            else Stamps(clip.path, video.offset_s + video.rate * times, common=True)
        )
    return tuple(found)
