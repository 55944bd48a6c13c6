"""Landmarks in images, compared with the points of a body that they mark: likelihood, and information about the points.

The model is that of :mod:`tk.model.cues.landmarks`. A *place* is a landmark's point, or a bone between two of them, of
which images show the depth. In each image each half of the body is a mixture of two assignments: landmarks as they are
named, and with left and right exchanged. An image shows a point's position across the ray: with the point at (u, v) on
the plane at distance 1, the derivatives are the rows (1, 0, -u) and (0, 1, -v) in the camera's frame.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.columns import SCALAR, TRANSFORM, VECTOR, columns
from tk.kernels.kinematics import JOINT_NUMBERS, TWIST, forward_tree, load_rotation, load_translation, parent_of
from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.taichi_internals import Launcher
from tk.kernels.vectors import cross, dot, times, triple, triple_in

Float = NDArray[np.float64]

# Columns of ``numbers``: density of a wrong landmark (1/m²) or depth (1/m), probability that left and right of a half
# are exchanged in an image, logarithms of the probabilities that an image shows the person and somebody else, factor of
# the precisions, share of the likelihood that counts, least depth, metres, and 2π in full precision.
WRONG, EXCHANGED, SHOWN, ELSEWHERE, PRECISION, INDEPENDENT, NEAREST, TURN = range(8)
# Columns of ``cameras``: 3×4 transform, direction to the person. Of ``points``: place, the last degree of freedom above
# it. Of ``bones``: the landmarks at both ends, and the share of the depth that is seen.
_FRAME, _SIGHT, _ = columns(TRANSFORM, VECTOR)
_PLACE, _DOF, _ = columns(VECTOR, SCALAR)
_FROM, _TO, _SHARE = range(3)
# Place of each element of a symmetric matrix (3, 3) in its upper triangle, row by row.
_UPPER = (0, 1, 2), (1, 3, 4), (2, 4, 5)


class LandmarkArrays(NamedTuple):
    """Landmarks of one person in V images of F frames: L landmarks, K bones, N = L + K places."""

    tree: Float  # (D, 11) of :func:`tk.kernels.kinematics.pack_tree`
    points: Float  # (L, 4) the body's points, metres, and the last degree of freedom above each
    bones: Float  # (K, 3) the landmarks at both ends, and the share of the depth between them that is seen
    half: NDArray[np.int32]  # (N,) 0 or 1, the half of the body of each place
    cameras: Float  # (F, V, 15) 3×4 transforms from the world, and directions to the person
    # (F, V, 2, L, 4) x and y on the plane at distance 1, probability of being right, and 1/variance, 1/m², as named and
    # exchanged
    marks: Float
    depths: Float  # (F, V, 2, K, 3) depth, metres, probability of being right, and 1/variance, 1/m²
    offset: Float  # (F, N) variance of a place's offset along an axis, metres²


@ti.func
def _mark(cameras: ti.template(), marks: ti.template(), numbers: ti.template(), f: int, v: int, a: int, i: int, x):
    """Compare landmark i of image v, assignment a, with a point x. Return the likelihood relative to that of a wrong
    landmark, the weight, 1/m², the distances along x and y, metres, and the point on the plane at distance 1."""
    q = times(load_rotation(cameras, f, v), x) + load_translation(cameras, f, v)
    right, weight = marks[f, v, a, i, 2], numbers[PRECISION] * marks[f, v, a, i, 3]
    if q[2] <= numbers[NEAREST]:
        q[2] = 1.0
        right = 0.0
    dx, dy = marks[f, v, a, i, 0] * q[2] - q[0], marks[f, v, a, i, 1] * q[2] - q[1]
    inside = right * weight / numbers[TURN] * ti.exp(-0.5 * weight * (dx * dx + dy * dy))
    both = inside + (1.0 - right) * numbers[WRONG]
    return ti.Vector([both / numbers[WRONG], inside / both * weight, dx, dy, q[0] / q[2], q[1] / q[2]])


@ti.func
def _depth(
    cameras: ti.template(), depths: ti.template(), bones: ti.template(), numbers: ti.template(), f: int, v: int, a: int,
    k: int, x: ti.template(), b: int, first: int,
):  # fmt: skip
    """Compare the depth of bone k, as :func:`_mark` does, with the landmarks' points in row b of x, from ``first`` on:
    likelihood, weight and distance."""
    start, end = ti.cast(bones[k, _FROM], ti.i32), ti.cast(bones[k, _TO], ti.i32)
    bone = bones[k, _SHARE] * (triple_in(x, b, first + end, 0) - triple_in(x, b, first + start, 0))
    right, weight = depths[f, v, a, k, 1], numbers[PRECISION] * depths[f, v, a, k, 2]
    away = depths[f, v, a, k, 0] - dot(triple_in(cameras, f, v, _SIGHT), bone)
    inside = right * ti.sqrt(weight / numbers[TURN]) * ti.exp(-0.5 * weight * away * away)
    both = inside + (1.0 - right) * numbers[WRONG]
    return ti.Vector([both / numbers[WRONG], inside / both * weight, away])


@ti.func
def _likelihood(
    bones: ti.template(), half: ti.template(), cameras: ti.template(), marks: ti.template(), depths: ti.template(),
    numbers: ti.template(), f: int, b: int, x: ti.template(), first: int, named: ti.template(),
):  # fmt: skip
    """Return the negative logarithm of the likelihood of all landmarks if they were independent, with the points in row
    b of x, from ``first`` on; ``named`` (B, V, 2, 2) receives the probability that an image shows the person, with
    assignment a of a half."""
    L, cost = marks.shape[3], 0.0 * numbers[0]
    for v in range(cameras.shape[1]):
        for a in range(2):
            for h in range(2):
                named[b, v, a, h] = numbers[EXCHANGED] if a == 1 else 1.0 - numbers[EXCHANGED]
            for i in range(L):
                m = _mark(cameras, marks, numbers, f, v, a, i, triple_in(x, b, first + i, 0))
                named[b, v, a, half[i]] = named[b, v, a, half[i]] * m[0]
            for k in range(bones.shape[0]):
                m = _depth(cameras, depths, bones, numbers, f, v, a, k, x, b, first)
                named[b, v, a, half[L + k]] = named[b, v, a, half[L + k]] * m[0]
        upper, lower = named[b, v, 0, 0] + named[b, v, 1, 0], named[b, v, 0, 1] + named[b, v, 1, 1]
        person, other = ti.log(upper) + ti.log(lower) + numbers[SHOWN], numbers[ELSEWHERE]
        most = ti.max(person, other)
        total = most + ti.log(ti.exp(person - most) + ti.exp(other - most))
        shown = ti.exp(person - total)
        for a in range(2):
            named[b, v, a, 0] = named[b, v, a, 0] / upper * shown
            named[b, v, a, 1] = named[b, v, a, 1] / lower * shown
        cost -= total
    return cost


@ti.func
def _say(
    bones: ti.template(), half: ti.template(), cameras: ti.template(), marks: ti.template(), depths: ti.template(),
    numbers: ti.template(), f: int, b: int, n: int, x: ti.template(), named: ti.template(),
):  # fmt: skip
    """Return the information about place n, and its product with the distance to the landmarks: (3, 3) and (3,) in nine
    numbers, the upper triangle row by row first."""
    L, zero = marks.shape[3], 0.0 * numbers[0]
    found = ti.Vector([zero for _ in range(9)])
    for v in range(cameras.shape[1]):
        for a in range(2):
            # two rows of derivatives, with their distances; a bone has one
            w, first, second = named[b, v, a, half[n]], ti.Vector([zero, zero, zero]), ti.Vector([zero, zero, zero])
            d = ti.Vector([zero, zero])
            if n < L:
                m = _mark(cameras, marks, numbers, f, v, a, n, triple_in(x, b, n, 0))
                R = load_rotation(cameras, f, v)
                first = ti.Vector([R[0, i] - m[4] * R[2, i] for i in ti.static(range(3))])
                second = ti.Vector([R[1, i] - m[5] * R[2, i] for i in ti.static(range(3))])
                d = ti.Vector([m[2], m[3]])
                w *= m[1]
            else:
                m = _depth(cameras, depths, bones, numbers, f, v, a, n - L, x, b, 0)
                first = triple_in(cameras, f, v, _SIGHT)
                d = ti.Vector([m[2], zero])
                w *= m[1]
            for i in ti.static(range(3)):
                found[6 + i] += w * (d[0] * first[i] + d[1] * second[i])
                for j in ti.static(range(i, 3)):
                    found[_UPPER[i][j]] += w * (first[i] * first[j] + second[i] * second[j])
    return found


@ti.func
def _inverse(W, variance):
    """Return the inverse of 1 + variance · W, both upper triangles of symmetric matrices, and its determinant."""
    a, b, c = 1.0 + variance * W[0], variance * W[1], variance * W[2]
    d, e, f = 1.0 + variance * W[3], variance * W[4], 1.0 + variance * W[5]
    rows = ti.Vector([d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b])
    determinant = a * rows[0] + b * rows[1] + c * rows[2]
    return rows / determinant, determinant


@functools.cache
def _terms_kernel() -> Launcher:
    """Build the kernel. ``scored``: 1 computes the cost, 0 what the landmarks say about the places."""
    Array, f64 = ti.types.ndarray, ti.f64

    @ti.kernel
    def landmark_terms(
        tree: Array(f64, 2), points: Array(f64, 2), bones: Array(f64, 2), half: Array(ti.i32, 1),
        cameras: Array(f64, 3), marks: Array(f64, 5), depths: Array(f64, 5), offset: Array(f64, 2),
        numbers: Array(f64, 1), pose: Array(f64, 2), scored: int, spread: int,
        joints: Array(f64, 3), x: Array(f64, 3), named: Array(f64, 4),
        cost: Array(f64, 1), information: Array(f64, 4), pull: Array(f64, 3), jacobian: Array(f64, 4),
    ):  # fmt: skip
        L, N = points.shape[0], half.shape[0]
        for turn in range(spread * pose.shape[0]):
            if turn % spread != 0:
                continue
            b = turn // spread
            f = b if marks.shape[0] > 1 else 0
            forward_tree(tree, pose, b, b, joints)
            for i in range(L):
                k = ti.cast(points[i, _DOF], ti.i32)
                place = times(load_rotation(joints, b, k), triple(points, i, 0)) + load_translation(joints, b, k)
                for axis in ti.static(range(3)):
                    x[b, i, axis] = place[axis]
                while k >= 0 and scored == 0:
                    moves = cross(triple_in(joints, b, k, TWIST), place) + triple_in(joints, b, k, TWIST + 3)
                    for axis in ti.static(range(3)):
                        jacobian[b, i, axis, k] = moves[axis]
                    k = parent_of(tree, k)
            volume, excess = 0.0 * numbers[0], 0.0 * numbers[0]
            for stage in range(1 + scored):  # the points themselves, then with their offsets
                score = _likelihood(bones, half, cameras, marks, depths, numbers, f, b, x, stage * L, named)
                # where the step leaves a landmark's normal part, it is too long, and no offset is better
                cost[b] = score if stage == 0 else numbers[INDEPENDENT] * (ti.min(excess + score, cost[b]) + volume)
                for n in range((N if scored == 0 else L) * (1 - stage)):
                    W = _say(bones, half, cameras, marks, depths, numbers, f, b, n, x, named)
                    inverse, determinant = _inverse(W, offset[f, n])
                    volume += 0.5 * ti.log(determinant)
                    for i in ti.static(range(3)):
                        rest = 0.0 * volume
                        for m in ti.static(range(3)):
                            rest += inverse[_UPPER[i][m]] * W[6 + m]
                        if scored == 1:
                            x[b, L + n, i] = x[b, n, i] + offset[f, n] * rest
                            excess += 0.5 * offset[f, n] * rest * rest
                        else:
                            pull[b, i, n] = numbers[INDEPENDENT] * rest
                            for j in ti.static(range(3)):  # both matrices are symmetric and commute
                                both = 0.0 * volume
                                for m in ti.static(range(3)):
                                    both += inverse[_UPPER[i][m]] * W[_UPPER[m][j]]
                                information[b, i, j, n] = numbers[INDEPENDENT] * both

    return Launcher(landmark_terms)


def _launch(seen: LandmarkArrays, numbers: Float, poses: Float, scored: bool) -> tuple[Float, Float, Float, Float]:
    ensure_runtime()
    B, D, L, N, V = *poses.shape, len(seen.points), len(seen.half), seen.cameras.shape[1]
    if len(seen.marks) not in (1, B):
        raise ValueError(f"landmarks of {len(seen.marks)} frames, and {B} poses")
    some = 1 if scored else B
    cost, information, pull = np.empty(B), np.empty((some, 3, 3, N)), np.empty((some, 3, N))
    jacobian = np.zeros((some, L, 3, D))
    pose = np.ascontiguousarray(poses, np.float64)
    scratch = np.empty((B, D, JOINT_NUMBERS)), np.empty((B, 2 * L, 3)), np.empty((B, V, 2, 2))
    _terms_kernel()(
        *seen, numbers, pose, int(scored), spread_of(B), *scratch, cost, information, pull, jacobian
    )  # fmt: skip
    return cost, information, pull, jacobian


def landmark_costs(seen: LandmarkArrays, numbers: Float, poses: Float) -> Float:
    """Return (B,) the negative logarithm of the landmarks' likelihood at poses (B, D), nats.

    The offsets are integrated out by Laplace's method, about the offsets that one step of Newton's gives.

    Args:
        seen: of one frame, or of B.
        numbers: the model's numbers, in the order from :data:`WRONG` to :data:`TURN`.
        poses: (B, D).

    Raises:
        ValueError: the landmarks are neither of one frame nor of B.
    """
    return _launch(seen, numbers, poses, True)[0]


def landmark_information(seen: LandmarkArrays, numbers: Float, poses: Float) -> tuple[Float, Float, Float]:
    """Return the information (B, 3, 3, N) of the landmarks about the places at poses (B, D), 1/m², its product
    (B, 3, N) with the distance to the landmarks, 1/m, the offsets integrated out, and the derivatives (B, L, 3, D) of
    the points by the pose. Arguments and errors as for :func:`landmark_costs`."""
    return _launch(seen, numbers, poses, False)[1:]
