"""A cone body seen through a grid of rays: what each ray meets first, and what that costs (silhouette paper, eq. 12).

A ray's cost depends on what it meets: column 0 of ``cost`` where it meets nothing, column g + 1 where it meets a part
of colour group g. With 0 and 1 in the right places their sum is the number of wrong pixels, E_S's numerator; with what
colours say it tells a forearm before the trunk from one behind it.

Many poses that differ in one limb are compared by casting the rest once: a launch may start from labels and depths that
an earlier one left, and draw some parts only.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cone_arrays import NEAREST_M, ConeArrays, keep, place_part, shape_of
from tk.kernels.cones import capsule, enter_unit, extent, interior_point
from tk.kernels.kinematics import forward, load_rotation, load_translation
from tk.kernels.launch import Launcher
from tk.kernels.projection import camera_center, project
from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.vectors import norm_sqr, times

# How much larger than to first order spheres are taken in the pictures when rays are cast; and how many times as much
# as its middle a distorted axis lies beside the chord anywhere.
MARGIN, BEND = 1.1, 1.5
# Columns of a part's outline in a picture: its beginning, its axis, the radius and, across the axis, that radius; then
# where the camera is in the unit part, and the pixel of the part's middle.
_BEGIN, _AXIS, _RADIUS, _ACROSS, _ORIGIN, _MIDDLE, _COLUMNS = 0, 2, 4, 5, 7, 10, 12
# Depth of a ray that meets nothing.
FAR = 1e9


class Cast(NamedTuple):
    """What rays meet.

    Attributes:
        label: (V, H, W) uint8: 0 nothing, else 1 + the part's index.
        depth: (V, H, W) float32, in lengths of the ray's direction; :data:`FAR` where a ray meets nothing.
    """

    label: NDArray[np.uint8]
    depth: NDArray[np.float32]


@ti.func
def _in_row(outline: ti.template(), b: int, v: int, p: int, y: int):
    """Where a row of a picture enters and leaves the capsule that holds a part; the wrong way round if it does not."""
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


@functools.cache
def _cast_kernel(real, alone):
    @ti.kernel
    def cast_rows(
        axis: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        point: ti.types.ndarray(dtype=real, ndim=2),  # (D, 6)
        prismatic: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        parent: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        part_kind: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        part_shape: ti.types.ndarray(dtype=real, ndim=2),  # (P, 4)
        part_frame: ti.types.ndarray(dtype=real, ndim=2),  # (P, 12)
        part_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        group: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,) colour group of each part
        camera: ti.types.ndarray(dtype=real, ndim=2),  # (V, 22)
        drawn: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (K,) the parts to draw
        chain: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,) the degrees of freedom that move them
        spread: ti.i32,
        step: ti.i32,  # pixels between rays; the first is at step // 2
        rays: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (V, H, W, 3) world; zero outside the picture
        cost: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (V, H, W, G + 1)
        before_label: ti.types.ndarray(dtype=ti.u8, ndim=3),  # (V, H, W)
        before_depth: ti.types.ndarray(dtype=ti.f32, ndim=3),  # (V, H, W)
        export: ti.i32,
        most_outside: real,
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        frames: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 12) scratch
        twists: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 6) scratch
        placed: ti.types.ndarray(dtype=real, ndim=3),  # (B, P, 12) scratch, world to unit parts
        # (B, V, P, _COLUMNS) scratch: what holds the part, a capsule in pixels; and the camera, in the unit part
        outline: ti.types.ndarray(dtype=real, ndim=4),
        stretch: ti.types.ndarray(dtype=ti.i32, ndim=3),  # (B, K, 2) scratch: first and last column in a row
        outside: ti.types.ndarray(dtype=real, ndim=1),  # (B,) out: mean cost at the drawn parts' middles
        change: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (B, V) out: what drawing changes of the cost
        label: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (B, V, H, W) out, if export; before_label when called
        depth: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (B, V, H, W) out, if export; before_depth when called
    ):
        B, V, H, W = pose.shape[0], rays.shape[0], rays.shape[1], rays.shape[2]
        K = drawn.shape[0]
        # a pose is one thread's, see tk.kernels.silhouette
        ti.loop_config(serialize=alone)
        for turn in range(spread * B):
            if turn % spread != 0:
                continue
            b = turn // spread
            forward(axis, point, prismatic, parent, chain, pose, b, b, frames, twists)
            out, seen = ti.cast(0.0, real), ti.cast(1e-6, real)
            for k in range(K):
                p = drawn[k]
                R, t = place_part(frames, part_dof, part_frame, b, p)
                shape = shape_of(part_shape, p)
                size = extent(part_kind[p], shape, 1.0)
                M = ti.Matrix([[R[j, i] / size[i] for j in ti.static(range(3))] for i in ti.static(range(3))])
                keep(placed, b, p, M, t)
                middle = times(R, interior_point(part_kind[p], shape)) + t
                for v in range(V):
                    pixel, _, depth_m = project(camera, v, middle)
                    outline[b, v, p, _MIDDLE], outline[b, v, p, _MIDDLE + 1] = pixel[0], pixel[1]
                    i = ti.cast(ti.round((pixel[0] - step // 2) / step), ti.i32)
                    j = ti.cast(ti.round((pixel[1] - step // 2) / step), ti.i32)
                    if depth_m > NEAREST_M and i >= 0 and j >= 0 and i < W and j < H:
                        out += ti.cast(ti.max(cost[v, j, i, group[p] + 1] - cost[v, j, i, 0], 0.0), real)
                        seen += 1.0
            outside[b] = out / seen
            if outside[b] > most_outside:
                continue
            # what holds each part in each picture: most pixels are far from most parts
            for k in range(K):
                p = drawn[k]
                shape = shape_of(part_shape, p)
                size = extent(part_kind[p], shape, 1.0)
                M, t = load_rotation(placed, b, p), load_translation(placed, b, p)
                z0, z1, reach = capsule(part_kind[p], shape)
                along_part = ti.Vector([M[2, i] * size[2] for i in ti.static(range(3))])
                for v in range(V):
                    begin, J0, depth0 = project(camera, v, t + z0 * along_part)
                    end, J1, depth1 = project(camera, v, t + z1 * along_part)
                    radius = 0.0 * depth0
                    nearest, farthest = ti.min(depth0, depth1), ti.max(depth0, depth1)
                    if nearest > 1.5 * reach + NEAREST_M:
                        # the Frobenius norm of the derivative is at least its growth in any direction
                        growth = ti.max(J0.norm() * depth0 / (depth0 - reach), J1.norm() * depth1 / (depth1 - reach))
                        chord = end - begin
                        x = outline[b, v, p, _MIDDLE] - begin[0]
                        y = outline[b, v, p, _MIDDLE + 1] - begin[1]
                        aside = ti.abs(chord[0] * y - chord[1] * x) / ti.max(chord.norm(), 1e-6)
                        radius = MARGIN * growth * reach + BEND * aside
                    elif farthest > -reach:
                        radius = 1e6 + 0.0 * radius
                        begin *= 0.0
                        end = begin
                    along = end - begin
                    across = radius / ti.max(along.norm(), 1e-6)
                    origin = times(M, camera_center(camera, v) - t)
                    outline[b, v, p, _RADIUS] = radius
                    outline[b, v, p, _ACROSS], outline[b, v, p, _ACROSS + 1] = across * along[1], -across * along[0]
                    for a in ti.static(range(2)):
                        outline[b, v, p, _BEGIN + a], outline[b, v, p, _AXIS + a] = begin[a], along[a]
                    for a in ti.static(range(3)):
                        outline[b, v, p, _ORIGIN + a] = origin[a]
            for v in range(V):
                # the rows that the drawn parts cover
                top, bottom = H, -1
                for k in range(K):
                    p = drawn[k]
                    radius = outline[b, v, p, _RADIUS]
                    if radius > 0.0:
                        y0 = outline[b, v, p, _BEGIN + 1] - step // 2
                        y1 = y0 + outline[b, v, p, _AXIS + 1]
                        top = ti.min(top, ti.max(ti.cast(ti.ceil((ti.min(y0, y1) - radius) / step), ti.i32), 0))
                        last = ti.cast(ti.floor((ti.max(y0, y1) + radius) / step), ti.i32)
                        bottom = ti.max(bottom, ti.min(last, H - 1))
                total = ti.cast(0.0, ti.f64)
                for j in range(top, bottom + 1):
                    # and the stretches of this row
                    low, high = W, -1
                    for k in range(K):
                        left, right = _in_row(outline, b, v, drawn[k], j * step + step // 2)
                        first, last = W, -1
                        if left < right:
                            first = ti.max(ti.cast(ti.ceil((left - step // 2) / step), ti.i32), 0)
                            last = ti.min(ti.cast(ti.floor((right - step // 2) / step), ti.i32), W - 1)
                        stretch[b, k, 0], stretch[b, k, 1] = first, last
                        low, high = ti.min(low, first), ti.max(high, last)
                    in_row = ti.cast(0.0, ti.f32)
                    for i in range(low, high + 1):
                        ray = ti.Vector([ti.cast(rays[v, j, i, a], real) for a in ti.static(range(3))])
                        nearest = ti.cast(before_depth[v, j, i], real)
                        met = -1
                        if norm_sqr(ray) > 0.0:
                            for k in range(K):
                                if i >= stretch[b, k, 0] and i <= stretch[b, k, 1]:
                                    p = drawn[k]
                                    origin = ti.Vector([outline[b, v, p, _ORIGIN + a] for a in ti.static(range(3))])
                                    local = times(load_rotation(placed, b, p), ray)
                                    t = enter_unit(part_kind[p], part_shape[p, 3], origin, local)
                                    if t > 0.0 and t < nearest:
                                        nearest = t
                                        met = p
                        if met >= 0:
                            old = ti.cast(before_label[v, j, i], ti.i32)
                            was = 0
                            if old > 0:
                                was = group[old - 1] + 1
                            in_row += cost[v, j, i, group[met] + 1] - cost[v, j, i, was]
                            if export == 1:
                                label[b, v, j, i] = ti.cast(met + 1, ti.u8)
                                depth[b, v, j, i] = ti.cast(nearest, ti.f32)
                    total += in_row
                change[b, v] = total

    return Launcher(cast_rows)


def nothing(shape: tuple[int, int, int]) -> Cast:
    """Rays (V, H, W) that meet nothing."""
    return Cast(np.zeros(shape, np.uint8), np.full(shape, FAR, np.float32))


def cast(
    body: ConeArrays,
    group: NDArray[np.int32],
    cameras: NDArray[np.floating],
    step: int,
    rays: NDArray[np.float32],
    cost: NDArray[np.float32],
    poses: NDArray[np.floating],
    drawn: NDArray[np.int32] | None = None,
    before: Cast | None = None,
    export: bool = False,
    most_outside: float = np.inf,
) -> tuple[NDArray[np.float64], Cast | None]:
    """Cast the rays at B poses.

    Args:
        body: the cone body.
        group: (P,) colour group of each part.
        cameras: (V, 22) rows of :func:`tk.kernels.projection.pack_camera`.
        step: pixels between rays; the first goes through pixel ``step // 2``.
        rays: (V, H, W, 3) float32 viewing directions, world frame; zero where a camera has no pixel.
        cost: (V, H, W, G + 1) float32, see the module.
        poses: (B, D).
        drawn: (K,) indices of the parts to draw; all if None.
        before: what the rays meet of the other parts; nothing if None.
        export: whether to return what the rays meet.
        most_outside: a pose is not cast, and costs inf, whose drawn parts' middles cost more than this, on an average
            over parts and views: most of a limb's places are outside the visual hull, and are told by these few rays.

    Returns:
        (B, V) sum of the rays' costs; and, with ``export``, the casts with B as the first axis, else None.
    """
    ensure_runtime()
    dtype = body.axis.dtype
    poses = np.ascontiguousarray(poses, dtype)
    B, D = poses.shape
    V, H, W = rays.shape[:3]
    P = len(body.part_kind)
    if drawn is None:
        drawn = np.arange(P, dtype=np.int32)
    before = before or nothing((V, H, W))
    change, outside = np.empty((B, V)), np.empty(B, dtype)
    shape = (B, V, H, W) if export else (1, 1, 1, 1)
    label, depth = np.empty(shape, np.uint8), np.empty(shape, np.float32)
    if export:
        label[:], depth[:] = before.label, before.depth
    _cast_kernel(ti.f64 if dtype == np.float64 else ti.f32, B == 1)(
        *body[:8],
        group,
        np.ascontiguousarray(cameras, dtype),
        drawn,
        _above(body, drawn),
        spread_of(B),
        step,
        rays,
        cost,
        before.label,
        before.depth,
        int(export),
        most_outside,
        poses,
        np.empty((B, D, 12), dtype),
        np.empty((B, D, 6), dtype),
        np.empty((B, P, 12), dtype),
        np.empty((B, V, P, _COLUMNS), dtype),
        np.empty((B, len(drawn), 2), np.int32),
        outside,
        change,
        label,
        depth,
    )
    change[outside > most_outside] = np.inf
    if before.label.any():
        columns = np.concatenate([[0], group + 1])[before.label]
        base = np.take_along_axis(cost, columns[..., None], axis=-1)[..., 0].sum(axis=(1, 2), dtype=np.float64)
    else:
        base = cost[..., 0].sum(axis=(1, 2), dtype=np.float64)
    return base + change, Cast(label, depth) if export else None


def _above(body: ConeArrays, drawn: NDArray[np.int32]) -> NDArray[np.int32]:
    """The degrees of freedom that move some of the parts, ascending."""
    moves = np.zeros(len(body.parent), np.bool_)
    moves[body.part_dof[drawn]] = True
    for k in range(len(moves) - 1, -1, -1):
        if moves[k] and body.parent[k] >= 0:
            moves[body.parent[k]] = True
    return np.flatnonzero(moves).astype(np.int32)
