"""The videos of a project: which folder holds them, and which camera made which."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tk.errors import CaptureError, VideoError
from tk.io.captures.calibration import match_camera
from tk.io.captures.video import PICTURE_SUFFIXES, VIDEO_SUFFIXES

#: video files that tk does not read; they are named when nothing else is found
_OTHER_VIDEOS = (".m4v", ".mts", ".m2ts", ".webm", ".wmv", ".mpg", ".mpeg", ".flv", ".3gp", ".ts")

#: words in the names of cameras and files that tell nothing about which camera it is
_COMMON_WORDS = frozenset({"int", "ext", "img", "calib", "video", "synchronized", "sync", "camera", "cam", "port"})

#: a name of numbers alone that is shorter than this ("1", "02") may be within another by chance
_TELLING = 4

#: files of a folder that are looked at before it is taken to hold no pictures
_GLANCE = 200


@dataclass(frozen=True)
class Places:
    """Where a tool keeps its videos.

    Attributes:
        folders: patterns relative to the project's folder, "." being the folder itself; the first that matches counts.
        pictures: single pictures count, too.
    """

    folders: tuple[str, ...]
    pictures: bool = False


@dataclass(frozen=True)
class Wanted:
    """A camera whose video is looked for: its ``name``, and a second name, its ``key`` in the calibration."""

    name: str
    key: str


@dataclass(frozen=True)
class Found:
    """The videos of a recording.

    Attributes:
        folder: that holds them.
        clips: of each camera, None where there is none.
        notes: how they were matched, where that is not plain, and what was left over.
    """

    folder: Path
    clips: tuple[Path | None, ...]
    notes: tuple[str, ...] = ()


def find_clips(
    root: Path,
    places: Places,
    cameras: Sequence[Wanted],
    trial: str | None,
    in_order: bool,
) -> Found:
    """The video of each camera in the project's folder.

    Args:
        root: the project's folder.
        places: where in it to look.
        cameras: whose videos.
        trial: a part of the path of the videos that are meant.
        in_order: where names tell nothing, the first camera belongs to the first video, and so on.

    Raises:
        VideoError: there are no videos, several recordings, or names that cannot be matched; it says what there is.
    """
    folder, clips = _one_set(root, places, trial)
    order = match_clips(cameras, list(clips), in_order)
    if order is None:
        names = ", ".join(camera.name for camera in cameras[:12]) + (", …" if len(cameras) > 12 else "")
        hint = "rename the videos to the cameras' names"
        raise VideoError(
            f"{folder}: cannot tell which video belongs to which camera: the cameras are {names}, the videos "
            f"{_some(clips)}; {hint if trial else f'choose a recording with --trial NAME, or {hint}'}"
        )
    notes = []
    stems = [None if stem is None else clips[stem] for stem in order.stems]
    if order.by == "order":
        pairs = ", ".join(
            f"{camera.name} ↔ {stem.name}" for camera, stem in zip(cameras, stems, strict=True) if stem is not None
        )
        notes.append(f"{folder}: the names do not tell, so cameras and videos are matched in their order: {pairs}")
    left = sorted(set(clips) - {stem for stem in order.stems if stem is not None})
    if left:
        notes.append(f"{folder}: belongs to no camera: {_some(left)}")
    return Found(folder, tuple(stems), tuple(notes))


def clips_in(folder: Path, pictures: bool = False) -> dict[str, Path]:
    """The clips that a folder holds, by name: video files; else folders of pictures, or of one video each.

    Symbolic links are followed; pipes and devices are not clips.

    Raises:
        VideoError: two files have one name, but for the suffix.
    """
    files = _regular(folder)
    suffixes = VIDEO_SUFFIXES + (PICTURE_SUFFIXES if pictures else ())
    clips: dict[str, Path] = {}
    for path in files:
        if path.suffix.lower() in suffixes:
            if path.stem in clips:
                raise VideoError(f"{folder}: holds both {clips[path.stem].name} and {path.name}; keep one of them")
            clips[path.stem] = path
    if clips:
        return clips
    for below in _folders(folder):
        inside = _regular(below)
        videos = [path for path in inside if path.suffix.lower() in VIDEO_SUFFIXES]
        numbered = [
            path
            for path in inside[:_GLANCE]
            if path.suffix.lower() in PICTURE_SUFFIXES and re.search(r"[0-9]$", path.stem)
        ]
        if len(videos) == 1:
            clips[below.name] = videos[0]
        elif numbered and not videos:
            clips[below.name] = below
    return clips


@dataclass(frozen=True)
class _Order:
    """The stem of each camera's clip, and ``by`` what they were matched."""

    stems: tuple[str | None, ...]
    by: str


