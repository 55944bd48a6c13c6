"""The loop: step a tracker through a capture, write the result, tell how it goes, resume."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ResultError, TkError
from tk.io.captures.capture import Capture
from tk.io.captures.mask_store import MaskStore
from tk.io.results.files import check_output
from tk.io.results.writer import (
    FrameResult,
    HullPoints,
    ResultWriter,
    Status,
    Value,
    blamed_on,
    read_result,
    revise_result,
)
from tk.model.hull.hull import HullSurface
from tk.run.offline import REFINED, finish, tell_unknown
from tk.run.plan import Plan, open_plan
from tk.run.prefetch import Observed
from tk.settings import Settings
from tk.threads import one_thread
from tk.trackers.camera_monitor import CameraMonitor
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.protocol import Estimate, Observation
from tk.trackers.region import RegionTracker

_LOG = logging.getLogger(__name__)


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


class Silent:
    """A reporter that wants to know nothing; whoever wants some of it derives from it."""

    def note(self, text: str) -> None:
        pass

    def begin(self, total: int, done: int) -> None:
        pass

    def advance(self, frame: int, estimate: Estimate | None) -> None:
        pass


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

    @property
    def mostly_lost(self) -> bool:
        """Whether more than half of the result's frames are lost."""
        return 2 * self.lost > self.frames


