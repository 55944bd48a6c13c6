"""Rotations as matrices, quaternions (w, x, y, z) and successive turns about axes; all vectorised over leading axes."""

from __future__ import annotations

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

Float = NDArray[np.float64]

# Below this sine of the middle angle the first and the last turn are the same: all is given to the last.
_SINGULAR = 1e-7
# Cosine of the middle angle, 10° from the singularity, below which changes are damped, and weight of a change relative
# to an error of the rotation. An arm held level to the side with 0.5° of noise then keeps its angles within 1° (without
# damping they jump by 88°) at errors of up to 1°; with twice the weight, errors reach 3.5°.
_NEAR_SINGULAR, _DAMPING = np.sin(np.radians(10.0)), 0.1
# Gauss-Newton steps: enough to converge from the last frame's angles. The first frame is followed so many times: its
# damped changes then come to an end, unless it is within about a degree of the singularity.
_DAMPED_STEPS = 20


def to_quaternions(R: Float) -> Float:
    """Return unit quaternions (..., 4), w, x, y, z, of rotations (..., 3, 3); w is not negative."""
    R = np.asarray(R)
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    # 4 q qᵀ: each row is a multiple of the quaternion, that with the largest diagonal entry is the most exact
    q = np.empty((*R.shape[:-2], 4, 4))
    q[..., 0, 0] = 1 + diagonal.sum(axis=-1)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        q[..., 1 + i, 1 + i] = 1 + diagonal[..., i] - diagonal[..., j] - diagonal[..., k]
        q[..., 0, 1 + i] = q[..., 1 + i, 0] = R[..., k, j] - R[..., j, k]
        q[..., 1 + i, 1 + j] = q[..., 1 + j, 1 + i] = R[..., i, j] + R[..., j, i]
    largest = np.diagonal(q, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(q, largest[..., None, None], axis=-2)[..., 0, :]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def to_matrices(quaternions: Float) -> Float:
    """Return rotations (..., 3, 3) of quaternions (..., 4), w first, of any length but 0."""
    q = np.asarray(quaternions)
    w, v = q[..., 0, None, None], q[..., 1:]
    squares = q[..., None, :] @ q[..., None]
    across = np.cross(v[..., None, :], np.eye(3)).swapaxes(-1, -2)  # v × e, by columns
    R = (w * w - v[..., None, :] @ v[..., None]) * np.eye(3) + 2 * (v[..., None] * v[..., None, :] + w * across)
    return np.asarray(R / squares)


def continuous(quaternions: Float) -> Float:
    """Return quaternions (F, ..., 4) over time, each with the sign that brings it nearer to the one before."""
    turns_back = (quaternions[1:] * quaternions[:-1]).sum(axis=-1) < 0
    signs = np.cumprod(np.where(turns_back, -1.0, 1.0), axis=0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[..., None]])


def turn(axis: str, angle: Float) -> Float:
    """Return the rotation (..., 3, 3) by ``angle`` (...), radians, about the axis "x", "y" or "z"."""
    k = "xyz".index(axis)
    i, j = (k + 1) % 3, (k + 2) % 3
    R = np.zeros((*np.shape(angle), 3, 3))
    R[..., k, k] = 1.0
    R[..., i, i] = R[..., j, j] = np.cos(angle)
    R[..., j, i] = np.sin(angle)
    R[..., i, j] = -np.sin(angle)
    return R


def half_turn(axis: Float) -> Float:
    """Return the rotation (..., 3, 3) by 180° about an axis (..., 3) of any length."""
    axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    return np.asarray(2 * axis[..., :, None] * axis[..., None, :] - np.eye(3))


def compose(sequence: str, angles: Float) -> Float:
    """Return rotations (..., 3, 3) of angles (..., 3), radians, about moving axes: "zxy" is Rz Rx Ry."""
    first, second, third = (turn(axis, angles[..., k]) for k, axis in enumerate(sequence))
    return first @ second @ third


