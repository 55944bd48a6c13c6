"""The folder RAW: one video a camera, or one folder a camera with the chapters of a recording in order."""

from __future__ import annotations

import filecmp
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ClockError
from tk.io.captures.calibration import Calibration, match_camera, read_calibration
from tk.io.captures.packets import open_video
from tk.io.captures.timing import chapter_shifts, image_interval
from tk.io.captures.video import VIDEO_SUFFIXES, probe_video
from tk.io.importers.videos import natural
from tk.model.cameras.camera import Camera

Float = NDArray[np.float64]

#: seconds; a shorter video, or a shorter part that two videos have in common, shows too little to be compared
SHORTEST_S = 2.0
#: GoPro's names: GX020012.MP4 is chapter 2 of recording 12; the chapter stands before the number
_GOPRO = re.compile(r"G[HXSL](\d\d)(\d{4})$", re.IGNORECASE)
#: seconds by which a chapter may be created later than the end of the one before: whole seconds, and writing files
_CREATED_S = 5.0
_TIMECODE = re.compile(r"(\d\d):(\d\d):(\d\d)([:;.])(\d+)$")


@dataclass(frozen=True)
class Recording:
    """The video of a camera.

    Attributes:
        name: the camera.
        paths: its files, in order.
        shifts_s: own time minus the time stamps in the file, seconds, of each file; 0 for the first.
        times_s: (N,) own time of all images, seconds: the time stamps in the first file, continued.
        width, height: of the images, turned as the file asks for, pixels.
        turn: degrees, counter-clockwise, by which the file asks players to turn its images.
        created: creation time in the file; None without one.
        timecode_s: timecode of the first image, seconds since midnight; None without one.
    """

    name: str
    paths: tuple[Path, ...]
    shifts_s: tuple[float, ...]
    times_s: Float
    width: int
    height: int
    turn: int = 0
    created: datetime | None = None
    timecode_s: float | None = None

    @property
    def interval_s(self) -> float:
        """Interval of the images, seconds."""
        return image_interval(self.times_s)

    @property
    def span(self) -> tuple[float, float]:
        """Own time at which the video begins and ends, seconds."""
        return float(self.times_s[0]), float(self.times_s[-1]) + self.interval_s

    @property
    def begins_s(self) -> list[float]:
        """Own times at which its files begin, seconds."""
        return [float(self.times_s[0]) + shift for shift in self.shifts_s]

    @property
    def dropped(self) -> int:
        """Number of images that are missing: gaps of about a whole number of intervals."""
        gaps = np.rint(np.diff(self.times_s) / self.interval_s)
        return int((gaps - 1)[gaps > 1].sum())

    @property
    def where(self) -> str:
        """How messages name the recording."""
        return f"camera {self.name}"


def read_raw(folder: Path, cameras: Sequence[str] | None = None) -> list[Recording]:
    """Return the recording of each camera, by name.

    Raises:
        CaptureError: the folder has fewer than two cameras, a name is unknown, a file is there twice, or a chapter is
            missing or out of order.
        VideoError: a file is no video, or cannot be decoded.
        ClockError: a video has no time stamps, or is too short.
    """
    found = list_files(folder)
    for name in cameras or ():
        if name not in found:
            raise CaptureError(f"{folder}: has no camera {name!r}; it has {', '.join(found)}")
    chosen = {name: paths for name, paths in found.items() if cameras is None or name in cameras}
    if len(chosen) < 2:
        raise CaptureError(f"{folder}: holds one camera, {next(iter(chosen))}; tk sync needs the videos of two or more")
    with ThreadPoolExecutor(2) as threads:
        recordings = list(threads.map(lambda item: _read(*item), chosen.items()))
    _check_different([path for recording in recordings for path in recording.paths])
    return recordings


def _check_different(files: Sequence[Path]) -> None:
    """Raise CaptureError if two files are the same."""
    for other, path in combinations(files, 2):
        if path.stat().st_size and filecmp.cmp(other, path, shallow=False):
            raise CaptureError(f"{path}: is the same file as {other}; each camera, and each chapter, needs its own")


