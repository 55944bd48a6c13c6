"""Forward kinematics of a tree of twists, as Taichi functions for the kernels that need it.

A tree is one array ``(D, 11)``, see :func:`pack_tree`. ``joints (C, D, 18 or more)`` receives for each degree of
freedom the 3×4 transform after it, row by row, and its world twist (ω, v): a point x below moves at ω × x + v. C are
scratch rows, one a parallel task, so that no task waits for another.

The shoulder girdle has no degree of freedom of its own, but the shoulder rises as the arm does. So the first degree of
freedom of a shoulder may carry a translation ``rise · u`` before its rotation, with u the sine of the arm's elevation
over the horizontal in the trunk's frame, which follows from its own angle and the next one (:data:`ARM_UP`).
"""

import numpy as np

from tk.kernels.columns import SCALAR, SPATIAL, TRANSFORM, VECTOR, columns
from tk.kernels.runtime import ti
from tk.kernels.vectors import cross, norm_sqr, product, times, triple

# The arm's elevation u from a shoulder's first two angles, the arm being level in the zero configuration:
# u = ARM_UP[0] cos(second) sin(first) + ARM_UP[1] sin(second).
ARM_UP = (-np.sqrt(2 / 3), np.sqrt(1 / 3))
# Columns of a tree: axis, point, rise, 1 where prismatic, parent.
_AXIS, TREE_POINT, TREE_RISE, TREE_PRISMATIC, TREE_PARENT, _ = columns(VECTOR, VECTOR, VECTOR, SCALAR, SCALAR)
# Columns of ``joints``.
_FRAME, TWIST, JOINT_NUMBERS = columns(TRANSFORM, SPATIAL)


def pack_tree(
    axis: np.ndarray, point: np.ndarray, rise: np.ndarray, prismatic: np.ndarray, parent: np.ndarray
) -> np.ndarray:
    """Pack a tree into one array (D, 11), float64.

    Args:
        axis: (D, 3) of the twists in the zero configuration.
        point: (D, 3) on the axes, metres.
        rise: (D, 3) metres, see the module.
        prismatic: (D,) 1 for a translation along the axis.
        parent: (D,) index of the degree of freedom above, -1 at the root.
    """
    return np.column_stack([axis, point, rise, prismatic, parent]).astype(np.float64)


@ti.func
def load_rotation(frames: ti.template(), c: int, k: int):
    return ti.Matrix(
        [
            [frames[c, k, 0], frames[c, k, 1], frames[c, k, 2]],
            [frames[c, k, 4], frames[c, k, 5], frames[c, k, 6]],
            [frames[c, k, 8], frames[c, k, 9], frames[c, k, 10]],
        ]
    )


@ti.func
def load_translation(frames: ti.template(), c: int, k: int):
    return ti.Vector([frames[c, k, 3], frames[c, k, 7], frames[c, k, 11]])


@ti.func
def store_frame(frames: ti.template(), c: int, k: int, R, t):
    """Store rotation and translation of a 3×4 transform in the first 12 columns of row (c, k)."""
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            frames[c, k, 4 * i + j] = R[i, j]
        frames[c, k, 4 * i + 3] = t[i]


@ti.func
def rotation_of(array: ti.template(), i: int, first: ti.template()):
    """Return the rotation (3, 3) of the 3×4 transform in row i, from column ``first`` on."""
    return ti.Matrix([[array[i, first + 4 * a + b] for b in ti.static(range(3))] for a in ti.static(range(3))])


@ti.func
def translation_of(array: ti.template(), i: int, first: ti.template()):
    """Return the translation (3,) of the same."""
    return ti.Vector([array[i, first + 4 * a + 3] for a in ti.static(range(3))])


@ti.func
def carried(joints: ti.template(), c: int, k: int, array: ti.template(), i: int, first: ti.template()):
    """Return rotation and translation to the world of what degree of freedom k carries; its transform to the zero
    configuration is that of :func:`rotation_of`."""
    R = load_rotation(joints, c, k)
    t = times(R, translation_of(array, i, first)) + load_translation(joints, c, k)
    return product(R, rotation_of(array, i, first)), t


