"""One account of the evidence: when a camera is left out, and when a frame is lost, suspect or without sigma.

**Cameras.** A camera is right, or it has one of :data:`FAULTS`. Evidence of its image
(:mod:`tk.model.masks.image_health`) is certain, and counts for one frame; what was known before stays. Evidence of its
mask is the missing and the surplus area, as excess above the camera's baseline, in spreads. Three states explain it:

- right: both areas are normal.
- poor: in a part of the frames, pieces of the person are missing from the mask, and it shows pieces of other things,
  such as something that the person carries. In a few of these frames the mask misleads: it is *torn*.
- wrong: any missing and any surplus area. A camera that is turned, moved or late has both.

A poor mask of a right camera is used, because the others fit as well with it. So where a residual speaks against a
camera, the person is tracked with the camera and without it (:meth:`Cameras.judge`), and what the others gain decides.
A torn mask is left out in its frame. A wrong camera is left out until it is right: it is weighed in each frame at the
pose that the others give. What several frames show is combined by forward probabilities (Rabiner, *Proceedings of the
IEEE*, 1989). A mask in which the tracker finds nothing of the person is no evidence, and is left out, too
(:func:`all_left_out`).

**Frames.** What a frame itself shows is its first reason: the numbers that the tracker reports (:class:`Match`), or a
pose that is impossible after the last one (:class:`FrameJudge`). :func:`judge_frames` adds what several frames show
together: body and masks differ more than in a correct recording, or the cameras do not determine depth. A run asks it
in each frame with the last frames, and at its end with all of them. What no single person's frames show, who is who
and which of two cameras is right, the run adds at its end (:mod:`tk.run.offline`). What follows from a reason, lost,
suspect or without sigma, stands in :mod:`tk.trackers.reason`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import determine_depth
from tk.model.cues.part_colors import RATE
from tk.model.masks.image_health import IMAGE_FAULTS
from tk.model.stateful import Stateful
from tk.trackers.protocol import Estimate, Tracker, sharing
from tk.trackers.reason import Reason, is_lost
from tk.trackers.residual import LEVEL, LEVEL_SPREAD, OUTLIER, RECENT, displacement

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Frames between two searches for a lost person; a residual that stays high starts them after 1, 2, 4 … times as many.
# Also between two searches for a limb that stays misplaced.
RECOVER_EVERY = 3
# Sigma is unknown after this many consecutive frames with a high residual: two searches have failed.
UNKNOWN_AFTER = 2 * RECOVER_EVERY
# Highest speed of the trunk, m/s: a sprinter reaches 12; and an error of its position between frames, metres.
FASTEST_M_S, TRUNK_ERROR_M = 12.0, 0.2
_TRUNK = JOINTS.index("pelvis"), JOINTS.index("neck")


WRONG, TORN, UNSEEN = "wrong", "torn", "unseen"
#: faults of a camera, in words for the user, by the names of its states
FAULTS = {
    WRONG: "disagrees with the others",
    TORN: "shows other things, or misses a part of the person",
    **{name: text for name, (text, _) in IMAGE_FAULTS.items()},
    UNSEEN: "does not see the person",
}
STATES = ("used", *FAULTS)
#: meaning of each value of `/evidence/camera`
STATE_MEANINGS = ("0: used", *(f"{value}: {text}" for value, text in enumerate(FAULTS.values(), 1)))

# A camera becomes wrong once in eleven minutes, a mask poor once in half a minute; both last five seconds. These rates
# are assumed, and so are the shares below.
_BEGIN_HZ, _END_HZ, _POOR_HZ = 0.0015, 0.2, 0.03
# Wrong poses a second, whatever the cameras are.
_LOSE_HZ = 0.3
# Share of the frames with a poor mask in which it misleads. Mean size of a piece, as a share of the person's pixels.
_TORN, _PIECE = 0.05, 0.15


def likelihoods(excess: Float, spread: Float) -> Float:
    """Return (C, 3) logarithms of the likelihoods of the states right, poor and wrong; 0 if the excess is unknown.

    Args:
        excess: (C, 2) of missing and surplus area, in spreads.
        spread: (C,) of the areas, shares of the person's pixels: if a camera is wrong, all areas between 0 and 1 are
            equally likely; pieces have an exponential distribution.
    """
    over = np.fmax(excess, 0.0)
    normal = -(over**2) / 2 - np.log(2 * np.pi) / 2
    anything = np.log(spread)[:, None]
    pieces = anything - np.log(_PIECE) - over * spread[:, None] / _PIECE
    poor = (np.logaddexp(normal, pieces) - np.log(2.0)).sum(axis=1)  # an area is normal or not, equally likely
    found = np.stack([normal.sum(axis=1), poor, 2 * anything[:, 0]], axis=1)
    return np.where(np.isfinite(excess[:, :1]), found, 0.0)


@dataclass(frozen=True)
class Belief:
    """(C, 3) the probability that each camera is right, that its mask is poor, and that it is wrong; and (C,) the fault
    of its image, an index in :data:`STATES`, 0 without one."""

    probability: Float
    fault: NDArray[np.uint8]


class Cameras(Stateful[Belief]):
    """The states of C cameras, in frames at a rate of ``fps``."""

    State = Belief

    def __init__(self, count: int, fps: float) -> None:
        self._probability = np.tile([1.0, 0.0, 0.0], (count, 1))
        self._fault = np.zeros(count, np.uint8)
        self._fps = fps
        begin, poor, end = _BEGIN_HZ / fps, min(_POOR_HZ / fps, 0.5), min(_END_HZ / fps, 0.5)
        after = end * _POOR_HZ / (_END_HZ + _POOR_HZ)  # the mask of a camera that was wrong may be poor
        self._transition = np.array([
            [1 - poor - begin, poor, begin],
            [end, 1 - end - begin, begin],
            [end - after, after, 1 - end],
        ])  # fmt: skip

    @property
    def states(self) -> NDArray[np.uint8]:
        """(C,) index of each camera's state in :data:`STATES`; 0 unless its image has a fault, or it is more likely
        wrong than not."""
        wrong = np.where(self._probability[:, 2] > 0.5, np.uint8(STATES.index(WRONG)), np.uint8(0))
        return np.where(self._fault > 0, self._fault, wrong)

    @property
    def unfit(self) -> Bool:
        """(C,) cameras whose image shows that they cannot be used."""
        return np.asarray(self._fault > 0)

    def accuse(self, camera: int) -> None:
        """Take it for certain that a camera is wrong now; later frames may show that it is right again."""
        self._probability[camera] = 0.0, 0.0, 1.0

    def look(self, faults: Sequence[str | None]) -> None:
        """Take in the faults of the images of the next frame; None for an image without one."""
        self._fault = np.array([0 if fault is None else STATES.index(fault) for fault in faults], np.uint8)

    def weigh(self, cameras: Bool, likelihood: Float) -> None:
        """Weigh cameras (C,) by the likelihoods (C, 3) of their residual."""
        nats = self._expected() + likelihood
        for camera in np.flatnonzero(cameras):
            self._probability[camera] = _normalised(nats[camera])

    def accused(self, likelihood: Float, best: Float, kept: Bool) -> int | None:
        """Return which of the cameras used, ``kept`` (C,), is to be judged; None if none is.

        Its residual must speak against it; and with what the others can gain without it at most, it must be likelier
        that it misleads than that it does not.

        Args:
            likelihood: (C, 3) at the pose of all of them.
            best: (C, 3) of residuals without an excess.
        """
        right, poor, wrong = (self._expected() + likelihood).T
        odds = np.logaddexp(poor + np.log(_TORN), wrong) - np.logaddexp(right, poor + np.log1p(-_TORN))
        doubtful = kept & (likelihood[:, 1:].max(axis=1) > likelihood[:, 0])
        camera = int(np.argmax(np.where(doubtful, odds, -np.inf)))
        others = kept & (np.arange(len(kept)) != camera)
        gain = self._marginal(best, others) - self._marginal(likelihood, others)
        return camera if doubtful[camera] and odds[camera] + gain > 0 else None

    def judge(self, camera: int, others: Bool, with_it: Float, without: Float) -> str | None:
        """Return the fault of a camera, if it has one, from the likelihoods (C, 3) at the poses with it and without it.

        The explanations that are compared: the camera is right; its mask is poor; the pose is wrong, so that all
        residuals may be anything; or the pose without the camera is right, and the mask is torn or the camera wrong.
        ``others``: (C,) the other cameras used.
        """
        right, poor, wrong = self._expected()[camera]
        all_used, fewer = self._marginal(with_it, others), self._marginal(without, others)
        probability = _normalised(
            np.array([
                np.logaddexp(
                    right + with_it[camera, 0] + all_used,
                    np.log(_LOSE_HZ / self._fps) + with_it[camera, 2] + with_it[others, 2].sum(),
                ),
                poor + np.log1p(-_TORN) + with_it[camera, 1] + all_used,
                wrong + without[camera, 2] + fewer,
                poor + np.log(_TORN) + without[camera, 1] + fewer,
            ])
        )  # fmt: skip
        self._probability[camera] = probability[:3] + np.array([0.0, probability[3], 0.0])
        if self.states[camera]:
            return WRONG
        return TORN if probability[2:].sum() > 0.5 else None

    def _expected(self) -> Float:
        """Return (C, 3) logarithms of the probabilities of the states, before the frame's masks are seen."""
        return np.asarray(np.log(np.maximum(self._probability @ self._transition, np.finfo(np.float64).tiny)))

    def _marginal(self, likelihood: Float, cameras: Bool) -> float:
        """Return the logarithm of the likelihood of cameras (C,) in unknown states, from those (C, 3) of each state."""
        return float(np.logaddexp.reduce((self._expected() + likelihood)[cameras], axis=1).sum())


