"""How sure a joint's place is: from the contours' noise, and from how far the person is from the usual posture.

Two things make a joint's error. Contours err by some pixels, and the curvature at the optimum says what that does to a
joint. And no joint of a person is a hinge at a point: where the model's lies in the flesh differs from where an
anatomist puts it by about a centimetre. As long as a limb keeps its direction in the trunk that is a constant, which no
motion shows and `tk evaluate` takes off; when the limb turns the difference turns with it. In the same way a spine
bends along its length, the model's in one place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.skeleton import JOINTS, SEGMENTS, Skeleton

Float = NDArray[np.float64]

# A joint's place in the flesh, metres along an axis, and what a bend of the waist by one radian adds to all joints.
# Chosen on walk, dance, fold, cube and treadmill such that as many errors are within 1 and 2 σ as are of a normal's.
# The first is about what the joints' constant offsets are on these.
IN_THE_FLESH_M, BENT_M = 0.0067, 0.0145

# The bone whose direction tells how a joint is turned, by the joints at its ends; the trunk's own joints have none.
_BONES = {
    "head_top": ("neck", "head_top"),
    **{f"{joint}_{side}": (f"shoulder_{side}", f"elbow_{side}") for side in "lr" for joint in ("shoulder", "elbow")},
    **{f"wrist_{side}": (f"elbow_{side}", f"wrist_{side}") for side in "lr"},
    **{f"{joint}_{side}": (f"hip_{side}", f"knee_{side}") for side in "lr" for joint in ("hip", "knee")},
    **{f"ankle_{side}": (f"knee_{side}", f"ankle_{side}") for side in "lr"},
}
_TURNED = np.array([JOINTS.index(name) for name in _BONES])
_FROM = np.array([JOINTS.index(start) for start, _ in _BONES.values()])
_TO = np.array([JOINTS.index(end) for _, end in _BONES.values()])
_TRUNK = SEGMENTS.index("torso")


def contour_variance(skeleton: Skeleton, pose: Float, precision: Float, free: NDArray[np.bool_]) -> Float:
    """(..., 15) variance of the joints' places along an axis, metres², that the contours' noise makes.

    Args:
        skeleton: of D degrees of freedom.
        pose: (..., D).
        precision: (..., D, D) the information about the pose that contours and priors give.
        free: (D,) what was free to change.
    """
    index = np.flatnonzero(free)
    covariance = np.linalg.inv(precision[..., index[:, None], index])
    w, v = skeleton.twists(pose)
    moves = skeleton.ancestors()[skeleton.joint_segment][:, index]
    w, v = w[..., None, index, :], v[..., None, index, :]
    J = np.where(moves[:, :, None], np.cross(w, skeleton.joints(pose)[..., None, :]) + v, 0.0)  # (..., 15, free, 3)
    J = np.swapaxes(J, -1, -2)
    return np.asarray((J * (J @ covariance[..., None, :, :])).sum(axis=(-1, -2)) / 3)


def directions(skeleton: Skeleton, poses: Float) -> Float:
    """(..., 15, 3) the direction, in the trunk, of the bone that each joint turns with, at poses (..., D); zero for the
    trunk's own joints."""
    x = skeleton.joints(poses)
    bones = (x[..., _TO, :] - x[..., _FROM, :]) @ skeleton.segment_transforms(poses)[..., _TRUNK, :3, :3]
    result = np.zeros(x.shape)
    result[..., _TURNED, :] = bones / np.linalg.norm(bones, axis=-1, keepdims=True)
    return result


def posture_variance(skeleton: Skeleton, poses: Float, usual: Float) -> Float:
    """(..., 15) variance along an axis, metres², of what is no constant of where the joints of poses (..., D) lie.

    Args:
        usual: (15, 3) mean or median of :func:`directions` over the recording.
    """
    length = np.linalg.norm(usual, axis=-1, keepdims=True)
    turned = directions(skeleton, poses) - usual / np.where(length > 0, length, 1.0)
    bent = (np.asarray(poses)[..., skeleton.is_waist] ** 2).sum(axis=-1, keepdims=True)
    return np.asarray(IN_THE_FLESH_M**2 * (turned**2).sum(axis=-1) + BENT_M**2 * bent)
