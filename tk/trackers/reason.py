"""The reason of a frame: why it is lost, suspect or without sigma, and what follows from it.

A tracker, and the judgement of the frames before (:mod:`tk.trackers.judgement`), give a frame one reason. Its status
and whether its sigma is known follow from the reason here, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.io.results.status import Status
from tk.model.masks.image_health import described

Float = NDArray[np.float64]


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
        Status.LOST, False, "high residual after a loss or a cut",
        _IMPOSSIBLE.format("after a loss or a cut its residual is still high"),
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


_STATUS = np.array([-1 if then.status is None else then.status for then in CONSEQUENCES.values()])
_SIGMA = np.array([then.sigma for then in CONSEQUENCES.values()])


def status_of(origin: ArrayLike, reasons: ArrayLike) -> NDArray[np.uint8]:
    """Return (...) the status of frames with these reasons (...).

    Args:
        origin: (...) how the tracker came to the pose: tracked, initialised or recovered; absent if nobody is there.
        reasons: (...).
    """
    origin, then = np.asarray(origin), _STATUS[np.asarray(reasons)]
    return np.where((origin == Status.ABSENT) | (then < 0), origin, then).astype(np.uint8)


def is_lost(reason: Reason) -> bool:
    """Return whether a frame with this reason has no pose."""
    return CONSEQUENCES[reason].status == Status.LOST


def known_sigma(sigma: Float, reasons: ArrayLike) -> Float:
    """Return sigma (..., J), metres, of frames with these reasons (...); NaN where it is not known."""
    return np.where(_SIGMA[np.asarray(reasons)][..., None], sigma, np.nan)


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
