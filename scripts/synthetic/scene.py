# No `from __future__ import annotations` here: Taichi reads the annotations of kernels.
"""The room: textured floor and walls, boxes along the walls, two lamps. Rendered once a camera, without the actor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.noise import hash3, noise3
from tk.kernels.runtime import ensure_runtime, ti
from tk.model.cameras.camera import Camera

HALF_ROOM_M = (4.9, 4.6)
"""Half the room's extent along x and y; the cameras hang inside."""
SHADOW_MAP_PX = 384
LAMP_RADIUS_M = 0.12

vec3 = ti.types.vector(3, ti.f32)
Array = ti.types.ndarray

# centre x, y, half extents x, y, height, colour: clutter outside the ring of cameras and of the motion
_BOXES = np.array(
    [
        (-4.4, -2.6, 0.40, 0.55, 0.75, 0.33, 0.22, 0.12),
        (-4.5, 0.6, 0.30, 0.80, 1.90, 0.24, 0.17, 0.11),
        (-3.3, 4.1, 0.70, 0.35, 0.90, 0.10, 0.17, 0.30),
        (0.4, 4.2, 0.45, 0.30, 0.55, 0.45, 0.34, 0.08),
        (3.6, 4.1, 0.30, 0.30, 1.30, 0.15, 0.25, 0.13),
        (4.4, 1.2, 0.35, 0.70, 0.70, 0.36, 0.12, 0.08),
        (4.5, -2.2, 0.28, 0.45, 1.60, 0.30, 0.31, 0.33),
        (1.6, -4.2, 0.80, 0.30, 0.80, 0.20, 0.13, 0.20),
        (-1.5, -4.2, 0.35, 0.30, 1.20, 0.38, 0.36, 0.30),
    ]
)


@dataclass(frozen=True)
class Lamps:
    """Lamps, each with a pinhole at its place that holds its shadow map.

    Attributes:
        cameras: one square camera a lamp.
        rays: its rays, (1, Z, Z, 3) each.
        light: (L, 7) position, RGB of the irradiance it gives, focal length of the shadow map.
        axes: (L, 3, 3) world to lamp.
        ambient: (3,) RGB.
    """

    cameras: tuple[Camera, ...]
    rays: tuple[NDArray[np.float32], ...]
    light: NDArray[np.float32]
    axes: NDArray[np.float32]
    ambient: NDArray[np.float32]


