"""The public functions :func:`tk.open_capture` and :func:`tk.track`."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, overload

import numpy as np

from tk.errors import ConfigError
from tk.io.captures.capture import Capture
from tk.io.captures.source import Source
from tk.io.importers import open_recording
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.model.setup import Setup
from tk.run import session
from tk.run.plan import recording_task
from tk.run.reporter import Silent
from tk.run.task import RecordingOptions, Task, parse_choice
from tk.segmenters import Segmenter
from tk.settings import Settings
from tk.trackers.protocol import Estimate

if TYPE_CHECKING:
    from typing_extensions import Unpack  # in typing from Python 3.11 on

_LOG = logging.getLogger(__name__)

PathLike = str | os.PathLike[str]


class _Logged(Silent):
    """The reporter of scripts: notes become warnings of the logger "tk", each tenth of the frames an INFO record."""

    def __init__(self) -> None:
        self._total = self._done = 0

    def note(self, text: str) -> None:
        _LOG.warning("%s", text)

    def begin(self, total: int, done: int) -> None:
        self._total, self._done = total, done

    def advance(self, frame: int, estimate: object) -> None:
        self._done += 1
        if self._total and 10 * self._done // self._total > 10 * (self._done - 1) // self._total:
            _LOG.info("frame %d: %d/%d", frame, self._done, self._total)


def open_capture(
    path: PathLike, cameras: str | Sequence[str] | None = None, masks: str = "auto", resample: bool = False
) -> Capture:
    """Open a capture folder.

    Args:
        path: the folder with `calibration.toml` and `videos/`.
        cameras: names of the cameras to use, as a list or with commas between them; all if None.
        masks: "auto" (those of the capture, if there are any), "none" (segment the videos), "median" (segment against
            the recording's median), or a folder of masks.
        resample: choose each frame's images by their time stamps, for cameras of different or variable rates.

    Raises:
        tk.errors.CaptureError: what is wrong with the folder, in one line that names the file.
    """
    if isinstance(cameras, str):
        cameras = [name.strip() for name in cameras.split(",")]
    return open_recording(Path(path), tuple(cameras) if cameras else None, masks, resample)


class _Options(TypedDict, total=False):
    """Options of :func:`track`, except capture and output."""

    setup: Setup | None
    method: str
    frames: tuple[int, int | None]
    config: Settings | None
    seed: int | None
    init_pose: PathLike | None
    body: PathLike | None
    people: str | int | Sequence[int]
    segmenter: Segmenter | None
    causal: bool
    resume: bool
    force: bool


@overload
def track(
    capture: Capture | Source | PathLike, output: None = None, **options: Unpack[_Options]
) -> Iterator[Estimate]: ...


@overload
def track(capture: Capture | Source | PathLike, output: PathLike, **options: Unpack[_Options]) -> Result: ...


def track(
    capture: Capture | Source | PathLike,
    output: PathLike | None = None,
    *,
    setup: Setup | None = None,
    method: str = "region",
    frames: tuple[int, int | None] = (0, None),
    config: Settings | None = None,
    seed: int | None = None,
    init_pose: PathLike | None = None,
    body: PathLike | None = None,
    people: str | int | Sequence[int] = "auto",
    segmenter: Segmenter | None = None,
    causal: bool = False,
    resume: bool = False,
    force: bool = False,
) -> Iterator[Estimate] | Result:
    """Track one or several people in a capture.

    Args:
        capture: of :func:`open_capture`, or the path of one, or another source of images.
        output: a result file to write; without one the estimates are returned frame by frame.
        setup: cameras, working volume, upward direction, rate and subjects of another source; a capture has its own.
        method: "region", "silhouette" or "volumetric".
        frames: range of frames to return, end exclusive (None: to the last frame).
        config: all settings; the defaults if None.
        seed: seed of the random generator, instead of the one in ``config``.
        init_pose: a file with a rough initial pose, or a folder of 2D keypoints; only with a capture.
        body: a result or a TOML file whose body is taken; only with a capture.
        people: "auto" (one person: the nearest to the initial pose if one is given, else the first that
            :func:`tk.people.find.order_people` returns), "all", or numbers in that order, then in that of entering.
        segmenter: makes the masks, unless the capture has some, instead of the empty scene or an installed segmenter.
        causal: stop after the first pass. Without ``output`` there is no second one.
        resume: continue an earlier run with the same ``output``.
        force: replace an existing ``output``; without it an existing file is an error.

    Returns:
        Without ``output`` an iterator of :class:`~tk.trackers.protocol.Estimate`: ``frame``, ``time`` (seconds),
        ``person``, ``pose`` (D,), ``joints`` (15, 3) metres, ``sigma`` (15,) metres, ``status`` … With it the finished
        :class:`~tk.io.results.data.Result`.

    Raises:
        tk.errors.TkError: bad input, in one line, or ``resume`` or ``force`` without ``output``; every frame finished
            before it is in the file.
        KeyboardInterrupt: the user stopped the run; with ``output`` the finished frames are in the file.
    """
    try:
        first, end = frames
        frames = index(first), None if end is None else index(end)
    except (TypeError, ValueError):
        raise ConfigError(f"frames {frames!r}: give the first one and the end, or None: (0, 100)") from None
    if segmenter is not None and not hasattr(segmenter, "segment"):
        raise ConfigError(f"segmenter {segmenter!r}: has no method segment, see tk.segmenters.Segmenter")
    settings = config or Settings()
    if seed is not None:
        settings = replace(settings, seed=seed)
    options = RecordingOptions(
        settings,
        method,
        frames,
        parse_choice(people if isinstance(people, str) else ",".join(map(str, np.ravel(people)))),
        causal,
        init_pose=Path(init_pose) if init_pose is not None else None,
        body=Path(body) if body is not None else None,
    )
    if setup is None and isinstance(capture, str | os.PathLike):
        capture = open_capture(capture, resample=settings.resample)
    if segmenter is not None and isinstance(capture, Capture):
        capture = replace(capture, segmenter=segmenter)
    reporter = _Logged()
    if output is None and (resume or force):
        raise ConfigError("resume and force need an output file")
    if isinstance(capture, Capture):
        if setup is not None:
            raise ConfigError("setup: a capture has its own")
        if output is None:
            return session.estimates(recording_task(capture, options), reporter.note)
        summary = session.track(capture, Path(output), options, reporter, resume, force)
    else:
        task = _source_task(capture, setup, options, segmenter)
        if output is None:
            return session.estimates(task, reporter.note)
        summary = session.track_task(task, Path(output), reporter, resume, force)
    if summary.interrupted:
        raise KeyboardInterrupt
    return read_result(Path(output))


def _source_task(
    source: Source | PathLike, setup: Setup | None, options: RecordingOptions, segmenter: Segmenter | None
) -> Task:
    """Return the task of tracking a source that is no capture."""
    if isinstance(source, str | os.PathLike):
        raise ConfigError("setup: a capture has its own")
    if setup is None:
        raise ConfigError(f"{source.where}: a source needs a setup: its cameras, working volume, up and rate")
    for name, given in (("init_pose", options.init_pose), ("body", options.body), ("segmenter", segmenter)):
        if given is not None:
            raise ConfigError(f"{name}: only with a capture; the setup or the source of your own holds it")
    return Task(setup, source, options)
