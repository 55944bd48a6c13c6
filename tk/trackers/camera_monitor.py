"""The camera monitor: steps a tracker without the cameras that are wrong, and rejects impossible poses.

Three checks exclude a camera: its image shows nothing, is frozen, or has moved since the first frame, so that the
calibration is no longer true (:mod:`tk.model.masks.image_health`); in the opening frames its masks contradict those of
the other cameras (:mod:`tk.model.masks.mask_agreement`); or, in a later frame, its residual is an outlier
(:mod:`tk.trackers.residual_judge`).

Only contour trackers can go without a camera: a visual hull without one of its masks is empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.results.status import Status
from tk.kernels.mask_values import OTHERS
from tk.model.body.joint_sigma import VIEW_M
from tk.model.body.plausibility import LastAccepted, Plausibility, check_extent, check_stature
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.landmark_agreement import evidence_for_cameras
from tk.model.masks.image_health import MOVED, HealthState, ImageHealth, described
from tk.model.masks.mask_agreement import Agreement, MaskAgreement
from tk.model.setup import Setup, Subject
from tk.model.stateful import Stateful
from tk.trackers.judgement import (
    CONSEQUENCES,
    FrameEvidence,
    Reason,
    depth_known,
    is_status,
    judge_frames,
    refused,
)
from tk.trackers.protocol import Estimate, Frame, Tracker, sharing, shows_person, without_cameras
from tk.trackers.region import RegionTracker
from tk.trackers.residual_judge import JudgeState, ResidualJudge

Float = NDArray[np.float64]

# Frames of the opening that are compared.
_OPENING = 5
# Reasons, as in messages.
_DISAGREES, _MISSING = "disagrees with the others", "misses a part of the person"

Span = tuple[int, int, int]
"""Frames: the first, the last, and their number."""


def spread_over(frames: Sequence[Frame], count: int = _OPENING) -> list[Frame]:
    """Return this many of the opening's frames, spread over it."""
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))]


def opening_agreement(setup: Setup, frames: Sequence[Frame]) -> Agreement:
    """Return whether the silhouettes of the opening frames agree.

    A network's masks have holes and contain pieces of other things. A camera whose masks contradict the others is right
    if its landmarks agree with the others'.
    """
    found = MaskAgreement(setup.rig, setup.volume).compare([frame.masks for frame in spread_over(frames)])
    seen = [frame.landmarks for frame in frames if frame.landmarks is not None]
    if not seen or not (found.wrong or found.refusal):
        return found
    return found.confirmed(evidence_for_cameras(setup.rig, seen))


@dataclass(frozen=True)
class MonitorState:
    """What is known of C cameras and of the person.

    Attributes:
        excluded: (C,) cameras that are wrong.
        refused: poses refused since the last accepted one, because of their residual.
        was_lost: whether the last frame has no pose.
        spans: of exclusion, by "camera/reason".
        doubted: (C,) see :class:`CameraMonitor`.
        recent: what the last frames show.
        opening_reasons: why cameras are excluded from the opening on.
        health, plausibility, judge: the parts; None without a judge.
    """

    excluded: NDArray[np.bool_]
    refused: int
    was_lost: bool
    spans: dict[str, Span]
    doubted: NDArray[np.bool_]
    recent: FrameEvidence
    opening_reasons: dict[int, str]
    health: HealthState
    plausibility: LastAccepted
    judge: JudgeState | None


