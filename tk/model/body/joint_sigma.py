"""Standard deviation of each joint's position: from the contours, and from the posture.

Three things cause a joint's error. First, contours err by some pixels. Second, clothes and the model's shape displace a
segment's contours in a view as a whole. Both are in the normal equations, where the displacements are unknowns
(:func:`tk.kernels.wrench.add_displaced`), so the pose's covariance contains them. Third, no joint of a person is a
hinge at a point: the model's joint differs from the anatomical one by about a centimetre. As long as a limb keeps its
direction relative to the trunk, this difference is a constant offset, which `tk evaluate` removes; when the limb turns,
the offset turns with it. In the same way a spine bends along its length, but the model's bends at one point; knees and
ankles are held by their own contours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import BONES, LIMBS, ROWS
from tk.model.body.skeleton import JOINTS, SEGMENTS, Skeleton

Float = NDArray[np.float64]

# Offset of a joint from the anatomical one, metres along an axis, and the error of the trunk and of what it carries if
# the waist bends by one radian, metres; fitted to rendered people, so that as many errors lie within 1 and 2 σ as for a
# normal distribution.
OFFSET_M, BENT_M = 0.005, 0.016

# Standard deviation of the displacement of a segment's contours in one view by clothes and the model's shape, metres
# along an axis: of the part that is the same in all frames of a recording, and of the part that changes, chosen on
# rendered people (docs/experiments.md, Sigma).
CONSTANT_M, CHANGING_M = 0.015, 0.003

# The bone that each joint turns with, by the joints at its ends; the trunk's own joints have none.
_BONES = {b: (a, b) for a, b in BONES if ROWS[a].chain and ROWS[a].chain == ROWS[b].chain}
_BONES |= {start: (start, middle) for start, middle, _ in LIMBS.values()}
_TURNED = np.array([JOINTS.index(name) for name in _BONES])
_FROM = np.array([JOINTS.index(start) for start, _ in _BONES.values()])
_TO = np.array([JOINTS.index(end) for _, end in _BONES.values()])
_TRUNK = SEGMENTS.index("torso")
# the joints that move with a spine that bends
_WITH_SPINE = np.array([all(name not in LIMBS[leg][1:] for leg in ("leg_l", "leg_r")) for name in JOINTS])


def pose_variance(skeleton: Skeleton, pose: Float, covariance: Float) -> Float:
    """Return (..., J) variance of the joints' positions along an axis, metres², from the pose's covariance.

    Args:
        skeleton: of D degrees of freedom.
        pose: (..., D).
        covariance: (..., D, D) of the pose.
    """
    J = skeleton.joint_jacobian(pose)  # (..., J, 3, D)
    J = J.reshape(*J.shape[:-3], -1, J.shape[-1])
    return np.asarray(((J @ covariance) * J).reshape(*J.shape[:-2], len(JOINTS), -1).sum(axis=-1) / 3)


def directions(skeleton: Skeleton, poses: Float) -> Float:
    """Return (..., J, 3) the direction, relative to the trunk, of the bone that each joint turns with, at poses
    (..., D); zero for the trunk's own joints."""
    x = skeleton.joints(poses)
    bones = (x[..., _TO, :] - x[..., _FROM, :]) @ skeleton.segment_transforms(poses)[..., _TRUNK, :3, :3]
    result = np.zeros(x.shape)
    result[..., _TURNED, :] = bones / np.linalg.norm(bones, axis=-1, keepdims=True)
    return result


def posture_variance(skeleton: Skeleton, poses: Float, mean: Float) -> Float:
    """Return (..., J) variance of the joints' offsets along an axis, metres², at poses (..., D).

    Args:
        mean: (J, 3) mean or median of :func:`directions` over the recording.
    """
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    turned = directions(skeleton, poses) - mean / np.where(length > 0, length, 1.0)
    bent = (np.asarray(poses)[..., skeleton.is_waist] ** 2).sum(axis=-1, keepdims=True)
    return np.asarray(OFFSET_M**2 * (turned**2).sum(axis=-1) + BENT_M**2 * bent * _WITH_SPINE)