@ti.func
def parent_of(tree: ti.template(), k: int):
    """Return the degree of freedom above k, or -1."""
    return ti.cast(tree[k, TREE_PARENT], ti.i32)


@ti.func
def rodrigues(w, angle):
    """Return the exponential of the skew matrix of ``angle·w``, with w a unit axis."""
    s, c = ti.sin(angle), ti.cos(angle)
    K = ti.Matrix([[0.0 * s, -w[2], w[1]], [w[2], 0.0 * s, -w[0]], [-w[1], w[0], 0.0 * s]])
    eye = ti.Matrix(
        [[1.0 + 0.0 * s, 0.0 * s, 0.0 * s], [0.0 * s, 1.0 + 0.0 * s, 0.0 * s], [0.0 * s, 0.0 * s, 1.0 + 0.0 * s]]
    )
    return eye + s * K + (1.0 - c) * product(K, K)


@ti.func
def _place_joint(
    tree: ti.template(),  # (D, 11)
    pose: ti.template(),  # (B, D)
    b: int,
    c: int,
    k: int,
    joints: ti.template(),  # (C, D, 18 or more) out
):
    """Place degree of freedom k at pose b, in row c of the scratch."""
    up = parent_of(tree, k)
    # the rise of the shoulder that k belongs to, and that shoulder's first degree of freedom
    first = k
    rise = triple(tree, k, TREE_RISE)
    if up >= 0:
        rise_above = triple(tree, up, TREE_RISE)
        if norm_sqr(rise_above) > 0.0:
            first, rise = up, rise_above
    zero = pose[b, k] * 0.0
    R = ti.Matrix([[1.0 + zero, zero, zero], [zero, 1.0 + zero, zero], [zero, zero, 1.0 + zero]])
    t = ti.Vector([zero, zero, zero])
    if up >= 0:
        R = load_rotation(joints, c, up)
        t = load_translation(joints, c, up)
    w, q = triple(tree, k, 0), triple(tree, k, TREE_POINT)
    w_world = times(R, w)
    q_world = times(R, q) + t
    rate = q_world * zero
    if rise[0] != 0.0 or rise[1] != 0.0 or rise[2] != 0.0:
        second = ti.select(first == k, k + 1, k)
        lifted = times(R, rise)
        above = parent_of(tree, first)
        if first != k and above >= 0:
            lifted = times(load_rotation(joints, c, above), rise)
        # ARM_UP in the pose's precision, which a literal need not have
        a, d = -ti.sqrt((zero + 2.0) / 3.0), ti.sqrt((zero + 1.0) / 3.0)
        s1, c1 = ti.sin(pose[b, first]), ti.cos(pose[b, first])
        s2, c2 = ti.sin(pose[b, second]), ti.cos(pose[b, second])
        if first == k:
            q_world += (a * c2 * s1 + d * s2) * lifted
            rate = a * c2 * c1 * lifted
        else:
            rate = (d * c2 - a * s2 * s1) * lifted
    v_world = w_world
    if ti.cast(tree[k, TREE_PRISMATIC], ti.i32) == 1:
        t += w_world * pose[b, k]
        w_world = w_world * 0.0
    else:
        R = product(R, rodrigues(w, pose[b, k]))
        t = q_world - times(R, q)
        v_world = cross(q_world, w_world) + rate
    store_frame(joints, c, k, R, t)
    for i in ti.static(range(3)):
        joints[c, k, TWIST + i] = w_world[i]
        joints[c, k, TWIST + 3 + i] = v_world[i]


@ti.func
def forward_tree(tree: ti.template(), pose: ti.template(), b: int, c: int, joints: ti.template()):
    """Place all degrees of freedom at pose b, in row c of ``joints``. Parents come before children."""
    for k in range(tree.shape[0]):
        _place_joint(tree, pose, b, c, k, joints)


@ti.func
def forward_chain(
    tree: ti.template(),
    chain: ti.template(),  # (N,) degrees of freedom, ascending, with all their ancestors
    pose: ti.template(),
    b: int,
    c: int,
    joints: ti.template(),
):
    """Place some degrees of freedom only, see :func:`forward_tree`."""
    for n in range(chain.shape[0]):
        _place_joint(tree, pose, b, c, chain[n], joints)