def decompose(sequence: str, R: Float) -> Float:
    """Return angles (..., 3), radians, the inverse of :func:`compose` for the sequences "zxy", "yxz" and "yxy".

    The middle angle lies within ±90°, or for "yxy" within -180° and 0. Where it is at an end of that range only the sum
    or difference of the others is determined; the first is then 0.
    """
    if sequence == "zxy":
        sine, first, third = R[..., 2, 1], (-R[..., 0, 1], R[..., 1, 1]), (-R[..., 2, 0], R[..., 2, 2])
        alone = np.arctan2(R[..., 0, 2], R[..., 0, 0])
    elif sequence == "yxz":
        sine, first, third = -R[..., 1, 2], (R[..., 0, 2], R[..., 2, 2]), (R[..., 1, 0], R[..., 1, 1])
        alone = np.arctan2(-R[..., 0, 1], R[..., 0, 0])
    elif sequence == "yxy":
        sine, first, third = R[..., 1, 1], (-R[..., 0, 1], -R[..., 2, 1]), (-R[..., 1, 0], R[..., 1, 2])
        alone = np.arctan2(R[..., 0, 2], R[..., 0, 0])
    else:
        raise ValueError(f"sequence {sequence} is none of zxy, yxz, yxy")
    cosine = np.hypot(*first)
    middle = -np.arctan2(cosine, sine) if sequence == "yxy" else np.arctan2(sine, cosine)
    singular = cosine < _SINGULAR
    return np.stack(
        [np.where(singular, 0.0, np.arctan2(*first)), middle, np.where(singular, alone, np.arctan2(*third))], axis=-1
    )


def follow(angles: Float) -> Float:
    """Return angles (F, 3), radians, about three different axes, rewritten so that each frame is near to the last.

    (a, b, c) is the same rotation as (a + π, π - b, c + π), and each angle may have whole turns added. Euler angles
    that are to be looked at, or interpolated, must not jump between these.
    """
    result = np.array(angles, dtype=np.float64)
    for f in range(1, len(result)):
        result[f] = _nearest(result[f], result[f - 1])
    return result


def _nearest(angles: Float, near: Float) -> Float:
    """Return the angles (3,) of the same rotation that are nearest to others (3,)."""
    a, b, c = angles
    found = np.array([[a, b, c], [a + np.pi, np.pi - b, c + np.pi]])
    found -= 2 * np.pi * np.round((found - near) / (2 * np.pi))
    return np.asarray(found[np.abs(found - near).sum(axis=1).argmin()])


def follow_rotations(sequence: str, R: Float) -> Float:
    """Return angles (F, 3) of rotations (F, 3, 3), radians, about three different axes, that change little by frame.

    They follow as in :func:`follow`; of the equivalent sequences, that with medians near zero is returned. Near the
    singular middle angle of ±90° only the sum or difference of the first and the last is determined well, and noise
    turns both by large, opposite angles. There, the change since the last frame is damped, at the expense of an error
    of the rotation (Nakamura & Hanafusa, J. Dyn. Syst. Meas. Control 108 (1986) 163-171, section 5). Everywhere else
    the angles are exact. If the first frame is near the singularity, its angles are found backward from the first exact
    ones, and then converge, so that a person who begins at rest has constant angles.
    """
    axes = [np.eye(3)["xyz".index(axis)] for axis in sequence]
    exact = decompose(sequence, R)
    result, last = np.empty_like(exact), np.zeros(3)
    regular = np.flatnonzero(np.abs(np.cos(exact[:, 1])) >= _NEAR_SINGULAR)
    begin = int(regular[0]) if len(regular) else len(exact) - 1
    for f in (*range(begin, 0, -1), *[0] * _DAMPED_STEPS, *range(len(exact))):
        angles = _nearest(exact[f], last)
        cosine = np.cos(angles[1])
        if abs(cosine) < _NEAR_SINGULAR:
            damping = _DAMPING**2 * (1 - (cosine / _NEAR_SINGULAR) ** 2)
            angles = last
            for _ in range(_DAMPED_STEPS):
                third, second = turn(sequence[2], angles[2]), turn(sequence[1], angles[1])
                J = np.column_stack([third.T @ second.T @ axes[0], third.T @ axes[1], axes[2]])
                error = scipy.spatial.transform.Rotation.from_matrix(compose(sequence, angles).T @ R[f]).as_rotvec()
                H = J.T @ J + damping * np.eye(3)
                angles = angles + np.linalg.solve(H, J.T @ error - damping * (angles - last))
        result[f] = last = angles
    mirrored = result * [1.0, -1.0, 1.0] + np.pi
    choices = [angles - 2 * np.pi * np.round(np.median(angles, axis=0) / (2 * np.pi)) for angles in (result, mirrored)]
    return min(choices, key=lambda angles: float(np.abs(np.median(angles, axis=0)).sum()))
