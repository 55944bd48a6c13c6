"""Poses and sizes that are impossible for a person.

The limits are wide: a value outside is impossible, or so unlikely that a wrong calibration, wrong masks or a wrong pose
are likelier. Statures: adults measure 1.3 to 2.2 m, children of six 1 m and more (WHO growth reference 2007: three
standard deviations below the median). The height of a smaller person is given in `capture.toml`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.model.body.joints import ANKLE_JOINTS, HIPS, SHOULDERS
from tk.model.body.skeleton import JOINTS, up_rotation

Float = NDArray[np.float64]

# Statures that are accepted if the height is not given, metres: see above.
STATURE_M = (1.0, 2.3)
# Greatest extent of a person, in heights: crouched with bent arms (0.55), upright with raised arms (1.5).
EXTENT = (0.55, 1.5)
# Highest speed of the trunk, m/s: a sprinter reaches 12; and an error of its position between frames, metres.
FASTEST_M_S, TRUNK_ERROR_M = 12.0, 0.2
# Fastest turn, degrees a second: a pirouette has three turns a second (1080); turns below 90° between frames are
# always accepted.
FASTEST_TURN_DEG_S = 1500.0
# How far the lower ankle may rise above its lowest position, metres: the best jumps are below one metre.
HIGHEST_M = 1.2
# Offset of a view's mask from the body, as a share of the person, above which the mask shows something else: half
# of the body is outside the mask.
MOST_OFFSET = 0.5

_CAUSES = "the unit or the scale of calibration.toml is wrong, or the masks show more or less than the person"
_PELVIS, _NECK = JOINTS.index("pelvis"), JOINTS.index("neck")
_HIPS = tuple(map(JOINTS.index, HIPS))
_SHOULDERS = tuple(map(JOINTS.index, SHOULDERS))
_ANKLES = tuple(map(JOINTS.index, ANKLE_JOINTS))


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


class Plausibility:
    """Checks the poses of consecutive frames.

    Args:
        up: upward direction of the world.
        fps: frames per second.
    """

    def __init__(self, up: str, fps: float) -> None:
        self._up = up_rotation(up)[:, 2]
        self._fps = fps
        self._joints: Float | None = None  # of the last accepted frame
        self._index = -1
        self._lowest = np.inf

    def judge(self, index: int, joints: Float, offset: Float | None) -> str | None:
        """Return why a pose is impossible; None if it is possible.

        Args:
            index: frame index.
            joints: (J, 3) metres.
            offset: (C,) the smaller of missing and surplus area of each used camera, as a share of the person; NaN for
                other cameras. None if not measured.
        """
        reason = self._reason(index, joints, offset)
        if reason is None:
            self._joints, self._index = joints, index
            self._lowest = min(self._lowest, self._height(joints))
        return reason

    def _reason(self, index: int, joints: Float, offset: Float | None) -> str | None:
        if not np.isfinite(joints).all():
            return "it has joints that are no numbers"
        if offset is not None and np.nanmax(offset, initial=0.0) > MOST_OFFSET:
            return "one view shows something else than the body"
        if self._height(joints) - self._lowest > HIGHEST_M:
            return "it hovers above where it stood"
        if self._joints is None:
            return None
        dt = max(index - self._index, 1) / self._fps
        middle = (_PELVIS, _NECK)
        moved = float(np.linalg.norm(joints[middle, :] - self._joints[middle, :], axis=1).min())
        if moved > FASTEST_M_S * dt + TRUNK_ERROR_M:
            return "it jumps"
        turned = self._turned_deg(joints)
        if turned > max(FASTEST_TURN_DEG_S * dt, 90.0):
            return "it turns round at once"
        return None

    def _height(self, joints: Float) -> float:
        return float((joints[_ANKLES, :] @ self._up).min())

    def _turned_deg(self, joints: Float) -> float:
        """Return the smaller of the angles by which the lines through the hips and the shoulders have turned."""
        assert self._joints is not None
        angles = []
        for left, right in (_HIPS, _SHOULDERS):
            a, b = joints[left] - joints[right], self._joints[left] - self._joints[right]
            cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-9)
            angles.append(float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
        return min(angles)

    def forget(self) -> None:
        """Forget the last pose, after a loss."""
        self._joints = None

    def state(self) -> Mapping[str, Any]:
        """Return what :meth:`restore` needs."""
        known = {} if self._joints is None else {"joints": self._joints, "index": self._index}
        return {**known, "lowest": self._lowest}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state."""
        self._joints = np.asarray(state["joints"], np.float64) if "joints" in state else None
        self._index = int(state.get("index", -1))
        self._lowest = float(state["lowest"])
