"""A tracker under watch: a camera that cannot be believed is left out of a frame, and what cannot be true is lost.

A camera is left out whose picture shows nothing or stands still (:mod:`tk.model.masks.image_health`), whose masks
the hull
of the others contradicts in the opening frames (:mod:`tk.model.masks.mask_agreement`), and, from frame to frame, one
that the
body explains badly: the frame is then tracked a second time without it, and if the body still does not explain it,
but does the others, the camera was what was wrong and not the pose. It comes back when the body that the others see
explains it again. This is the iteratively reweighted fit of robust statistics with weights of 0 and 1 and the camera as
the unit: what is wrong with one picture is wrong everywhere in it.

A poor mask is no wrong camera: where it is in doubt it contradicts nothing. What a camera that is turned, moved or late
lacks of the body on one side it shows beside the body on the other; a mask with pieces missing shows nothing there. It
would still pull limbs out of what is missing, so the camera is left out, too, but the pose that the others found is not
doubted for it, and it comes back when its masks have been whole for some frames.

Only for trackers of contours: a visual hull without one of its masks is empty, so those of hulls take all cameras.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.model.body.plausibility import Plausibility, check_extent, check_stature
from tk.model.body.skeleton import JOINTS
from tk.model.masks.image_health import ImageHealth, described
from tk.model.masks.mask_agreement import MaskAgreement
from tk.model.setup import Setup, Subject
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.protocol import Estimate, Observation, Tracker

Float = NDArray[np.float64]

# Frames of the opening whose masks are compared.
_OPENING = 5
# A camera is looked into whose E_S is above this, and above its usual by this factor.
_SUSPECT, _SUSPECT_RATIO = 0.25, 1.8
# It is left out if so much of the body, fitted without it, lies outside its mask; or if the body leaves its usual E_S
# times this unexplained, and the others' mean falls by this share.
_CULPRIT_RATIO, _RELIEF, _HOPELESS = 3.0, 0.15, 0.2
# The others must then be explained about as well as is usual, by these factors in the mean in the two cases.
_OTHERS_FIT = 1.5, 1.3
# A mask of which the person explains less than a quarter shows anything.
_BLOB = 0.75
# What it lacks where its mask is in doubt counts only if it is more than so much of the mask: then too little is left.
_TOO_LITTLE = 0.5
# Its mask has pieces missing if it shows beside the body no more than this share of what it lacks.
_TORN = 0.5
# It comes back when the others' body leaves no more than its usual times this unexplained; with a torn mask, when it
# has done so for some frames, for such masks come and go.
_BACK_RATIO, _WHOLE = 1.6, 6
# Whoever was lost is found when the masks are explained as well as is usual, by this factor in the mean.
_FOUND = 2.0
# A camera that was looked into in vain is not looked into again for so many frames unless it gets worse by this factor.
_PAUSE, _WORSE = 6, 1.2
# The usual E_S that is assumed at first, and how fast a better and a worse one is learned.
_FIRST_USUAL, _BETTER, _SLOWLY = 0.12, 0.1, 0.02
# Reasons, as messages tell them.
_DISAGREES, _TOO_FEW = "disagrees with the others", "fewer than two cameras see anybody"
_LACKS = "misses a part of the person"
_IMPLAUSIBLE = "the pose found cannot be true"

Span = tuple[int, int, int]
"""Of frames: the first, the last, how many."""


class CameraMonitor:
    """Steps a tracker.

    Args:
        tracker: started by :meth:`start`, or restored by whoever resumes.
        setup: the scene.
        subject: what is known of the person.
    """

    def __init__(self, tracker: Tracker, setup: Setup, subject: Subject) -> None:
        self.tracker, self._setup, self._subject = tracker, setup, subject
        self._names = setup.rig.names
        self._health = ImageHealth()
        self._plausibility = Plausibility(setup.up, setup.fps)
        C = len(self._names)
        self._usual = np.full(C, _FIRST_USUAL)
        self._distrusted = np.zeros(C, bool)
        self._lacks = np.zeros(C, bool)  # those of them whose masks miss a part of the person
        self._whole_for = np.zeros(C, np.int64)
        self._since_trial = np.full(C, _PAUSE)
        self._at_trial = np.zeros(C)
        self._left_out: dict[str, Span] = {}  # by "camera/reason"
        self._lost: dict[str, Span] = {}  # by reason
        self._why_apart: dict[int, str] = {}
        self._beside_usual = 1.0  # E_S of the last frame beside the usual

    def start(self, frames: Sequence[Observation]) -> list[Observation]:
        """The opening frames without the cameras that cannot be believed, for the tracker's start.

        Raises:
            CaptureError: the person has not the size that `capture.toml` tells.
        """
        health = ImageHealth()
        bad = np.array([self._bad(health.look(f.images, f.masks)) for f in frames])
        shown = [_without(f, b) for f, b in zip(frames, bad, strict=True)]
        chosen = np.unique(np.linspace(0, len(shown) - 1, _OPENING).round().astype(int))
        agreement = MaskAgreement(self._setup.rig, self._setup.volume).compare([shown[i].masks for i in chosen])
        for camera in agreement.inconsistent if isinstance(self.tracker, ContourTracker) else ():
            if len(self._names) - self._distrusted.sum() > 2:
                self._distrusted[camera] = True
                self._why_apart[camera] = agreement.reason(camera)
        if self._subject.height_m is not None:
            check_extent(agreement.extent_m, self._subject.height_m)
        return [_without(f, self._distrusted) for f in shown]

    def check_body(self) -> None:
        """Refuse a body that nobody has, as the tracker's start found it.

        Raises:
            CaptureError: of the person's size.
        """
        if self._subject.height_m is None:
            check_stature(self.tracker.body.dimensions.stature)

    def step(self, frame: Observation) -> tuple[Estimate, Observation]:
        """The pose in the next frame, and what of the frame it was made from."""
        sick = self._health.look(frame.images, frame.masks)
        bad = self._bad(sick)
        out = bad | self._distrusted
        used = _without(frame, out)
        if np.count_nonzero(used.masks.any(axis=(1, 2))) < 2:
            used = _without(frame, np.ones(len(out), bool))  # depth is free with one view
        watched = isinstance(self.tracker, ContourTracker) and len(out) - bad.sum() >= 3
        before = self.tracker.state() if watched else {}
        estimate = self.tracker.step(used)
        aside = None
        if watched and used.masks.any() and estimate.residual is not None:
            estimate, used, aside = self._weigh(frame, used, bad, before, estimate)
        for camera, reason in enumerate(sick):
            if reason is not None and bad[camera]:
                _count(self._left_out, f"{camera}/{reason}", frame.index)
        for camera in np.flatnonzero((out | self._distrusted) & ~bad).tolist():
            said = _LACKS if self._lacks[camera] else _DISAGREES
            _count(self._left_out, f"{camera}/{said}", frame.index)
        return self._judged(frame.index, estimate, used, aside), used

    def _bad(self, sick: Sequence[str | None]) -> NDArray[np.bool_]:
        """(C,) the cameras to go without. A visual hull is empty where a mask is, so its trackers take them all."""
        leaves_out = isinstance(self.tracker, ContourTracker)
        return np.array([leaves_out and reason is not None for reason in sick])

    def _weigh(
        self, frame: Observation, used: Observation, bad: NDArray[np.bool_], before: Mapping[str, Any], first: Estimate
    ) -> tuple[Estimate, Observation, Float]:
        """Leave out a camera that the body does not explain, and take back one that it does.

        Returns:
            the estimate, what it was made from, and (C,) by how much each used camera's mask lies beside the body.
        """
        assert first.residual is not None
        error = aside = first.residual.sum(axis=1)  # no mask can lie farther beside the body
        if self._distrusted.any() or np.nanmax(error, initial=0.0) > _SUSPECT:
            lacking, surplus = self._errors(frame, first)
            error, aside = lacking + surplus, _aside(lacking, surplus)
        ratio = error / self._usual
        usable = ~bad & np.isfinite(error)
        whole = usable & ((ratio < _BACK_RATIO) | (error < 0.8 * _SUSPECT))
        self._whole_for = np.where(whole, self._whole_for + 1, 0)
        back = self._distrusted & (self._whole_for >= np.where(self._lacks, _WHOLE, 1))
        kept = usable & ~self._distrusted
        self._since_trial += 1
        suspects = np.flatnonzero(kept & (error > _SUSPECT) & (ratio > _SUSPECT_RATIO))
        suspects = suspects[
            (self._since_trial[suspects] > _PAUSE) | (error[suspects] > _WORSE * self._at_trial[suspects])
        ]
        estimate = first
        tracker = self.tracker
        assert isinstance(tracker, ContourTracker)
        if len(suspects) and kept.sum() >= 3:
            worst = int(suspects[np.argmax(ratio[suspects])])
            others = kept.copy()
            others[worst] = False
            after = tracker.state()
            fewer = _without(used, ~others)
            tracker.rewind(before)
            second = tracker.step(fewer)
            lacking, surplus = self._errors(frame, second)
            again = lacking + surplus
            relief = 1.0 - float(np.mean(again[others]) / np.mean(error[others]))
            # Where the body does not explain the others either, it is the pose that is wrong. A mask with somebody else
            # beside the person misleads contours little. A body that two cameras see may be anywhere in a third.
            others_fit = float(np.mean(again[others] / self._usual[others]))
            outside = lacking[worst] > (_HOPELESS if others.sum() >= 3 else 2 * _HOPELESS)
            hopeless = others_fit < _OTHERS_FIT[0] and (outside or again[worst] > _BLOB)
            much = others.sum() >= 3 and again[worst] > _CULPRIT_RATIO * self._usual[worst]
            relieved = others_fit < _OTHERS_FIT[1] and much and relief > _RELIEF
            culprit = relief > -_RELIEF / 2 and (hopeless or relieved)
            if culprit:
                self._distrusted[worst] = True
                self._lacks[worst] = surplus[worst] < _TORN * lacking[worst]
                estimate, used, kept = replace(second, status=first.status), fewer, others
                aside = _aside(lacking, surplus)
            else:
                tracker.rewind(after)
                self._since_trial[worst], self._at_trial[worst] = 0, error[worst]
        told = error if estimate is first else again
        self._beside_usual = float(np.mean((told / self._usual)[kept])) if kept.any() else np.inf
        if estimate.status != "lost" and self._beside_usual < _FOUND:
            rate = np.where(error < self._usual, _BETTER, _SLOWLY)
            self._usual = np.where(kept, np.maximum(self._usual + rate * (error - self._usual), 0.05), self._usual)
        self._distrusted &= ~back
        return estimate, used, np.where(kept, aside, np.nan)

    def _errors(self, frame: Observation, estimate: Estimate) -> Float:
        """(2, C) the two parts of E_S at the estimate's pose, of cameras left out, too: body outside the mask, unless
        that is in doubt there and much is left, and mask outside the body. NaN where a camera sees nobody, or no body
        was fitted.
        """
        tracker, drawn = self.tracker, estimate.drawn
        assert isinstance(tracker, ContourTracker)
        if drawn is None or estimate.masks is None:
            return np.full((2, len(frame.masks)), np.nan)
        # what it took for the person, where it had the camera
        masks, had = estimate.masks, estimate.masks.any(axis=(1, 2))
        if not had.all():
            masks = masks.copy()
            masks[~had] = tracker.cleaned(frame.masks[~had])
        person = tracker.screen.sample(masks) >= 128
        seen = np.count_nonzero(person, axis=(1, 2)).astype(np.float64)
        seen[seen == 0] = np.nan
        missing, surplus = drawn & ~person, person & ~drawn
        lacking = np.count_nonzero(missing, axis=(1, 2)) / seen
        if frame.uncertain is not None:
            excused = np.count_nonzero(missing & tracker.screen.sample(frame.uncertain), axis=(1, 2)) / seen
            lacking -= np.where(excused < _TOO_LITTLE, excused, 0.0)
        return np.stack([lacking, np.count_nonzero(surplus, axis=(1, 2)) / seen])

    def _judged(self, index: int, estimate: Estimate, used: Observation, aside: Float | None) -> Estimate:
        """The estimate, lost where it cannot be true."""
        if estimate.status == "lost":
            self._plausibility.forget()
            if not used.masks.any():
                _count(self._lost, _TOO_FEW, index)
            return estimate
        reason = self._plausibility.judge(index, estimate.joints, aside)
        if aside is not None and estimate.status == "recovered" and self._beside_usual > _FOUND:
            reason = reason or "after a loss it does not explain the masks yet"
        if reason is None:
            return estimate
        _count(self._lost, f"{_IMPLAUSIBLE}: {reason}", index)
        self._plausibility.forget()
        if isinstance(self.tracker, ContourTracker):
            self.tracker.lose()
        return replace(estimate, status="lost", sigma=None if estimate.sigma is None else np.full(len(JOINTS), np.nan))

    def report(self) -> list[str]:
        """What was left out or lost, a line a camera and reason."""
        lines = []
        for key, span in sorted(self._left_out.items()):
            camera, _, reason = key.partition("/")
            because = self._why_apart.get(int(camera)) if reason == _DISAGREES else None
            more = f" ({because})" if because else ""
            lines.append(f"camera {self._names[int(camera)]} {reason}{more}: left out of {described(*span)}")
        return lines + [f"{reason}: lost, {described(*span)}" for reason, span in self._lost.items()]

    def state(self) -> Mapping[str, Any]:
        """What :meth:`restore` needs beside the tracker's own state."""
        return {
            "usual": self._usual,
            "distrusted": self._distrusted,
            "lacks": self._lacks,
            "whole_for": self._whole_for,
            "since_trial": self._since_trial,
            "at_trial": self._at_trial,
            **{f"health/{name}": value for name, value in self._health.state().items()},
            **{f"plausibility/{name}": value for name, value in self._plausibility.state().items()},
            "spans": json.dumps([self._left_out, self._lost, self._why_apart]),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take up what :meth:`state` gave; the tracker is restored by whoever has its model."""
        part: dict[str, dict[str, Any]] = {"health": {}, "plausibility": {}}
        for name, value in state.items():
            group, slash, rest = name.partition("/")
            if slash and group in part:
                part[group][rest] = value
        self._usual = np.array(state["usual"], np.float64)
        self._distrusted = np.array(state["distrusted"], bool)
        self._lacks = np.array(state["lacks"], bool)
        self._whole_for = np.array(state["whole_for"], np.int64)
        self._since_trial = np.array(state["since_trial"], np.int64)
        self._at_trial = np.array(state["at_trial"], np.float64)
        self._health.restore(part["health"])
        self._plausibility.restore(part["plausibility"])
        left_out, lost, apart = json.loads(str(state["spans"]))
        self._left_out = {key: (span[0], span[1], span[2]) for key, span in left_out.items()}
        self._lost = {key: (span[0], span[1], span[2]) for key, span in lost.items()}
        self._why_apart = {int(camera): reason for camera, reason in apart.items()}


def _aside(lacking: Float, surplus: Float) -> Float:
    """(C,) by how much masks lie beside a body: what they lack of it, but no more than they show beside it, as a share
    of the mask or of the body, whichever is larger; of both parts of E_S."""
    return np.asarray(np.minimum(lacking, surplus) / np.maximum(1.0 + lacking - surplus, 1.0))


def _count(spans: dict[str, Span], key: str, index: int) -> None:
    first, _, count = spans.get(key, (index, index, 0))
    spans[key] = (first, index, count + 1)


def _without(frame: Observation, out: NDArray[np.bool_]) -> Observation:
    """The frame as if some cameras (C,) saw nobody."""
    if not out.any():
        return frame
    masks = frame.masks.copy()
    masks[out] = 0
    uncertain = frame.uncertain
    if uncertain is not None:
        uncertain = uncertain.copy()
        uncertain[out] = False
    images = frame.images
    if images.size:  # one colour has no borders
        images = images.copy()
        images[out] = 0
    return replace(frame, images=images, masks=masks, uncertain=uncertain)
