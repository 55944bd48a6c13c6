"""When a frame is lost, suspect or without sigma: the reasons, their messages, and the decision.

What a frame itself shows (nobody, an impossible pose, a residual that stays high) is its first reason.
:func:`judge_frames` adds what several frames show together: body and masks differ more than in a correct recording, or
the cameras do not determine depth. A run asks it in each frame with the last frames, and at its end with all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import determine_depth
from tk.model.masks.image_health import described
from tk.trackers.residual import LEVEL, LEVEL_SPREAD, OUTLIER, RATE, RECENT, displacement

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Keeps the logarithm finite where a body fits perfectly; a hundredth of the level.
_TINY = 1e-3
# Sigma is unknown after this many consecutive frames with a high residual, and two failed searches for the person.
UNKNOWN_AFTER = 6


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
