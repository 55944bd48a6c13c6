"""Cast a grid of rays at a cone body: the part that each ray meets first and its cost (silhouette paper, eq. 12).

A ray costs column 0 of ``cost`` where it meets nothing, column g + 1 where it meets a part of colour group g (the last
column if there are fewer: two columns suffice without colours). With costs of 0 and 1 taken from the masks, the sum is
the number of wrong pixels, E_S's numerator; costs from colours distinguish a forearm in front of the trunk from one
behind it.

To compare many poses that differ in one limb, the rest is cast once: a launch may start from the labels and depths of
an earlier one, and draw some parts only.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.columns import PAIR, SCALAR, VECTOR, columns
from tk.kernels.cone_arrays import NEAREST_M, PART_DOF, PART_GROUP, ConeArrays, group_of, kind_of, place_part, shape_of
from tk.kernels.cones import capsule, enter_unit, extent, interior_point
from tk.kernels.kinematics import (
    JOINT_NUMBERS,
    TREE_PARENT,
    forward_chain,
    load_rotation,
    load_translation,
    store_frame,
)
from tk.kernels.projection import camera_center, project
from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.taichi_internals import Launcher
from tk.kernels.vectors import norm2, norm_sqr, times

# Safety factors of the capsule that encloses a part in an image, beyond first order: of its radius, and of the distance
# between a distorted axis and its chord, measured at the middle. Too small, and rays miss parts near the border of
# wide-angle images (tested with two such lenses); too large costs time only.
MARGIN, BEND = 1.1, 1.5
# Columns of a part's outline in an image: capsule's begin, axis, radius, and the radius across the axis; then the
# camera's centre in the unit part, and the pixel of the part's middle.
_BEGIN, _AXIS, _RADIUS, _ACROSS, _ORIGIN, _MIDDLE, _COLUMNS = columns(PAIR, PAIR, SCALAR, PAIR, VECTOR, PAIR)
# Columns of the packed settings: see Rays and costs(); 1 to write labels and depths.
_STEP, _MOST_OUTSIDE, _EXPORT = range(3)
# Depth of a ray that meets nothing, far beyond any volume.
FAR = 1e9


class Rays(NamedTuple):
    """A grid of rays through the pixels of V images."""

    cameras: NDArray[np.floating]  # (V, 27) of :func:`tk.kernels.projection.pack_cameras`
    step: int  # pixels between rays; the first goes through pixel ``step // 2``
    directions: NDArray[np.float32]  # (V, H, W, 3) world frame; zero where a camera has no pixel


class Cast(NamedTuple):
    """The part that each ray meets first; with B poses as the first axis."""

    label: NDArray[np.uint8]  # (V, H, W) uint8, 1 + the part's index; 0 where a ray meets nothing
    depth: NDArray[np.float32]  # (V, H, W) float32, in lengths of the ray's direction; `FAR` where a ray meets nothing


@ti.func
def column_of(parts: ti.template(), cost: ti.template(), p: int):
    """Return the column of ``cost`` of a ray that meets part p."""
    return ti.min(group_of(parts, p) + 1, cost.shape[3] - 1)


@ti.func
def _in_row(outline: ti.template(), b: int, v: int, p: int, y: int):
    """Return where a row of an image enters and leaves the capsule that encloses a part; left > right if it misses."""
    radius = outline[b, v, p, _RADIUS]
    left, right = 1e9 + 0.0 * radius, -1e9 + 0.0 * radius
    if radius > 0.0:
        x0, dx, dy = outline[b, v, p, _BEGIN], outline[b, v, p, _AXIS], outline[b, v, p, _AXIS + 1]
        h = y - outline[b, v, p, _BEGIN + 1]
        for end in ti.static(range(2)):
            square = radius * radius - (h - end * dy) ** 2
            if square > 0.0:
                half = ti.sqrt(square)
                left, right = ti.min(left, x0 + end * dx - half), ti.max(right, x0 + end * dx + half)
        if ti.abs(dy) > 1e-6:
            for side in ti.static((-1, 1)):
                share = (h - side * outline[b, v, p, _ACROSS + 1]) / dy
                if share > 0.0 and share < 1.0:
                    x = x0 + side * outline[b, v, p, _ACROSS] + share * dx
                    left, right = ti.min(left, x), ti.max(right, x)
    return left, right


@ti.func
def middle_cost(
    placed_middle,
    cameras: ti.template(),  # (V, 27)
    rays: ti.template(),  # (V, H, W, 3)
    cost: ti.template(),  # (V, H, W, G + 1)
    outline: ti.template(),  # (B, V, P, _COLUMNS)
    b: int,
    v: int,
    p: int,
    column: int,
    step: int,
):
    """Return the cost of the ray nearest to a part's middle, ``column`` instead of nothing, and 1; zeros without a ray.

    Stores the middle's pixel in the outline.
    """
    pixel, _, depth_m = project(cameras, v, placed_middle)
    outline[b, v, p, _MIDDLE], outline[b, v, p, _MIDDLE + 1] = pixel[0], pixel[1]
    i = ti.cast(ti.round((pixel[0] - step // 2) / step), ti.i32)
    j = ti.cast(ti.round((pixel[1] - step // 2) / step), ti.i32)
    more, seen, inside = ti.cast(0.0, ti.f32), 0, 0.0
    if depth_m > NEAREST_M and i >= 0 and j >= 0 and i < cost.shape[2] and j < cost.shape[1]:
        inside = norm_sqr(ti.Vector([rays[v, j, i, a] for a in ti.static(range(3))]))
    if inside > 0.0:
        more = ti.max(cost[v, j, i, column] - cost[v, j, i, 0], 0.0)
        seen = 1
    return more, seen


@ti.func
def enclose_part(
    parts: ti.template(),  # (P, 21)
    placed: ti.template(),  # (B, P, 12)
    cameras: ti.template(),  # (V, 27)
    b: int,
    p: int,
    outline: ti.template(),  # (B, V, P, _COLUMNS) out
):
    """Store the capsule, in pixels, that encloses a part in each image, and the camera in the unit part's frame."""
    kind, shape = kind_of(parts, p), shape_of(parts, p)
    size = extent(kind, shape, 1.0)
    M, t = load_rotation(placed, b, p), load_translation(placed, b, p)
    z0, z1, reach = capsule(kind, shape)
    along_part = ti.Vector([M[2, i] * size[2] for i in ti.static(range(3))])
    for v in range(cameras.shape[0]):
        begin, J0, depth0 = project(cameras, v, t + z0 * along_part)
        end, J1, depth1 = project(cameras, v, t + z1 * along_part)
        radius = 0.0 * depth0
        nearest, farthest = ti.min(depth0, depth1), ti.max(depth0, depth1)
        if nearest > 1.5 * reach + NEAREST_M:
            # the Frobenius norm of the derivative is at least its growth in any direction
            growth = ti.max(J0.norm() * depth0 / (depth0 - reach), J1.norm() * depth1 / (depth1 - reach))
            chord = end - begin
            x = outline[b, v, p, _MIDDLE] - begin[0]
            y = outline[b, v, p, _MIDDLE + 1] - begin[1]
            offset = ti.abs(chord[0] * y - chord[1] * x) / ti.max(norm2(chord), 1e-6)
            radius = MARGIN * growth * reach + BEND * offset
        elif farthest > -reach:
            # the camera is close to the part or inside: all pixels
            radius = 1e6 + 0.0 * radius
            begin *= 0.0
            end = begin
        along = end - begin
        across = radius / ti.max(norm2(along), 1e-6)
        origin = times(M, camera_center(cameras, v) - t)
        outline[b, v, p, _RADIUS] = radius
        outline[b, v, p, _ACROSS], outline[b, v, p, _ACROSS + 1] = across * along[1], -across * along[0]
        for a in ti.static(range(2)):
            outline[b, v, p, _BEGIN + a], outline[b, v, p, _AXIS + a] = begin[a], along[a]
        for a in ti.static(range(3)):
            outline[b, v, p, _ORIGIN + a] = origin[a]


