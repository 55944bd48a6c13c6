"""One account of the evidence: when a camera is left out, and when a frame is lost, suspect or without sigma.

**Cameras.** A camera is right, or it has one of :data:`FAULTS`. Evidence of its image
(:mod:`tk.model.masks.image_health`) is certain, and counts for one frame. Evidence of its mask is the missing and the
surplus area, as excess above the camera's baseline, in spreads. Three states explain it:

- right: both areas are normal; surplus area may be somebody or something else in the mask.
- torn: in a part of the frames any part of the mask is missing; surplus area as of a right camera.
- wrong: any missing and any surplus area. A camera that is turned, moved or late has both.

A wrong pose explains a high residual, too. So the evidence of one frame is a comparison of explanations: the person is
tracked with the camera and without it (:meth:`Cameras.judge`). A camera that is left out is weighed in each frame at
the pose that the others give, by forward probabilities (Rabiner, *Proceedings of the IEEE*, 1989).

**Frames.** What a frame itself shows (nobody, an impossible pose, a residual that stays high) is its first reason.
:func:`judge_frames` adds what several frames show together: body and masks differ more than in a correct recording, or
the cameras do not determine depth. A run asks it in each frame with the last frames, and at its end with all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import determine_depth
from tk.model.masks.image_health import IMAGE_FAULTS, described
from tk.model.stateful import Stateful
from tk.trackers.residual import LEVEL, LEVEL_SPREAD, OUTLIER, RATE, RECENT, displacement

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Keeps the logarithm finite where a body fits perfectly; a hundredth of the level.
_TINY = 1e-3
# Sigma is unknown after this many consecutive frames with a high residual, and two failed searches for the person.
UNKNOWN_AFTER = 6


class Fault(NamedTuple):
    """A fault of a camera: the text for the user, and whether it is certain, because the image itself shows it."""

    text: str
    certain: bool


WRONG, TORN = "wrong", "torn"
#: faults of a camera by the names of its states
FAULTS = {
    WRONG: Fault("disagrees with the others", False),
    TORN: Fault("misses a part of the person", False),
    **{name: Fault(text, True) for name, (text, _) in IMAGE_FAULTS.items()},
}
STATES = ("used", *FAULTS)
_CERTAIN = np.array([False, *(fault.certain for fault in FAULTS.values())])
#: meaning of each value of `/evidence/camera`
STATE_MEANINGS = ("0: used", *(f"{value}: {fault.text}" for value, fault in enumerate(FAULTS.values(), 1)))

# Faults of a camera a second: each kind begins once in eleven minutes, and lasts five seconds.
_BEGIN_HZ, _END_HZ = 0.0015, 0.2
# Least probability of a state.
_LEAST = 1e-9
# Wrong poses a second, whatever the cameras are.
_LOSE_HZ = 0.3
# Share of the frames in which a torn mask is whole; probability that a right mask shows something else, too; and that
# pixels of people who touch each other in an image are taken for one another's.
_WHOLE, _FOREIGN, _MIXED = 0.5, 1e-4, 0.01


def likelihoods(excess: Float, spread: Float, touched: Bool | bool = False) -> Float:
    """Return (C, 3) logarithms of the likelihoods of the states right, wrong and torn; 0 if the excess is unknown.

    Args:
        excess: (C, 2) of missing and surplus area, in spreads.
        spread: (C,) of the areas, shares of the person's pixels: if a mask shows anything, all areas between 0 and 1
            are equally likely.
        touched: (C,) whether another person's pixels touch this person's: the mask of a right camera may then miss
            anything, and show anything.
    """
    normal = -(np.fmax(excess, 0.0) ** 2) / 2 - np.log(2 * np.pi) / 2
    anything = np.log(spread)
    surplus = np.logaddexp(np.log1p(-_FOREIGN) + normal[:, 1], np.log(_FOREIGN) + anything)
    torn = np.logaddexp(np.log(_WHOLE) + normal[:, 0], np.log1p(-_WHOLE) + anything)
    mixed = np.log(_MIXED) + 2 * anything
    right = np.where(touched, np.logaddexp(normal[:, 0] + surplus, mixed), normal[:, 0] + surplus)
    found = np.stack([right, 2 * anything, torn + surplus], axis=1)
    return np.where(np.isfinite(excess[:, :1]), found, 0.0)


@dataclass(frozen=True)
class Belief:
    """(C, S) the probability of each of :data:`STATES` of each camera."""

    probability: Float


class Cameras(Stateful[Belief]):
    """The states of C cameras, in frames at a rate of ``fps``."""

    State = Belief

    def __init__(self, count: int, fps: float) -> None:
        self._probability = np.zeros((count, len(STATES)))
        self._probability[:, 0] = 1.0
        self._fps = fps
        begin = _BEGIN_HZ / fps
        self._prior = np.log([1 - 2 * begin, begin, begin])

    @property
    def states(self) -> NDArray[np.uint8]:
        """(C,) index of each camera's state in :data:`STATES`; 0 unless a fault is likelier than none."""
        faults = 1 + self._probability[:, 1:].argmax(axis=1)
        return np.where(self._probability[:, 0] < 0.5, faults, 0).astype(np.uint8)

    @property
    def unfit(self) -> Bool:
        """(C,) cameras whose image shows that they cannot be used."""
        return np.asarray(_CERTAIN[self.states])

    def be(self, camera: int, state: str) -> None:
        """Take a camera's state for certain."""
        self._probability[camera] = np.arange(len(STATES)) == STATES.index(state)

    def look(self, faults: Sequence[str | None]) -> None:
        """Take in the faults of the images of the next frame; None for an image without one."""
        for camera, (fault, was) in enumerate(zip(faults, self.unfit, strict=True)):
            if fault is not None or was:
                self.be(camera, fault or "used")

    def weigh(self, cameras: Bool, likelihood: Float) -> None:
        """Weigh cameras (C,) that are left out, by the likelihoods (C, 3) of their residual at the others' pose."""
        end = min(_END_HZ / self._fps, 0.5)
        begin = np.exp(self._prior)
        for camera in np.flatnonzero(cameras):
            right, wrong, torn = np.maximum(self._probability[camera, :3], _LEAST)
            before = right * begin + np.array([(wrong + torn) * end, wrong * (1 - end), torn * (1 - end)])
            self._probability[camera, :3] = _normalised(np.log(before) + likelihood[camera])

    def accused(self, likelihood: Float, best: Float, kept: Bool) -> int | None:
        """Return which of the cameras used, ``kept`` (C,), is to be judged; None if none is.

        Its residual must speak against it; and with what the others can gain without it at most, a fault must be
        likelier than none.

        Args:
            likelihood: (C, 3) at the pose of all of them.
            best: (C, 3) of residuals without an excess.
        """
        against = np.where(kept, likelihood[:, 1:].max(axis=1) - likelihood[:, 0], -np.inf)
        camera = int(np.argmax(against))
        others = kept & (np.arange(len(kept)) != camera)
        gain = self._marginal(best[others]) - self._marginal(likelihood[others])
        return camera if against[camera] > 0 and against[camera] + self._prior[1] + gain > 0 else None

    def judge(self, camera: int, others: Bool, with_it: Float, without: Float) -> bool:
        """Return whether a camera has a fault, from the likelihoods (C, 3) at the poses with it and without it.

        Four explanations are compared: the camera is right, wrong or torn; or the pose is wrong, so that all residuals
        may be anything. ``others``: (C,) the other cameras used.
        """
        right = self._prior[0] + with_it[camera, 0] + self._marginal(with_it[others])
        lost = np.log(_LOSE_HZ / self._fps) + with_it[camera, 1] + with_it[others, 1].sum()
        faults = self._prior[1:] + without[camera, 1:] + self._marginal(without[others])
        probability = _normalised(np.array([np.logaddexp(right, lost), *faults]))
        found = bool(probability[0] < 0.5)
        if found:
            self.be(camera, WRONG)
            self._probability[camera, :3] = probability
        return found

    def _marginal(self, likelihood: Float) -> float:
        """Return the logarithm of the likelihood of N cameras in unknown states, from those (N, 3) of each state."""
        return float(np.logaddexp.reduce(self._prior + likelihood, axis=1).sum())