def all_left_out(states: NDArray[np.uint8], shown: Bool, estimate: Estimate) -> NDArray[np.uint8]:
    """Return (C,) the states of the cameras in a frame, also of those in which the tracker has found nothing of the
    person. If it has found nothing in any camera, the frame's reason says so.

    Args:
        states: (C,) of the cameras, as judged.
        shown: (C,) whether the masks that the tracker was given show anything. If the tracker has taken all of it for
            something else, the mask is torn.
        estimate: of the tracker.
    """
    if estimate.residual is None or estimate.found == Reason.NOBODY:
        return states
    nothing = np.where(shown, STATES.index(TORN), STATES.index(UNSEEN))
    return np.where((states == 0) & np.isnan(estimate.residual[:, 0]), nothing, states).astype(np.uint8)


def _normalised(nats: Float) -> Float:
    """Return probabilities that are proportional to exp(nats)."""
    found = np.exp(nats - nats.max())
    return np.asarray(found / found.sum())


@dataclass(frozen=True)
class Match:
    """How well a tracker's pose explains a frame, and what is known of the frames before.

    Attributes:
        error: the residual, mean over the views; not finite if nobody is seen.
        most: the residual above which the person is lost.
        excess: of the residual above its baseline, mean over the views, spreads.
        cut: whether the person is elsewhere than in the frame before.
        lost_for, refused: consecutive frames before in which the person was lost, and whose pose was refused, because
            its residual was still high.
        high_for: consecutive frames with a high residual, this one included; 0 if it is not high.
        depth: whether the cameras used determine depth.
        false_alarm: as for :func:`judge_frames`.
    """

    error: float
    most: float
    excess: float = 0.0
    cut: bool = False
    lost_for: int = 0
    refused: int = 0
    high_for: int = 0
    depth: bool = True
    false_alarm: float = 0.5

    @property
    def reason(self) -> Reason:
        """The reason that the frame itself shows."""
        if not np.isfinite(self.error):
            return Reason.NOBODY
        if self.error > self.most:
            return Reason.UNEXPLAINED
        if (self.cut or self.lost_for) and self.excess > self._most_excess:
            return Reason.STILL_HIGH
        if not self.depth:
            return Reason.ONE_SIDED
        if self.high_for >= UNKNOWN_AFTER:
            return Reason.HIGH
        return Reason.CUT if self.cut else Reason.NONE

    @property
    def _most_excess(self) -> float:
        """The largest excess of a pose after a loss or a cut: one spread, because no prediction supports such a pose.
        After the frames in which a baseline follows a change, the level itself may have changed: halfway between a high
        residual and an outlier is then accepted."""
        high = NormalDist().inv_cdf(1.0 - self.false_alarm)
        return 1.0 if self.refused < 1 / RATE else (high + OUTLIER) / 2