def match_clips(cameras: Sequence[Wanted], stems: Sequence[str], in_order: bool) -> _Order | None:
    """The clip's name of each camera; None when it cannot be told for two cameras at least.

    Tried in this order, the one that matches most cameras counts, and none may match two cameras with one clip: equal
    names; one name within the other ("cam01" in "int_cam01_img"); the number in which the names differ ("cam_0",
    "port_0"); what is left of the names without their common beginning and end ("A", "trial1-camA"); and, where
    ``in_order``, the order of the names.
    """
    ways: list[tuple[str, Callable[[], list[str | None]]]] = [
        ("name", lambda: [_equal(camera, stems) for camera in cameras]),
        ("part", lambda: [_within(camera, stems) for camera in cameras]),
        ("number", lambda: _by_difference(cameras, stems, _distinct_numbers)),
        ("difference", lambda: _by_difference(cameras, stems, _differences)),
    ]
    best: _Order | None = None
    for by, way in ways:
        found = way()
        taken = [stem for stem in found if stem is not None]
        if len(taken) < 2 or len(set(taken)) < len(taken):
            continue
        if best is None or len(taken) > len(best.stems) - best.stems.count(None):
            best = _Order(tuple(found), by)
    if best is None and in_order and len(stems) == len(cameras) >= 2:
        by_name = sorted(range(len(cameras)), key=lambda index: natural(cameras[index].name))
        ordered: list[str | None] = [None] * len(cameras)
        for index, stem in zip(by_name, sorted(stems, key=natural), strict=True):
            ordered[index] = stem
        best = _Order(tuple(ordered), "order")
    return best


