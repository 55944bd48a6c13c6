"""Track a person a second time.

With other cameras, the whole run: a camera that was left out is judged again, because cameras and delays have changed.
The second run counts only if its poses explain the images better: every image of both runs is compared, also those of
cameras that were left out.

Backwards, the frames that were lost: where a search from the frame before has failed, the pose of the frame after may
lead to the right one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, islice, takewhile
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.captures.frames import FrameSet
from tk.io.captures.mask_store import MaskStore
from tk.io.captures.source import Source
from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.cues.ray_costs import RayGrid, residual_of
from tk.model.setup import InitPose, Setup, Subject
from tk.run.delays import COMPARED
from tk.trackers.camera_monitor import CameraMonitor
from tk.trackers.contour_finder import COARSE_ROWS
from tk.trackers.judgement import FrameJudge, all_left_out
from tk.trackers.protocol import Estimate, Frame, shows_person, usable
from tk.trackers.reason import is_lost
from tk.trackers.region import RegionTracker
from tk.trackers.residual import RECENT

Float = NDArray[np.float64]

# A camera is judged again if the first run left it out of this share of the frames in which it shows the person.
# Tracking again takes as long as the first pass.
_LEFT_OUT = 0.1


TrackerAndMasks = tuple[RegionTracker, MaskStore]
"""A tracker with the cameras of a run, and the masks of the frames with the delays of the run."""


class Found(Protocol):
    """What a run has found, by the datasets of a result; ``lost``: (F,) frames without a pose."""

    lost: NDArray[np.bool_]

    def current(self, dataset: str) -> Any:
        """Return a dataset, such as "pose" (F, D) in the setup's world, or "residual" (F, C, 2)."""
        ...


@dataclass(frozen=True)
class Run:
    """The frames of a run in which the person is present.

    Attributes:
        tracker, masks: see :data:`TrackerAndMasks`.
        frames: (F,) numbers of the frames.
        poses: (F, D) in the setup's world.
        lost: (F,) frames without a pose.
        residual: (F, C, 2), NaN for a camera that was left out.
        cameras: (F, C) states of the cameras, indices in :data:`~tk.trackers.judgement.STATES`.
    """

    tracker: RegionTracker
    masks: MaskStore
    frames: NDArray[np.int64]
    poses: Float
    lost: NDArray[np.bool_]
    residual: Float
    cameras: NDArray[np.uint8]

    @classmethod
    def of(cls, used: TrackerAndMasks, frames: NDArray[np.int64], found: Found, rows: NDArray[np.int64]) -> Run:
        """Return some rows of what a run has found in frames (F,)."""
        pose, residual, cameras = (found.current(name)[rows] for name in ("pose", "residual", "evidence/camera"))
        return cls(*used, frames[rows], pose, found.lost[rows], residual, cameras)

    def left_out(self) -> NDArray[np.bool_]:
        """Return (C,) the cameras that show the person and were left out of a part of the frames."""
        rows = np.flatnonzero(~self.lost)
        shown = np.array([shows_person(self.masks.get(int(frame))) for frame in self.frames[rows]])
        if not len(rows):
            return np.zeros(self.residual.shape[1], np.bool_)
        out = shown & np.isnan(self.residual[rows, :, 0])
        return np.asarray(out.sum(axis=0) > _LEFT_OUT * shown.sum(axis=0))

    def wrong_pixels(self, frames: NDArray[np.int64]) -> Float:
        """Return (N, C) E_S of some frames (N,) by all cameras, at most 1; 1 in lost frames, NaN where nobody is
        seen."""
        tracker = self.tracker
        grid = RayGrid(tracker.world.rig, COARSE_ROWS)
        rows = np.searchsorted(self.frames, frames)
        poses = tracker.world.poses_in(self.poses[rows])
        found = np.empty((len(frames), len(grid.rig)))
        for k, frame in enumerate(frames.tolist()):
            seen = grid.sample(self.masks.get(frame))
            label = grid.render(tracker.body, poses[k][None]).label[0]
            found[k] = residual_of(label > 0, seen >= PERSON, seen == OTHERS).sum(axis=1)
        found[self.lost[rows]] = np.where(np.isnan(found[self.lost[rows]]), np.nan, 1.0)
        return np.minimum(found, 1.0)


def explains_better(second: Run, first: Run) -> bool:
    """Return whether a run explains the images better than an earlier one: the mean share of wrong pixels, of the same
    images, is lower."""
    frames = np.intersect1d(second.frames, first.frames)
    if not len(frames):
        return False
    frames = frames[np.unique(np.linspace(0, len(frames) - 1, COMPARED).round().astype(int))]
    new, old = second.wrong_pixels(frames), first.wrong_pixels(frames)
    both = np.isfinite(new) & np.isfinite(old)
    return bool(both.any() and new[both].mean() < old[both].mean())


