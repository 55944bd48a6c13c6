"""A person who is tracked: the tracker, its camera monitor, and where the person was last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.kernels.mask_values import PERSON
from tk.model.body.joints import JOINTS
from tk.model.cameras.camera import Rig
from tk.model.setup import Subject
from tk.model.stateful import Stateful
from tk.people.share import REACH_M, STRANGER_SHARE
from tk.trackers.camera_monitor import CameraMonitor, MonitorState
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.protocol import Estimate, Frame, Tracker, sharing, without_cameras
from tk.trackers.reason import Reason
from tk.trackers.registry import TrackerState

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Answer:
    """What is known of a person after a frame.

    Attributes:
        estimate: of the pose.
        share: the person's share of the frame, in cameras whose images are right.
        used: the part of the share that the tracker has used.
    """

    estimate: Estimate
    share: Frame
    used: Frame

    def without_pose(self, tracker: Tracker) -> Answer:
        """Return the answer of somebody who is absent: the reason, and what is known of the cameras, stay."""
        names = ("found", "judged", "cameras", "shift", "timing", "iterations")
        kept = {name: getattr(self.estimate, name) for name in names}
        return replace(self, estimate=replace(no_pose(tracker, len(self.share.masks)), **kept))


@dataclass(frozen=True)
class PersonMotion:
    """What changes from frame to frame, see :class:`Person`."""

    tracker: TrackerState
    monitor: MonitorState
    lost: bool
    absent: bool
    drawn: NDArray[np.bool_] | None
    place: Float | None


@dataclass(frozen=True)
class PersonState:
    """What a resumed run needs of a person who is tracked.

    Attributes:
        number: see :class:`Person`.
        subject: number of the subject; None: nothing is known of the person.
        in_init_pose: whether the subject began in the initialisation pose.
        body: of a person who is not in the result; None of others.
        member: what changes from frame to frame, see :class:`PersonMotion`.
    """

    number: int
    subject: int | None
    in_init_pose: bool
    body: dict[str, Any] | None
    member: PersonMotion


@dataclass
class Person(Stateful[PersonMotion]):
    """A person who is tracked."""

    State = PersonMotion

    number: int  # in the result; people who are not written have higher numbers
    subject: Subject  # what is known of the person
    tracker: Tracker
    monitor: CameraMonitor
    written: bool = True  # whether the person is in the result
    lost: bool = False  # in the last frame
    absent: bool = False  # nobody was seen in the last frame who could be this person
    drawn: NDArray[np.bool_] | None = None  # (C, h, w) the body in the last frame that is not lost, see `Estimate`
    place: Float | None = None  # (3,) m, mean of the joints in that frame

    @property
    def sharing(self) -> ContourTracker[Any]:
        """The tracker, which can track a person among others."""
        tracker = sharing(self.tracker)
        assert tracker is not None
        return tracker

    def begin(self, frames: Sequence[Frame], hull_m: float | None, whole: Sequence[Frame] = ()) -> None:
        """Start the tracker.

        Args:
            frames: the person's share of the opening.
            hull_m: height of the visual hull in the first frame.
            whole: the opening with everybody's masks.

        Raises:
            CaptureError: nobody can be tracked.
        """
        seen = self.monitor.start(frames, whole)
        self.tracker.start(seen, replace(self.subject, hull_m=hull_m))
        self.monitor.check_body()

    def step(self, share: Frame) -> Answer:
        """Return the answer for this person's share of the next frame."""
        estimate, used = self.monitor.step(share)
        self.lost = estimate.status == "lost"
        if not self.lost:
            self.drawn, self.place = estimate.drawn, estimate.joints.mean(axis=0)
        return Answer(estimate, without_cameras(share, self.monitor.unfit), used)

    def shows_others(self, masks: NDArray[np.uint8], rig: Rig) -> bool:
        """Return whether masks (C, H, W) show more than this person, pixels far from the last body, or may do so, as
        before the first frame."""
        tracker = sharing(self.tracker)
        if tracker is None or self.lost:
            return False
        if self.place is None:
            return True
        if self.drawn is None:  # the tracker renders no body
            return False
        shown = tracker.coarse_grid.sample(masks) >= PERSON
        for camera, cells, body in zip(rig, shown, self.drawn, strict=True):
            area = np.count_nonzero(body)
            if np.count_nonzero(cells) <= (1 + STRANGER_SHARE) * area:
                continue
            # the unpredicted half of a fist's motion
            reach = REACH_M / 2 * camera.pixels_per_metre(self.place) / tracker.coarse_grid.step
            size = 2 * max(round(reach), 1) + 1
            near = cv2.dilate(body.view(np.uint8), np.ones((size, size), np.uint8)) > 0
            if np.count_nonzero(cells & ~near) > STRANGER_SHARE * area:
                return True
        return False

    def has_left(self, masks: NDArray[np.uint8]) -> bool:
        """Return whether the person, who is lost, has left the last place: in every view most of the body would be on
        background, by masks (C, H, W).

        One view that still shows the person says that the others' masks fail.
        """
        body = self.drawn
        if body is None:
            return False
        sampled = self.sharing.coarse_grid.sample(masks)
        covered = np.count_nonzero(body, axis=(1, 2))
        return bool((np.count_nonzero(body & (sampled < PERSON), axis=(1, 2)) >= 0.5 * covered).all())


def no_pose(tracker: Tracker, views: int, lost: bool = False) -> Estimate:
    """Return the estimate of a tracker for somebody who is absent in some views, or ``lost``."""
    return Estimate(
        pose=np.full(len(tracker.pose_names), np.nan),
        joints=np.full((len(JOINTS), 3), np.nan),
        origin=Status.TRACKED if lost else Status.ABSENT,
        objective=np.nan,
        iterations=np.zeros(len(tracker.stages), np.int32),
        timing=dict.fromkeys(tracker.timing_stages, 0.0),
        deviation=np.full(len(JOINTS), np.nan) if tracker.reports_sigma else None,
        residual=np.full((views, 2), np.nan) if tracker.reports_sigma else None,
        found=Reason.UNEXPLAINED if lost else Reason.NONE,
    )
