"""`capture.toml`: description of a capture. Every key is optional."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tk.errors import ConfigError, VolumeError
from tk.io.captures.session import SESSION, described, merged, session_of
from tk.io.toml import Table, load_toml
from tk.model.cameras.up import up_text
from tk.model.cameras.volume import Volume

#: known initialisation poses; "any": the subject may begin in any pose
INIT_POSES = ("da-vinci", "any")

#: what gives the times of images: time stamps, else the files; or `fps`, with files that play at another rate
TIMES = ("files", "fps")

#: range of the frame rate, 1/s: from one image in 100 s to the fastest cameras
FPS_RANGE = (0.01, 1e5)

#: metres, largest side of a working volume, and largest distance of its centre from the origin
_MOST_VOLUME_M, _FARTHEST_M = 1000.0, 1e6

_KEYS: dict[str, tuple[str, ...]] = {
    "background": ("from", "to"),
    "volume": ("center", "size"),
    "subject": ("height", "position", "body", "init"),
    "init": ("frame", "pose", "keypoints"),
}
_TOP_KEYS = ("name", "fps", "times", "up", "from", "to", "videos", *_KEYS)
_VIDEO_KEYS = ("path", "offset", "rate")


@dataclass(frozen=True)
class GivenVideo:
    """A video that is not in `videos/`: a table `[videos.NAME]`.

    Attributes:
        paths: its file, or its chapters in order, relative to the capture's folder.
        offset_s, rate: an image is taken at offset_s + rate * own time, seconds of the capture's common time; own time
            is its time stamp in the file.
    """

    paths: tuple[str, ...]
    offset_s: float = 0.0
    rate: float = 1.0


@dataclass(frozen=True)
class Span:
    """The part of a recording that is used, in seconds of the common time; None: not given.

    Attributes:
        begin, end: the frames, ``end`` exclusive.
        empty: begin and end of the part with the empty scene, which is the background.
    """

    begin: float | None = None
    end: float | None = None
    empty: tuple[float, float] | None = None


@dataclass(frozen=True)
class GivenSubject:
    """A person as `capture.toml` describes one: the table `[subject]`, or one of several `[[subject]]`.

    Attributes:
        height_m: height without shoes, metres.
        position: (x, y, z) metres, rough position in the frame of the initialisation.
        body, init: files with a body and with a rough pose, relative to the capture's folder.
    """

    height_m: float | None = None
    position: tuple[float, float, float] | None = None
    body: str | None = None
    init: str | None = None


@dataclass(frozen=True)
class CaptureSettings:
    """Content of `capture.toml`; None for keys that it does not have.

    Attributes:
        name: name of the capture.
        fps: frame rate, 1/s.
        times: one of :data:`TIMES`.
        up: axis that points up in the world, as :func:`tk.model.cameras.up.up_text` writes it: "z", or a unit vector.
            None: inferred from the cameras.
        volume: the working volume, metres.
        subjects: the people, at least one.
        init_frame: the frame in which the subject stands in the initialisation pose.
        init_pose: one of :data:`INIT_POSES`.
        init_keypoints: folder of 2D keypoints of the first pose, relative to the capture's; None if there is none.
        videos: the videos that are not in `videos/`, by name.
        span: the part of the recording that is used.
        unknown: unknown keys, for example misspelt ones.
        inherited: notes about what comes from the session.
    """

    name: str | None = None
    fps: float | None = None
    times: str = "files"
    up: str | None = None
    volume: Volume | None = None
    subjects: tuple[GivenSubject, ...] = (GivenSubject(),)
    init_frame: int = 0
    init_pose: str = "da-vinci"
    init_keypoints: str | None = None
    videos: Mapping[str, GivenVideo] = field(default_factory=dict)
    span: Span = Span()
    unknown: tuple[str, ...] = ()
    inherited: tuple[str, ...] = ()


def read_settings(path: Path) -> CaptureSettings:
    """Read `capture.toml`; a missing file counts as an empty one. A capture in a session inherits its settings.

    Raises:
        CaptureError: invalid TOML or a value out of range, with the file and the key.
        VolumeError: the working volume is empty.
    """
    own = load_toml(path) if path.exists() else {}
    if (session := session_of(path.parent)) is None:
        return _settings(path, own)
    shared = _settings(session / SESSION, merged(path.parent, {}))  # before the trial's: its errors name its file
    notes = described(path.parent, own)
    if shared.unknown:
        notes.append(f"{session / SESSION}: unknown keys are ignored: {', '.join(shared.unknown)}")
    found = _settings(path, merged(path.parent, own))
    return replace(found, unknown=_unknown_keys(own), inherited=tuple(notes))


def _settings(path: Path, values: dict[str, Any]) -> CaptureSettings:
    """Return the settings in a document; ``path``: the file that errors name."""
    document = Table(values, str(path))

    fps = document.number("fps") if "fps" in document else None
    if fps is not None and fps <= 0:
        document.fail(f"fps = {fps:g} must be positive")
    if fps is not None and not FPS_RANGE[0] <= fps <= FPS_RANGE[1]:
        document.fail(f"fps = {fps:g} must be between {FPS_RANGE[0]:g} and {FPS_RANGE[1]:g}")

    times = document.text("times", "files")
    if times not in TIMES:
        document.fail(f"times = {times!r} must be one of {', '.join(TIMES)}")
    if times == "fps" and fps is None:
        document.fail('times = "fps" needs fps, the rate at which the videos were recorded')

    up = _up(document) if "up" in document else None

    init = document.table("init")
    init_frame = init.integer("frame", 0)
    if init_frame < 0:
        init.fail(f"frame = {init_frame} must not be negative")
    init_pose = init.text("pose", "da-vinci")
    if init_pose not in INIT_POSES:
        init.fail(f"pose = {init_pose!r} must be one of {', '.join(INIT_POSES)}")

    return CaptureSettings(
        name=document.text("name", "") if "name" in document else None,
        fps=fps,
        times=times,
        up=up,
        volume=_volume(document.table("volume")) if "volume" in document else None,
        subjects=_subjects(document),
        init_frame=init_frame,
        init_pose=init_pose,
        init_keypoints=init.text("keypoints", "") if "keypoints" in init else None,
        videos=_videos(document.table("videos")),
        span=_span(document),
        unknown=_unknown_keys(document.values),
    )


def _videos(table: Table) -> dict[str, GivenVideo]:
    videos = {}
    for name in table.values:
        video = table.table(name)
        video.where = f"{table.where.removesuffix('[videos]')}[videos.{name}]"
        paths = video.values.get("path")
        paths = paths if isinstance(paths, list) else [paths]
        if not paths or not all(isinstance(path, str) and path.strip() for path in paths):
            video.fail("path must be the name of a file, or a list of the names of its chapters in order")
        rate = video.number("rate", 1.0)
        if rate <= 0:
            video.fail(f"rate = {rate:g} must be positive; it is the seconds of the common time in one of the video's")
        videos[name] = GivenVideo(tuple(paths), video.number("offset", 0.0), rate)
    return videos


def _span(document: Table) -> Span:
    begin, end = (document.number(key) if key in document else None for key in ("from", "to"))
    if begin is not None and end is not None and begin >= end:
        document.fail(f"from = {begin:g} must be before to = {end:g}, seconds of the common time")
    empty = None
    if "background" in document:
        table = document.table("background")
        empty = table.number("from"), table.number("to")
        if empty[0] >= empty[1]:
            table.fail(f"from = {empty[0]:g} must be before to = {empty[1]:g}, seconds of the common time")
    return Span(begin, end, empty)


def _subjects(document: Table) -> tuple[GivenSubject, ...]:
    listed = document.values.get("subject")
    if not isinstance(listed, list):
        return (_subject(document.table("subject")),)
    if not listed or not all(isinstance(values, dict) for values in listed):
        document.fail("subject must be a table [subject], or several [[subject]]")
    return tuple(
        _subject(Table(values, f"{document.where}: [[subject]] {n}", document.error)) for n, values in enumerate(listed)
    )


def given_height(table: Table) -> float | None:
    """Return the height in a table `[subject]`, metres; None without one."""
    height_m = table.number("height") if "height" in table else None
    if height_m is not None and not 0.3 <= height_m <= 3.0:
        table.fail(f"height = {height_m:g} must be between 0.3 and 3 metres")
    return height_m


def _subject(table: Table) -> GivenSubject:
    return GivenSubject(
        height_m=given_height(table),
        position=_triple(table.array("position", (3,))) if "position" in table else None,
        body=table.text("body", "") if "body" in table else None,
        init=table.text("init", "") if "init" in table else None,
    )


def _up(document: Table) -> str:
    """Return the text of ``up``: the name of an axis, or a vector of any length."""
    value = document.values.get("up", "z")
    try:
        return up_text(document.array("up", (3,)) if isinstance(value, list) else document.text("up", "z"))
    except ConfigError as reason:
        document.fail(str(reason))


def _volume(table: Table) -> Volume:
    table.error = VolumeError
    center = table.array("center", (3,))
    size = table.array("size", (3,))
    if (size <= 0).any():
        table.fail(f"size = {size.tolist()} is empty; give three positive lengths in metres")
    if (size > _MOST_VOLUME_M).any() or (np.abs(center) > _FARTHEST_M).any():
        table.fail(f"center = {center.tolist()}, size = {size.tolist()}: is too large or too far away; give metres")
    return Volume(_triple(center), _triple(size))


def _unknown_keys(document: Any) -> tuple[str, ...]:
    unknown = [key for key in document if key not in _TOP_KEYS]
    for table, keys in _KEYS.items():
        found = document.get(table, {})
        for values in found if isinstance(found, list) else [found]:
            unknown += [f"{table}.{key}" for key in values if key not in keys]
    for name, values in document.get("videos", {}).items():
        unknown += [f"videos.{name}.{key}" for key in values if key not in _VIDEO_KEYS]
    return tuple(unknown)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
