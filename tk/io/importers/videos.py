"""Find the videos of a project, and match them with the cameras by their names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tk.errors import CaptureError, VideoError
from tk.io.captures.calibration import match_camera
from tk.io.captures.pictures import PICTURE_SUFFIXES
from tk.io.captures.video import VIDEO_SUFFIXES

#: words in names of cameras and files that do not identify a camera
_COMMON_WORDS = frozenset({"int", "ext", "img", "calib", "video", "synchronized", "sync", "camera", "cam", "port"})

#: shortest name of digits alone that identifies a camera as a part of another name: "1" or "02" may be chance, serial
#: numbers have more digits
_LEAST_DIGITS = 4


@dataclass(frozen=True)
class CameraNames:
    """A camera's name, and its key in the calibration; its video may have either name."""

    name: str
    key: str


@dataclass(frozen=True)
class Found:
    """The videos of a recording."""

    folder: Path  # the folder with the videos
    clips: tuple[Path | None, ...]  # video file or folder of images of each camera, None without one
    notes: tuple[str, ...] = ()  # lines about a match that is not obvious, and about videos without a camera


def find_clips(
    root: Path,
    patterns: Sequence[str],
    cameras: Sequence[CameraNames],
    trial: str | None,
    in_order: bool,
    images: bool = False,
) -> Found:
    """Find the video of each camera in the project's folder.

    Args:
        root: the project's folder.
        patterns: folders in it, "." being the folder itself; the first pattern with videos is used.
        cameras: their names.
        trial: a part of the path of the videos, None to accept any.
        in_order: if names do not match, the first camera belongs to the first video, and so on.
        images: accept single images as clips.
    """
    folder, clips = _one_recording(root, patterns, trial, images)
    notes: list[str] = []
    stems, how = match_clips(cameras, list(clips)), "names differ, so cameras and videos are matched by parts of them"
    if stems is None and in_order and len(clips) == len(cameras):
        stems = in_order_of_names(cameras, list(clips))
        how = "names do not match, so cameras and videos are matched in their order"
    if stems is None:
        names = ", ".join(camera.name for camera in cameras[:12]) + (", …" if len(cameras) > 12 else "")
        raise VideoError(
            f"{folder}: cannot match videos and cameras by name: the cameras are {names}, the videos "
            f"{_some(clips)}; rename the videos to the cameras' names",
            hint="" if trial else "or choose a recording with --trial NAME",
        )
    pairs = [(camera, stem) for camera, stem in zip(cameras, stems, strict=True) if stem is not None]
    if any(stem not in (camera.name, camera.key) for camera, stem in pairs):
        notes.append(f"{folder}: {how}: " + ", ".join(f"{camera.name} ↔ {clips[stem].name}" for camera, stem in pairs))
    if left := sorted(set(clips) - set(stems)):
        notes.append(f"{folder}: no camera matches {_some(left)}")
    return Found(folder, tuple(clips.get(stem or "") for stem in stems), tuple(notes))


def _clips_in(folder: Path, images: bool) -> dict[str, Path]:
    """Return the clips in a folder by name: video files; without any, folders of images or of one video each.

    Symbolic links are followed; pipes and devices are not clips.
    """
    files = _regular(folder)
    suffixes = VIDEO_SUFFIXES + (PICTURE_SUFFIXES if images else ())
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
        numbered = any(path.suffix.lower() in PICTURE_SUFFIXES and re.search(r"[0-9]$", path.stem) for path in inside)
        if len(videos) == 1:
            clips[below.name] = videos[0]
        elif numbered and not videos:
            clips[below.name] = below
    return clips


def match_clips(cameras: Sequence[CameraNames], stems: Sequence[str]) -> Sequence[str | None] | None:
    """Return the clip's name of each camera, matched by name; None if fewer than two cameras match.

    The first rule that matches most cameras counts, and no rule may match two cameras with one clip: equal names; one
    name within the other ("cam01" in "int_cam01_img"); the number in which the names differ ("cam_0", "port_0"); the
    names without their common beginning and end ("A", "trial1-camA"). Of as many clips as cameras, all must match:
    "cam1" to "cam4" and "cam0" to "cam3" may be the same cameras.
    """
    best, most = None, 1
    for found in (
        [_equal(camera, stems) for camera in cameras],
        [_within(camera, stems) for camera in cameras],
        _by_difference(cameras, stems, _distinct_numbers),
        _by_difference(cameras, stems, _differences),
    ):
        taken = [stem for stem in found if stem is not None]
        whole = len(taken) == len(cameras) or len(cameras) != len(stems)
        if whole and len(taken) == len(set(taken)) > most:
            best, most = found, len(taken)
    return best