def natural(text: str) -> list[tuple[int, str]]:
    """A key that sorts numbers in names by value: cam2 before cam10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", text) if part]


def _equal(camera: Wanted, stems: Sequence[str]) -> str | None:
    try:
        return match_camera(camera.name, camera.key, stems)
    except CaptureError:  # ambiguous
        return None


def _words(text: str) -> tuple[str, ...]:
    """The words and numbers of a name, without leading zeros: "Cam_01" is ("cam", "1")."""
    found = re.findall(r"[a-z]+|[0-9]+", text.lower())
    return tuple(word.lstrip("0") or "0" if word.isdigit() else word for word in found)


def _within(camera: Wanted, stems: Sequence[str]) -> str | None:
    """The one stem that contains a name of the camera, or is contained in it, word by word."""
    for name in dict.fromkeys((camera.name, camera.key)):
        inner = [stem for stem in stems if _tells(name) and _contains(_words(stem), _words(name))]
        outer = [stem for stem in stems if _tells(stem) and _contains(_words(name), _words(stem))]
        for found in (inner, outer):
            if len(found) == 1:
                return found[0]
    return None


def _tells(name: str) -> bool:
    """Whether a name, found within another, can be no chance."""
    words = _words(name)
    return not set(words) <= _COMMON_WORDS and (len(name) >= _TELLING or not all(word.isdigit() for word in words))


def _contains(words: tuple[str, ...], part: tuple[str, ...]) -> bool:
    n = len(part)
    return n > 0 and any(words[start : start + n] == part for start in range(len(words) - n + 1))


def _by_difference(
    cameras: Sequence[Wanted], stems: Sequence[str], differences: Callable[[Sequence[str]], list[str]]
) -> list[str | None]:
    """By that in which the names differ; all there is of the cameras must be there of the stems, or vice versa.

    "cam1" to "cam4" and "0" to "3" are thus not matched: which is which would be a guess.
    """
    theirs = differences(stems)
    for names in ([camera.name for camera in cameras], [camera.key for camera in cameras]):
        own = differences(names)
        if own and theirs and (set(own) <= set(theirs) or set(theirs) <= set(own)):
            return [stems[theirs.index(value)] if value in theirs else None for value in own]
    return [None] * len(cameras)


def _distinct_numbers(names: Sequence[str]) -> list[str]:
    """A number of each name, at the same place in all, in which no two agree; [] if there is none or several."""
    rows = [_words(name) for name in names]
    if len({len(row) for row in rows}) != 1:
        return []
    columns = [
        list(column)
        for column in zip(*rows, strict=True)
        if all(word.isdigit() for word in column) and len(set(column)) == len(column)
    ]
    return columns[0] if len(columns) == 1 else []


def _differences(names: Sequence[str]) -> list[str]:
    """Each name without the beginning and the end that all have in common; [] if nothing is left of one."""
    if not names:
        return []
    start = _shared(names)
    rest = [name[start:] for name in names]
    end = _shared([name[::-1] for name in rest])
    left = [name[: len(name) - end].lower().lstrip("0") for name in rest]
    return left if all(left) and len(set(left)) == len(left) else []


def _shared(names: Sequence[str]) -> int:
    """How many characters all names begin with in common."""
    first, last = min(names), max(names)
    same = (index for index, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    return next(same, min(len(first), len(last)))


def _one_set(root: Path, places: Places, trial: str | None) -> tuple[Path, Mapping[str, Path]]:
    """The folder of the one recording that is meant, and its clips."""
    looked: list[str] = []
    for pattern in places.folders:
        found: dict[Path, dict[str, Path]] = {}
        for folder in [root] if pattern == "." else sorted(root.glob(pattern)):
            if folder.is_dir():
                clips = clips_in(folder, places.pictures)
                if trial is not None and trial not in str(folder.relative_to(root)):
                    clips = {stem: path for stem, path in clips.items() if trial in str(path.relative_to(folder))}
                if len(clips) >= 2:
                    found[folder] = clips
        if len(found) == 1:
            return next(iter(found.items()))
        if found:
            names = _some([str(folder.relative_to(root)) for folder in found])
            raise VideoError(
                f"{root}: holds videos of several recordings, in {names}; choose one with --trial NAME"
                + (f", {trial!r} is in the path of all of them" if trial else "")
            )
        looked.append("the folder itself" if pattern == "." else pattern)
    others = sorted(path.name for path in _regular(root) if path.suffix.lower() in _OTHER_VIDEOS)
    because = f" of the trial {trial!r}" if trial else ""
    if others:
        raise VideoError(
            f"{root}: {_some(others)}: tk reads {', '.join(VIDEO_SUFFIXES)}; convert them, e.g. with ffmpeg"
        )
    raise VideoError(f"{root}: holds no videos{because} of two cameras; looked in {', '.join(looked)}")


def _regular(folder: Path) -> list[Path]:
    return [path for path in _listed(folder) if path.is_file()]


def _folders(folder: Path) -> list[Path]:
    return [path for path in _listed(folder) if path.is_dir()]


def _listed(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as reason:
        raise VideoError(f"{folder}: cannot be read ({reason.strerror or reason})") from None


def _some(names: Iterable[str], most: int = 8) -> str:
    listed = list(names)
    return ", ".join(listed[:most]) + (f" and {len(listed) - most} more" if len(listed) > most else "")
