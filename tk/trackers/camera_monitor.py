"""The camera monitor: steps a tracker without the cameras that are wrong, and rejects impossible poses.

Three checks exclude a camera: its image shows nothing or is frozen (:mod:`tk.model.masks.image_health`); in the opening
frames its masks contradict those of the other cameras (:mod:`tk.model.masks.mask_agreement`); or, in a later frame,
its residual is an outlier of its baseline (:class:`~tk.trackers.residual.ResidualBaseline`). In the last case the frame
is tracked again without the camera. If the other cameras then have a normal residual and the camera still has an
outlier, the camera was wrong and not the pose. The camera is included again when its residual, at the pose that the
others give, is normal. This is the iteratively reweighted fit of robust statistics with weights of 0 and 1 and the
camera as the unit.

A poor mask is not a wrong camera. Uncertain pixels contradict nothing. A camera that is turned, moved or late has
missing area on one side of the body and surplus area on the other; a torn mask has only missing area. A torn mask would
still pull limbs out of the missing area, so its camera is excluded until its masks have been whole for some frames, but
the pose is not rejected because of it.

Only contour trackers can go without a camera: a visual hull without one of its masks is empty.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.kernels.mask_values import OTHERS
from tk.model.body.joint_sigma import VIEW_M
from tk.model.body.plausibility import Plausibility, check_extent, check_stature
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.common_view import LEAST_INFORMATION, depth_information
from tk.model.cues.ray_costs import residual_of
from tk.model.masks.image_health import ImageHealth, described
from tk.model.masks.mask_agreement import Agreement, MaskAgreement
from tk.model.setup import Setup, Subject
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.protocol import Estimate, Observation, Tracker, shows_person
from tk.trackers.region import RegionTracker
from tk.trackers.residual import OUTLIER, RATE, RECENT, contradicted

Float = NDArray[np.float64]

# Frames of the opening that are compared.
_OPENING = 5
# A camera with a residual (E_S) above this is excluded whatever its baseline: its mask is unrelated to the body.
_UNRELATED = 0.75
# Missing area on uncertain pixels is ignored, unless it is more than this share of the mask: then too little is left.
_TOO_LITTLE = 0.5
# A mask is torn if its surplus area is at most this share of its missing area.
_TORN = 0.5
# Consecutive frames after which a camera whose mask was torn is included again, because such masks come and go; and
# after which a camera is tested again that was found right. With half and twice the value no mean error of dance and
# cube (50 frames) changes; their cameras are right.
_WHOLE = _PAUSE = 6
_STATE = ("excluded", "torn", "normal_for", "since_test", "at_test", "refused", "recent")
# Reasons, as in messages.
_DISAGREES, _TOO_FEW = "disagrees with the others", "fewer than two cameras see anybody"
_MISSING = "misses a part of the person"
_IMPLAUSIBLE = "the pose found cannot be true"

Span = tuple[int, int, int]
"""Frames: the first, the last, and their number."""


def spread_over(frames: Sequence[Observation], count: int = _OPENING) -> list[Observation]:
    """Return this many of the opening's frames, spread over it."""
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))]


def opening_agreement(setup: Setup, frames: Sequence[Observation]) -> Agreement:
    """Return whether the silhouettes of the opening frames agree."""
    return MaskAgreement(setup.rig, setup.volume).compare([frame.masks for frame in spread_over(frames)])