@dataclass(frozen=True)
class FrameEvidence:
    """What F frames show of a person.

    Attributes:
        found: (F,) the :class:`~tk.trackers.reason.Reason` that each frame itself shows.
        posed: (F,) whether the person is present and has a pose.
        begins: (F,) whether the pose is not that of the frame before, moved on: after a loss or a cut.
        residual: (F, C, 2) missing and surplus area at the poses; NaN for a camera that was not used.
        depth: (F,) whether the cameras used determine depth.
    """

    found: NDArray[np.uint8]
    posed: Bool
    begins: Bool
    residual: Float
    depth: Bool

    @classmethod
    def none(cls, cameras: int) -> FrameEvidence:
        """Return the evidence before the first frame."""
        residual, yes = np.full((RECENT, cameras, 2), np.nan), np.ones(RECENT, np.bool_)
        return cls(np.zeros(RECENT, np.uint8), yes, ~yes, residual, yes)

    def then(self, found: Reason, begins: bool, residual: Float) -> FrameEvidence:
        """Return the evidence of the last frames when another one with a pose follows."""
        return FrameEvidence(
            np.append(self.found[1:], np.uint8(found)),
            self.posed,
            np.append(self.begins[1:], begins),
            np.concatenate([self.residual[1:], residual[None]]),
            np.append(self.depth[1:], found != Reason.ONE_SIDED),
        )