def _normalised(nats: Float) -> Float:
    """Return probabilities that are proportional to exp(nats)."""
    found = np.exp(nats - nats.max())
    return np.asarray(found / found.sum())


class Reason(IntEnum):
    """Why a frame has no pose, is suspect, or has no sigma: the values of `/evidence/reason`. The first one counts."""

    NONE = 0
    NOBODY = 1
    UNEXPLAINED = 2
    NO_NUMBERS = 3
    JUMPS = 4
    STILL_HIGH = 5
    UNCLEAR = 6
    CONTRADICTED = 7
    ONE_SIDED = 8
    HIGH = 9
    CUT = 10


@dataclass(frozen=True)
class Consequence:
    """What follows from a reason.

    Attributes:
        status: of the frame; None: as the tracker says.
        sigma: whether sigma is known.
        meaning: in a few words.
        text: for the user, with {} for the frames; empty if another line says it.
    """

    status: Status | None
    sigma: bool
    meaning: str
    text: str


_IMPOSSIBLE = "the pose found cannot be true: {}: lost, {{}}"
CONSEQUENCES = {
    Reason.NONE: Consequence(None, True, "nothing", ""),
    Reason.NOBODY: Consequence(Status.LOST, False, "too few views", "fewer than two cameras see anybody: no pose, {}"),
    Reason.UNEXPLAINED: Consequence(Status.LOST, False, "no pose explains the masks", ""),
    Reason.NO_NUMBERS: Consequence(
        Status.LOST, False, "joints are no numbers", _IMPOSSIBLE.format("it has joints that are no numbers")
    ),
    Reason.JUMPS: Consequence(Status.LOST, False, "the pose jumps", _IMPOSSIBLE.format("it jumps")),
    Reason.STILL_HIGH: Consequence(
        Status.LOST, False, "high residual after a loss",
        _IMPOSSIBLE.format("after a loss its residual is still high"),
    ),
    Reason.UNCLEAR: Consequence(Status.SUSPECT, False, "who is who, or which camera is right, is unclear", ""),
    Reason.CONTRADICTED: Consequence(
        Status.SUSPECT, False, "body and masks differ",
        "body and masks differ more than in correct recordings: suspect, {}; likely causes: the calibration of another "
        "recording, moved cameras, or videos of different recordings (see tk inspect)",
    ),
    Reason.ONE_SIDED: Consequence(
        None, False, "views from one side",
        "the cameras that are left see the person from the same or from opposite sides: σ is unknown, {}; add a camera "
        "from another side, at 30 to 150°",
    ),
    Reason.HIGH: Consequence(
        None, False, "the residual stays high", "the residual is high, and no better pose was found: σ is unknown, {}"
    ),
    Reason.CUT: Consequence(
        None, True, "elsewhere than before",
        "the person is elsewhere than in the frame before, as after a cut in the recording: searched for again, {}",
    ),
}  # fmt: skip
#: meaning of each value of `/evidence/reason`
MEANINGS = tuple(f"{int(reason)}: {CONSEQUENCES[reason].meaning}" for reason in Reason)


