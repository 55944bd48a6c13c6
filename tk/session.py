"""The loop: open a capture, step a tracker through it, write the result, tell how it goes, resume."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tk.ahead import TIMING_STAGES, Observed, Source, open_source
from tk.blas import one_blas_thread
from tk.config import Config
from tk.errors import CaptureError, ConfigError, ResultError, TkError
from tk.io.capture import Capture
from tk.io.init_pose import InitPose, read_init_pose
from tk.io.mask_store import MaskStore
from tk.io.result import (
    FrameResult,
    HullPoints,
    JointAngles,
    Result,
    ResultMeta,
    ResultWriter,
    Status,
    UsedCameras,
    Value,
    blamed_on,
    read_result,
    revise_result,
)
from tk.io.result_files import check_output
from tk.model.angles import ANGLES
from tk.model.cone_body import ConeBody
from tk.model.derived import derive
from tk.model.hull import HullSurface
from tk.model.skeleton import SEGMENTS, join_pose, split_pose
from tk.model.smoothing import smooth
from tk.refinement import refine_if_astray
from tk.segmentation import make_segmenter as make_segmenter
from tk.segmentation import mask_source
from tk.trackers.base import Estimate, Observation, Tracker
from tk.trackers.bodies import read_body
from tk.trackers.contours import ContourTracker
from tk.trackers.region import RegionTracker
from tk.trackers.silhouette import SilhouetteTracker
from tk.trackers.volumetric import LevenbergMarquardtTracker, VolumetricTracker
from tk.trackers.watch import Watch

_LOG = logging.getLogger(__name__)
Float = NDArray[np.float64]

METHODS = ("region", "silhouette", "volumetric", "lm")


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

    @property
    def mostly_lost(self) -> bool:
        """Whether more than half of the result's frames are lost."""
        return 2 * self.lost > self.frames


def make_tracker(method: str, capture: Capture, config: Config) -> Tracker:
    """The tracker of this name for a capture.

    Raises:
        ConfigError: there is none of this name.
    """
    rig, up = capture.rig, capture.up
    if method == RegionTracker.method:
        return RegionTracker(rig, up, config.silhouette, config.region)
    if method == SilhouetteTracker.method:
        return SilhouetteTracker(rig, up, config.silhouette)
    for tracker in (VolumetricTracker, LevenbergMarquardtTracker):
        if method == tracker.method:
            return tracker(rig, capture.volume, up, config)
    raise ConfigError(f"--method {method}: choose one of {', '.join(METHODS)}")