def in_order_of_names(cameras: Sequence[CameraNames], stems: Sequence[str]) -> list[str]:
    """Return the clip's name of each camera: the first name of a clip for the first name of a camera, and so on."""
    order = sorted(range(len(cameras)), key=lambda index: natural(cameras[index].name))
    return [stem for _, stem in sorted(zip(order, sorted(stems, key=natural), strict=True))]


def natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by value: cam2 before cam10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", text) if part]


def _equal(camera: CameraNames, stems: Sequence[str]) -> str | None:
    try:
        return match_camera(camera.name, camera.key, stems)
    except CaptureError:  # ambiguous
        return None


def _words(text: str) -> tuple[str, ...]:
    """Return the words and numbers of a name, without leading zeros: ("cam", "1") for "Cam_01"."""
    found = re.findall(r"[a-z]+|[0-9]+", text.lower())
    return tuple(word.lstrip("0") or "0" if word.isdigit() else word for word in found)


def _within(camera: CameraNames, stems: Sequence[str]) -> str | None:
    """Return the one stem that contains a name of the camera, or is contained in it, word by word."""
    for name in dict.fromkeys((camera.name, camera.key)):
        inner = [stem for stem in stems if _identifies(name) and _contains(_words(stem), _words(name))]
        outer = [stem for stem in stems if _identifies(stem) and _contains(_words(name), _words(stem))]
        for found in (inner, outer):
            if len(found) == 1:
                return found[0]
    return None


def _identifies(name: str) -> bool:
    """Return whether a name as a part of another name identifies a camera."""
    words = _words(name)
    return not set(words) <= _COMMON_WORDS and (len(name) >= _LEAST_DIGITS or not all(word.isdigit() for word in words))


def _contains(words: tuple[str, ...], part: tuple[str, ...]) -> bool:
    n = len(part)
    return n > 0 and any(words[start : start + n] == part for start in range(len(words) - n + 1))


def _by_difference(
    cameras: Sequence[CameraNames], stems: Sequence[str], differences: Callable[[Sequence[str]], list[str]]
) -> list[str | None]:
    """Match by the part in which the names differ; the cameras' parts must all occur in the stems, or vice versa.

    "cam1" to "cam4" and "0" to "3" are thus not matched, because that would be a guess.
    """
    theirs = differences(stems)
    for names in ([camera.name for camera in cameras], [camera.key for camera in cameras]):
        own = differences(names)
        if own and theirs and (set(own) <= set(theirs) or set(theirs) <= set(own)):
            return [stems[theirs.index(value)] if value in theirs else None for value in own]
    return [None] * len(cameras)


def _distinct_numbers(names: Sequence[str]) -> list[str]:
    """Return the number in each name, at the same place in all, that is distinct; [] if there is none or several."""
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
    """Return each name without the common beginning and end of all names; [] if nothing is left of one."""
    if not names:
        return []
    start = _shared(names)
    rest = [name[start:] for name in names]
    end = _shared([name[::-1] for name in rest])
    left = [name[: len(name) - end].lower().lstrip("0") for name in rest]
    return left if all(left) and len(set(left)) == len(left) else []


def _shared(names: Sequence[str]) -> int:
    """Return the length of the beginning that all names have in common."""
    first, last = min(names), max(names)
    same = (index for index, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    return next(same, min(len(first), len(last)))


def _one_recording(
    root: Path, patterns: Sequence[str], trial: str | None, images: bool
) -> tuple[Path, Mapping[str, Path]]:
    """Return the folder of the one recording that matches, and its clips."""
    searched: list[str] = []
    for pattern in patterns:
        found: dict[Path, dict[str, Path]] = {}
        for folder in [root] if pattern == "." else sorted(root.glob(pattern)):
            if folder.is_dir():
                clips = _clips_in(folder, images)
                if trial is not None and trial not in str(folder.relative_to(root)):
                    clips = {stem: path for stem, path in clips.items() if trial in str(path.relative_to(folder))}
                if len(clips) >= 2:
                    found[folder] = clips
        if len(found) == 1:
            return next(iter(found.items()))
        if found:
            names = _some([str(folder.relative_to(root)) for folder in found])
            raise VideoError(
                f"{root}: holds videos of several recordings, in {names}; choose one"
                + (f", {trial!r} is in the path of all of them" if trial else ""),
                hint="with --trial NAME",
            )
        searched.append("the folder itself" if pattern == "." else pattern)
    of_trial = f" of the trial {trial!r}" if trial else ""
    there = _some(path.name for path in _listed(root)) or "nothing"
    raise VideoError(
        f"{root}: holds no videos{of_trial} of two cameras; searched in {', '.join(searched)}; the folder holds "
        f"{there}; tk reads {', '.join(VIDEO_SUFFIXES)}"
    )


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