def list_files(folder: Path) -> dict[str, tuple[Path, ...]]:
    """Return the files of each camera, in order."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: is not a folder; give the one with a video, or a folder of chapters, per camera")
    if (folder / "videos").is_dir() and not _videos(folder):  # as a capture has them
        folder = folder / "videos"
    found: dict[str, tuple[Path, ...]] = {}
    for group in _recordings(_videos(folder)):
        if group[0].stem in found:
            raise CaptureError(f"{group[0]}: another file has the same name; each camera needs its own")
        found[group[0].stem] = group
    for inner in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
        if not (files := _videos(inner)):
            continue
        if inner.name in found:
            raise CaptureError(f"{inner}: a video has the same name; each camera needs its own")
        groups = list(_recordings(files))
        if len(groups) > 1 and any(_GOPRO.match(file.stem) for file in files):
            raise CaptureError(
                f"{inner}: holds {len(groups)} recordings, {', '.join(group[0].name for group in groups)}; "
                "keep the chapters of one"
            )
        found[inner.name] = tuple(file for group in groups for file in group)
    if not found:
        raise CaptureError(f"{folder}: holds no videos; put one video, or one folder of chapters, per camera into it")
    return dict(sorted(found.items()))


def read_cameras(folder: Path, recordings: Sequence[Recording]) -> tuple[Calibration | None, list[Camera]]:
    """Return the calibration in the folder, and the camera of each recording; None and [] without one.

    Raises:
        CalibrationError: it cannot be read.
        CaptureError: a recording has no camera in it, or another size.
    """
    path = folder / "calibration.toml"
    if not path.exists():
        return None, []
    calibration = read_calibration(path)
    names = [recording.name for recording in recordings]
    cameras: dict[str, Camera] = {}
    for camera, key in zip(calibration.rig, calibration.keys, strict=True):
        if (stem := match_camera(camera.name, key, names)) is not None:
            cameras[stem] = camera
    for name in names:
        if name not in cameras:
            raise CaptureError(
                f"camera {name}: has no camera in {path}, which has {', '.join(calibration.rig.names)}; "
                "name the video as its camera"
            )
    for recording in recordings:
        camera, size = cameras[recording.name], (recording.width, recording.height)
        if (camera.width, camera.height) not in (size, size[::-1] if recording.turn % 180 else size):
            raise CaptureError(
                f"{recording.paths[0]}: {recording.where}: is {size[0]}×{size[1]}, but {path.name} is of "
                f"{camera.width}×{camera.height}; calibrate for this size, or record with the calibrated one"
            )
    return calibration, [cameras[name] for name in names]


def _videos(folder: Path) -> list[Path]:
    named = [path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES and path.name[0] != "."]
    return sorted((path for path in named if not path.is_dir()), key=lambda file: natural(file.name.lower()))


def _recordings(files: Sequence[Path]) -> Iterator[tuple[Path, ...]]:
    """Yield the chapters of each recording in order; files of other names are recordings of their own."""
    groups: dict[str, list[Path]] = {}
    for file in files:
        name = _GOPRO.match(file.stem)
        groups.setdefault(name[2] if name else file.name, []).append(file)
    for group in groups.values():
        chapters = sorted(group)
        numbers = [int(name[1]) for file in chapters if (name := _GOPRO.match(file.stem))]
        for before, number, file in zip(numbers, numbers[1:], chapters[1:], strict=False):
            if number != before + 1:
                raise CaptureError(f"{file}: chapter {before + 1} of this recording is missing before it; copy it, too")
        yield tuple(chapters)


def _read(name: str, paths: tuple[Path, ...]) -> Recording:
    files: list[Float] = []
    first = None
    for path in paths:
        clip = probe_video(path)
        first = first or clip
        if clip.times_s is None or len(clip.times_s) < 2:
            raise ClockError(f"{path}: camera {name}: gives no times of its images; copy it into an MP4 or MOV file")
        if (clip.width, clip.height) != (first.width, first.height):
            raise CaptureError(
                f"{path}: is {clip.width}×{clip.height}; the chapter before it is {first.width}×{first.height}"
            )
        files.append(clip.times_s)
    assert first is not None
    shifts = chapter_shifts(files)
    every = np.concatenate([own + shift for own, shift in zip(files, shifts, strict=True)])
    marks = [_marks(path, image_interval(every)) for path in paths]
    created, timecode = marks[0]
    _check_order(name, paths, [mark[0] for mark in marks], [float(own[-1] - own[0]) for own in files])
    recording = Recording(
        name, paths, tuple(shifts), every, first.width, first.height, first.turn, created, timecode
    )  # fmt: skip
    if recording.span[1] - recording.span[0] < SHORTEST_S:
        raise ClockError(
            f"{paths[0]}: camera {name}: is {recording.span[1] - recording.span[0]:.1f} s long; too short to be "
            f"compared, record {SHORTEST_S:g} s or more"
        )
    return recording


def _check_order(
    name: str, paths: Sequence[Path], created: Sequence[datetime | None], lengths_s: Sequence[float]
) -> None:
    """Check the order of chapters by their creation times, which are those of their start or their end. Cameras that
    write the same time into all chapters say nothing.

    Raises:
        CaptureError: a chapter was created before the one before it, or too late to continue it.
    """
    for k, (one, other) in enumerate(pairwise(created)):
        if one is None or other is None or one == other or (one.tzinfo is None) != (other.tzinfo is None):
            continue
        apart_s = (other - one).total_seconds()
        if apart_s < 0:
            raise CaptureError(
                f"{paths[k + 1]}: camera {name}: was recorded {-apart_s:.0f} s before {paths[k].name}, by their "
                "creation times; name the chapters in their order"
            )
        late_s = apart_s - max(lengths_s[k], lengths_s[k + 1])
        if late_s > _CREATED_S:
            raise CaptureError(
                f"{paths[k + 1]}: camera {name}: was created {apart_s:.0f} s after {paths[k].name}, which lasts "
                f"{lengths_s[k]:.0f} s: a chapter between them is missing, or it is another recording; copy the "
                "chapter, or keep the files of one recording"
            )


def _marks(path: Path, interval_s: float) -> tuple[datetime | None, float | None]:
    """Return the creation time, and the timecode of the first image, seconds since midnight."""
    container, _ = open_video(path)
    with container:
        tables = [container.metadata, *(each.metadata for each in container.streams)]
        created = next((table["creation_time"] for table in tables if "creation_time" in table), None)
        timecode = next((table["timecode"] for table in tables if "timecode" in table), None)
    try:
        time = datetime.fromisoformat(created.replace("Z", "+00:00")) if created else None
    except ValueError:
        time = None
    return time, _timecode_s(timecode, interval_s) if timecode else None


def _timecode_s(text: str, interval_s: float) -> float | None:
    """Return a timecode in seconds; None if it is none. ``;`` or ``.`` before the frames: drop-frame counting."""
    parts = _TIMECODE.match(text)
    if parts is None:
        return None
    hours, minutes, seconds, frames = (int(parts[k]) for k in (1, 2, 3, 5))
    nominal = round(1 / interval_s)
    count = (hours * 3600 + minutes * 60 + seconds) * nominal + frames
    if parts[4] != ":":  # 2 of 30 numbers are left out each minute, except for every tenth
        count -= nominal // 15 * (60 * hours + minutes - (60 * hours + minutes) // 10)
    return count * interval_s