@dataclass(frozen=True)
class RoomView:
    """One camera's picture of the empty room, taken apart.

    Attributes:
        point, normal: (H, W, 3) what the pixel's centre sees, metres.
        indirect: (H, W, 3) reflected ambient light, antialiased.
        direct: (L, H, W, 3) reflected light of each lamp, with the room's own shadows.
    """

    point: NDArray[np.float32]
    normal: NDArray[np.float32]
    indirect: NDArray[np.float32]
    direct: NDArray[np.float32]


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation from world to a camera (x right, y down, z forward) that looks from ``eye`` at ``target``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def make_lamps(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Lamps:
    """A key lamp and a dimmer, bluer fill lamp, whose shadow maps cover the box from ``lower`` to ``upper``, metres."""
    eyes = np.array([[1.9, -2.4, 4.3], [-2.6, 2.2, 3.9]])
    colors = np.array([[0.88, 0.82, 0.74], [0.26, 0.29, 0.34]])
    corners = np.array(
        [[x, y, z] for x in (lower[0], upper[0]) for y in (lower[1], upper[1]) for z in (lower[2], upper[2])]
    )
    cameras, rays, light = [], [], []
    size = SHADOW_MAP_PX
    for i, eye in enumerate(eyes):
        rotation = look_at(eye, (lower + upper) / 2, np.array([0.0, 0.0, 1.0]))
        seen = (corners - eye) @ rotation.T
        focal = 0.48 * size / np.abs(seen[:, :2] / seen[:, 2:]).max()
        middle = (size - 1) / 2
        matrix = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
        camera = Camera(f"lamp{i}", size, size, matrix, np.zeros(5), rotation, -rotation @ eye)
        cameras.append(camera)
        rays.append(_rays(camera)[None])
        light.append([*eye, *colors[i], focal])
    axes = np.array([c.rotation for c in cameras], dtype=np.float32)
    ambient = np.array([0.40, 0.41, 0.43], dtype=np.float32)
    return Lamps(tuple(cameras), tuple(rays), np.array(light, dtype=np.float32), axes, ambient)


def _rays(camera: Camera, offset: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float32]:
    y, x = np.mgrid[: camera.height, : camera.width]
    grid = np.stack([x.ravel() + offset[0], y.ravel() + offset[1]], axis=1).astype(np.float64)
    return camera.rays(grid).astype(np.float32).reshape(camera.height, camera.width, 3)


def view_room(camera: Camera, lamps: Lamps, samples: int = 4) -> RoomView:
    """Render the empty room, ``samples`` x ``samples`` rays a pixel within the kernel."""
    ensure_runtime()
    height, width = camera.height, camera.width
    rays = _rays(camera)
    # a ray inside the pixel is a linear step from its centre; distortion does not bend it noticeably
    step_x = _rays(camera, (1.0, 0.0)) - rays
    step_y = _rays(camera, (0.0, 1.0)) - rays
    point, normal, indirect = (np.empty((height, width, 3), dtype=np.float32) for _ in range(3))
    direct = np.empty((len(lamps.light), height, width, 3), dtype=np.float32)
    center = camera.center.astype(np.float32)
    boxes = _BOXES.astype(np.float32)
    half = np.array(HALF_ROOM_M, dtype=np.float32)
    _room_kernel(samples, center, rays, step_x, step_y, half, boxes, lamps.light, lamps.ambient, point, normal,
                 indirect, direct)  # fmt: skip
    return RoomView(point, normal, indirect, direct)


@ti.func
def _hit_box(o, ray, b, boxes: ti.template()):
    """Distance to box b along the ray (1e9 for a miss) and the face's normal."""
    low = vec3(boxes[b, 0] - boxes[b, 2], boxes[b, 1] - boxes[b, 3], 0.0)
    high = vec3(boxes[b, 0] + boxes[b, 2], boxes[b, 1] + boxes[b, 3], boxes[b, 4])
    near, far = -1e9, 1e9
    normal = vec3(0.0)
    for c in ti.static(range(3)):
        r = ray[c] if ti.abs(ray[c]) > 1e-9 else 1e-9
        t0, t1 = (low[c] - o[c]) / r, (high[c] - o[c]) / r
        if ti.min(t0, t1) > near:
            near = ti.min(t0, t1)
            normal = vec3(0.0)
            normal[c] = -ti.math.sign(r)
        far = ti.min(far, ti.max(t0, t1))
    t = 1e9
    if far > near and near > 1e-4:
        t = near
    return t, normal


@ti.func
def _floor_color(p):
    """Parquet: staggered boards with grain."""
    board = ti.cast(ti.floor(p[1] / 0.14), ti.i32)
    along = p[0] / 0.9 + 0.37 * board
    piece = ti.cast(ti.floor(along), ti.i32)
    tone = 0.75 + 0.45 * hash3(board, piece, 7)
    tone *= 0.85 + 0.3 * noise3(vec3(p[0] * 6.0, p[1] * 70.0, 1.0 * piece))
    edge = ti.min(p[1] / 0.14 - board, 1.0 - (p[1] / 0.14 - board)) * 0.14
    edge = ti.min(edge, ti.min(along - piece, 1.0 - (along - piece)) * 0.9)
    if edge < 0.004:
        tone *= 0.55
    return tone * vec3(0.36, 0.25, 0.155)


@ti.func
def _wall_color(u, z, wall):
    """Plaster above, panels below, pictures in between; u runs along the wall."""
    c = vec3(0.50, 0.49, 0.44) * (0.9 + 0.12 * noise3(vec3(u * 9.0, z * 9.0, 5.0 * wall)))
    if wall == 1:
        c = c * vec3(0.85, 0.95, 1.05)
    if wall == 2:
        c = c * vec3(1.0, 0.86, 0.78)
    if z < 0.95:
        c = vec3(0.27, 0.29, 0.27) * (0.85 + 0.3 * noise3(vec3(u * 30.0, z * 5.0, 9.0 * wall)))
        panel = u / 0.6 - ti.floor(u / 0.6)
        if panel < 0.05 or z > 0.89 or z < 0.12:
            c *= 1.35
    cell = ti.cast(ti.floor(u / 1.3), ti.i32)
    if hash3(cell, wall, 3) > 0.4:  # a picture in this stretch of wall
        x = u / 1.3 - cell - 0.5
        y = (z - 1.65) / 1.3
        w, h = 0.18 + 0.16 * hash3(cell, wall, 4), 0.15 + 0.17 * hash3(cell, wall, 5)
        if ti.abs(x) < w and ti.abs(y) < h:
            hue = vec3(hash3(cell, wall, 11), hash3(cell, wall, 12), hash3(cell, wall, 13))
            c = 0.08 + 0.5 * hue * (0.3 + 0.9 * noise3(vec3(x * 9.0 + cell, y * 9.0, 1.0 * wall)))
            if ti.abs(x) > w - 0.03 or ti.abs(y) > h - 0.03:
                c = vec3(0.05, 0.04, 0.035)
    return c


@ti.func
def _box_color(p, b, n, boxes: ti.template()):
    c = vec3(boxes[b, 5], boxes[b, 6], boxes[b, 7])
    c *= 0.85 + 0.3 * noise3(p * vec3(12.0, 12.0, 30.0) + 3.0 * b)
    shelf = p[2] / 0.33 - ti.floor(p[2] / 0.33)
    if n[2] < 0.5 and shelf < 0.09:
        c *= 0.6
    return c


@ti.func
def _nearest(o, ray, half: ti.template(), boxes: ti.template()):
    """First surface of the room along a ray: distance, normal, and what it is (0 floor, 1-4 walls, 5+ boxes)."""
    best = 1e9
    normal = vec3(0.0, 0.0, 1.0)
    what = 0
    if ray[2] < -1e-6:
        best = -o[2] / ray[2]
    for c in ti.static(range(2)):
        if ti.abs(ray[c]) > 1e-6:
            side = ti.math.sign(ray[c])
            t = (side * half[c] - o[c]) / ray[c]
            if 0.0 < t < best:
                best = t
                normal = vec3(0.0)
                normal[c] = -side
                what = 1 + 2 * c + (1 if side > 0 else 0)
    for b in range(boxes.shape[0]):
        t, n = _hit_box(o, ray, b, boxes)
        if t < best:
            best, normal, what = t, n, 5 + b
    return best, normal, what


@ti.kernel
def _room_kernel(
    samples: ti.i32,
    origin: Array(dtype=ti.f32, ndim=1),
    rays: Array(dtype=ti.f32, ndim=3),  # (H, W, 3)
    step_x: Array(dtype=ti.f32, ndim=3),
    step_y: Array(dtype=ti.f32, ndim=3),
    half: Array(dtype=ti.f32, ndim=1),  # (2,)
    boxes: Array(dtype=ti.f32, ndim=2),  # (B, 8)
    light: Array(dtype=ti.f32, ndim=2),  # (L, 7)
    ambient: Array(dtype=ti.f32, ndim=1),
    point: Array(dtype=ti.f32, ndim=3),
    normals: Array(dtype=ti.f32, ndim=3),
    indirect: Array(dtype=ti.f32, ndim=3),
    direct: Array(dtype=ti.f32, ndim=4),
):
    for y, x in ti.ndrange(rays.shape[0], rays.shape[1]):
        o = vec3(origin[0], origin[1], origin[2])
        center = vec3(rays[y, x, 0], rays[y, x, 1], rays[y, x, 2])
        dx = vec3(step_x[y, x, 0], step_x[y, x, 1], step_x[y, x, 2])
        dy = vec3(step_y[y, x, 0], step_y[y, x, 1], step_y[y, x, 2])
        t_center, n_center, _ = _nearest(o, center, half, boxes)
        for c in ti.static(range(3)):
            point[y, x, c] = o[c] + t_center * center[c]
            normals[y, x, c] = n_center[c]
            indirect[y, x, c] = 0.0
            for lamp in range(light.shape[0]):
                direct[lamp, y, x, c] = 0.0
        share = 1.0 / (samples * samples)
        for s in range(samples * samples):
            a = (s % samples + 0.5) / samples - 0.5
            b = (s // samples + 0.5) / samples - 0.5
            ray = (center + a * dx + b * dy).normalized()
            t, n, what = _nearest(o, ray, half, boxes)
            p = o + t * ray
            color = vec3(0.0)
            if what == 0:
                color = _floor_color(p)
            elif what < 5:
                color = _wall_color(p[1] if what < 3 else p[0], p[2], what)
            else:
                color = _box_color(p, what - 5, n, boxes)
            # corners get less ambient light
            corner = ti.min(half[0] - ti.abs(p[0]), half[1] - ti.abs(p[1]))
            if what == 1 or what == 2:
                corner = ti.min(p[2], half[1] - ti.abs(p[1]))
            elif what == 3 or what == 4:
                corner = ti.min(p[2], half[0] - ti.abs(p[0]))
            dim = 1.0 - 0.4 * ti.exp(-corner / 0.35)
            for c in ti.static(range(3)):
                indirect[y, x, c] += share * dim * color[c] * ambient[c]
            for lamp in range(light.shape[0]):
                # each ray of the pixel looks at another spot of the lamp: soft shadows
                spot = vec3(light[lamp, 0], light[lamp, 1], light[lamp, 2])
                spot += LAMP_RADIUS_M * 2.0 * vec3(hash3(x, y, s) - 0.5, hash3(x, y, s + 999) - 0.5, 0.0)
                to_light = spot - p
                distance = to_light.norm()
                to_light /= distance
                facing = ti.max(n.dot(to_light), 0.0)
                if facing > 0.0:
                    start = p + 1e-3 * n
                    for k in range(boxes.shape[0]):
                        if facing > 0.0:
                            blocked, _face = _hit_box(start, to_light, k, boxes)
                            if blocked < distance:
                                facing = 0.0
                for c in ti.static(range(3)):
                    direct[lamp, y, x, c] += share * facing * color[c] * light[lamp, 3 + c]
