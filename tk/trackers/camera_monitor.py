"""The camera monitor: steps a tracker without the cameras that are wrong, and rejects impossible poses.

A camera is left out of a frame if

- its image shows nothing, is frozen, or has moved since the first frame, so that the calibration is no longer true
  (:mod:`tk.model.masks.image_health`);
- in the opening frames its masks contradict those of the other cameras (:mod:`tk.model.masks.mask_agreement`);
- its residual in this frame or the last ones is explained best by a fault of the camera (:mod:`tk.trackers.judgement`);
- the tracker finds nothing of the person in its mask; or
- no other camera in use shows the person, so that there is no depth (:func:`~tk.trackers.protocol.usable`).

No camera is left out for good. One that is wrong is weighed again in each frame in which it shows the person, if the
images of three cameras can be used, and the tracker has residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.body.joint_sigma import CHANGING_M
from tk.model.body.plausibility import check_extent, check_stature, height_contradiction
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import determine_depth
from tk.model.cameras.landmark_agreement import evidence_for_cameras
from tk.model.cues.landmarks import deviation
from tk.model.cues.ray_costs import residual_of
from tk.model.masks.image_health import MOVED, HealthState, ImageHealth, described
from tk.model.masks.mask_agreement import Agreement, MaskAgreement
from tk.model.setup import AVERAGE_STATURE_M, Setup, Subject
from tk.model.stateful import Stateful
from tk.trackers.judgement import (
    FAULTS,
    STATES,
    TORN,
    UNSEEN,
    WRONG,
    Belief,
    Cameras,
    FrameJudge,
    JudgeState,
    all_left_out,
    likelihoods,
)
from tk.trackers.protocol import Estimate, Frame, Tracker, shows_person, two_pass, usable, without_cameras
from tk.trackers.reason import Reason, is_lost
from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]
T = TypeVar("T")

# Frames of the opening that are compared.
_OPENING = 5
# Missing area on uncertain pixels is ignored, unless it is more than this share of the mask: too little is left then.
_TOO_LITTLE = 0.5

Span = tuple[int, int, int]
"""Frames: the first, the last, and their number."""


def spread_over(frames: Sequence[T]) -> list[T]:
    """Return :data:`_OPENING` of the opening's frames, spread over it."""
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, _OPENING).round().astype(int))]


def image_faults(rig: Rig, frames: Sequence[Frame]) -> NDArray[np.bool_]:
    """Return (F, C) whether each image of consecutive frames has a fault."""
    health = ImageHealth(rig.sizes)
    return np.array([[fault is not None for fault in health.look(f.images, f.masks)] for f in frames], np.bool_)


def opening_agreement(setup: Setup, frames: Sequence[Frame], bad: NDArray[np.bool_]) -> Agreement:
    """Return whether the silhouettes of the opening frames agree. ``bad``: (F, C) images that are not compared."""
    rows = spread_over(range(len(frames)))
    found = MaskAgreement(setup.rig, setup.volume).compare([frames[i].masks for i in rows], ~bad[rows])
    return confirmed(found, setup.rig, [frame.landmarks for frame in frames], bad)


def confirmed(found: Agreement, rig: Rig, landmarks: Sequence[Float | None], bad: NDArray[np.bool_]) -> Agreement:
    """Return the agreement of masks without contradictions that the landmarks deny.

    A network's masks have holes and contain pieces of other things. A camera whose masks contradict the others is right
    if its landmarks agree with the others'. Of two cameras, lines of sight nearly meet however one of them is turned
    about its upright axis: their landmarks deny no contradiction that is small beside the landmarks' own errors.

    Args:
        found: by the masks.
        rig: C cameras.
        landmarks: (N, C, L, 4) of N people in each of F frames, None where nothing is known.
        bad: (F, C) images that are not compared.
    """
    seen = [
        np.where(wrong[:, None, None], np.nan, marked)
        for marked, wrong in zip(landmarks, bad, strict=True)
        if marked is not None
    ]
    apart = np.nanmax(found.tangency.apart, initial=0.0)  # share of the person's size
    unseen = len(rig) == 2 and apart * AVERAGE_STATURE_M < 2 * deviation(np.array(1.0))
    if not seen or unseen or not (found.wrong or found.refusal):
        return found
    turned = {c: found.shift_px[c] / found.reductions[c] for c in found.wrong if np.hypot(*found.shift_px[c]) > 0}
    return found.confirmed(evidence_for_cameras(rig, seen, turned))


