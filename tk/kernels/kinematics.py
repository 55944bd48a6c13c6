"""Forward kinematics of a tree of twists, as Taichi functions for the kernels that need it.

Layout: ``frames (C, D, 12)`` holds the 3×4 transform after each degree of freedom, row by row; ``twists (C, D, 6)`` its
world twist (ω, v): a point x below it moves at ω × x + v. C are scratch rows, one a parallel task, so that no task
waits for another.

The shoulder girdle has no degree of freedom of its own, but the shoulder rises as the arm does. So the first degree of
freedom of a shoulder may carry a translation ``rise · u`` before its rotation, with u the sine of the arm's elevation
over the horizontal in the trunk's frame, which its own angle and the next one make (:data:`ARM_UP`).
"""

import functools

import numpy as np

from tk.kernels.runtime import ensure_runtime, ti

# The arm's elevation u from a shoulder's first two angles, the arm being level in the zero configuration:
# u = ARM_UP[0] cos(second) sin(first) + ARM_UP[1] sin(second).
ARM_UP = (-np.sqrt(2 / 3), np.sqrt(1 / 3))
# Columns of ``point``: the point, and the rise where there is one.
RISE = 3


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
def load_vector3(array: ti.template(), i: int):
    return ti.Vector([array[i, 0], array[i, 1], array[i, 2]])


@ti.func
def rodrigues(w, angle):
    """exp of the skew matrix of ``angle·w``, with w a unit axis."""
    s, c = ti.sin(angle), ti.cos(angle)
    K = ti.Matrix([[0.0 * s, -w[2], w[1]], [w[2], 0.0 * s, -w[0]], [-w[1], w[0], 0.0 * s]])
    eye = ti.Matrix(
        [[1.0 + 0.0 * s, 0.0 * s, 0.0 * s], [0.0 * s, 1.0 + 0.0 * s, 0.0 * s], [0.0 * s, 0.0 * s, 1.0 + 0.0 * s]]
    )
    return eye + s * K + (1.0 - c) * (K @ K)


@ti.func
def _rises(point: ti.template(), k: int):
    return point[k, RISE] != 0.0 or point[k, RISE + 1] != 0.0 or point[k, RISE + 2] != 0.0


@ti.func
def forward(
    axis: ti.template(),  # (D, 3)
    point: ti.template(),  # (D, 3), or (D, 6) with the rise
    prismatic: ti.template(),  # (D,) 0 or 1
    parent: ti.template(),  # (D,)
    pose: ti.template(),  # (B, D)
    b: int,
    c: int,
    frames: ti.template(),  # (C, D, 12) out
    twists: ti.template(),  # (C, D, 6) out
):
    """Fill row c of the scratch with the tree at pose b. Parents come before children."""
    for k in range(axis.shape[0]):
        w = load_vector3(axis, k)
        q = load_vector3(point, k)
        zero = pose[b, k] * 0.0
        R = ti.Matrix([[1.0 + zero, zero, zero], [zero, 1.0 + zero, zero], [zero, zero, 1.0 + zero]])
        t = ti.Vector([zero, zero, zero])
        if parent[k] >= 0:
            R = load_rotation(frames, c, parent[k])
            t = load_translation(frames, c, parent[k])
        w_world = R @ w
        q_world = R @ q + t
        rate = q_world * zero
        if point.shape[1] > 3:
            first, second = k, k + 1
            above = R
            if parent[k] >= 0 and _rises(point, parent[k]):
                first, second = parent[k], k
                above = load_rotation(frames, c, parent[first])
            if _rises(point, first):
                rise = above @ ti.Vector([point[first, RISE + i] for i in ti.static(range(3))])
                # of the pose's precision, which a literal need not have
                a, d = -ti.sqrt((zero + 2.0) / 3.0), ti.sqrt((zero + 1.0) / 3.0)
                s1, c1 = ti.sin(pose[b, first]), ti.cos(pose[b, first])
                s2, c2 = ti.sin(pose[b, second]), ti.cos(pose[b, second])
                if first == k:
                    q_world += (a * c2 * s1 + d * s2) * rise
                    rate = a * c2 * c1 * rise
                else:
                    rate = (d * c2 - a * s2 * s1) * rise
        v_world = w_world
        if prismatic[k] == 1:
            t += w_world * pose[b, k]
            w_world = w_world * 0.0
        else:
            R = R @ rodrigues(w, pose[b, k])
            t = q_world - R @ q
            v_world = q_world.cross(w_world) + rate
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                frames[c, k, 4 * i + j] = R[i, j]
            frames[c, k, 4 * i + 3] = t[i]
            twists[c, k, i] = w_world[i]
            twists[c, k, 3 + i] = v_world[i]


@ti.func
def point_velocity(prismatic: ti.template(), twists: ti.template(), c: int, k: int, x):
    """∂x/∂p_k of a point x below degree of freedom k (silhouette paper, eq. 6)."""
    w = ti.Vector([twists[c, k, 0], twists[c, k, 1], twists[c, k, 2]])
    return w.cross(x) + ti.Vector([twists[c, k, 3], twists[c, k, 4], twists[c, k, 5]])


@functools.cache
def _place_kernel(real):
    @ti.kernel
    def place(
        axis: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        point: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        prismatic: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        parent: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        local: ti.types.ndarray(dtype=real, ndim=2),  # (N, 3)
        last_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        frames: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 12) scratch
        twists: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 6) scratch
        world: ti.types.ndarray(dtype=real, ndim=3),  # (B, N, 3) out
    ):
        for b in range(pose.shape[0]):
            forward(axis, point, prismatic, parent, pose, b, b, frames, twists)
            for n in range(local.shape[0]):
                k = last_dof[n]
                x = load_rotation(frames, b, k) @ load_vector3(local, n) + load_translation(frames, b, k)
                for i in ti.static(range(3)):
                    world[b, n, i] = x[i]

    return place


def place(
    axis: np.ndarray,
    point: np.ndarray,
    prismatic: np.ndarray,
    parent: np.ndarray,
    local: np.ndarray,
    last_dof: np.ndarray,
    pose: np.ndarray,
) -> np.ndarray:
    """Points of the zero configuration carried to B poses.

    Args:
        axis: (D, 3), point: (D, 3) or (D, 6), twists in the zero configuration; prismatic, parent: (D,).
        local: (N, 3) points, metres; last_dof: (N,) the last degree of freedom above each.
        pose: (B, D), float32 or float64: the precision of the computation.

    Returns:
        (B, N, 3) world points, metres.
    """
    ensure_runtime()
    dtype = pose.dtype
    real = ti.f64 if dtype == np.float64 else ti.f32
    B, D = pose.shape
    world = np.empty((B, len(local), 3), dtype)
    _place_kernel(real)(
        *(np.ascontiguousarray(a, dtype) for a in (axis, point)),
        np.ascontiguousarray(prismatic, np.int32),
        np.ascontiguousarray(parent, np.int32),
        np.ascontiguousarray(local, dtype),
        np.ascontiguousarray(last_dof, np.int32),
        np.ascontiguousarray(pose),
        np.empty((B, D, 12), dtype),
        np.empty((B, D, 6), dtype),
        world,
    )
    return world