def track(
    capture: Capture,
    output: Path,
    config: Settings,
    reporter: Reporter,
    method: str = "region",
    frames: tuple[int, int | None] = (0, None),
    init_pose: Path | None = None,
    resume: bool = False,
    store_hull: bool = False,
    body: Path | None = None,
    causal: bool = False,
    force: bool = False,
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
        init_pose: a file with a rough initial pose, see :mod:`tk.io.captures.init_pose`, or a folder of 2D
            keypoints, see
            :mod:`tk.io.captures.keypoints`.
        resume: go on where an earlier run of the same command stopped.
        store_hull: keep the hull's surface in the result, too.
        body: a result or a TOML file whose body is taken; None fits one to the opening frames.
        causal: leave it at the first pass, in which a frame knows nothing of those after it.
        force: replace a result that exists.

    Raises:
        TkError: bad input; everything finished before it is in the file.
    """
    check_output(output, force, resume)
    said: list[str] = []

    def note(text: str) -> None:
        said.append(text)
        reporter.note(text)

    for warning in capture.warnings:
        note(warning)
    with open_plan(capture, config, note, method, frames, init_pose, body) as plan:
        meta = plan.meta()
        writer, done = ResultWriter.resume(output, meta) if resume else (ResultWriter.create(output, meta), 0)
        again = not causal and isinstance(plan.tracker, RegionTracker)  # the second pass asks for the masks
        kept = output.with_name(f".{output.name}.masks")
        masks = MaskStore(kept, resume=bool(done)) if again else None
        if not (done or again):
            kept.unlink(missing_ok=True)  # of a stopped run; a second pass's replace them at the first frame
        run = _Run(plan, _Output(writer, done, plan.origin(store_hull), store_hull), masks)
        started = time.perf_counter()
        interrupted = False
        try:
            with writer:
                reporter.begin(plan.stop - plan.begin, min(done, plan.stop - plan.begin))
                for estimate in run.estimates():
                    reporter.advance(estimate.frame, estimate)
            if run.tracked or run.restore_unfinished(output, causal):
                for line in run.watch.report():
                    note(line)
                with one_thread():
                    finish(output, plan, masks, note)
                if said:
                    revise_result(output, notes=said)
            kept.unlink(missing_ok=True)
        except KeyboardInterrupt:
            # caught outside the writer, which then leaves an older result alone if nothing is done
            interrupted = True
        return Summary(done + run.tracked, run.lost, time.perf_counter() - started, run.tracked, interrupted)


def estimates(
    capture: Capture,
    config: Settings,
    note: Callable[[str], None] = lambda _: None,
    method: str = "region",
    frames: tuple[int, int | None] = (0, None),
    init_pose: Path | None = None,
    body: Path | None = None,
) -> Iterator[Estimate]:
    """Track a capture and hand out the frames' estimates one by one, as the first pass finds them; no file is written.

    Arguments and errors are those of :func:`track`.
    """
    for warning in capture.warnings:
        note(warning)
    with open_plan(capture, config, note, method, frames, init_pose, body) as plan:
        run = _Run(plan, None)
        unknown: list[int] = []
        for estimate in run.estimates():
            if estimate.status != "lost" and estimate.sigma is not None and np.isnan(estimate.sigma).all():
                unknown.append(estimate.frame)
            yield estimate
        for line in run.watch.report():
            note(line)
        tell_unknown(unknown, note)


# Frames go to the file together that are finished within this time, seconds, and are told of then.
WRITE_EVERY_S = 0.5

_ORIGIN, _LOST, _WATCH = "run/", "lost frames", "watch/"


@dataclass
class _Output:
    """Where a run writes, and what an earlier one has written.

    Attributes:
        done: frames that an earlier run has finished.
        origin: what must agree with it.
    """

    writer: ResultWriter
    done: int
    origin: Mapping[str, str]
    store_hull: bool

    def check(self) -> None:
        """Raise ResultError where the earlier run was another one."""
        for name, value in self.origin.items():
            found = self.writer.state.get(_ORIGIN + name)
            if found != value:
                raise ResultError(
                    f"{self.writer.path}: was made differently: {name}: {found}, not {value}; "
                    "start afresh with --force in the place of --resume"
                )
        if REFINED in self.writer.model:
            raise ResultError(
                f"{self.writer.path}: a second pass has gone over its frames, so no more can be added; start afresh "
                "with --force in the place of --resume; with --causal the result can be prolonged"
            )


class _Run:
    """One run of a tracker through a capture; how far it got stands in ``tracked`` and ``lost`` whatever ends it."""

    def __init__(self, plan: Plan, output: _Output | None, masks: MaskStore | None = None) -> None:
        self.plan, self.output = plan, output
        self.tracked = 0
        self.lost = 0
        self.masks = masks
        self.watch = CameraMonitor(plan.tracker, plan.capture)

    def estimates(self) -> Iterator[Estimate]:
        """Start or restore the tracker, and step it to the end; what is handed out is in the file already."""
        plan, output = self.plan, self.output
        done = output.done if output else 0
        if output and done:
            with blamed_on(output.writer.path, "the state of the run"):
                self.lost = int(np.asarray(output.writer.state[_ORIGIN + _LOST]))
        if plan.begin + done >= plan.stop:
            return
        if output and done:
            output.check()
            self._restore(output)
            yield from self._step_through(plan.source.frames(plan.begin + done, plan.stop))
            return
        # The body is fitted to the same frames however few are asked for, so that a run may be prolonged by --resume.
        count = plan.tracker.opening_frames
        observations = plan.source.frames(plan.first, max(plan.stop, plan.first + count))
        _LOG.info("reading the first frames and learning what the scene looks like")
        plan.tracker.prepare()
        opening, broken = _take(observations, count)
        _LOG.info("finding the person in frame %d and fitting the body to %d frames", plan.first, len(opening))
        try:
            with one_thread():
                seen = self.watch.start([o for o, _ in opening])
                plan.tracker.start(seen, plan.capture.subject_height_m, plan.init, plan.body)
                self.watch.check_body()
        except CaptureError as error:
            raise CaptureError(f"{plan.capture.path}: {error}") from None
        del seen
        if output:
            output.writer.write_model(plan.tracker.model())
        yield from self._step_through(chain(_emptied(opening), broken or observations))

    def restore_unfinished(self, path: Path, causal: bool) -> bool:
        """Restore the tracker if an earlier run got to the last frame and no further; whether it is so."""
        output, tracker = self.output, self.plan.tracker
        if output is None or not output.done or not isinstance(tracker, ContourTracker):
            return False
        refined = causal or not isinstance(tracker, RegionTracker) or REFINED in output.writer.model
        if refined and read_result(path).smoothed is not None:
            return False
        output.check()
        self._restore(output)
        return True

    def _restore(self, output: _Output) -> None:
        with blamed_on(output.writer.path, "the state of the run"):
            self.plan.tracker.restore(output.writer.model, output.writer.state)
            self.watch.restore(_below(_WATCH, output.writer.state))

    def _step_through(self, observations: Iterator[Observed]) -> Iterator[Estimate]:
        """Step the tracker to the end; frames are handed out when they are in the file."""
        output = self.output
        finished: list[Estimate] = []
        written, writing = -np.inf, 0.0  # the first frame is told of at once
        try:
            for observation, laps in observations:
                if observation.index >= self.plan.stop:
                    break
                started = time.perf_counter()
                estimate = self._step(observation)
                if estimate is None:
                    continue
                stepped = time.perf_counter()
                timing = {**laps, **estimate.timing, "total": laps["wait"] + writing + stepped - started}
                estimate = replace(estimate, timing=timing)
                due = not output or stepped - written > WRITE_EVERY_S
                if output:
                    output.writer.append(_row(estimate, output.store_hull), self._state(output), flush=due)
                self.tracked += 1
                finished.append(estimate)
                writing = time.perf_counter() - stepped
                if due:
                    written = stepped + writing
                    yield from finished
                    finished.clear()
        except TkError:  # what could be read counts
            yield from self._written(finished)
            raise
        yield from self._written(finished)

    def _step(self, observation: Observation) -> Estimate | None:
        """The estimate in a frame, its masks kept for the second pass; None before the first frame to be written."""
        plan, index = self.plan, observation.index
        with one_thread():
            estimate, used = self.watch.step(observation)
        if index < plan.begin:
            return None
        if self.masks is not None:
            self.masks.put(index, self._kept(observation, used, estimate))
        self.lost += estimate.status == "lost"
        # masks are large, and a view of the ring of frames at that: nobody who keeps the estimate keeps them
        return replace(estimate, frame=index, time=index / plan.capture.fps, masks=None, drawn=None)

    def _kept(self, observation: Observation, used: Observation, estimate: Estimate) -> NDArray[np.uint8]:
        """The masks (C, H, W) of a frame, cleaned, as the tracker took them; those of cameras that were left out, too,
        for these may be refined."""
        tracker = self.plan.tracker
        assert isinstance(tracker, ContourTracker)
        taken = tracker.cleaned(used.masks) if estimate.masks is None else estimate.masks
        out = np.asarray(observation.masks.any(axis=(1, 2)) & ~used.masks.any(axis=(1, 2)))
        if out.any():
            taken = taken.copy()
            taken[out] = tracker.cleaned(observation.masks[out])
        return taken

    def _written(self, finished: list[Estimate]) -> Iterator[Estimate]:
        if self.output and finished:
            self.output.writer.flush()
        yield from finished

    def _state(self, output: _Output) -> Mapping[str, Value]:
        origin = {_ORIGIN + name: value for name, value in output.origin.items()}
        watched = {_WATCH + name: value for name, value in self.watch.state().items()}
        return {**self.plan.tracker.state(), **watched, **origin, _ORIGIN + _LOST: self.lost}


def _below(prefix: str, state: Mapping[str, Value]) -> dict[str, Value]:
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


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


def _row(estimate: Estimate, store_hull: bool) -> FrameResult:
    return FrameResult(
        frame=estimate.frame,
        time=estimate.time,
        pose=estimate.pose,
        waist=estimate.waist,
        ankles=estimate.ankles if len(estimate.ankles) else None,
        joints=estimate.joints,
        sigma=estimate.sigma,
        residual=estimate.residual,
        status=int(Status[estimate.status.upper()]),
        objective=estimate.objective,
        iterations=estimate.iterations,
        timing=estimate.timing,
        hull=points_of(estimate.surface) if store_hull and estimate.surface is not None else None,
    )


def points_of(surface: HullSurface) -> HullPoints:
    """A hull's surface as the result file keeps it: colours RGB, uint8."""
    return HullPoints(surface.positions, surface.colors[:, ::-1].round().clip(0, 255).astype(np.uint8))
