"""The loop: open a capture, step a tracker through it, write the result, tell how it goes, resume."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.config import Config
from tk.errors import CaptureError, ConfigError
from tk.io.capture import Capture
from tk.io.frames import FrameSet
from tk.io.init_pose import InitPose, read_init_pose
from tk.io.result import FrameResult, HullPoints, ResultMeta, ResultWriter, Status
from tk.model.foreground import CollinearityForeground, Mog2Foreground, median_plate
from tk.model.hull import HullSurface
from tk.tracker import Estimate, Observation, Stopwatch, Tracker
from tk.volumetric import VolumetricTracker

Segmenter = Callable[[FrameSet], NDArray[np.uint8]]

METHODS = ("volumetric",)

# frames from which a background is made where there is no recording of the empty scene
PLATE_FRAMES = 25


class Reporter(Protocol):
    """Who wants to know how it goes."""

    def note(self, text: str) -> None:
        """A line worth reading."""
        ...

    def begin(self, total: int, done: int) -> None:
        """``total`` frames are to be tracked, ``done`` of which an earlier run has finished."""
        ...

    def advance(self, frame: int, estimate: Estimate) -> None:
        """A frame is finished and in the file."""
        ...


@dataclass(frozen=True)
class Summary:
    """What a run did: frames written in all, those lost, seconds of this run, frames of this run, interrupted or not."""

    frames: int
    lost: int
    seconds: float
    tracked_now: int
    interrupted: bool = False


def make_tracker(method: str, capture: Capture, config: Config) -> Tracker:
    """The tracker of this name for a capture."""
    if method == "volumetric":
        return VolumetricTracker(capture.rig, capture.volume, capture.up, config)
    raise ConfigError(f"--method {method}: choose one of {', '.join(METHODS)}")


def make_segmenter(capture: Capture, config: Config, note: Callable[[str], None]) -> Segmenter:
    """Masks of each frame: the capture's own, or a segmentation learned from its background."""
    if capture.has_masks:
        return _given_masks
    sizes = [(camera.width, camera.height) for camera in capture.rig]
    clips = capture.background()
    if clips is None:
        note(
            f"{capture.path}: no masks and no background/; taking the median of {PLATE_FRAMES} frames as the empty scene"
        )
        step = max(capture.frame_count // PLATE_FRAMES, 1)
        with capture.frames() as frames:
            samples = [frame.images.copy() for frame in frames if frame.index % step == 0]
        clips = median_plate(samples, sizes)
    learner = CollinearityForeground if config.segmentation == "collinearity" else Mog2Foreground
    foreground = learner.learn(clips, capture.rig.frame_shape, sizes, config.foreground)
    return lambda frame: foreground.segment(frame.images)


def _given_masks(frame: FrameSet) -> NDArray[np.uint8]:
    assert frame.masks is not None
    return frame.masks


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
    but not written. Ctrl-C ends the run after the frame in hand, with the file closed and ready for ``resume``.

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
    tracker = make_tracker(method, capture, config)
    init = read_init_pose(init_pose, tracker.pose_names) if init_pose else None
    first = init.frame if init and init.frame is not None else frames[0] if init else capture.init_frame
    if init is None and capture.init_pose == "any":
        raise CaptureError(
            f'{capture.path / "capture.toml"}: init.pose = "any", so nobody stands in the Da Vinci pose; '
            "give a rough pose with --init-pose FILE"
        )
    stop = min(frames[1], capture.frame_count) if frames[1] is not None else capture.frame_count
    begin = max(frames[0], first)
    if frames[0] < first:
        reporter.note(
            f"frames before {first} are left out: the subject is found in frame {first} and followed forwards"
        )
    if begin >= stop:
        raise ConfigError(f"--frames {frames[0]}:{frames[1]}: nothing to track between frames {begin} and {stop}")
    meta = ResultMeta(
        pose_names=tracker.pose_names,
        pose_units=tracker.pose_units,
        stages=tracker.stages,
        timing_stages=("decode", "masks", *tracker.timing_stages, "total"),
        fps=capture.fps,
        up=capture.up,
        capture=capture.name,
        method=method,
        seed=config.seed,
        config_toml=config.to_toml(),
    )
    writer, done = ResultWriter.resume(output, meta) if resume else (ResultWriter.create(output, meta), 0)
    with writer:
        return _run(capture, tracker, writer, done, config, reporter, (first, begin, stop), init, store_hull)


def _run(
    capture: Capture,
    tracker: Tracker,
    writer: ResultWriter,
    done: int,
    config: Config,
    reporter: Reporter,
    span: tuple[int, int, int],
    init: InitPose | None,
    store_hull: bool,
) -> Summary:
    first, begin, stop = span
    reporter.begin(stop - begin, done)
    if begin + done >= stop:
        return Summary(done, 0, 0.0, 0)
    started = time.perf_counter()
    segment = make_segmenter(capture, config, reporter.note)
    height = capture.subject_height_m
    if done:
        tracker.restore(writer.model, writer.state)
        reader_start = begin + done
    else:
        reader_start = first
    lost = tracked = 0
    interrupted = False
    with capture.frames(reader_start, stop) as frames:
        observations = _observe(frames, segment)
        try:
            if not done:
                opening = list(islice(observations, config.tracking.init_frames))
                tracker.start([observation for observation, _ in opening], height, init)
                writer.write_model(tracker.model())
                observations = chain(opening, observations)
            for observation, watch in observations:
                estimate = tracker.step(observation)
                if observation.index < begin:
                    continue
                timing = {**watch.laps, **estimate.timing}
                timing["total"] = sum(timing.values())
                writer.append(_row(observation.index, capture.fps, estimate, timing, store_hull), tracker.state())
                tracked += 1
                lost += estimate.status == "lost"
                reporter.advance(observation.index, estimate)
        except KeyboardInterrupt:
            interrupted = True
    return Summary(done + tracked, lost, time.perf_counter() - started, tracked, interrupted)


def _observe(frames: Iterator[FrameSet], segment: Segmenter) -> Iterator[tuple[Observation, Stopwatch]]:
    """Frames with their masks, and what it took to get them."""
    while True:
        watch = Stopwatch()
        frame = next(frames, None)
        if frame is None:
            return
        watch.lap("decode")
        masks = segment(frame)
        watch.lap("masks")
        yield Observation(frame.index, frame.images, masks), watch


def _row(index: int, fps: float, estimate: Estimate, timing: dict[str, float], store_hull: bool) -> FrameResult:
    return FrameResult(
        frame=index,
        time=index / fps,
        pose=estimate.pose,
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
