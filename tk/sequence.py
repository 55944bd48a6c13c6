"""The loop: open a capture, step a tracker through it, write the result, tell how it goes, resume."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Protocol

import numpy as np

from tk.ahead import TIMING_STAGES, Observed, Source, open_source
from tk.config import Config
from tk.errors import CaptureError, ConfigError, ResultError, TkError
from tk.io.capture import Capture
from tk.io.init_pose import InitPose, read_init_pose
from tk.io.result import FrameResult, HullPoints, ResultMeta, ResultWriter, Status, Value, blamed_on
from tk.model.hull import HullSurface
from tk.segmentation import make_segmenter as make_segmenter
from tk.silhouette import SilhouetteTracker
from tk.trackers.base import Estimate, Tracker
from tk.volumetric import LevenbergMarquardtTracker, VolumetricTracker

TRACKERS = {tracker.method: tracker for tracker in (VolumetricTracker, LevenbergMarquardtTracker)}
METHODS = (*TRACKERS, SilhouetteTracker.method)


class Reporter(Protocol):
    """Who wants to know how it goes."""

    def note(self, text: str) -> None:
        """A line worth reading."""
        ...

    def begin(self, total: int, done: int) -> None:
        """``total`` frames are to be tracked, ``done`` of which an earlier run has finished."""
        ...

    def advance(self, frame: int, estimate: Estimate | None) -> None:
        """A frame is finished; ``estimate`` is None where no pose is sought."""
        ...


@dataclass(frozen=True)
class Summary:
    """What a run did.

    Attributes:
        frames: in the result, those of earlier runs included.
        lost: frames among them that are lost.
        seconds: that this run took.
        tracked_now: frames that this run added.
        interrupted: somebody stopped it with Ctrl-C.
    """

    frames: int
    lost: int
    seconds: float
    tracked_now: int
    interrupted: bool = False


def make_tracker(method: str, capture: Capture, config: Config) -> Tracker:
    """The tracker of this name for a capture."""
    if method == SilhouetteTracker.method:
        return SilhouetteTracker(capture.rig, capture.up, config.silhouette)
    if method not in TRACKERS:
        raise ConfigError(f"--method {method}: choose one of {', '.join(METHODS)}")
    return TRACKERS[method](capture.rig, capture.volume, capture.up, config)


def track(
    capture: Capture,
    output: Path,
    config: Config,
    reporter: Reporter,
    method: str = "volumetric",
    frames: tuple[int, int | None] = (0, None),
    init_pose: Path | None = None,
    resume: bool = False,
    store_hull: bool = False,
) -> Summary:
    """Track a capture and write the result, frame by frame.

    The subject is found in the capture's initial frame and followed from there; what lies before ``frames`` is tracked
    but not written. Ctrl-C ends the run with all finished frames in the file, closed and ready for ``resume``.

    Args:
        capture: what to track.
        output: the result file.
        config: all settings.
        reporter: who hears of the progress.
        method: the tracker's name.
        frames: first frame to write and the one to stop before (None: the last).
        init_pose: a file with a rough initial pose, see :mod:`tk.io.init_pose`.
        resume: go on where an earlier run of the same command stopped.
        store_hull: keep the hull's surface in the result, too.

    Raises:
        TkError: bad input; everything finished before it is in the file.
    """
    for warning in capture.warnings:
        reporter.note(warning)
    # its process starts while this one makes tables and compiles
    with open_source(capture, config, reporter.note, keep_images=method != SilhouetteTracker.method) as source:
        tracker = make_tracker(method, capture, config)
        init = read_init_pose(init_pose, tracker.pose_names) if init_pose else None
        if init and not ((capture.volume.lower <= init.center) & (init.center <= capture.volume.upper)).all():
            raise CaptureError(
                f"{init_pose}: the body is at {init.center.round(2).tolist()}, outside the working volume "
                f"{capture.volume.lower.round(2).tolist()} to {capture.volume.upper.round(2).tolist()}; give metres"
            )
        first = init.frame if init and init.frame is not None else frames[0] if init else capture.init_frame
        if init is None and capture.init_pose == "any":
            if method != SilhouetteTracker.method:
                raise CaptureError(
                    f'{capture.path / "capture.toml"}: init.pose = "any", so nobody stands in the Da Vinci pose; '
                    f"give a rough pose with --init-pose FILE, or use --method {SilhouetteTracker.method}"
                )
            first = max(first, frames[0])  # no frame is better than another
        start, stop = choose_frames(capture, frames, reporter.note)
        if not first < capture.frame_count:
            raise CaptureError(f"{init_pose}: frame = {first} is past the capture's last, {capture.frame_count - 1}")
        if first >= stop:
            raise ConfigError(
                f"--frames {start}:{stop}: the subject is found in frame {first} and followed forwards; "
                f"end after frame {first}, or start elsewhere with --init-pose FILE"
            )
        begin = max(start, first)
        if start < first:
            reporter.note(
                f"frames before {first} are left out: the subject is found in frame {first} and followed forwards"
            )
        meta = ResultMeta(
            pose_names=tracker.pose_names,
            pose_units=tracker.pose_units,
            stages=tracker.stages,
            timing_stages=(*TIMING_STAGES, *tracker.timing_stages, "total"),
            fps=capture.fps,
            up=capture.up,
            capture=capture.name,
            method=method,
            seed=config.seed,
            config_toml=config.to_toml(),
            waist_names=tracker.waist_names,
        )
        origin = _origin(capture, first, begin, init, store_hull)
        writer, done = ResultWriter.resume(output, meta) if resume else (ResultWriter.create(output, meta), 0)
        run = _Run(capture, source, tracker, writer, config, reporter, (first, begin, stop), done, origin, store_hull)
        started = time.perf_counter()
        interrupted = False
        try:
            with writer:
                run.go(init)
        except (
            KeyboardInterrupt
        ):  # caught outside the writer, which then leaves an older result alone if nothing is done
            interrupted = True
        return Summary(done + run.tracked, run.lost, time.perf_counter() - started, run.tracked, interrupted)


def choose_frames(capture: Capture, frames: tuple[int, int | None], note: Callable[[str], None]) -> tuple[int, int]:
    """The first frame of ``--frames`` and the one to stop before, within the capture.

    Raises:
        ConfigError: the capture ends before the first.
    """
    start, stop = frames
    if start >= capture.frame_count:
        asked = f"{start}:" if stop is None else f"{start}:{stop}"
        raise ConfigError(f"--frames {asked}: {capture.path} has only frames 0 to {capture.frame_count - 1}")
    if stop is not None and stop > capture.frame_count:
        note(f"--frames {start}:{stop}: {capture.path} ends with frame {capture.frame_count - 1}")
    return start, capture.frame_count if stop is None else min(stop, capture.frame_count)


def _origin(capture: Capture, first: int, begin: int, init: InitPose | None, store_hull: bool) -> dict[str, str]:
    """What else but :class:`ResultMeta` must agree when a run is taken up again, by the name that a user knows."""
    masks = capture.mask_clips
    return {
        "first frame": str(begin),
        "frame of the initial pose": str(first),
        "cameras": ", ".join(capture.rig.names),
        "masks": "none" if masks is None else os.path.relpath(masks[0].path.parent, capture.path),
        "initial pose (its hash)": "none" if init is None else hashlib.sha256(repr(init).encode()).hexdigest()[:12],
        "stored hull": "yes" if store_hull else "no",
    }


_ORIGIN, _LOST = "run/", "lost frames"


class _Run:
    """One run of a tracker through a capture; how far it got stands in ``tracked`` and ``lost`` whatever ends it."""

    def __init__(
        self,
        capture: Capture,
        source: Source,
        tracker: Tracker,
        writer: ResultWriter,
        config: Config,
        reporter: Reporter,
        span: tuple[int, int, int],
        done: int,
        origin: Mapping[str, str],
        store_hull: bool,
    ) -> None:
        self.capture, self.source, self.tracker, self.writer = capture, source, tracker, writer
        self.config, self.reporter = config, reporter
        self.first, self.begin, self.stop = span
        self.done = done
        self.origin = origin
        self.store_hull = store_hull
        self.tracked = 0
        self.lost = 0

    def go(self, init: InitPose | None) -> None:
        """Start or restore the tracker, and step it to the end."""
        if self.done:
            self._check_origin()
            with blamed_on(self.writer.path, "the state of the run"):
                self.lost = int(np.asarray(self.writer.state[_ORIGIN + _LOST]))
        self.reporter.begin(self.stop - self.begin, min(self.done, self.stop - self.begin))
        if self.begin + self.done >= self.stop:
            return
        if self.done:
            with blamed_on(self.writer.path, "the state of the run"):
                self.tracker.restore(self.writer.model, self.writer.state)
            self._step_through(self.source.frames(self.begin + self.done, self.stop))
            return
        # The body is fitted to the same frames however few are asked for, so that a run may be prolonged by --resume.
        silhouette = self.tracker.method == SilhouetteTracker.method
        opening_frames = (self.config.silhouette if silhouette else self.config.tracking).init_frames
        observations = self.source.frames(self.first, max(self.stop, self.first + opening_frames))
        opening, broken = _take(observations, opening_frames)
        try:
            self.tracker.start([o for o, _ in opening], self.capture.subject_height_m, init)
        except CaptureError as error:
            raise CaptureError(f"{self.capture.path}: {error}") from None
        self.writer.write_model(self.tracker.model())
        self._step_through(chain(_emptied(opening), broken or observations))

    def _check_origin(self) -> None:
        for name, value in self.origin.items():
            found = self.writer.state.get(_ORIGIN + name)
            if found != value:
                raise ResultError(
                    f"{self.writer.path}: was made differently: {name}: {found}, not {value}; "
                    "run without --resume to start afresh"
                )

    def _step_through(self, observations: Iterator[Observed]) -> None:
        writing = 0.0
        for observation, laps in observations:
            if observation.index >= self.stop:
                return
            started = time.perf_counter()
            estimate = self.tracker.step(observation)
            finished = time.perf_counter()
            if observation.index < self.begin:
                continue
            total = laps["wait"] + writing + finished - started
            timing = {**laps, **estimate.timing, "total": total}
            row = _row(observation.index, self.capture.fps, estimate, timing, self.store_hull)
            self.writer.append(row, self._state(self.lost + (estimate.status == "lost")))
            self.tracked += 1
            self.lost += estimate.status == "lost"
            self.reporter.advance(observation.index, estimate)
            writing = time.perf_counter() - finished

    def _state(self, lost: int) -> Mapping[str, Value]:
        origin = {_ORIGIN + name: value for name, value in self.origin.items()}
        return {**self.tracker.state(), **origin, _ORIGIN + _LOST: lost}


def _take(observations: Iterator[Observed], count: int) -> tuple[list[Observed], Iterator[Observed] | None]:
    """The first ``count`` observations; if one after the first cannot be read, those before it and what raises then."""
    taken: list[Observed] = []
    try:
        for observation in observations:
            taken.append(observation)
            if len(taken) == count:
                break
    except TkError as error:
        if not taken:
            raise
        return taken, _raising(error)
    return taken, None


def _emptied(opening: list[Observed]) -> Iterator[Observed]:
    """Hands the opening out and keeps none of it, for pictures are large."""
    opening.reverse()
    while opening:
        yield opening.pop()


def _raising(error: TkError) -> Iterator[Observed]:
    raise error
    yield


def _row(index: int, fps: float, estimate: Estimate, timing: dict[str, float], store_hull: bool) -> FrameResult:
    return FrameResult(
        frame=index,
        time=index / fps,
        pose=estimate.pose,
        waist=estimate.waist,
        joints=estimate.joints,
        status=int(Status[estimate.status.upper()]),
        objective=estimate.objective,
        iterations=estimate.iterations,
        timing=timing,
        hull=points_of(estimate.surface) if store_hull and estimate.surface is not None else None,
    )


def points_of(surface: HullSurface) -> HullPoints:
    """A hull's surface as the result file keeps it: colours RGB, uint8."""
    return HullPoints(surface.positions, surface.colors[:, ::-1].round().clip(0, 255).astype(np.uint8))
