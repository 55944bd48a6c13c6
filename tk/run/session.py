"""The loop of a run: step the trackers through a source, write the result, report progress, resume."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ResultError, TkError
from tk.io.captures.capture import Capture
from tk.io.captures.mask_store import MaskStore
from tk.io.captures.source import Source
from tk.io.results.data import FrameResult, HullPoints, Value
from tk.io.results.files import check_result_path
from tk.io.results.reader import as_damage_error, read_joints, read_result
from tk.io.results.revision import revise_result
from tk.io.results.status import Status
from tk.io.results.writer import ResultWriter
from tk.model.hull.hull import HullSurface
from tk.model.setup import Setup, Subject
from tk.run.offline import REFINED, finish, report_suspect, report_unknown
from tk.run.plan import Plan, open_plan, recording_setup
from tk.run.prefetch import Observed
from tk.run.reporter import Reporter
from tk.settings import Settings
from tk.threads import one_thread
from tk.trackers.camera_monitor import CameraMonitor
from tk.trackers.protocol import Estimate, Observation, Tracker, share, silhouette, two_pass

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Summary:
    """Outcome of a run.

    Attributes:
        status: (F,) status of the frames in the result, including those of earlier runs.
        seconds: duration of this run.
        tracked_now: number of frames that this run added.
        interrupted: whether Ctrl-C stopped it.
    """

    status: NDArray[np.uint8]
    seconds: float
    tracked_now: int
    interrupted: bool = False

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.status)

    @property
    def present(self) -> int:
        """Number of frames in which the person is present."""
        return int((self.status != Status.ABSENT).sum())

    @property
    def lost(self) -> int:
        """Number of frames in which the person is present, but not found."""
        return int((self.status == Status.LOST).sum())

    @property
    def suspect(self) -> int:
        """Number of frames with a pose that the residual contradicts."""
        return int((self.status == Status.SUSPECT).sum())


def track(
    capture: Capture,
    output: Path,
    settings: Settings,
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
    """Track a recording, see :func:`track_source`.

    Args:
        capture: the recording; other arguments as of :func:`track_source`.
        init_pose, body: files, see :func:`tk.run.plan.recording_setup`.

    Raises:
        TkError: bad input; every frame finished before it is in the file.
    """
    masks = Path(capture.masks) if capture.masks not in ("auto", "none", "median") else None
    check_result_path(output, force, resume, [init_pose, capture.init_keypoints, body, masks], capture.path)
    setup = recording_setup(capture, init_pose, body, frames[0])
    notes = capture.warnings
    return track_source(
        setup, capture, output, settings, reporter, method, frames, resume, store_hull, causal, force, notes
    )


def track_source(
    setup: Setup,
    source: Source,
    output: Path,
    settings: Settings,
    reporter: Reporter,
    method: str = "region",
    frames: tuple[int, int | None] = (0, None),
    resume: bool = False,
    store_hull: bool = False,
    causal: bool = False,
    force: bool = False,
    notes: tuple[str, ...] = (),
) -> Summary:
    """Track the subjects of a setup and write the result of the first one, frame by frame.

    A subject is found in its frame of initialisation and tracked forwards; frames before ``frames`` are tracked but not
    written. Ctrl-C ends the run with all finished frames in the file, closed and ready for ``resume``.

    Args:
        setup: the scene.
        source: the images.
        output: the result file.
        settings: all settings.
        reporter: receives notes and progress.
        method: name of the tracker.
        frames: range of frames to write, end exclusive (None: to the end of the source).
        resume: continue where an earlier run of the same command stopped.
        store_hull: store the hull's surface in the result, too.
        causal: stop after the first pass, in which no frame depends on later ones.
        force: replace an existing result.
        notes: notes about the input, for reporter and result.

    Raises:
        TkError: bad input; every frame finished before it is in the file.
    """
    check_result_path(output, force, resume)
    said: list[str] = []

    def note(text: str) -> None:
        said.append(text)
        reporter.note(text)

    for text in notes:
        note(text)
    with open_plan(setup, source, settings, note, method, frames) as plan:
        meta = plan.meta()
        writer, done = ResultWriter.resume(output, meta) if resume else (ResultWriter.create(output, meta), 0)
        if done and len(setup.subjects) > 1:
            raise ResultError(f"{output}: --resume works with one subject, not {len(setup.subjects)}")
        again = not causal and plan.trackers[0].has_second_pass  # the second pass needs the masks
        kept = output.with_name(f".{output.name}.masks")
        masks = MaskStore(kept, resume=bool(done)) if again else None
        if not (done or again):
            kept.unlink(missing_ok=True)  # of a stopped run; with a second pass, the first frame replaces it
        run = _Run(plan, _Output(writer, done, plan.origin(store_hull), store_hull), masks)
        started = time.perf_counter()
        interrupted = False
        try:
            with writer:
                reporter.begin(plan.total, min(done, plan.total) if plan.total else done)
                for estimate in run.estimates():
                    reporter.advance(estimate.frame, estimate)
            if run.tracked or run.restore_unfinished(output, causal):
                for line in run.people[0].monitor.report():
                    note(line)
                with one_thread():
                    finish(output, plan, masks, note)
                if said:
                    revise_result(output, notes=said)
            kept.unlink(missing_ok=True)
        except KeyboardInterrupt:
            # caught outside the writer, which then keeps an older result if no frame is finished
            interrupted = True
        status = read_joints(output).status if done + run.tracked else None
        return Summary(
            np.zeros(0, np.uint8) if status is None else status, time.perf_counter() - started, run.tracked, interrupted
        )


def estimates(
    setup: Setup,
    source: Source,
    settings: Settings,
    note: Callable[[str], None] = lambda _: None,
    method: str = "region",
    frames: tuple[int, int | None] = (0, None),
) -> Iterator[Estimate]:
    """Track the subjects of a setup and yield the estimates of the first one, as the first pass finds them. No file is
    written.

    Arguments and errors are those of :func:`track_source`.
    """
    with open_plan(setup, source, settings, note, method, frames) as plan:
        run = _Run(plan, None)
        unknown: list[int] = []
        suspect: list[int] = []
        for estimate in run.estimates():
            if estimate.status == "suspect":
                suspect.append(estimate.frame)
            if estimate.status != "lost" and estimate.sigma is not None and np.isnan(estimate.sigma).all():
                unknown.append(estimate.frame)
            yield estimate
        for line in run.people[0].monitor.report():
            note(line)
        report_unknown(unknown, note)
        report_suspect(suspect, note)


# Seconds between two writes to the file; frames finished within this time are written and reported together. A shorter
# time costs more writes; a longer one loses more frames when the process is killed.
WRITE_EVERY_S = 0.5

_ORIGIN, _WATCH = "run/", "watch/"


@dataclass
class _Output:
    """The result file of a run.

    Attributes:
        done: number of frames that an earlier run has finished.
        origin: what must agree with the earlier run.
    """

    writer: ResultWriter
    done: int
    origin: Mapping[str, str]
    store_hull: bool

    def check(self) -> None:
        """Raise ResultError if the earlier run was another one."""
        for name, value in self.origin.items():
            found = self.writer.state.get(_ORIGIN + name)
            if found != value:
                raise ResultError(
                    f"{self.writer.path}: was made differently: {name}: {found}, not {value}; "
                    "start again with --force instead of --resume"
                )
        if REFINED in self.writer.model:
            raise ResultError(
                f"{self.writer.path}: a second pass has gone over its frames, so no more can be added; start again "
                "with --force instead of --resume; a result of --causal can be continued"
            )


@dataclass
class _Person:
    """A subject during a run.

    Attributes:
        silhouette: (C, H, W) bool, pixels that the body covers in the last frame; None if unknown.
    """

    subject: Subject
    tracker: Tracker
    monitor: CameraMonitor
    silhouette: NDArray[np.bool_] | None = None


class _Run:
    """One run of trackers through a source. ``tracked`` counts frames, even if the run is interrupted."""

    def __init__(self, plan: Plan, output: _Output | None, masks: MaskStore | None = None) -> None:
        self.plan, self.output = plan, output
        self.tracked = 0
        self.masks = masks
        self.people = [
            _Person(subject, tracker, CameraMonitor(tracker, plan.setup, subject))
            for subject, tracker in zip(plan.setup.subjects, plan.trackers, strict=True)
        ]

    def estimates(self) -> Iterator[Estimate]:
        """Start or restore the trackers, and step them to the end; yielded estimates are in the file already."""
        plan, output = self.plan, self.output
        done = output.done if output else 0
        if plan.stop is not None and plan.begin + done >= plan.stop:
            return
        if output and done:
            output.check()
            self._restore(output)
            yield from self._step_through(plan.observations.frames(plan.begin + done, plan.stop))
            return
        # The body is fitted to the same frames however few are asked for, so that --resume may extend a run.
        count = max(person.tracker.opening_frames for person in self.people)
        stop = None if plan.stop is None else max(plan.stop, plan.first + count)
        observations = plan.observations.frames(plan.first, stop)
        _LOG.info("reading the first frames and learning what the scene looks like")
        for person in self.people:
            person.tracker.prepare()
        opening, broken = _take(observations, count)
        _LOG.info("finding the person in frame %d and fitting the body to %d frames", plan.first, len(opening))
        try:
            with one_thread():
                for person in self.people:
                    seen, subject = person.monitor.start([o for o, _ in opening]), person.subject
                    person.tracker.start(seen, subject.height_m, subject.init, subject.body)
                    person.monitor.check_body()
                    del seen
        except CaptureError as error:
            raise CaptureError(f"{plan.source.where}: {error}") from None
        if output:
            output.writer.write_model(self.people[0].tracker.model())
        yield from self._step_through(chain(_emptied(opening), broken or observations))

    def restore_unfinished(self, path: Path, causal: bool) -> bool:
        """Restore the tracker if an earlier run wrote the last frame, but did not finish the result; whether it did."""
        output, tracker = self.output, self.people[0].tracker
        if output is None or not output.done or not tracker.has_segments:
            return False
        refined = causal or not tracker.has_second_pass or REFINED in output.writer.model
        if refined and read_result(path).smoothed is not None:
            return False
        output.check()
        self._restore(output)
        return True

    def _restore(self, output: _Output) -> None:
        person = self.people[0]
        with as_damage_error(output.writer.path, "the state of the run"):
            person.tracker.restore(output.writer.model, output.writer.state)
            person.monitor.restore(_below(_WATCH, output.writer.state))

    def _step_through(self, observations: Iterator[Observed]) -> Iterator[Estimate]:
        """Step the trackers to the end; an estimate is yielded when it is in the file."""
        output, stop = self.output, self.plan.stop
        finished: list[Estimate] = []
        written, writing = -np.inf, 0.0  # the first frame is written at once
        try:
            for observation, laps in observations:
                if stop is not None and observation.index >= stop:
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
        except TkError:  # frames before the broken one count
            yield from self._written(finished)
            raise
        yield from self._written(finished)

    def _step(self, observation: Observation) -> Estimate | None:
        """Step all trackers; return the first one's estimate, None before the first frame to be written."""
        people = self.people
        shared = share(observation, [person.silhouette for person in people])
        with one_thread():
            found = [person.monitor.step(own) for person, own in zip(people, shared, strict=True)]
        if len(people) > 1:
            for person, (estimate, _) in zip(people, found, strict=True):
                person.silhouette = silhouette(estimate, observation.masks.shape)
        if observation.index < self.plan.begin:
            return None
        estimate, used = found[0]
        if self.masks is not None:
            self.masks.put(observation.index, self._kept(shared[0], used, estimate))
        # masks are large, and a view into the ring of frames: an estimate must not keep them
        return replace(estimate, frame=observation.index, time=observation.time, masks=None, drawn=None)

    def _kept(self, observation: Observation, used: Observation, estimate: Estimate) -> NDArray[np.uint8]:
        """Return the cleaned masks (C, H, W) of a frame, including those of excluded cameras, which may be refined."""
        tracker = two_pass(self.people[0].tracker)
        assert tracker is not None
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
        person = self.people[0]
        origin = {_ORIGIN + name: value for name, value in output.origin.items()}
        monitor = {_WATCH + name: value for name, value in person.monitor.state().items()}
        return {**person.tracker.state(), **monitor, **origin}


def _below(prefix: str, state: Mapping[str, Value]) -> dict[str, Value]:
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


def _take(observations: Iterator[Observed], count: int) -> tuple[list[Observed], Iterator[Observed] | None]:
    """Return the first ``count`` observations; if one after the first cannot be read, those before it, and an iterator
    that raises the error."""
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
    """Yield the opening and keep none of it, because images are large."""
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
    """Return a hull's surface as a result stores it: colours RGB, uint8."""
    return HullPoints(surface.positions, surface.colors[:, ::-1].round().clip(0, 255).astype(np.uint8))