def track_again(
    first: Run,
    now: TrackerAndMasks,
    source: Source,
    setup: Setup,
    subject: Subject,
    landmarks: Mapping[int, Float],
    within: Callable[[float], None],
) -> tuple[Mapping[int, Estimate], CameraMonitor] | None:
    """Track the frames of a run again in which every camera has an image, from its first pose on, and judge all cameras
    anew; return the estimates by frame, and the monitor. None if nobody can be tracked so.

    The body is fitted again if the run left out a camera.

    Args:
        first: the run.
        now: the new cameras, and masks with the new delays, which are not made again.
        source: with the new delays; its length is known.
        setup: the scene.
        subject: what is known of the person.
        landmarks: (C, L, 4) of the person by frame, with the new delays, where there are any.
        within: receives the share that is done.
    """
    (tracker, masks), frame_count = now, source.frame_count
    assert frame_count is not None
    shown = first.frames[~first.lost & (first.frames >= source.first_frame) & (first.frames < frame_count)]
    if not len(shown):
        return None
    begin, stop = int(shown[0]), min(frame_count, int(first.frames[-1]) + 1)
    pose = first.poses[np.searchsorted(first.frames, begin)]
    monitor = CameraMonitor(tracker, replace(setup, rig=tracker.rig), subject)
    found: dict[int, Estimate] = {}
    with source.frames(begin, stop) as images:
        frames = shown_again(images, first.frames, masks, landmarks)
        opening = list(islice(frames, tracker.opening_frames))
        try:
            seen = monitor.start(opening)
            if first.left_out().any():
                given = dict(zip(tracker.pose_names, pose.tolist(), strict=True))
                init = InitPose({}, given, height_m=subject.height_m or tracker.body.dimensions.barefoot)
                tracker.start(seen, replace(subject, init=init))
        except CaptureError:
            return None
        tracker.start_at(pose)
        opening.reverse()
        waiting = (opening.pop() for _ in range(len(opening)))  # images are large
        for frame in chain(waiting, frames):
            found[frame.index] = monitor.step(frame)[0].light
            within((frame.index + 1 - begin) / (stop - begin))
    return found, monitor


def shown_again(
    images: Iterable[FrameSet], present: NDArray[np.int64], masks: MaskStore, landmarks: Mapping[int, Float]
) -> Iterator[Frame]:
    """Yield what images show again of a person, in the frames in which the person is present, by their numbers: the
    masks are not made again.

    Args:
        images: in order.
        present: (F,) numbers of frames.
        masks: of these frames at least.
        landmarks: as for :func:`track_again`.
    """
    numbers = set(present.tolist())
    for frame in images:
        if (n := frame.index) in numbers:
            marked = landmarks[n][None] if n in landmarks else None
            yield Frame(n, frame.halved, masks.get(n), time=frame.time, landmarks=marked)


def step_without(
    tracker: RegionTracker, frame: Frame, unused: NDArray[np.bool_], states: NDArray[np.uint8]
) -> Estimate:
    """Track a frame without the cameras (C,) that are unused; the estimate has the states of the cameras, those (C,)
    given for unused ones."""
    used = usable(frame, unused)
    estimate = tracker.step(used)
    return replace(estimate, cameras=all_left_out(np.where(unused, states, 0), shows_person(used.masks), estimate))


def track_back(run: Run, landmarks: Mapping[int, Float]) -> dict[int, Estimate]:
    """Track each stretch of lost frames backwards, from the frames after it on, to the first frame in which the person
    is not found; return the estimates of those in which the person is found, by frame.

    Frames are judged as in the run. The tracker begins :data:`~tk.trackers.residual.RECENT` frames after the stretch,
    or fewer if those are lost, so that motion and residual are known. Colours are not used: no image is read again.

    Args:
        run: the run; its frames are in order.
        landmarks: (C, L, 4) of the person by frame, where there are any.
    """
    found: dict[int, Estimate] = {}
    lost = run.lost
    if not lost.any():
        return found
    tracker = run.tracker.with_cameras(run.tracker.rig)
    for rows in np.split(np.arange(len(lost)), np.flatnonzero(np.diff(run.frames) > 1) + 1):
        for last in np.flatnonzero(lost[rows[:-1]] & ~lost[rows[1:]]):
            after = list(takewhile(lambda row: not lost[row], rows[last + 1 : last + 1 + RECENT]))
            stretch = list(takewhile(lambda row: lost[row], rows[last::-1]))
            tracker.start_at(run.poses[after[-1]])
            judge = FrameJudge(tracker, run.residual.shape[1], tracker.fps, tracker.region_settings.false_alarm)
            for row in chain(reversed(after), stretch):
                if (number := int(run.frames[row])) not in run.masks:
                    break
                masks, marked = run.masks.get(number), landmarks.get(number)
                blank = np.empty((len(masks), 0, 0, 3), np.uint8)
                frame = Frame(number, blank, masks, landmarks=None if marked is None else marked[None])
                known = after[0] if lost[row] else row
                estimate = step_without(tracker, frame, np.isnan(run.residual[known, :, 0]), run.cameras[known])
                estimate = judge.judge(number, estimate)
                if is_lost(estimate.reason):
                    break
                if lost[row]:
                    found[number] = estimate.light
    return found