@dataclass(frozen=True)
class FrameEvidence:
    """What F frames show of a person.

    Attributes:
        found: (F,) the first :class:`Reason` in each frame itself.
        posed: (F,) whether the person is present and has a pose.
        residual: (F, C, 2) missing and surplus area at the poses; NaN for a camera that was not used.
        depth: (F,) whether the cameras used determine depth.
    """

    found: NDArray[np.uint8]
    posed: Bool
    residual: Float
    depth: Bool

    @classmethod
    def none(cls, cameras: int) -> FrameEvidence:
        """Return the evidence before the first frame."""
        residual, depth = np.full((RECENT, cameras, 2), np.nan), np.ones(RECENT, np.bool_)
        return cls(np.zeros(RECENT, np.uint8), depth, residual, depth)

    def then(self, found: Reason, residual: Float, depth: bool) -> FrameEvidence:
        """Return the evidence of the last frames with a pose when another one follows."""
        return FrameEvidence(
            np.append(self.found[1:], np.uint8(found)),
            self.posed,
            np.concatenate([self.residual[1:], residual[None]]),
            np.append(self.depth[1:], depth),
        )


def judge_frames(evidence: FrameEvidence, false_alarm: float, whole: bool = False) -> NDArray[np.uint8]:
    """Return (F,) the :class:`Reason` of each of F consecutive frames.

    Args:
        evidence: what the frames show.
        false_alarm: probability with which the residual of a right pose counts as high, in one frame.
        whole: whether these are all frames of a recording, tracked twice. Then a residual that stays high counts from
            its first frame. If most frames are suspect or have a high residual, what is wrong lasts, such as a
            calibration, and the body fits the others by chance: all are suspect.
    """
    found, posed = evidence.found, evidence.posed
    high = found == Reason.HIGH
    if whole:
        high = np.array([high[i : i + UNKNOWN_AFTER].any() for i in range(len(high))], np.bool_)
    contradicted = _contradicted(np.where(posed[:, None, None], evidence.residual, np.nan), false_alarm)
    if whole and 2 * np.count_nonzero(posed & evidence.depth & (contradicted | high)) > np.count_nonzero(posed):
        contradicted = posed
    flags = {Reason.CONTRADICTED: contradicted, Reason.ONE_SIDED: ~evidence.depth, Reason.HIGH: high}
    reasons = np.where(np.isin(found, list(flags)), np.uint8(Reason.NONE), found)
    for reason, flag in flags.items():
        reasons = np.where(posed & flag & ((reasons == Reason.NONE) | (reasons > reason)), np.uint8(reason), reasons)
    return reasons


