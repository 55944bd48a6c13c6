"""Standard deviation of each joint's position: from the contours' noise, the views, and the posture.

Three things cause a joint's error. First, contours err by some pixels; the curvature at the optimum gives the effect on
a joint. Second, clothes and the choice between edges displace a bone's contours in a view as a whole; several views at
large angles average this and contradict a wrong choice, two views along the same line do neither. Third, no joint of a
person is a hinge at a point: the model's joint differs from the anatomical one by about a
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

# Displacement of a bone's contours in one view, metres, and how far a joint can be from its place if no view shows it
# (the length of a bone), metres. Fitted on walk, dance, fold, cube, hd and treadmill-slow: with 5 or more, 3 and 2
# cameras 75, 78, 85 % of the errors lie within 1 σ and 93, 93, 96 % within 2 σ; without this term 72, 69, 65 % and 91,
# 89, 86 %. With two cameras that face each other 95 % instead of 63 % lie within 1 σ. With 0.01 or 0.02 m these shares
# change by up to 4 %.
VIEW_M, REACH_M = 0.015, 0.3

# The bone that each joint turns with, by the joints at its ends; the trunk's own joints have none.
_BONES = {b: (a, b) for a, b in BONES if ROWS[a].chain and ROWS[a].chain == ROWS[b].chain}
_BONES |= {start: (start, middle) for start, middle, _ in LIMBS.values()}
_TURNED = np.array([JOINTS.index(name) for name in _BONES])
_FROM = np.array([JOINTS.index(start) for start, _ in _BONES.values()])
_TO = np.array([JOINTS.index(end) for _, end in _BONES.values()])
_TRUNK = SEGMENTS.index("torso")


def contour_variance(skeleton: Skeleton, pose: Float, covariance: Float) -> Float:
    """Return (..., J) variance of the joints' positions along an axis, metres², from the contours' noise.

    Args:
        skeleton: of D degrees of freedom.
        pose: (..., D).
        covariance: (..., D, D) of the pose.
    """
    J = skeleton.joint_jacobian(pose)  # (..., J, 3, D)
    J = J.reshape(*J.shape[:-3], -1, J.shape[-1])
    return np.asarray(((J @ covariance) * J).reshape(*J.shape[:-2], len(JOINTS), -1).sum(axis=-1) / 3)


def view_variance(rays: Float, shares: Float, view_m: float = VIEW_M) -> Float:
    """Return (..., J) variance of the joints' positions along the direction that the views determine least, metres²;
    NaN for a joint whose rays are not finite.

    A view measures a joint's position across its ray only, and only as far as it shows the joint's bones. Priors and
    motion are no evidence of a position, so they do not count. This is the covariance of triangulation with weights
    (Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., section 12.6), minus that of one full view across each
    direction: three cameras around the person give as much, and the contours' noise covers it.

    Args:
        rays: (..., V, J, 3) unit vectors between the cameras and the joints.
        shares: (..., V, J) how much of the joint's bones a view shows, 0 to 1; 0 for a view that was not used.
        view_m: displacement of a bone's contours in one view, metres, :data:`VIEW_M` if the cameras are correct.
    """
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    information = (VIEW_M / view_m) ** 2 * (shares[..., None, None] * across).sum(axis=-4)
    information += (VIEW_M / REACH_M) ** 2 * np.eye(3)
    known = np.isfinite(information).all(axis=(-1, -2))
    least = np.linalg.eigvalsh(np.where(known[..., None, None], information, np.eye(3)))[..., 0]
    return np.where(known, VIEW_M**2 * np.maximum(1.0 / least - 1.0, 0.0), np.nan)


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
    return np.asarray(OFFSET_M**2 * (turned**2).sum(axis=-1) + BENT_M**2 * bent)
