"""What cannot be true of a person, whatever the pictures say.

Limits are wide: what lies outside is not unusual but impossible, or so nearly that a wrong calibration, wrong masks
or a tracker gone astray are likelier. Statures: adults measure 1.3 to 2.2 m, children of six 1 m and more (WHO growth
reference 2007: three standard deviations below the median). Who is smaller is named in `capture.toml`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.model.body.skeleton import JOINTS, up_rotation

Float = NDArray[np.float64]

#: statures that are believed without being told, metres
STATURE_M = (1.0, 2.3)
#: the greatest extent of a person, beside the height: crouched with bent arms, or upright with raised ones
EXTENT = (0.55, 1.5)
#: a sprinter makes 12 m/s; and so much may the estimate of a trunk jump by itself, metres
FASTEST_M_S, JUMP_M = 12.0, 0.2
#: a pirouette makes three turns a second; a turn in a frame aside this and 90° is left taken for right
FASTEST_TURN_DEG_S = 1500.0
#: how far the lower ankle may be above where it stood lowest, metres: the best jump less than a metre
HIGHEST_M = 1.2
#: by so much of the person a view's mask lies beside the body if it shows something else
UNEXPLAINED = 0.5

_CAUSES = "the unit or the scale of calibration.toml is wrong, or the masks show more or less than the person"
_PELVIS, _NECK = JOINTS.index("pelvis"), JOINTS.index("neck")
_HIPS = JOINTS.index("hip_l"), JOINTS.index("hip_r")
_SHOULDERS = JOINTS.index("shoulder_l"), JOINTS.index("shoulder_r")
_ANKLES = JOINTS.index("ankle_l"), JOINTS.index("ankle_r")


def fits_height(extent_m: float, height_m: float) -> bool:
    """Whether a person of this height may be this long in some direction; an unknown extent, NaN, may be anything."""
    return not (extent_m < EXTENT[0] * height_m or extent_m > EXTENT[1] * height_m)


def check_extent(extent_m: float, height_m: float) -> None:
    """Refuse a hull in which a person of this height has no room, or far too much.

    Args:
        extent_m: the hull's greatest extent; NaN where there is none, which is not refused here.
        height_m: as `capture.toml` tells it.

    Raises:
        CaptureError: with the likely causes.
    """
    if not fits_height(extent_m, height_m):
        raise CaptureError(
            f"the person measures {extent_m:.2f} m in the pictures, but [subject] height in capture.toml says "
            f"{height_m:.2f} m: {_CAUSES}"
        )


def check_stature(stature_m: float) -> None:
    """Refuse a stature that nobody has, measured in silhouettes where `capture.toml` does not tell it.

    Raises:
        CaptureError: with the likely causes.
    """
    if not STATURE_M[0] <= stature_m <= STATURE_M[1]:
        raise CaptureError(
            f"the person measures {stature_m:.2f} m in the pictures: {_CAUSES}; if the size is right, or the person "
            "does not stand at the beginning, give [subject] height in capture.toml"
        )


class Plausibility:
    """Judges one frame after the other.

    Args:
        up: what points up in the world.
        fps: frames a second.
    """

    def __init__(self, up: str, fps: float) -> None:
        self._up = up_rotation(up)[:, 2]
        self._fps = fps
        self._joints: Float | None = None  # of the last frame that was believed
        self._index = -1
        self._lowest = np.inf

    def judge(self, index: int, joints: Float, aside: Float | None) -> str | None:
        """Why the joints (15, 3) of a frame cannot be right; None where they can.

        Args:
            index: the frame's number.
            joints: (15, 3) metres.
            aside: (C,) by how much the masks of the cameras that were used lie beside the body: body outside the mask
                and as much mask outside the body, as a share of it. NaN for other cameras; None where nobody tells.
        """
        reason = self._reason(index, joints, aside)
        if reason is None:
            self._joints, self._index = joints, index
            self._lowest = min(self._lowest, self._height(joints))
        return reason

    def _reason(self, index: int, joints: Float, aside: Float | None) -> str | None:
        if not np.isfinite(joints).all():
            return "it has joints that are no numbers"
        if aside is not None and np.nanmax(aside, initial=0.0) > UNEXPLAINED:
            return "one view shows something else than the body"
        if self._height(joints) - self._lowest > HIGHEST_M:
            return "it hovers above where it stood"
        if self._joints is None:
            return None
        dt = max(index - self._index, 1) / self._fps
        middle = (_PELVIS, _NECK)
        moved = float(np.linalg.norm(joints[middle, :] - self._joints[middle, :], axis=1).min())
        if moved > FASTEST_M_S * dt + JUMP_M:
            return "it jumps"
        turned = self._turned_deg(joints)
        if turned > max(FASTEST_TURN_DEG_S * dt, 90.0):
            return "it turns round at once"
        return None

    def _height(self, joints: Float) -> float:
        return float((joints[_ANKLES, :] @ self._up).min())

    def _turned_deg(self, joints: Float) -> float:
        """The smaller of the angles by which hips and shoulders have turned, both across."""
        assert self._joints is not None
        angles = []
        for left, right in (_HIPS, _SHOULDERS):
            a, b = joints[left] - joints[right], self._joints[left] - self._joints[right]
            cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-9)
            angles.append(float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
        return min(angles)

    def forget(self) -> None:
        """The person was lost: where he or she was before says nothing any more."""
        self._joints = None

    def state(self) -> Mapping[str, Any]:
        """What :meth:`restore` needs."""
        known = {} if self._joints is None else {"joints": self._joints, "index": self._index}
        return {**known, "lowest": self._lowest}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take up what :meth:`state` gave."""
        self._joints = np.asarray(state["joints"], np.float64) if "joints" in state else None
        self._index = int(state.get("index", -1))
        self._lowest = float(state["lowest"])
