"""What a run is before its first frame: setup, source, trackers, and the range of frames."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from tk.errors import CaptureError, ConfigError
from tk.io.captures.capture import Capture
from tk.io.captures.film import Film, filmed
from tk.io.captures.keypoints import first_pose
from tk.io.captures.source import Source
from tk.io.results.data import JointAngles, ResultMeta
from tk.io.settings_file import to_toml
from tk.model.body.anthropometry import AVERAGE_BODY
from tk.model.body.body_points import LANDMARKS
from tk.model.body.skeleton import SEGMENTS, build_skeleton
from tk.model.setup import Setup, Subject
from tk.run.prefetch import TIMING_STAGES, Observations, open_observations
from tk.run.segmentation import mask_source, sees_landmarks, sources_of_masks
from tk.run.task import RecordingOptions, Task, describe
from tk.trackers.bodies import read_body
from tk.trackers.judgement import STATE_MEANINGS
from tk.trackers.proposals.limbs import CANDIDATES
from tk.trackers.protocol import Tracker
from tk.trackers.reason import MEANINGS
from tk.trackers.registry import tracker_class

_LOG = logging.getLogger(__name__)


def recording_task(capture: Capture, options: RecordingOptions) -> Task:
    """Return the task of tracking a recording.

    Raises:
        TkError: a file of the options cannot be used, or the initial pose is not in the recording.
    """
    # stored in the result, so that the capture is opened in the same way
    settings = replace(options.settings, resample=capture.resampled)
    setup = _recording_setup(capture, options)
    small = reduce_images(capture, settings.person_pixels)
    return Task(replace(setup, rig=small.rig), small, replace(options, settings=settings), small.warnings)


def _recording_setup(capture: Capture, options: RecordingOptions) -> Setup:
    """Return a capture's setup, with the initial pose and the body that files give for its subjects."""
    first_frame = options.frames[0]
    setup = capture.setup()
    subjects: list[Subject] = []
    names = build_skeleton(AVERAGE_BODY).names
    for subject, given in zip(setup.subjects, capture.subjects, strict=True):
        first = not subjects
        init_file, body_file = (capture.path / name if name else None for name in (given.init, given.body))
        if first:
            init_file, body_file = options.init_pose or init_file, options.body or body_file
        init = first_pose(capture, names, init_file, first_frame) if first or init_file else None
        frame = subject.init_frame
        if init is not None:
            where = init_file or capture.init_keypoints
            if not ((setup.volume.lower <= init.center) & (init.center <= setup.volume.upper)).all():
                raise CaptureError(
                    f"{where}: the body is at {init.center.round(2).tolist()}, outside the working volume "
                    f"{setup.volume.lower.round(2).tolist()} to {setup.volume.upper.round(2).tolist()}; give metres"
                )
            frame = first_frame if init.frame is None else init.frame
            if init.frame is not None and init.frame >= capture.frame_count:
                raise CaptureError(f"{where}: frame = {frame} is past the capture's last, {capture.frame_count - 1}")
        known = read_body(body_file, setup.up) if body_file else None
        subjects.append(replace(subject, init_frame=frame, init=init, body=known))
    frames = {s.init_frame for s in subjects if s.init is not None}
    if len(frames) > 1:
        raise CaptureError(f"{capture.path}: the initial poses are of the frames {sorted(frames)}; give one frame")
    return replace(setup, subjects=tuple(subjects))