def judge_frames(evidence: FrameEvidence, false_alarm: float, whole: bool = False) -> NDArray[np.uint8]:
    """Return (F,) the :class:`~tk.trackers.reason.Reason` of each of F consecutive frames.

    Args:
        evidence: what the frames show.
        false_alarm: probability with which the residual of a right pose counts as high, in one frame.
        whole: whether these are all frames of a recording, tracked twice. Then a residual that stays high counts from
            its first frame. If most frames are suspect or have a high residual, what is wrong lasts, such as a
            calibration, and the body fits the others by chance: all are suspect.
    """
    found, posed = evidence.found, evidence.posed
    high = found == Reason.HIGH
    contradicted = np.zeros(len(found), np.bool_)
    residual = np.where(posed[:, None, None], evidence.residual, np.nan)
    starts = np.flatnonzero(~posed | evidence.begins)
    for rows in np.split(np.arange(len(found)), starts):  # frames before a loss or a cut show nothing about this pose
        contradicted[rows] = _contradicted(residual[rows], false_alarm)
        if whole:
            of_these = high[rows]
            high[rows] = [of_these[i : i + UNKNOWN_AFTER].any() for i in range(len(rows))]
    if whole and 2 * np.count_nonzero(posed & evidence.depth & (contradicted | high)) > np.count_nonzero(posed):
        contradicted = posed
    flags = {Reason.CONTRADICTED: contradicted, Reason.ONE_SIDED: ~evidence.depth, Reason.HIGH: high}
    reasons = np.where(np.isin(found, list(flags)), np.uint8(Reason.NONE), found)
    for reason, flag in flags.items():
        reasons = np.where(posed & flag & ((reasons == Reason.NONE) | (reasons > reason)), np.uint8(reason), reasons)
    return reasons


