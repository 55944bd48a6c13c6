"""Standard deviation of each joint's position: from the contours' noise, and from the posture.

Two things cause a joint's error. First, contours err by some pixels; the curvature at the optimum gives the effect on a
joint. Second, no joint of a person is a hinge at a point: the model's joint differs from the anatomical one by about a
centimetre. As long as a limb keeps its direction relative to the trunk, this difference is a constant offset, which
`tk evaluate` removes; when the limb turns, the offset turns with it. In the same way a spine bends along its length,
but the model's bends at one point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import BONES, LIMBS, ROWS
from tk.model.body.skeleton import JOINTS, SEGMENTS, Skeleton

Float = NDArray[np.float64]

# Offset of a joint from the anatomical one, metres along an axis, and the error of all joints when the waist bends by
# one radian. Fitted on walk, dance, fold, cube and treadmill-slow, so that as many errors lie within 1 and 2 σ as for a
# normal distribution. The joints' constant offsets on these captures are about as large as the first.
OFFSET_M, BENT_M = 0.0067, 0.0145

# The bone that each joint turns with, by the joints at its ends; the trunk's own joints have none.
_BONES = {b: (a, b) for a, b in BONES if ROWS[a].chain and ROWS[a].chain == ROWS[b].chain}
_BONES |= {start: (start, middle) for start, middle, _ in LIMBS.values()}
_TURNED = np.array([JOINTS.index(name) for name in _BONES])
_FROM = np.array([JOINTS.index(start) for start, _ in _BONES.values()])
_TO = np.array([JOINTS.index(end) for _, end in _BONES.values()])
_TRUNK = SEGMENTS.index("torso")


def contour_variance(skeleton: Skeleton, pose: Float, precision: Float, free: NDArray[np.bool_]) -> Float:
    """Return (..., 15) variance of the joints' positions along an axis, metres², from the contours' noise.

    Args:
        skeleton: of D degrees of freedom.
        pose: (..., D).
        precision: (..., D, D) information of contours and priors about the pose.
        free: (D,) bool, degrees of freedom that were optimised.
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
    """Return (..., 15, 3) the direction, relative to the trunk, of the bone that each joint turns with, at poses
    (..., D); zero for the trunk's own joints."""
    x = skeleton.joints(poses)
    bones = (x[..., _TO, :] - x[..., _FROM, :]) @ skeleton.segment_transforms(poses)[..., _TRUNK, :3, :3]
    result = np.zeros(x.shape)
    result[..., _TURNED, :] = bones / np.linalg.norm(bones, axis=-1, keepdims=True)
    return result


def posture_variance(skeleton: Skeleton, poses: Float, mean: Float) -> Float:
    """Return (..., 15) variance of the joints' offsets along an axis, metres², at poses (..., D).

    Args:
        mean: (15, 3) mean or median of :func:`directions` over the recording.
    """
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    turned = directions(skeleton, poses) - mean / np.where(length > 0, length, 1.0)
    bent = (np.asarray(poses)[..., skeleton.is_waist] ** 2).sum(axis=-1, keepdims=True)
    return np.asarray(OFFSET_M**2 * (turned**2).sum(axis=-1) + BENT_M**2 * bent)
