"""Overlap of a cone body's silhouettes with masks, by ray casting (silhouette paper, eq. 12)."""

import functools

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cone_arrays import NEAREST_M, ConeArrays, keep, place_part, shape_of
from tk.kernels.cones import enclosing_radius, enter, interior_point
from tk.kernels.kinematics import forward, load_rotation, load_translation
from tk.kernels.launch import Launcher
from tk.kernels.projection import camera_center, project
from tk.kernels.runtime import ensure_runtime, spread_of, ti

# How much larger than its first-order size a part's disc is taken when rays are cast.
DISC_MARGIN = 1.1


@functools.cache
def _overlap_kernel(real):
    @ti.kernel
    def overlap_rows(
        axis: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        point: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        prismatic: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        parent: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        part_kind: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        part_shape: ti.types.ndarray(dtype=real, ndim=2),  # (P, 4)
        part_frame: ti.types.ndarray(dtype=real, ndim=2),  # (P, 12)
        part_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        camera: ti.types.ndarray(dtype=real, ndim=2),  # (V, 22)
        spread: ti.i32,
        step: ti.i32,  # pixels between rays; the first is at step // 2
        rays: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (V, H, W, 3) world; zero outside the picture
        mask: ti.types.ndarray(dtype=ti.u8, ndim=3),  # (V, H, W)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        frames: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 12) scratch
        twists: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 6) scratch
        placed: ti.types.ndarray(dtype=real, ndim=3),  # (B, P, 12) scratch
        disc: ti.types.ndarray(dtype=real, ndim=4),  # (B, V, P, 3) scratch, centre and square radius in pixels
        counts: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B V H, 2) out: model without mask, mask without model
        picture: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (B, V, H, W) out
    ):
        B, V, H, W = pose.shape[0], rays.shape[0], rays.shape[1], rays.shape[2]
        P = part_dof.shape[0]
        for b in range(B):
            forward(axis, point, prismatic, parent, pose, b, b, frames, twists)
            for p in range(P):
                R, t = place_part(frames, part_dof, part_frame, b, p)
                keep(placed, b, p, R, t)
                # a disc in each picture that holds the part: most pixels are far from most parts
                shape = shape_of(part_shape, p)
                middle = R @ interior_point(part_kind[p], shape) + t
                reach = enclosing_radius(part_kind[p], shape)
                for v in range(V):
                    pixel, J, z = project(camera, v, middle)
                    radius = 0.0 * z
                    if z > 1.5 * reach + NEAREST_M:
                        # the Frobenius norm of the derivative is at least its growth in any direction
                        radius = DISC_MARGIN * J.norm() * reach * z / (z - reach)
                    elif z > -reach:
                        radius = 1e6 + 0.0 * z
                    disc[b, v, p, 0], disc[b, v, p, 1], disc[b, v, p, 2] = pixel[0], pixel[1], radius * radius
        for turn in range(spread * (B * V * H)):
            if turn % spread != 0:
                continue
            c = turn // spread
            b, v, j = c // (V * H), (c // H) % V, c % H
            eye = camera_center(camera, v)
            for i in range(W):
                picture[b, v, j, i] = ti.cast(0, ti.u8)
            for p in range(P):
                # the stretch of this row that the part's disc covers
                across = disc[b, v, p, 2] - (j * step + step // 2 - disc[b, v, p, 1]) ** 2
                if across > 0.0:
                    half = ti.sqrt(across)
                    middle = disc[b, v, p, 0] - step // 2
                    first = ti.max(ti.cast(ti.ceil((middle - half) / step), ti.i32), 0)
                    last = ti.min(ti.cast(ti.floor((middle + half) / step), ti.i32), W - 1)
                    shape = shape_of(part_shape, p)
                    R = load_rotation(placed, b, p).transpose()
                    local = R @ (eye - load_translation(placed, b, p))
                    for i in range(first, last + 1):
                        if picture[b, v, j, i] == 0:
                            ray = ti.Vector([ti.cast(rays[v, j, i, a], real) for a in ti.static(range(3))])
                            if ray.norm_sqr() > 0.0 and enter(part_kind[p], shape, local, R @ ray, 1.0) > 0.0:
                                picture[b, v, j, i] = ti.cast(255, ti.u8)
            more, less = 0, 0
            for i in range(W):
                if picture[b, v, j, i] > 0 and mask[v, j, i] < 128:
                    more += 1
                if picture[b, v, j, i] == 0 and mask[v, j, i] >= 128:
                    less += 1
            counts[c, 0], counts[c, 1] = more, less

    return Launcher(overlap_rows)


def overlap(
    body: ConeArrays,
    cameras: np.ndarray,
    step: int,
    rays: np.ndarray,
    masks: np.ndarray,
    poses: np.ndarray,
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Cast a ray through every pixel: the silhouettes of B poses against masks.

    Args:
        body: the cone body.
        cameras: (V, 22) rows of :func:`tk.kernels.projection.pack_camera`.
        step: pixels between rays; the first goes through pixel ``step // 2``.
        rays: (V, H, W, 3) float32 viewing directions, world frame; zero where a camera has no pixel.
        masks: (V, H, W) uint8.
        poses: (B, D).

    Returns:
        counts (B, V, 2) of pixels in the model but not the mask, and in the mask but not the model; silhouettes
        (B, V, H, W) uint8, 0 or 255.
    """
    ensure_runtime()
    dtype = body.axis.dtype
    poses = np.ascontiguousarray(poses, dtype)
    B, D = poses.shape
    V, H, W = rays.shape[:3]
    counts = np.empty((B * V * H, 2), np.int32)
    picture = np.empty((B, V, H, W), np.uint8)
    _overlap_kernel(ti.f64 if dtype == np.float64 else ti.f32)(
        *body[:8],
        np.ascontiguousarray(cameras, dtype),
        spread_of(B * V * H),
        step,
        np.ascontiguousarray(rays, np.float32),
        np.ascontiguousarray(masks),
        poses,
        np.empty((B, D, 12), dtype),
        np.empty((B, D, 6), dtype),
        np.empty((B, len(body.part_kind), 12), dtype),
        np.empty((B, V, len(body.part_kind), 3), dtype),
        counts,
        picture,
    )
    return counts.reshape(B, V, H, 2).sum(axis=2, dtype=np.int64), picture