@dataclass(frozen=True)
class MonitorState:
    """What is known of C cameras and of the person.

    Attributes:
        cameras: the probability of each of their states.
        spans: of exclusion, by "camera/state".
        doubted: (C,) see :class:`CameraMonitor`.
        opening_reasons: why cameras are excluded from the opening on.
        health, frames: the parts.
    """

    cameras: Belief
    spans: dict[str, Span]
    doubted: NDArray[np.bool_]
    opening_reasons: dict[int, str]
    health: HealthState
    frames: JudgeState


class CameraMonitor(Stateful[MonitorState]):
    """Steps a tracker; excludes cameras that are wrong.

    Args:
        tracker: the caller starts it with the frames of :meth:`start`, or restores it.
        setup: rig, working volume, upward direction and rate.
        subject: what is known of the person.

    Attributes:
        doubted: (C,) cameras whose images may be the cause of a fault: those that were left out, which the others
            contradicted; all of them if the person was lost, or jumped.
    """

    State = MonitorState

    def __init__(self, tracker: Tracker, setup: Setup, subject: Subject) -> None:
        self.tracker, self._setup, self._subject = tracker, setup, subject
        self._names = setup.rig.names
        self._health = ImageHealth(setup.rig.sizes)
        C = len(self._names)
        self.doubted = np.zeros(C, bool)
        self._cameras = Cameras(C, setup.fps)
        self._region = region = two_pass(tracker)  # only this one has residuals
        self._frames = FrameJudge(tracker, C, setup.fps, region.region_settings.false_alarm if region else 0.5)
        self._spans: dict[str, Span] = {}
        self._opening_reasons: dict[int, str] = {}

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
        bad = image_faults(self._setup.rig, frames)
        agreement = opening_agreement(self._setup, frames, bad)
        if whole and (agreement.refusal or np.count_nonzero(agreement.tested_right) < 2):
            agreement = opening_agreement(self._setup, whole, image_faults(self._setup.rig, whole))
        if agreement.refusal:
            raise CaptureError(agreement.refusal)
        if self._region is not None:
            self._region.view_m = float(np.hypot(CHANGING_M, agreement.undetected_m))
        for camera in agreement.wrong:
            self._cameras.accuse(camera)
            self._opening_reasons[camera] = agreement.reason(camera)
        out = self._cameras.states > 0
        alone = not any((f.masks == OTHERS).any() for f in frames)  # the hull of two people is larger than one
        if self._subject.height_m is not None and alone:
            check_extent(agreement.extent_m, self._subject.height_m)
        return [without_cameras(f, out | b) for f, b in zip(frames, bad, strict=True)]

    def check_body(self) -> None:
        """After the tracker's start, refuse a fitted body of an impossible size, or of another height than given.

        Raises:
            CaptureError: with the size and its likely causes.
        """
        dimensions = self.tracker.body.dimensions
        if self._subject.height_m is None:
            check_stature(dimensions.stature)
        elif self._subject.body is None and (
            reason := height_contradiction(dimensions.barefoot, self._subject.height_m)
        ):
            raise CaptureError(reason)

    def step(self, frame: Frame) -> tuple[Estimate, Frame]:
        """Return the estimate for the next frame, and the observation without the excluded cameras."""
        cameras = self._cameras
        faults = self._health.look(frame.images, frame.masks, (cameras.states > 0) & ~cameras.unfit)
        cameras.look(faults)
        out = cameras.states
        used = usable(frame, out > 0)
        if self._region is not None and np.count_nonzero(~cameras.unfit) >= 3:
            estimate, used, torn = self._weigh(self._region, frame, used)
            out = np.where(torn, STATES.index(TORN), out)
        else:
            estimate = self.tracker.step(used)
        out = all_left_out(np.where(out > 0, out, cameras.states), shows_person(used.masks), estimate)
        estimate = self._frames.judge(frame.index, replace(estimate, cameras=out, shift=self._health.moved))
        self.doubted |= is_lost(estimate.reason) or estimate.found == Reason.CUT
        for camera, state in enumerate(out.tolist()):
            if state:
                self.doubted[camera] |= STATES[state] != UNSEEN
                _count(self._spans, f"{camera}/{STATES[state]}", frame.index)
        return estimate, used

    def _weigh(self, tracker: RegionTracker, frame: Frame, used: Frame) -> tuple[Estimate, Frame, NDArray[np.bool_]]:
        """Step the tracker, and judge the cameras by their residuals. Return the estimate, the observation without the
        cameras that were left out, and (C,) those whose masks are torn.

        Cameras that see the person from the same or from opposite sides say nothing about another one, because they do
        not determine a pose.
        """
        cameras, before = self._cameras, tracker.state
        torn = np.zeros(len(frame.masks), np.bool_)
        estimate = tracker.step(used)
        if estimate.residual is None or not shows_person(used.masks).any():
            return estimate, used, torn
        residual, left_out = estimate.residual, (cameras.states > 0) & ~cameras.unfit
        kept = (cameras.states == 0) & np.isfinite(residual[:, 0])
        accused = self._accused(tracker, residual, kept)
        if left_out.any() or accused is not None:
            residual = self._residual(tracker, frame, estimate)
            accused = self._accused(tracker, residual, kept)
        others = kept & (np.arange(len(kept)) != accused)
        if accused is not None and determine_depth(self._setup.rig.centers, estimate.joints.mean(axis=0), others):
            after, fewer = tracker.state, without_cameras(used, ~others)
            tracker.state = before
            second = tracker.step(fewer)
            again = self._residual(tracker, frame, second)
            # both poses by a baseline that has not learned this frame from the camera
            with_it, without = (_likelihoods(tracker, found) for found in (residual, again))
            fault = cameras.judge(accused, others, with_it, without)
            if fault:
                torn[accused] = fault == TORN
                estimate, used, residual = second, fewer, again
            else:
                tracker.state = after
        # the others' residuals are explained by the accused one; and without a third camera nothing is judged
        weighed = left_out if accused is not None or np.count_nonzero(kept) < 3 else left_out | kept
        cameras.weigh(weighed & np.isfinite(residual[:, 0]), _likelihoods(tracker, residual))
        return estimate, used, torn

    def _accused(self, tracker: RegionTracker, residual: Float, kept: NDArray[np.bool_]) -> int | None:
        """Return the camera that is to be judged, by a residual (C, 2); None if none is."""
        if np.count_nonzero(kept) < 3:
            return None
        best = likelihoods(np.zeros_like(residual), tracker.residuals.spread)
        return self._cameras.accused(_likelihoods(tracker, residual), best, kept)

    def _residual(self, tracker: RegionTracker, frame: Frame, estimate: Estimate) -> Float:
        """Return (C, 2) missing and surplus area at the estimate's pose, of excluded cameras, too. Missing area on
        uncertain pixels is not counted if enough of the mask is left. NaN where a camera sees nobody, or no body was
        fitted.
        """
        drawn = estimate.drawn
        if drawn is None or estimate.masks is None:
            return np.full((len(frame.masks), 2), np.nan)
        masks, used = estimate.masks, shows_person(estimate.masks)
        if not used.all():
            masks = masks.copy()
            masks[~used] = tracker.cleaned(frame.masks[~used])
        sampled = tracker.coarse_grid.sample(masks)
        person, others = sampled >= PERSON, sampled == OTHERS
        residual = residual_of(drawn, person, others)
        if frame.uncertain is not None:
            excused = residual_of(drawn & tracker.coarse_grid.sample(frame.uncertain), person, others)[:, 0]
            residual[:, 0] -= np.where(excused < _TOO_LITTLE, excused, 0.0)
        return residual

    @property
    def unfit(self) -> NDArray[np.bool_]:
        """(C,) cameras that their image excludes from the last frame."""
        return self._cameras.unfit

    @property
    def moved(self) -> NDArray[np.bool_]:
        """(C,) the cameras that have been moved since the first frame."""
        return np.array([f"{camera}/{MOVED}" in self._spans for camera in range(len(self._names))])

    def report(self) -> list[str]:
        """Return a line for each camera and reason of exclusion."""
        lines = []
        for key, span in sorted(self._spans.items()):
            camera, _, state = key.partition("/")
            because = self._opening_reasons.get(int(camera)) if state == WRONG else None
            more = f" ({because})" if because else ""
            lines.append(f"camera {self._names[int(camera)]} {FAULTS[state]}{more}: left out of {described(*span)}")
        return lines


def _likelihoods(tracker: RegionTracker, residual: Float) -> Float:
    """Return (C, 3) those of the cameras' states, from a residual (C, 2)."""
    return likelihoods(tracker.residuals.excess(residual), tracker.residuals.spread)


def _count(spans: dict[str, Span], key: str, index: int) -> None:
    first, _, count = spans.get(key, (index, index, 0))
    spans[key] = (first, index, count + 1)