def _contradicted(residual: Float, false_alarm: float) -> Bool:
    """Return (F,) whether residuals (F, C, 2) of consecutive frames contradict the poses: the frame is among
    :data:`~tk.trackers.residual.RECENT` ones whose mean displacement is far above that of correct recordings.

    Half of the logarithm's variance lies between recordings, so all frames of a recording with a high level would count
    as contradicted. The limit is therefore set for the probability ``false_alarm`` squared.
    """
    log = np.log(displacement(residual) + _TINY)
    measured = np.flatnonzero(np.isfinite(log))
    result = np.zeros(len(residual), np.bool_)
    if len(measured):
        window = min(RECENT, len(measured))
        mean = np.convolve(log[measured], np.full(window, 1.0 / window), "valid")
        limit = np.log(LEVEL) - LEVEL_SPREAD * NormalDist().inv_cdf(false_alarm**2)
        for first in np.flatnonzero(mean > limit):
            result[measured[first : first + window]] = True
    return result


def first_reason(status: str, sigma: Float | None, nobody: bool = False) -> Reason:
    """Return the reason that a tracker's status and sigma (J,) imply. ``nobody``: whether no camera shows anybody."""
    if status == "lost":
        return Reason.NOBODY if nobody else Reason.UNEXPLAINED
    return Reason.HIGH if sigma is not None and np.isnan(sigma).all() else Reason.NONE


def refused(excess: float, since: int, false_alarm: float) -> bool:
    """Return whether the pose after a loss is refused, because of its residual's excess, mean over the views.

    It may be one spread, because no prediction supports such a pose. After the frames in which a baseline follows a
    change, the level itself may have changed: halfway between a high residual and an outlier is then accepted.

    Args:
        excess: see :class:`~tk.trackers.residual.ResidualBaseline`.
        since: number of poses refused in turn.
        false_alarm: as for :func:`judge_frames`.
    """
    high = NormalDist().inv_cdf(1.0 - false_alarm)
    return excess > (1.0 if since < 1 / RATE else (high + OUTLIER) / 2)


def is_status(reasons: NDArray[np.integer], status: Status) -> Bool:
    """Return (...) whether reasons (...) give frames this status."""
    return np.isin(reasons, [reason for reason, then in CONSEQUENCES.items() if then.status == status])


def sigma_known(reasons: NDArray[np.integer]) -> Bool:
    """Return (...) whether sigma is known in frames with these reasons (...)."""
    return np.isin(reasons, [reason for reason, then in CONSEQUENCES.items() if then.sigma])


def depth_known(rig: Rig, joints: Float, residual: Float | None) -> Bool:
    """Return (...) whether the cameras that were used, those with a residual (..., C, 2), determine the depth of joints
    (..., J, 3). Without residuals nothing speaks against it."""
    used = np.ones((*joints.shape[:-2], len(rig)), np.bool_) if residual is None else np.isfinite(residual[..., 0])
    return determine_depth(rig.centers, joints.mean(axis=-2), used)


def report_frames(
    frames: Sequence[int] | NDArray[np.int64],
    reasons: Sequence[int] | NDArray[np.uint8],
    note: Callable[[str], None],
) -> None:
    """Report the frames (F,) of each reason (F,) by one line for the user."""
    numbers = np.asarray(frames)
    for reason, then in CONSEQUENCES.items():
        found = numbers[np.asarray(reasons) == reason]
        if len(found) and then.text:
            note(then.text.format(described(int(found[0]), int(found[-1]), len(found))))
