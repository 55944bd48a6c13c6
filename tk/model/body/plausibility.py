"""Poses and sizes that are impossible for a person.

The limits are wide: a value outside is impossible, or so unlikely that a wrong calibration, wrong masks or a wrong pose
are likelier. Statures: adults measure 1.3 to 2.2 m, children of six 1 m and more (WHO growth reference 2007: three
standard deviations below the median). The height of a smaller person is given in `capture.toml`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.model.body.skeleton import JOINTS
from tk.model.stateful import Stateful

Float = NDArray[np.float64]

# Statures that are accepted if the height is not given, metres: see above.
STATURE_M = (1.0, 2.3)
# Greatest extent of a person, in heights: crouched with bent arms (0.55), upright with raised arms (1.5).
EXTENT = (0.55, 1.5)
# Highest speed of the trunk, m/s: a sprinter reaches 12; and an error of its position between frames, metres.
FASTEST_M_S, TRUNK_ERROR_M = 12.0, 0.2

_CAUSES = "the unit or the scale of calibration.toml is wrong, or the masks show more or less than the person"
_TRUNK = JOINTS.index("pelvis"), JOINTS.index("neck")


def fits_height(extent_m: float, height_m: float) -> bool:
    """Return whether a person of this height may have this greatest extent; True for an unknown one (NaN)."""
    return not (extent_m < EXTENT[0] * height_m or extent_m > EXTENT[1] * height_m)


def check_extent(extent_m: float, height_m: float) -> None:
    """Refuse a hull that is too small or too large for a person of this height.

    Args:
        extent_m: the hull's greatest extent; NaN without a hull, which is accepted.
        height_m: the height in `capture.toml`.

    Raises:
        CaptureError: with the likely causes.
    """
    if not fits_height(extent_m, height_m):
        raise CaptureError(
            f"the person measures {extent_m:.2f} m in the images, but [subject] height in capture.toml says "
            f"{height_m:.2f} m: {_CAUSES}"
        )


def check_stature(stature_m: float) -> None:
    """Refuse an impossible stature, estimated from silhouettes because `capture.toml` has no height.

    Raises:
        CaptureError: with the likely causes.
    """
    if not STATURE_M[0] <= stature_m <= STATURE_M[1]:
        raise CaptureError(
            f"the person measures {stature_m:.2f} m in the images: {_CAUSES}; if the size is right, or the person "
            "does not stand at the beginning, give [subject] height in capture.toml"
        )


@dataclass(frozen=True)
class LastAccepted:
    """The joints (J, 3), metres, of the last accepted frame, and its number; None after a loss."""

    joints: Float | None
    index: int


class Plausibility(Stateful[LastAccepted]):
    """Checks the poses of consecutive frames, at ``fps`` frames per second."""

    State = LastAccepted

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._joints: Float | None = None
        self._index = -1

    def judge(self, index: int, joints: Float) -> str | None:
        """Return why the joints (J, 3), metres, of a frame are impossible, "NO_NUMBERS" or "JUMPS"; None if they are
        possible."""
        if not np.isfinite(joints).all():
            return "NO_NUMBERS"
        if self._joints is not None:
            dt = max(index - self._index, 1) / self._fps
            moved = float(np.linalg.norm(joints[_TRUNK, :] - self._joints[_TRUNK, :], axis=1).min())
            if moved > FASTEST_M_S * dt + TRUNK_ERROR_M:
                return "JUMPS"
        self._joints, self._index = joints, index
        return None

    def forget(self) -> None:
        """Forget the last pose, after a loss."""
        self._joints = None