def reduce_images(capture: Capture, person_pixels: int) -> Capture:
    """Return a capture whose images are reduced where the person is larger than ``person_pixels``; see
    :attr:`tk.settings.Settings.person_pixels`. A warning of the capture reports it."""
    heights = capture.setup().person_pixels()
    factors = np.maximum(heights // person_pixels, 1).astype(int) if person_pixels else np.ones(len(heights), int)
    if factors.max() == 1:
        return capture
    names, sizes = np.array(capture.rig.names), []
    for factor in np.unique(factors[factors > 1]):
        chosen = factors == factor
        who = "all cameras" if chosen.all() else ", ".join(names[chosen])
        low, high = np.unique(heights[chosen].round(-1).astype(int))[[0, -1]]
        tall = f"{low} px" if low == high else f"{low} to {high} px"
        sizes.append(f"{who} at 1/{factor} (the person is about {tall} tall)")
    line = f"{capture.path}: images are read at a reduced size: {', '.join(sizes)}; person_pixels = 0: at full size"
    return replace(capture.reduced(factors.tolist()), warnings=(*capture.warnings, line))


def choose_frames(source: Source, frames: tuple[int, int | None], note: Callable[[str], None]) -> tuple[int, int]:
    """Return the first frame that is asked for and that all cameras have, and the end, exclusive. The length of the
    source must be known.

    Raises:
        ConfigError: there is no such frame.
    """
    (start, stop), count = frames, source.frame_count
    assert count is not None
    if start >= count:
        asked = f"{start}:" if stop is None else f"{start}:{stop}"
        raise ConfigError(f"frames {asked}: {source.where} has only frames 0 to {count - 1}")
    if stop is not None and stop > count:
        note(f"frames {start}:{stop}: {source.where} ends with frame {count - 1}")
    if stop is not None and stop <= source.first_frame:
        raise ConfigError(
            f"frames {start}:{stop}: the latest camera of {source.where} begins in frame {source.first_frame}"
        )
    return max(start, source.first_frame), count if stop is None else min(stop, count)


@dataclass(frozen=True)
class Plan:
    """A task, and how it is done.

    Attributes:
        task: what is tracked.
        observations: the source's frames, segmented.
        tracker: the first person's, not started yet.
        first: frame of the initialisation.
        begin, stop: range of frames written, stop exclusive; None: until the source ends.
    """

    task: Task
    observations: Observations
    tracker: Tracker
    first: int
    begin: int
    stop: int | None

    @property
    def total(self) -> int:
        """Number of frames written; 0 if the length of the source is unknown."""
        return 0 if self.stop is None else self.stop - self.begin

    def meta(self) -> ResultMeta:
        """Return what the result says about itself."""
        tracker, task, setup = self.tracker, self.task, self.task.setup
        landmarks = LANDMARKS if tracker.reports_sigma and sees_landmarks(task) else ()
        return ResultMeta(
            pose_names=tracker.pose_names,
            pose_units=tracker.pose_units,
            stages=tracker.stages,
            timing_stages=(*TIMING_STAGES, *tracker.timing_stages, "total"),
            fps=setup.fps,
            up=setup.up,
            capture=task.source.name,
            method=tracker.method,
            seed=task.settings.seed,
            config_toml=to_toml(task.settings),
            sigma=tracker.reports_sigma,
            residual_cameras=setup.rig.names if tracker.reports_sigma else (),
            mask_sources=sources_of_masks(task.source) if tracker.reports_sigma else (),
            landmark_names=landmarks,
            depth=bool(landmarks),
            reasons=MEANINGS,
            judged=True,
            deviation=tracker.reports_sigma,
            modes=CANDIDATES if tracker.has_second_pass else 0,
            camera_states=STATE_MEANINGS if tracker.reports_sigma else (),
            segment_names=SEGMENTS if tracker.has_segments else (),
            feet=tracker.has_segments,
            angles=JointAngles.of_body(tracker.pose_names, bool(landmarks)) if tracker.has_segments else (),
            objective_kind=tracker.objective_kind,
        )

    def origin(self) -> dict[str, str]:
        """Return what else must agree when a run is resumed, by the name that a user knows."""
        options, setup, source = self.task.options, self.task.setup, self.task.source

        def hashed(given: Sequence[object]) -> str:
            known = any(value is not None for value in given)
            return hashlib.sha256(repr(given).encode()).hexdigest()[:12] if known else "none"

        return {
            "first frame": str(self.begin),
            "frame of the initial pose": str(self.first),
            "given body (its hash)": hashed([s.body for s in setup.subjects]),
            "cameras": ", ".join(setup.rig.names),
            "size of the images": ", ".join("full" if k == 1 else f"1/{k}" for k in setup.rig.reductions),
            "masks": source.masks_from if source.has_masks else mask_source(source),
            "initial pose (its hash)": hashed([s.init for s in setup.subjects]),
            "stored hull": "yes" if options.store_hull else "no",
            "people": describe(options.people),
            "videos and times of the frames (their hash)": hashed(_read_from(source)),
        }


def _read_from(source: Source) -> Sequence[str | None]:
    """Return the files outside a capture's folder, and the clock on which frames were chosen from files."""
    if not isinstance(source, Capture) or source.clock is None:
        return (None,)
    return (source.clock.text, *source.videos)


@contextmanager
def open_plan(task: Task, note: Callable[[str], None], film: Film | None = None) -> Iterator[Plan]:
    """Make trackers and open the source's observations; ``note`` receives lines for the user. A ``film`` is given its
    frames, those of the video of the result, and their images.

    Raises:
        TkError: the options are inconsistent with each other or with the source.
    """
    setup, source, frames = task.setup, task.source, task.options.frames
    kind = tracker_class(task.options.method)
    start, stop = max(frames[0], source.first_frame), frames[1]
    if source.frame_count is not None:
        start, stop = choose_frames(source, frames, note)
    first = min(s.init_frame for s in setup.subjects)
    if not any(s.init or s.in_init_pose for s in setup.subjects):
        first = max(first, start)  # no pose is given, so any frame may serve
    if stop is not None and first >= stop:
        raise ConfigError(
            f"frames {start}:{stop}: the subject is found in frame {first} and followed forwards; "
            f"end after frame {first}, or give an initial pose in another frame",
            hint="with --init-pose FILE",
        )
    if start < first:
        note(f"frames before {first} are left out: the subject is found in frame {first} and followed forwards")
    begin = max(start, first)
    if film is not None and stop is not None:
        film.frames = filmed(begin, stop, setup.fps)
    # the process of the observations starts while this one makes tables and compiles
    with open_observations(task, note, kind.image_step, film) as observations:
        _LOG.info("preparing the %s tracker", task.options.method)
        yield Plan(task, observations, kind.of(setup, task.settings), first, begin, stop)