def _contradicted(residual: Float, false_alarm: float) -> Bool:
    """Return (F,) whether residuals (F, C, 2) of consecutive frames contradict the poses: the frame is among
    :data:`~tk.trackers.residual.RECENT` ones, or all if there are fewer, whose mean displacement is far above that of
    correct recordings.

    Half of the logarithm's variance lies between recordings, so all frames of a recording with a high level would count
    as contradicted. The limit is therefore set for the probability ``false_alarm`` squared.
    """
    away = displacement(residual)
    measured = np.flatnonzero(np.isfinite(away))
    result = np.zeros(len(residual), np.bool_)
    if len(measured):
        window = min(RECENT, len(measured))
        mean = np.convolve(away[measured], np.full(window, 1.0 / window), "valid")
        limit = LEVEL * np.exp(-LEVEL_SPREAD * NormalDist().inv_cdf(false_alarm**2))
        for first in np.flatnonzero(mean > limit):
            result[measured[first : first + window]] = True
    return result


def depth_known(rig: Rig, joints: Float, residual: Float | None) -> Bool:
    """Return (...) whether the cameras that were used, those with a residual (..., C, 2), determine the depth of joints
    (..., J, 3). Without residuals nothing speaks against it."""
    used = np.ones((*joints.shape[:-2], len(rig)), np.bool_) if residual is None else np.isfinite(residual[..., 0])
    return determine_depth(rig.centers, joints.mean(axis=-2), used)


def impossible(joints: Float, before: Float | None, seconds: float) -> Reason:
    """Return why joints (J, 3), metres, are impossible so many seconds after others; NONE if they are possible."""
    if not np.isfinite(joints).all():
        return Reason.NO_NUMBERS
    if before is None:
        return Reason.NONE
    moved = float(np.linalg.norm(joints[_TRUNK, :] - before[_TRUNK, :], axis=1).min())
    return Reason.JUMPS if moved > FASTEST_M_S * seconds + TRUNK_ERROR_M else Reason.NONE


@dataclass(frozen=True)
class JudgeState:
    """What the last frames show; the joints (J, 3), metres, of the last frame with a pose, None after a loss, and its
    number."""

    recent: FrameEvidence
    joints: Float | None
    index: int


class FrameJudge(Stateful[JudgeState]):
    """Judges the estimates of consecutive frames.

    Args:
        tracker: it searches for the person after an impossible pose.
        cameras: number of cameras.
        fps: frames per second.
        false_alarm: as for :func:`judge_frames`.
    """

    State = JudgeState

    def __init__(self, tracker: Tracker, cameras: int, fps: float, false_alarm: float) -> None:
        self._tracker, self._cameras, self._fps, self._false_alarm = tracker, cameras, fps, false_alarm
        self._recent = FrameEvidence.none(cameras)
        self._joints: Float | None = None
        self._index = -1

    def judge(self, index: int, estimate: Estimate) -> Estimate:
        """Return the estimate of a frame with the reason that the frame itself shows, and with the reason that the last
        frames show."""
        found, begins = estimate.found, estimate.origin == Status.RECOVERED
        if not is_lost(found):
            before = None if begins else self._joints  # the person may be elsewhere, as after a cut
            found = impossible(estimate.joints, before, max(abs(index - self._index), 1) / self._fps) or found
            if is_lost(found) and (tracker := sharing(self._tracker)) is not None:
                tracker.lose()
        if is_lost(found):
            self._joints, self._recent = None, FrameEvidence.none(self._cameras)
            return replace(estimate, found=found, judged=found)
        self._joints, self._index = estimate.joints, index
        residual = np.full((self._cameras, 2), np.nan) if estimate.residual is None else estimate.residual
        self._recent = self._recent.then(found, begins, residual)
        return replace(estimate, found=found, judged=Reason(judge_frames(self._recent, self._false_alarm)[-1]))