class CameraMonitor:
    """Steps a tracker; excludes cameras that are wrong.

    Args:
        tracker: the caller starts it with the frames of :meth:`start`, or restores it.
        setup: rig, working volume, upward direction and rate.
        subject: what is known of the person.
    """

    def __init__(self, tracker: Tracker, setup: Setup, subject: Subject) -> None:
        self.tracker, self._setup, self._subject = tracker, setup, subject
        self._names = setup.rig.names
        self._health = ImageHealth()
        self._plausibility = Plausibility(setup.fps)
        C = len(self._names)
        self._excluded = np.zeros(C, bool)
        self._tested = False
        self._torn = np.zeros(C, bool)  # excluded because of a torn mask
        self._normal_for = np.zeros(C, np.int64)  # consecutive frames with a normal residual
        self._since_test = np.full(C, _PAUSE)
        self._at_test = np.zeros(C)  # excess at the last test
        self._spans: dict[str, Span] = {}  # of exclusion, by "camera/reason"
        self._lost: dict[str, Span] = {}  # by reason
        self._opening_reasons: dict[int, str] = {}
        self._refused = np.zeros((), np.int64)  # poses refused since the last accepted one, because of their residual
        self._recent = np.full((RECENT, C, 2), np.nan)  # residuals of the last frames
        self._excess = 0.0  # of this frame, mean over the cameras used; 0 if it was not tested

    def start(self, frames: Sequence[Observation]) -> list[Observation]:
        """Return the opening frames without the cameras that are wrong, for the tracker's start.

        Raises:
            CaptureError: the cameras contradict each other, or the person's size contradicts the height in
                `capture.toml`.
        """
        health = ImageHealth()
        bad = np.array([self._bad(health.look(f.images, f.masks)) for f in frames])
        shown = [_without(f, b) for f, b in zip(frames, bad, strict=True)]
        agreement = opening_agreement(self._setup, shown)
        if agreement.refusal:
            raise CaptureError(agreement.refusal)
        self._tested = int(agreement.tested_right.sum()) >= 2
        if isinstance(self.tracker, RegionTracker):
            self.tracker.view_m = float(np.hypot(VIEW_M, agreement.undetected_m))
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
        return [_without(f, self._excluded) for f in shown]

    @property
    def tested(self) -> bool:
        """Whether the silhouettes of two cameras or more could be compared before the start, and agreed."""
        return self._tested

    def check_body(self) -> None:
        """Refuse a body of an impossible size, after the tracker's start.

        Raises:
            CaptureError: with the size and its likely causes.
        """
        if self._subject.height_m is None:
            check_stature(self.tracker.body.dimensions.stature)

    def step(self, frame: Observation) -> tuple[Estimate, Observation]:
        """Return the estimate for the next frame, and the observation without the excluded cameras."""
        unhealthy = self._health.look(frame.images, frame.masks)
        bad = self._bad(unhealthy)
        out = bad | self._excluded
        used = _without(frame, out)
        if np.count_nonzero(shows_person(used.masks)) < 2:
            used = _without(frame, np.ones(len(out), bool))  # one view does not determine depth
        monitored = isinstance(self.tracker, RegionTracker) and len(out) - bad.sum() >= 3
        before = self.tracker.state() if monitored else {}
        estimate = self.tracker.step(used)
        self._excess = 0.0
        if monitored and shows_person(used.masks).any() and estimate.residual is not None:
            estimate, used = self._test(frame, used, bad, before, estimate)
        for camera, reason in enumerate(unhealthy):
            if reason is not None and bad[camera]:
                _count(self._spans, f"{camera}/{reason}", frame.index)
        for camera in np.flatnonzero((out | self._excluded) & ~bad).tolist():
            reason = _MISSING if self._torn[camera] else _DISAGREES
            _count(self._spans, f"{camera}/{reason}", frame.index)
        return self._suspect(self._plausible(frame.index, estimate, used)), used

    def _bad(self, unhealthy: Sequence[str | None]) -> NDArray[np.bool_]:
        """Return (C,) the cameras whose image excludes them. Trackers of hulls need all cameras."""
        return np.array([self.tracker.can_exclude_cameras and reason is not None for reason in unhealthy])

    def _test(
        self, frame: Observation, used: Observation, bad: NDArray[np.bool_], before: Mapping[str, Any], first: Estimate
    ) -> tuple[Estimate, Observation]:
        """Exclude a camera that is wrong, and include those again that are right; return the estimate, and the
        observation without the excluded cameras."""
        tracker = self.tracker
        assert isinstance(tracker, RegionTracker) and first.residual is not None
        baseline = tracker.residuals
        error = first.residual.sum(axis=1)
        if self._excluded.any() or np.nanmax(baseline.excess(error), initial=0.0) > OUTLIER:
            error = self._residual(frame, first).sum(axis=1)
        excess = baseline.excess(error)
        usable = ~bad & np.isfinite(error)
        self._normal_for = np.where(usable & (excess < self._normal), self._normal_for + 1, 0)
        back = self._excluded & (self._normal_for >= np.where(self._torn, _WHOLE, 1))
        kept = usable & ~self._excluded
        self._since_test += 1
        suspects = kept & (excess > OUTLIER)
        suspects &= (self._since_test > _PAUSE) | (excess > self._at_test + baseline.threshold)
        estimate = first
        if suspects.any() and kept.sum() >= 3:
            worst = int(np.argmax(np.where(suspects, excess, -np.inf)))
            others = kept.copy()
            others[worst] = False
            after = tracker.state()
            fewer = _without(used, ~others)
            tracker.rewind(before)
            second = tracker.step(fewer)
            residual = self._residual(frame, second)
            if self._is_wrong(worst, residual, error, others, second.joints):
                self._excluded[worst] = True
                self._torn[worst] = residual[worst, 1] < _TORN * residual[worst, 0]
                estimate, used, kept = replace(second, status=first.status), fewer, others
                error = residual.sum(axis=1)
            else:
                tracker.rewind(after)
                self._since_test[worst], self._at_test[worst] = 0, excess[worst]
        self._excess = tracker.residuals.mean_excess(np.where(kept, error, np.nan))
        self._excluded &= ~back
        return estimate, used

    def _is_wrong(self, camera: int, residual: Float, before: Float, others: NDArray[np.bool_], joints: Float) -> bool:
        """Return whether a camera is wrong, by the joints (J, 3) and the residual (C, 2) of the pose without it.

        Cameras that see the person from the same or from opposite sides contradict no other camera, because they do not
        determine a pose. If the other cameras have a high residual too, the pose is wrong instead. Surplus area alone,
        such as a second person in the mask, hardly misleads contours: it counts only if the others' E_S falls without
        the camera, from ``before`` (C,), by one spread. A pose from two cameras is uncertain, so a third must have
        twice the excess.
        """
        assert isinstance(self.tracker, RegionTracker)
        rays = joints.mean(axis=0) - self._setup.rig.centers[others]
        if depth_information(rays / np.linalg.norm(rays, axis=1, keepdims=True)) < LEAST_INFORMATION:
            return False
        baseline, error = self.tracker.residuals, residual.sum(axis=1)
        excess_of_others = baseline.mean_excess(np.where(others, error, np.nan))
        if excess_of_others > baseline.threshold:
            return False
        many = others.sum() >= 3
        missing = baseline.excess(residual[:, 0])[camera] > (OUTLIER if many else 2 * OUTLIER)
        relief = baseline.mean_excess(np.where(others, before, np.nan)) - excess_of_others
        surplus = many and baseline.excess(error)[camera] > OUTLIER and relief > 1.0
        return bool(missing or surplus or error[camera] > _UNRELATED)

    def _residual(self, frame: Observation, estimate: Estimate) -> Float:
        """Return (C, 2) missing and surplus area at the estimate's pose, of excluded cameras, too. Missing area on
        uncertain pixels is not counted if enough of the mask is left. NaN where a camera sees nobody, or no body was
        fitted.
        """
        tracker, drawn = self.tracker, estimate.drawn
        assert isinstance(tracker, ContourTracker)
        if drawn is None or estimate.masks is None:
            return np.full((len(frame.masks), 2), np.nan)
        masks, used = estimate.masks, shows_person(estimate.masks)
        if not used.all():
            masks = masks.copy()
            masks[~used] = tracker.cleaned(frame.masks[~used])
        sampled = tracker.screen.sample(masks)
        person, others = sampled >= 128, sampled == OTHERS
        residual = residual_of(drawn, person, others)
        if frame.uncertain is not None:
            excused = residual_of(drawn & tracker.screen.sample(frame.uncertain), person, others)[:, 0]
            residual[:, 0] -= np.where(excused < _TOO_LITTLE, excused, 0.0)
        return residual

    def _plausible(self, index: int, estimate: Estimate, used: Observation) -> Estimate:
        """Return the estimate, with status lost if it is impossible."""
        if estimate.status == "lost":
            self._plausibility.forget()
            if not shows_person(used.masks).any():
                _count(self._lost, _TOO_FEW, index)
            return estimate
        if estimate.status == "recovered":  # the person may be elsewhere, as after a cut
            self._plausibility.forget()
        reason = self._plausibility.judge(index, estimate.joints)
        if reason is None and estimate.status == "recovered" and self._excess > self._accepted:
            reason = "after a loss its residual is still high"
            self._refused = self._refused + 1
        if reason is None:
            self._refused = np.zeros((), np.int64)
            return estimate
        _count(self._lost, f"{_IMPLAUSIBLE}: {reason}", index)
        self._plausibility.forget()
        if isinstance(self.tracker, ContourTracker):
            self.tracker.lose()
        return replace(estimate, status="lost", sigma=None if estimate.sigma is None else np.full(len(JOINTS), np.nan))

    def _suspect(self, estimate: Estimate) -> Estimate:
        """Return the estimate, with status suspect if the residual of the last frames contradicts it."""
        if estimate.status == "lost" or estimate.residual is None or not isinstance(self.tracker, RegionTracker):
            return estimate
        self._recent = np.concatenate([self._recent[1:], estimate.residual[None]])
        wrong = contradicted(self._recent, self.tracker.config.false_alarm)[-1]
        return replace(estimate, status="suspect") if wrong else estimate

    @property
    def _accepted(self) -> float:
        """The largest excess of a pose after a loss: one spread, because no prediction supports such a pose. After the
        frames in which a baseline follows a change (1 / RATE), the level itself may have changed, and only an abnormal
        residual refuses a pose. With twice the limit, a mirrored pose was accepted for 12 frames (fault "away")."""
        return 1.0 if self._refused < 1 / RATE else self._normal

    @property
    def _normal(self) -> float:
        """The excess below which a residual is normal again: halfway between a high one and an outlier."""
        assert isinstance(self.tracker, RegionTracker)
        return (self.tracker.residuals.threshold + OUTLIER) / 2

    def report(self) -> list[str]:
        """Return a line for each camera and reason of exclusion, and for each reason of a loss."""
        lines = []
        for key, span in sorted(self._spans.items()):
            camera, _, reason = key.partition("/")
            because = self._opening_reasons.get(int(camera)) if reason == _DISAGREES else None
            more = f" ({because})" if because else ""
            lines.append(f"camera {self._names[int(camera)]} {reason}{more}: left out of {described(*span)}")
        # without two views the person may also be absent, which the monitor does not know
        status = {reason: "no pose" if reason == _TOO_FEW else "lost" for reason in self._lost}
        return lines + [f"{reason}: {status[reason]}, {described(*span)}" for reason, span in self._lost.items()]

    def state(self) -> Mapping[str, Any]:
        """Return what :meth:`restore` needs beside the tracker's own state."""
        return {
            **{name: getattr(self, f"_{name}") for name in _STATE},
            **{f"health/{name}": value for name, value in self._health.state().items()},
            **{f"plausibility/{name}": value for name, value in self._plausibility.state().items()},
            "spans": json.dumps([self._spans, self._lost, self._opening_reasons]),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state; the caller restores the tracker."""
        part: dict[str, dict[str, Any]] = {"health": {}, "plausibility": {}}
        for name, value in state.items():
            group, slash, rest = name.partition("/")
            if slash and group in part:
                part[group][rest] = value
        for name in _STATE:
            setattr(self, f"_{name}", np.array(state[name]))
        self._health.restore(part["health"])
        self._plausibility.restore(part["plausibility"])
        spans, lost, reasons = json.loads(str(state["spans"]))
        self._spans = {key: (span[0], span[1], span[2]) for key, span in spans.items()}
        self._lost = {key: (span[0], span[1], span[2]) for key, span in lost.items()}
        self._opening_reasons = {int(camera): reason for camera, reason in reasons.items()}


def _count(spans: dict[str, Span], key: str, index: int) -> None:
    first, _, count = spans.get(key, (index, index, 0))
    spans[key] = (first, index, count + 1)


def _without(frame: Observation, out: NDArray[np.bool_]) -> Observation:
    """Return the frame with empty masks in some cameras (C,)."""
    if not out.any():
        return frame
    masks = frame.masks.copy()
    masks[out] = 0
    uncertain = frame.uncertain
    if uncertain is not None:
        uncertain = uncertain.copy()
        uncertain[out] = False
    images = frame.images
    if images.size:  # a single colour has no edges
        images = images.copy()
        images[out] = 0
    return replace(frame, images=images, masks=masks, uncertain=uncertain)