class CameraMonitor(Stateful[MonitorState]):
    """Steps a tracker; excludes cameras that are wrong.

    Args:
        tracker: the caller starts it with the frames of :meth:`start`, or restores it.
        setup: rig, working volume, upward direction and rate.
        subject: what is known of the person.

    Attributes:
        unfit: (C,) cameras that their image excludes from the last frame.
        doubted: (C,) cameras whose images may be the cause of a fault: those that were left out, which the others
            contradicted; all of them if the person was lost, or jumped.
    """

    State = MonitorState

    def __init__(self, tracker: Tracker, setup: Setup, subject: Subject) -> None:
        self.tracker, self._setup, self._subject = tracker, setup, subject
        self._names = setup.rig.names
        self._health = ImageHealth()
        self._plausibility = Plausibility(setup.fps)
        C = len(self._names)
        self.unfit, self.doubted = np.zeros(C, bool), np.zeros(C, bool)
        self._excluded = np.zeros(C, bool)
        self._judge = ResidualJudge(tracker, setup.rig) if isinstance(tracker, RegionTracker) else None
        self._spans: dict[str, Span] = {}
        self._recent = FrameEvidence.none(C)
        self._opening_reasons: dict[int, str] = {}
        self._refused = 0
        self._was_lost = False
        self._excess = 0.0  # of this frame, mean over the cameras used; 0 if it was not tested

    def start(self, frames: Sequence[Frame], whole: Sequence[Frame] = ()) -> list[Frame]:
        """Return the opening frames without the cameras that are wrong, for the tracker's start.

        Args:
            frames: the person's share of the opening.
            whole: the opening with everybody's masks. They are compared where those of the person alone show too
                little: cameras that do not belong together show several people where one is.

        Raises:
            CaptureError: the cameras contradict each other, or the person's size contradicts the height in
                `capture.toml`.
        """
        health = ImageHealth()
        bad = np.array([self._bad(health.look(f.images, f.masks)) for f in frames])
        shown = [without_cameras(f, b) for f, b in zip(frames, bad, strict=True)]
        agreement = opening_agreement(self._setup, shown)
        if whole and (agreement.refusal or np.count_nonzero(agreement.tested_right) < 2):
            agreement = opening_agreement(self._setup, [without_cameras(f, np.asarray(bad.all(axis=0))) for f in whole])
        if agreement.refusal:
            raise CaptureError(agreement.refusal)
        if self._judge is not None:
            self._judge.tracker.view_m = float(np.hypot(VIEW_M, agreement.undetected_m))
        for camera in agreement.wrong:
            self._excluded[camera] = True
            self._opening_reasons[camera] = agreement.reason(camera)
        if self._excluded.any() and not self.tracker.can_exclude_cameras:
            reasons = (
                f"camera {self._names[c]} {_DISAGREES} ({reason})" for c, reason in self._opening_reasons.items()
            )
            raise CaptureError(f"{'; '.join(reasons)}: this method needs masks that fit from all cameras")
        alone = not any((f.masks == OTHERS).any() for f in frames)  # the hull of two people is larger than one
        if self._subject.height_m is not None and alone:
            check_extent(agreement.extent_m, self._subject.height_m)
        return [without_cameras(f, self._excluded) for f in shown]

    def check_body(self) -> None:
        """Refuse a body of an impossible size, after the tracker's start.

        Raises:
            CaptureError: with the size and its likely causes.
        """
        if self._subject.height_m is None:
            check_stature(self.tracker.body.dimensions.stature)

    def step(self, frame: Frame) -> tuple[Estimate, Frame]:
        """Return the estimate for the next frame, and the observation without the excluded cameras."""
        unhealthy = self._health.look(frame.images, frame.masks, self._excluded)
        self.unfit = bad = self._bad(unhealthy)
        out = bad | self._excluded
        used = without_cameras(frame, out)
        if np.count_nonzero(shows_person(used.masks)) < 2:
            used = without_cameras(frame, np.ones(len(out), bool))  # one view does not determine depth
        if self._judge is not None and len(out) - bad.sum() >= 3:
            estimate, used, self._excess = self._judge.step(frame, used, bad, self._excluded)
        else:
            estimate, self._excess = self.tracker.step(used), 0.0
        for camera, reason in enumerate(unhealthy):
            if reason is not None and bad[camera]:
                _count(self._spans, f"{camera}/{reason}", frame.index)
        for camera in np.flatnonzero((out | self._excluded) & ~bad).tolist():
            torn = self._judge is not None and self._judge.torn[camera]
            reason = _MISSING if torn else _DISAGREES
            _count(self._spans, f"{camera}/{reason}", frame.index)
        self.doubted |= out | self._excluded
        return self._judged(frame.index, estimate, used), used

    def _judged(self, index: int, estimate: Estimate, used: Frame) -> Estimate:
        """Return the estimate of a frame with the status and the sigma that follow from its reason."""
        found = self._found(index, estimate, used)
        if is_status(np.array(found), Status.LOST):
            self._plausibility.forget()
            if estimate.status != "lost" and (tracker := sharing(self.tracker)) is not None:
                tracker.lose()
            reason = found
        else:
            residual = np.full((len(self._names), 2), np.nan) if estimate.residual is None else estimate.residual
            depth = bool(depth_known(self._setup.rig, estimate.joints, estimate.residual))
            self._recent = self._recent.then(found, residual, depth)
            reason = Reason(judge_frames(self._recent, self._false_alarm)[-1])
        then = CONSEQUENCES[reason]
        status = estimate.status if then.status is None else then.status.name.lower()
        self._was_lost = status == "lost"
        self.doubted |= self._was_lost or found == Reason.CUT
        unknown = estimate.sigma is not None and not then.sigma
        sigma = np.full(len(JOINTS), np.nan) if unknown else estimate.sigma
        return replace(estimate, status=status, reason=int(reason), sigma=sigma)

    def _found(self, index: int, estimate: Estimate, used: Frame) -> Reason:
        """Return the reason that a frame itself shows."""
        if estimate.status == "lost":
            return Reason.UNEXPLAINED if shows_person(used.masks).any() else Reason.NOBODY
        recovered = estimate.status == "recovered"
        if recovered:  # the person may be elsewhere, as after a cut
            self._plausibility.forget()
        reason = self._plausibility.judge(index, estimate.joints)
        if reason is None and recovered and refused(self._excess, self._refused, self._false_alarm):
            self._refused += 1
            return Reason.STILL_HIGH
        if reason is not None:
            return Reason[reason]
        self._refused = 0
        if recovered and not self._was_lost:
            return Reason.CUT
        if estimate.sigma is not None and np.isnan(estimate.sigma).all():
            return Reason.HIGH
        return Reason.NONE

    @property
    def _false_alarm(self) -> float:
        """See :func:`judge_frames`; only region trackers have residuals."""
        return self.tracker.config.false_alarm if isinstance(self.tracker, RegionTracker) else 0.5

    def _bad(self, unhealthy: Sequence[str | None]) -> NDArray[np.bool_]:
        """Return (C,) the cameras whose image excludes them. Trackers of hulls need all cameras."""
        return np.array([self.tracker.can_exclude_cameras and reason is not None for reason in unhealthy])

    @property
    def moved(self) -> NDArray[np.bool_]:
        """(C,) the cameras that have been moved since the first frame."""
        return np.array([f"{camera}/{MOVED}" in self._spans for camera in range(len(self._names))])

    def report(self) -> list[str]:
        """Return a line for each camera and reason of exclusion."""
        lines = []
        for key, span in sorted(self._spans.items()):
            camera, _, reason = key.partition("/")
            because = self._opening_reasons.get(int(camera)) if reason == _DISAGREES else None
            more = f" ({because})" if because else ""
            lines.append(f"camera {self._names[int(camera)]} {reason}{more}: left out of {described(*span)}")
        return lines


def _count(spans: dict[str, Span], key: str, index: int) -> None:
    first, _, count = spans.get(key, (index, index, 0))
    spans[key] = (first, index, count + 1)