def track(
    capture: Capture,
    output: Path,
    config: Config,
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
        init_pose: a file with a rough initial pose, see :mod:`tk.io.init_pose`.
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
    with _open(capture, config, note, method, frames, init_pose, body) as plan:
        tracker, capture = plan.tracker, plan.capture
        meta = _meta(tracker, capture, config)
        origin = _origin(capture, plan, store_hull)
        writer, done = ResultWriter.resume(output, meta) if resume else (ResultWriter.create(output, meta), 0)
        run = _Run(plan, config, _Output(writer, done, origin, store_hull))
        started = time.perf_counter()
        interrupted = False
        try:
            with writer:
                reporter.begin(plan.stop - plan.begin, min(done, plan.stop - plan.begin))
                for estimate in run.estimates():
                    reporter.advance(estimate.frame, estimate)
            if run.tracked or run.restore_unfinished(output, causal):
                for line in run.watch.report():
                    reporter.note(line)
                with one_blas_thread():
                    finish(output, plan, config, run.masks, note, causal)
                if said:
                    revise_result(output, notes=said)
        except KeyboardInterrupt:
            # caught outside the writer, which then leaves an older result alone if nothing is done
            interrupted = True
        return Summary(done + run.tracked, run.lost, time.perf_counter() - started, run.tracked, interrupted)


def estimates(
    capture: Capture,
    config: Config,
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
    with _open(capture, config, note, method, frames, init_pose, body) as plan:
        run = _Run(plan, config, None)
        yield from run.estimates()
        for line in run.watch.report():
            note(line)


@dataclass(frozen=True)
class _Plan:
    """What is to be tracked, and by whom.

    Attributes:
        first: the frame in which the subject is found; begin: the first that is told; stop: the one to stop before.
        init: the rough pose, if one was given; body: the body, if one was given.
    """

    capture: Capture
    source: Source
    tracker: Tracker
    first: int
    begin: int
    stop: int
    init: InitPose | None
    body: ConeBody | None


@contextmanager
def _open(
    capture: Capture,
    config: Config,
    note: Callable[[str], None],
    method: str,
    frames: tuple[int, int | None],
    init_pose: Path | None,
    body_file: Path | None,
) -> Iterator[_Plan]:
    # its process starts while this one makes tables and compiles
    with open_source(capture, config, note, keep_images=method != SilhouetteTracker.method) as source:
        _LOG.info("preparing the %s tracker", method)
        tracker = make_tracker(method, capture, config)
        body = read_body(body_file, capture.up) if body_file else None
        if body is not None and not isinstance(tracker, ContourTracker):
            raise ConfigError(f"--body {body_file}: the {method} tracker fits a body of its own; use --method region")
        init = read_init_pose(init_pose, tracker.pose_names) if init_pose else None
        if init and not ((capture.volume.lower <= init.center) & (init.center <= capture.volume.upper)).all():
            raise CaptureError(
                f"{init_pose}: the body is at {init.center.round(2).tolist()}, outside the working volume "
                f"{capture.volume.lower.round(2).tolist()} to {capture.volume.upper.round(2).tolist()}; give metres"
            )
        first = init.frame if init and init.frame is not None else frames[0] if init else capture.init_frame
        if init is None and capture.init_pose == "any":
            if not tracker.any_pose:
                raise CaptureError(
                    f'{capture.path / "capture.toml"}: init.pose = "any", so nobody stands in the Da Vinci pose; '
                    f"give a rough pose with --init-pose FILE, or use --method {RegionTracker.method}"
                )
            first = max(first, frames[0])  # no frame is better than another
        start, stop = choose_frames(capture, frames, note)
        if not first < capture.frame_count:
            raise CaptureError(f"{init_pose}: frame = {first} is past the capture's last, {capture.frame_count - 1}")
        if first >= stop:
            raise ConfigError(
                f"--frames {start}:{stop}: the subject is found in frame {first} and followed forwards; "
                f"end after frame {first}, or start elsewhere with --init-pose FILE"
            )
        if start < first:
            note(f"frames before {first} are left out: the subject is found in frame {first} and followed forwards")
        yield _Plan(capture, source, tracker, first, max(start, first), stop, init, body)


def _meta(tracker: Tracker, capture: Capture, config: Config) -> ResultMeta:
    contours = isinstance(tracker, ContourTracker)
    return ResultMeta(
        pose_names=tracker.pose_names,
        pose_units=tracker.pose_units,
        stages=tracker.stages,
        timing_stages=(*TIMING_STAGES, *tracker.timing_stages, "total"),
        fps=capture.fps,
        up=capture.up,
        capture=capture.name,
        method=tracker.method,
        seed=config.seed,
        config_toml=config.to_toml(),
        waist_names=tracker.waist_names,
        ankle_names=tracker.ankle_names,
        sigma=tracker.method == RegionTracker.method,
        fit_cameras=capture.rig.names if tracker.method == RegionTracker.method else (),
        segment_names=SEGMENTS if contours else (),
        feet=contours,
        angles=tuple(JointAngles(a.joint, a.names, a.convention) for a in ANGLES) if contours else (),
        objective_kind="E_S" if contours else "robust distance of surface points",
    )


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
    return max(start, capture.first_frame), capture.frame_count if stop is None else min(stop, capture.frame_count)


def _origin(capture: Capture, plan: _Plan, store_hull: bool) -> dict[str, str]:
    """What else but :class:`ResultMeta` must agree when a run is taken up again, by the name that a user knows."""
    masks, init = capture.mask_clips, plan.init
    given = "none" if plan.body is None else hashlib.sha256(repr(plan.body).encode()).hexdigest()[:12]
    return {
        "first frame": str(plan.begin),
        "frame of the initial pose": str(plan.first),
        "given body (its hash)": given,
        "cameras": ", ".join(capture.rig.names),
        "masks": mask_source(capture) if masks is None else os.path.relpath(masks[0].path.parent, capture.path),
        "initial pose (its hash)": "none" if init is None else hashlib.sha256(repr(init).encode()).hexdigest()[:12],
        "stored hull": "yes" if store_hull else "no",
    }


_ORIGIN, _LOST, _WATCH = "run/", "lost frames", "watch/"
#: in `/model` of a result that a second pass has gone over
REFINED = "refined"


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

    def __init__(self, plan: _Plan, config: Config, output: _Output | None) -> None:
        self.plan, self.config, self.output = plan, config, output
        self.tracked = 0
        self.lost = 0
        self.masks = MaskStore()
        self.watch = Watch(plan.tracker, plan.capture)

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
        if isinstance(plan.tracker, ContourTracker):
            plan.tracker.prepare()
        opening, broken = _take(observations, count)
        _LOG.info("finding the person in frame %d and fitting the body to %d frames", plan.first, len(opening))
        try:
            with one_blas_thread():
                seen = self.watch.start([o for o, _ in opening])
                if plan.body is not None and isinstance(plan.tracker, ContourTracker):
                    plan.tracker.start(seen, plan.capture.subject_height_m, plan.init, plan.body)
                else:
                    plan.tracker.start(seen, plan.capture.subject_height_m, plan.init)
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
        plan, output = self.plan, self.output
        writing = 0.0
        for observation, laps in observations:
            if observation.index >= plan.stop:
                return
            started = time.perf_counter()
            with one_blas_thread():
                estimate, used = self.watch.step(observation)
            if observation.index < plan.begin:
                continue
            if output and isinstance(plan.tracker, RegionTracker):
                self.masks.put(observation.index, _kept(observation, used, estimate))
            finished = time.perf_counter()
            total = laps["wait"] + writing + finished - started
            timing = {**laps, **estimate.timing, "total": total}
            index = observation.index
            estimate = replace(estimate, frame=index, time=index / plan.capture.fps, timing=timing)
            self.lost += estimate.status == "lost"
            if output:
                output.writer.append(_row(estimate, output.store_hull), self._state(output))
            self.tracked += 1
            writing = time.perf_counter() - finished
            yield estimate

    def _state(self, output: _Output) -> Mapping[str, Value]:
        origin = {_ORIGIN + name: value for name, value in output.origin.items()}
        watched = {_WATCH + name: value for name, value in self.watch.state().items()}
        return {**self.plan.tracker.state(), **watched, **origin, _ORIGIN + _LOST: self.lost}


def finish(
    output: Path, plan: _Plan, config: Config, masks: MaskStore, note: Callable[[str], None], causal: bool
) -> None:
    """What needs all frames: the second pass unless ``causal``; segments, feet and angles; the smoothed copy; cameras.

    The second pass settles every frame anew, with the body fitted to frames of the whole recording where that did not
    begin with the initialisation pose; by refined cameras where they disagree, unless ``config.refine`` is False. The
    result is replaced in one step; if this does not end, the first pass's stays.
    """
    tracker = plan.tracker
    if not isinstance(tracker, ContourTracker):
        return
    result = read_result(output)
    none = np.zeros((len(result.frames), 0))
    waist = none if result.waist is None else result.waist
    ankles = none if result.ankles is None else result.ankles
    skeleton = tracker.body.skeleton
    poses = np.array([join_pose(skeleton, *row) for row in zip(result.pose, waist, ankles, strict=True)])
    lost = result.status == Status.LOST
    columns: dict[str, NDArray[Any]] = {}
    model: Mapping[str, Value] | None = None
    cameras = UsedCameras(plan.capture.rig, np.array(plan.capture.time_offset_s))
    if isinstance(tracker, RegionTracker) and not causal:
        _LOG.info("second pass")
        # the initialisation pose shows all of the body; what else a recording may begin with does not
        shown = plan.init is None and plan.capture.init_pose != "any"
        assert result.fit_error is not None
        missing = [int(f) for f in result.frames if int(f) not in masks]
        if missing:  # what an earlier run has tracked
            with open_source(plan.capture, config, lambda _: None) as source:
                for observation, _ in source.frames(min(missing), max(missing) + 1):
                    masks.put(observation.index, tracker.without_foreign(observation).masks)
        if config.refine:
            refined = refine_if_astray(tracker, masks, result.frames, poses, ~lost, note)
            if refined is not None:
                tracker, masks, offsets = refined
                cameras = UsedCameras(tracker.views.rig, cameras.time_offset_s + offsets / plan.capture.fps)
                if np.round(offsets).any():
                    note("tracking again: the first pass had the pictures out of step")
                    again = _track_again(plan, config, tracker, cameras, result.frames, poses)
                    rows = np.flatnonzero(np.isin(result.frames, list(again)))
                    told_again = [again[int(frame)] for frame in result.frames[rows]]
                    poses[rows] = [join_pose(skeleton, e.pose, e.waist, e.ankles) for e in told_again]
                    lost[rows] = [e.status == "lost" for e in told_again]
                    columns |= _replaced(result, rows, told_again)
        poses, columns["fit_error"] = tracker.second_pass(
            masks.sequence(result.frames),
            poses,
            lost,
            columns.get("fit_error", result.fit_error),
            plan.capture.subject_height_m,
            keep_body=plan.body is not None or shown,
        )
        model = {**tracker.model(), REFINED: 1}
    _LOG.info("angles, feet, and the smoothed copy")
    # the first pass's poses stand as they are
    told = ("pose", "waist", "ankles", "joints/position") if model is None else ()
    columns |= {name: values for name, values in _columns(tracker, poses).items() if name not in told}
    filtered = smooth(tracker.body.skeleton, poses, ~lost, plan.capture.fps)
    smoothed = {**_columns(tracker, filtered.poses), "bridged": filtered.bridged}
    revise_result(output, columns, smoothed=smoothed, model=model, cameras=cameras)


def _track_again(
    plan: _Plan, config: Config, tracker: RegionTracker, cameras: UsedCameras, frames: NDArray[np.int64], poses: Float
) -> dict[int, Estimate]:
    """The estimates of those of the frames (F,) of which all cameras have a picture once they are in step, by frame.

    It begins at the pose that the first pass found there.
    """
    capture = replace(plan.capture, rig=cameras.rig, time_offset_s=tuple(cameras.time_offset_s.tolist()))
    begin = max(capture.first_frame, int(frames[0]))
    ends = [clip.frame_count + late for clip, late in zip(capture.clips, capture.late_frames, strict=True)]
    stop = min(*ends, int(frames[-1]) + 1)
    if begin >= stop:
        return {}
    start = poses[np.searchsorted(frames, begin)][None]
    once = {"poses": start, "previous": start, "costs": np.zeros(1), "ages": np.ones(1, int)}
    tracker.restore(tracker.model(), {**tracker.state(), **once, "usual": np.inf, "lost_for": 0})
    with open_source(capture, config, lambda _: None) as source:
        return {observation.index: tracker.step(observation) for observation, _ in source.frames(begin, stop)}


def _replaced(result: Result, rows: NDArray[np.int64], estimates: Sequence[Estimate]) -> dict[str, NDArray[Any]]:
    """What a result's first pass told of these rows, told by other estimates."""
    assert result.sigma is not None and result.fit_error is not None
    columns = {
        "joints/sigma": result.sigma.copy(),
        "fit_error": result.fit_error.copy(),
        "objective": result.objective.copy(),
        "status": result.status.copy(),
    }
    for row, e in zip(rows, estimates, strict=True):
        columns["joints/sigma"][row], columns["fit_error"][row] = e.sigma, e.fit_error
        columns["objective"][row] = e.objective
        if result.status[row] != Status.INITIALISED:
            columns["status"][row] = Status[e.status.upper()]
    return columns


def _columns(tracker: ContourTracker, poses: NDArray[np.float64]) -> dict[str, NDArray[np.floating]]:
    """The datasets that tell poses (F, D) and what follows from them."""
    skeleton = tracker.body.skeleton
    paper, waist, ankles = (np.array(part) for part in zip(*(split_pose(skeleton, p) for p in poses), strict=True))
    derived = derive(skeleton, tracker.body.dimensions, poses)
    columns = {"pose": paper, "joints/position": derived.joints, "segments/rotation": derived.rotations}
    columns["feet/position"] = derived.feet
    columns |= {f"angles/{joint}": values for joint, values in derived.angles.items()}
    if tracker.waist_names:
        columns["waist"] = waist
    if tracker.ankle_names:
        columns["ankles"] = ankles
    return columns


def _kept(observation: Observation, used: Observation, estimate: Estimate) -> NDArray[np.uint8]:
    """The masks (C, H, W) of a frame as the tracker took them; those of cameras that were left out as they were, for
    these may be refined."""
    taken = used.masks if estimate.masks is None else estimate.masks
    out = np.asarray(observation.masks.any(axis=(1, 2)) & ~used.masks.any(axis=(1, 2)))
    return np.where(out[:, None, None], observation.masks, taken) if out.any() else taken


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
        fit_error=estimate.fit_error,
        status=int(Status[estimate.status.upper()]),
        objective=estimate.objective,
        iterations=estimate.iterations,
        timing=estimate.timing,
        hull=points_of(estimate.surface) if store_hull and estimate.surface is not None else None,
    )


def points_of(surface: HullSurface) -> HullPoints:
    """A hull's surface as the result file keeps it: colours RGB, uint8."""
    return HullPoints(surface.positions, surface.colors[:, ::-1].round().clip(0, 255).astype(np.uint8))