@ti.func
def covered_rows(outline: ti.template(), drawn: ti.template(), b: int, v: int, step: int, H: int):
    """Return the first and the last row of rays that the drawn parts may cover."""
    top, bottom = H, -1
    for k in range(drawn.shape[0]):
        p = drawn[k]
        radius = outline[b, v, p, _RADIUS]
        if radius > 0.0:
            y0 = outline[b, v, p, _BEGIN + 1] - step // 2
            y1 = y0 + outline[b, v, p, _AXIS + 1]
            top = ti.min(top, ti.max(ti.cast(ti.ceil((ti.min(y0, y1) - radius) / step), ti.i32), 0))
            last = ti.cast(ti.floor((ti.max(y0, y1) + radius) / step), ti.i32)
            bottom = ti.max(bottom, ti.min(last, H - 1))
    return top, bottom


@ti.func
def covered_columns(
    outline: ti.template(), drawn: ti.template(), b: int, v: int, j: int, step: int, W: int, stretch: ti.template()
):
    """Store each drawn part's first and last ray of row j, and return the first and last of all."""
    low, high = W, -1
    for k in range(drawn.shape[0]):
        left, right = _in_row(outline, b, v, drawn[k], j * step + step // 2)
        first, last = W, -1
        if left < right:
            first = ti.max(ti.cast(ti.ceil((left - step // 2) / step), ti.i32), 0)
            last = ti.min(ti.cast(ti.floor((right - step // 2) / step), ti.i32), W - 1)
        stretch[b, k, 0], stretch[b, k, 1] = first, last
        low, high = ti.min(low, first), ti.max(high, last)
    return low, high


@ti.func
def first_part(
    parts: ti.template(),  # (P, 21)
    placed: ti.template(),  # (B, P, 12)
    outline: ti.template(),  # (B, V, P, _COLUMNS)
    stretch: ti.template(),  # (B, K, 2)
    drawn: ti.template(),  # (K,)
    b: int,
    v: int,
    i: int,
    ray,
    depth,
):
    """Return the drawn part that a ray of column i meets first, nearer than ``depth``, or -1; and the depth there."""
    met, nearest = -1, depth
    for k in range(drawn.shape[0]):
        if i >= stretch[b, k, 0] and i <= stretch[b, k, 1]:
            p = drawn[k]
            origin = ti.Vector([outline[b, v, p, _ORIGIN + a] for a in ti.static(range(3))])
            t = enter_unit(kind_of(parts, p), parts[p, 3], origin, times(load_rotation(placed, b, p), ray))
            if t > 0.0 and t < nearest:
                nearest = t
                met = p
    return met, nearest


@functools.cache
def _cast_kernel(real):
    @ti.kernel
    def cast_rows(
        # the body
        tree: ti.types.ndarray(dtype=real, ndim=2),  # (D, 11)
        parts: ti.types.ndarray(dtype=real, ndim=2),  # (P, 21)
        drawn: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (K,) the parts to draw
        chain: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,) the degrees of freedom that move them
        # the frame
        cameras: ti.types.ndarray(dtype=real, ndim=2),  # (V, 27)
        rays: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (V, H, W, 3) world; zero outside the picture
        cost: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (V, H, W, G + 1)
        before_label: ti.types.ndarray(dtype=ti.u8, ndim=3),  # (V, H, W)
        before_depth: ti.types.ndarray(dtype=ti.f32, ndim=3),  # (V, H, W)
        # settings
        numbers: ti.types.ndarray(dtype=real, ndim=1),  # (3,) from _STEP to _EXPORT
        spread: ti.i32,
        # the poses
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        # scratch
        joints: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 18)
        placed: ti.types.ndarray(dtype=real, ndim=3),  # (B, P, 12) world to unit part
        outline: ti.types.ndarray(dtype=real, ndim=4),  # (B, V, P, _COLUMNS)
        stretch: ti.types.ndarray(dtype=ti.i32, ndim=3),  # (B, K, 2) first and last ray of a row
        # out
        change: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (B, V) what drawing changes of the cost
        label: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (B, V, H, W), if export; before_label when called
        depth: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (B, V, H, W), if export; before_depth when called
    ):
        B, V, K, H, W = pose.shape[0], rays.shape[0], drawn.shape[0], rays.shape[1], rays.shape[2]
        # one thread handles a pose from end to end, see tk.kernels.silhouette
        for turn in range(spread * B):
            if turn % spread != 0:
                continue
            b = turn // spread
            step = ti.cast(numbers[_STEP], ti.i32)
            forward_chain(tree, chain, pose, b, b, joints)
            out, seen = ti.cast(0.0, real), ti.cast(1e-6, real)
            for k in range(K):
                p = drawn[k]
                R, t = place_part(joints, parts, b, p)
                kind, shape = kind_of(parts, p), shape_of(parts, p)
                size = extent(kind, shape, 1.0)
                M = ti.Matrix([[R[j, i] / size[i] for j in ti.static(range(3))] for i in ti.static(range(3))])
                store_frame(placed, b, p, M, t)
                middle, column = times(R, interior_point(kind, shape)) + t, column_of(parts, cost, p)
                for v in range(V):
                    more, one = middle_cost(middle, cameras, rays, cost, outline, b, v, p, column, step)
                    out += ti.cast(more, real)
                    seen += one
            if out / seen > numbers[_MOST_OUTSIDE]:
                for v in range(V):
                    change[b, v] = ti.math.inf
                continue
            # most pixels are far from most parts
            for k in range(K):
                enclose_part(parts, placed, cameras, b, drawn[k], outline)
            for v in range(V):
                top, bottom = covered_rows(outline, drawn, b, v, step, H)
                total = ti.cast(0.0, ti.f64)
                for j in range(top, bottom + 1):
                    low, high = covered_columns(outline, drawn, b, v, j, step, W, stretch)
                    in_row = ti.cast(0.0, ti.f32)
                    for i in range(low, high + 1):
                        ray = ti.Vector([ti.cast(rays[v, j, i, a], real) for a in ti.static(range(3))])
                        met, nearest = -1, ti.cast(before_depth[v, j, i], real)
                        if norm_sqr(ray) > 0.0:
                            met, nearest = first_part(parts, placed, outline, stretch, drawn, b, v, i, ray, nearest)
                        if met >= 0:
                            hidden = ti.cast(before_label[v, j, i], ti.i32) - 1
                            before = 0
                            if hidden >= 0:
                                before = column_of(parts, cost, hidden)
                            in_row += cost[v, j, i, column_of(parts, cost, met)] - cost[v, j, i, before]
                            if numbers[_EXPORT] == 1.0:
                                label[b, v, j, i] = ti.cast(met + 1, ti.u8)
                                depth[b, v, j, i] = ti.cast(nearest, ti.f32)
                    total += in_row
                change[b, v] = total

    return Launcher(cast_rows)


def nothing(shape: tuple[int, int, int]) -> Cast:
    """Return the cast of rays (V, H, W) that meet nothing."""
    return Cast(np.zeros(shape, np.uint8), np.full(shape, FAR, np.float32))


def costs(
    body: ConeArrays,
    rays: Rays,
    cost: NDArray[np.float32],
    poses: NDArray[np.floating],
    drawn: NDArray[np.int32] | None = None,
    before: Cast | None = None,
    most_outside: float = np.inf,
) -> NDArray[np.float64]:
    """Cast the rays at B poses and return the sums (B, V) of their costs.

    Args:
        body: the cone body.
        rays: the grid.
        cost: (V, H, W, G + 1) float32, see the module.
        poses: (B, D).
        drawn: (K,) indices of the parts to draw; all if None.
        before: the cast of the other parts at one pose; nothing if None.
        most_outside: a pose whose rays through the drawn parts' middles cost more than this, on average over parts and
            views, is not cast and costs inf: most candidate poses of a limb lie outside the visual hull, and these few
            rays reject them.
    """
    return _launch(body, rays, cost, poses, drawn, before or nothing(cost.shape[:3]), most_outside, None)


def cast(
    body: ConeArrays,
    rays: Rays,
    cost: NDArray[np.float32],
    poses: NDArray[np.floating],
    drawn: NDArray[np.int32] | None = None,
) -> tuple[NDArray[np.float64], Cast]:
    """Return the sums of the rays' costs, and the casts; arguments as for :func:`costs`."""
    before = nothing(cost.shape[:3])
    B = len(poses)
    met = Cast(np.repeat(before.label[None], B, axis=0), np.repeat(before.depth[None], B, axis=0))
    return _launch(body, rays, cost, poses, drawn, before, np.inf, met), met


def _launch(
    body: ConeArrays,
    rays: Rays,
    cost: NDArray[np.float32],
    poses: NDArray[np.floating],
    drawn: NDArray[np.int32] | None,
    before: Cast,
    most_outside: float,
    met: Cast | None,
) -> NDArray[np.float64]:
    """Return the sums of the rays' costs. ``met``, a copy of ``before`` for each pose, receives the casts."""
    ensure_runtime()
    dtype = body.tree.dtype
    poses = np.ascontiguousarray(poses, dtype)
    B, D = poses.shape
    V, P = len(cost), len(body.parts)
    if drawn is None:
        drawn = np.arange(P, dtype=np.int32)
    change = np.empty((B, V))
    _cast_kernel(ti.f64 if dtype == np.float64 else ti.f32)(
        body.tree,
        body.parts,
        drawn,
        _above(body, drawn),
        np.ascontiguousarray(rays.cameras, dtype),
        rays.directions,
        cost,
        *before,
        np.array((rays.step, most_outside, met is not None), dtype),
        spread_of(B),
        poses,
        *_scratch(B, V, D, P, dtype),
        change,
        *(met or _no_cast()),
    )
    if before.label.any():
        column = np.minimum(body.parts[:, PART_GROUP].astype(np.intp) + 1, cost.shape[3] - 1)
        columns = np.concatenate([[0], column])[before.label]
        columns += np.arange(0, cost.size, cost.shape[3]).reshape(columns.shape)  # take is faster than take_along_axis
        base = cost.ravel().take(columns).sum(axis=(1, 2), dtype=np.float64)
    else:
        base = cost[..., 0].sum(axis=(1, 2), dtype=np.float64)
    return np.asarray(base + change)


@functools.lru_cache(8)
def _scratch(B: int, V: int, D: int, P: int, dtype: np.dtype) -> tuple[NDArray, ...]:
    return (
        np.empty((B, D, JOINT_NUMBERS), dtype),
        np.empty((B, P, 12), dtype),
        np.empty((B, V, P, _COLUMNS), dtype),
        np.empty((B, P, 2), np.int32),
    )


@functools.cache
def _no_cast() -> Cast:
    return Cast(np.empty((1, 1, 1, 1), np.uint8), np.empty((1, 1, 1, 1), np.float32))


def _above(body: ConeArrays, drawn: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the degrees of freedom that move some of the drawn parts, ascending."""
    parent = body.tree[:, TREE_PARENT].astype(np.int32)
    moves = np.zeros(len(parent), np.bool_)
    moves[body.parts[drawn, PART_DOF].astype(np.int32)] = True
    for k in range(len(moves) - 1, -1, -1):
        if moves[k] and parent[k] >= 0:
            moves[parent[k]] = True
    return np.flatnonzero(moves).astype(np.int32)
