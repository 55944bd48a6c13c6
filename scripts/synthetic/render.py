# No `from __future__ import annotations` here: Taichi reads the annotations of kernels.
"""Sphere tracing of the actor, shadow maps, and compositing over the room. Taichi kernels and their host functions.

The picture is cut into tiles of 8 pixels; each tile traces only the primitives whose bounding spheres it can see
(a bounding sphere includes the blending radius, so the rest cannot change the distance there). Each pixel has a few
samples; sample s has its own place inside the pixel and its own moment of the exposure, which gives antialiasing,
coverage and motion blur at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.actor import Actor, join
from scripts.synthetic.noise import noise3
from scripts.synthetic.scene import Lamps, RoomView
from scripts.synthetic.skeleton import Pose
from tk.kernels.runtime import ensure_runtime, ti
from tk.model.cameras.camera import Camera

TILE = 8
MAX_STEPS = 120
HIT_M = 0.0008
CLOSE_M = 0.02
GRAZE_M = 0.004
"""A ray that has used up its steps this near to the body counts as a hit."""
SHADOW_BIAS_M = 0.035
FAR_M = 1.0e4
PENUMBRA_PX = 2.5
CORNERS = ((1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, 1.0, 1.0))

vec3 = ti.types.vector(3, ti.f32)
Array = ti.types.ndarray


@dataclass(frozen=True)
class Tiles:
    """``first`` (K, 2) int32 first column and row of each tile, ``start`` (K+1,) and ``primitive`` the primitives it
    sees, ``near_far`` (K, 2) float32 metres along the ray between which they lie."""

    first: NDArray[np.int32]
    start: NDArray[np.int32]
    primitive: NDArray[np.int32]
    near_far: NDArray[np.float32]


def make_tiles(camera: Camera, actor: Actor, pose: Pose) -> Tiles:
    """The tiles that can see the actor in any of these poses (the moments of one exposure)."""
    centers = actor.spheres(pose)  # (S, N, 3)
    samples, count = centers.shape[:2]
    pixels, depth = camera.project(centers.reshape(-1, 3))
    reach = actor.radii[None, :]
    focal = max(camera.matrix[0, 0], camera.matrix[1, 1])
    depth = depth.reshape(samples, count)
    # 1.25: distortion and obliqueness stretch a sphere's picture a little
    spread = 1.25 * focal * reach / np.maximum(depth - reach, 0.1) + 2.0
    pixels = pixels.reshape(samples, count, 2)
    # a sphere behind the camera has no pixels
    low = np.nan_to_num(pixels - spread[..., None], nan=np.inf).min(axis=0)
    high = np.nan_to_num(pixels + spread[..., None], nan=-np.inf).max(axis=0)
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    x, y = np.arange(columns) * TILE, np.arange(rows) * TILE
    in_x = (low[:, None, 0] < x + TILE) & (high[:, None, 0] > x - 1)  # (N, columns)
    in_y = (low[:, None, 1] < y + TILE) & (high[:, None, 1] > y - 1)
    seen = (in_y[:, :, None] & in_x[:, None, :]).reshape(count, -1).T  # (tiles, N)
    tiles = np.flatnonzero(seen.any(axis=1))
    seen = seen[tiles]
    distance = np.linalg.norm(centers - camera.center, axis=-1)
    near, far = (distance - reach).min(axis=0), (distance + reach).max(axis=0)
    return Tiles(
        np.stack([tiles % columns, tiles // columns], axis=1).astype(np.int32) * TILE,
        np.concatenate([[0], np.cumsum(seen.sum(axis=1))]).astype(np.int32),
        np.nonzero(seen)[1].astype(np.int32),
        np.stack([np.where(seen, near, np.inf).min(axis=1), np.where(seen, far, -np.inf).max(axis=1)], axis=1).astype(
            np.float32
        ),
    )


def sample_rays(camera: Camera, offsets: NDArray[np.float64]) -> NDArray[np.float32]:
    """(S, H, W, 3) unit directions in the world through each pixel's centre plus ``offsets`` (S, 2) pixels."""
    y, x = np.mgrid[: camera.height, : camera.width]
    grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    rays = [camera.rays(grid + offset) for offset in offsets]
    return np.array(rays, dtype=np.float32).reshape(len(offsets), camera.height, camera.width, 3)


@ti.func
def _primitive(p, frame, i, frames: ti.template(), shape: ti.template(), material):
    """Signed distance to primitive i at the moment ``frame``, and the point in the bone frame."""
    d = vec3(p[0] - frames[frame, i, 9], p[1] - frames[frame, i, 10], p[2] - frames[frame, i, 11])
    q = vec3(0.0)
    for r in ti.static(range(3)):  # transposed: world to bone
        q[r] = frames[frame, i, r] * d[0] + frames[frame, i, 3 + r] * d[1] + frames[frame, i, 6 + r] * d[2]
    a = vec3(shape[i, 0], shape[i, 1], shape[i, 2])
    b = vec3(shape[i, 4], shape[i, 5], shape[i, 6])
    ra, rb = shape[i, 3], shape[i, 7]
    result = 0.0
    if material % 6 == 5:  # a box with rounded edges
        edge = 0.006
        e = ti.abs(q - a) - (ra - edge)
        result = ti.max(e, 0.0).norm() + ti.min(e.max(), 0.0) - edge
    else:
        scale = vec3(shape[i, 8], shape[i, 9], shape[i, 10])
        u = q / scale
        axis = b - a
        length = ti.max(axis.norm(), 1e-6)
        axis /= length
        y = (u - a).dot(axis)
        across = (u - a - y * axis).norm()
        slope = ti.math.clamp((ra - rb) / length, -0.95, 0.95)
        # the sphere of the family that is nearest to u
        h = ti.math.clamp(y - across * slope / ti.sqrt(1.0 - slope * slope), 0.0, length)
        spoke = u - a - h * axis
        result = spoke.norm() - (ra - slope * h)
        # back from squeezed space: divide by the gradient there
        result /= ti.max((spoke.normalized(1e-9) / scale).norm(), 1e-6)
    wrinkle = shape[i, 16]
    if wrinkle > 0.0 and result < 0.02:
        # folds: warped waves, mostly across the bone
        w = ti.sin(23.0 * q[2] + 9.0 * q[0] + 2.5 * ti.sin(17.0 * q[1] + 11.0 * q[0] + 1.7 * shape[i, 17]))
        w += 0.6 * ti.sin(47.0 * q[2] - 21.0 * q[1] + 2.0 * ti.sin(31.0 * q[0] + 1.3 * shape[i, 17]))
        result -= 0.6 * wrinkle * w
    cut = shape[i, 11] * q[0] + shape[i, 12] * q[1] + shape[i, 13] * q[2] - shape[i, 14]
    return ti.max(result, -cut), q


@ti.func
def _body(p, frame, begin, end, primitives: ti.template(), frames: ti.template(), shape: ti.template(),
          materials: ti.template()):  # fmt: skip
    """Distance to the body, and the nearest primitive's index. Materials are blended within, not between."""
    best = 1e9
    best_i = -1
    group = 1e9
    group_i = -1
    group_nearest = 1e9
    current = -1
    outside = 1e9
    for k in range(begin, end):
        i = primitives[k]
        m = materials[i]
        if m != current:
            if group < best:
                best, best_i = group, group_i
            group, group_i, group_nearest, current = 1e9, -1, 1e9, m
        c = vec3(frames[frame, i, 12], frames[frame, i, 13], frames[frame, i, 14])
        bound = (p - c).norm() - frames[frame, i, 15]
        if bound > CLOSE_M:  # too far to blend: its bounding sphere will do for the next step
            outside = ti.min(outside, bound)
        else:
            d, _ = _primitive(p, frame, i, frames, shape, m)
            if d < group_nearest:
                group_nearest, group_i = d, i
            blend = shape[i, 15]
            h = ti.max(blend - ti.abs(d - group), 0.0)
            group = ti.min(d, group)
            if blend > 0.0:
                group -= h * h / (4.0 * blend)
    if group < best:
        best, best_i = group, group_i
    return ti.min(best, outside), best_i


@ti.func
def _trace(origin, ray, near, far, frame, begin, end, primitives: ti.template(), frames: ti.template(),
           shape: ti.template(), materials: ti.template()):  # fmt: skip
    """Distance along the ray to the body (FAR_M for a miss) and the primitive that was hit."""
    t = near
    hit = FAR_M
    hit_i = -1
    for step in range(MAX_STEPS):
        d, i = _body(origin + t * ray, frame, begin, end, primitives, frames, shape, materials)
        if d < HIT_M or (step == MAX_STEPS - 1 and d < GRAZE_M):
            hit, hit_i = t, i
            break
        t += 0.85 * d  # squeezed and wrinkled space is not quite 1-Lipschitz
        if t > far:
            break
    return hit, hit_i


@ti.func
def _in_lamp(p, light: ti.template(), axes: ti.template(), lamp):
    """The vector from a lamp to p in the world, and its x, y, z in the lamp's frame."""
    d = p - vec3(light[lamp, 0], light[lamp, 1], light[lamp, 2])
    z = axes[lamp, 2, 0] * d[0] + axes[lamp, 2, 1] * d[1] + axes[lamp, 2, 2] * d[2]
    x = axes[lamp, 0, 0] * d[0] + axes[lamp, 0, 1] * d[1] + axes[lamp, 0, 2] * d[2]
    y = axes[lamp, 1, 0] * d[0] + axes[lamp, 1, 1] * d[1] + axes[lamp, 1, 2] * d[2]
    return d, x, y, z


@ti.func
def _visibility(p, light: ti.template(), axes: ti.template(), shadow: ti.template(), lamp, bias):
    """Share of a lamp's light that reaches p: a bilinear, percentage-closer look-up in its shadow map."""
    d, x, y, z = _in_lamp(p, light, axes, lamp)
    size = shadow.shape[1]
    visible = 1.0
    if z > 0.1:
        u = x / z * light[lamp, 6] + 0.5 * (size - 1)
        v = y / z * light[lamp, 6] + 0.5 * (size - 1)
        reach = d.norm() - bias
        lit = 0.0
        weights = 0.0
        u0, v0 = ti.cast(ti.floor(u), ti.i32), ti.cast(ti.floor(v), ti.i32)
        for dv in range(-2, 4):
            for du in range(-2, 4):
                weight = ti.max(0.0, 3.0 - ti.abs(u0 + du - u)) * ti.max(0.0, 3.0 - ti.abs(v0 + dv - v))
                weights += weight
                inside = u0 + du >= 0 and u0 + du < size and v0 + dv >= 0 and v0 + dv < size
                if not inside or shadow[lamp, v0 + dv, u0 + du] > reach:
                    lit += weight
        visible = lit / weights
    return visible


@ti.func
def _shade(p, light: ti.template(), axes: ti.template(), veil: ti.template(), lamp):
    """Share of a lamp's light that reaches a point of the room: a bilinear look-up of the blurred silhouette."""
    _, x, y, z = _in_lamp(p, light, axes, lamp)
    size = veil.shape[1]
    lit = 1.0
    if z > 0.1:
        u = x / z * light[lamp, 6] + 0.5 * (size - 1)
        v = y / z * light[lamp, 6] + 0.5 * (size - 1)
        if u >= 0.0 and v >= 0.0 and u < size - 1 and v < size - 1:
            i, j = ti.cast(u, ti.i32), ti.cast(v, ti.i32)
            a, b = u - i, v - j
            upper = (1.0 - a) * veil[lamp, j, i] + a * veil[lamp, j, i + 1]
            lower = (1.0 - a) * veil[lamp, j + 1, i] + a * veil[lamp, j + 1, i + 1]
            lit -= (1.0 - b) * upper + b * lower
    return lit


@ti.func
def _albedo(i, person_m, q, colors: ti.template(), stripes):
    """The material's colour at a point of the bone frame; ``i`` is the primitive's number within its actor."""
    c = vec3(colors[person_m, 0], colors[person_m, 1], colors[person_m, 2])
    m = person_m % 6
    if m == 0:
        c *= 0.92 + 0.16 * noise3(q * 40.0)
        if i < 6 and q[0] > 0.06 and ti.abs(q[2] - 0.055) < 0.2:  # the face: eyes, brows, mouth
            eye = vec3(0.105, 0.032, 0.052)
            side = vec3(q[0], ti.abs(q[1]), q[2]) - eye
            if vec3(0.0, side[1] / 0.016, side[2] / 0.008).norm() < 1.0 and i > 0:
                c *= 0.25
            if vec3(0.0, side[1] / 0.022, (side[2] - 0.020) / 0.005).norm() < 1.0 and i > 0:
                c *= 0.3
            if vec3(0.0, q[1] / 0.026, (q[2] + 0.018) / 0.007).norm() < 1.0 and i > 0:
                c = vec3(c[0] * 0.75, c[1] * 0.45, c[2] * 0.45)
    elif m == 1:
        c *= 0.7 + 0.6 * noise3(vec3(q[0] * 60.0, q[1] * 60.0, q[2] * 15.0))
    elif m == 2:
        c *= 0.88 + 0.24 * noise3(q * 25.0)
        if (stripes >> (person_m // 6)) & 1 and ti.sin(q[2] * 110.0) > 0.55:
            c = 0.25 * c + vec3(0.45, 0.45, 0.42)
    elif m == 3:
        c *= 0.75 + 0.3 * noise3(q * 18.0) + 0.25 * noise3(vec3(q[0] * 160.0, q[1] * 160.0, q[2] * 30.0))
    elif m == 4:
        if q[2] < -0.062:
            c = vec3(0.5, 0.5, 0.48)  # a light sole
    else:
        c *= 0.9 + 0.2 * noise3(q * 30.0)
    return c


@ti.kernel
def _render_kernel(
    stripes: ti.i32,
    origin: Array(dtype=ti.f32, ndim=1),  # (3,)
    rays: Array(dtype=ti.f32, ndim=4),  # (S, H, W, 3)
    frames: Array(dtype=ti.f32, ndim=3),  # (S, N, 16)
    shape: Array(dtype=ti.f32, ndim=2),  # (N, 18)
    materials: Array(dtype=ti.i32, ndim=1),  # (N,)
    colors: Array(dtype=ti.f32, ndim=2),  # (6 P, 3)
    first: Array(dtype=ti.i32, ndim=2),  # (K, 2)
    start: Array(dtype=ti.i32, ndim=1),  # (K+1,)
    primitives: Array(dtype=ti.i32, ndim=1),
    near_far: Array(dtype=ti.f32, ndim=2),  # (K, 2)
    light: Array(dtype=ti.f32, ndim=2),  # (L, 7) position, colour, focal length of the shadow map
    axes: Array(dtype=ti.f32, ndim=3),  # (L, 3, 3)
    shadow: Array(dtype=ti.f32, ndim=3),  # (L, Z, Z)
    ambient: Array(dtype=ti.f32, ndim=1),  # (3,)
    out: Array(dtype=ti.f32, ndim=3),  # (H, W, 4) premultiplied colour and coverage, zero before
):
    for flat in range(first.shape[0] * TILE * TILE):
        k = flat // (TILE * TILE)
        x = first[k, 0] + flat % TILE
        y = first[k, 1] + (flat // TILE) % TILE
        if x < rays.shape[2] and y < rays.shape[1]:
            o = vec3(origin[0], origin[1], origin[2])
            total = vec3(0.0)
            covered = 0.0
            begin, end = start[k], start[k + 1]
            for s in range(rays.shape[0]):
                ray = vec3(rays[s, y, x, 0], rays[s, y, x, 1], rays[s, y, x, 2])
                t, i = _trace(
                    o, ray, near_far[k, 0], near_far[k, 1], s, begin, end, primitives, frames, shape, materials
                )
                if i >= 0:
                    p = o + t * ray
                    normal = vec3(0.0)
                    for e in ti.static(range(4)):  # gradient from the corners of a tetrahedron
                        corner = vec3(CORNERS[e][0], CORNERS[e][1], CORNERS[e][2])
                        d, _ = _body(p + 0.002 * corner, s, begin, end, primitives, frames, shape, materials)
                        normal += corner * d
                    normal = normal.normalized(1e-9)
                    m = materials[i]
                    _, q = _primitive(p, s, i, frames, shape, m)
                    # light bounced by the floor from below, by the room from above
                    sky = 0.72 + 0.28 * normal[2]
                    radiance = sky * vec3(ambient[0], ambient[1], ambient[2])
                    for lamp in range(light.shape[0]):
                        to_light = (vec3(light[lamp, 0], light[lamp, 1], light[lamp, 2]) - p).normalized(1e-9)
                        facing = ti.max(normal.dot(to_light), 0.0)
                        if facing > 0.0:
                            lit = facing * _visibility(p, light, axes, shadow, lamp, SHADOW_BIAS_M)
                            radiance += lit * vec3(light[lamp, 3], light[lamp, 4], light[lamp, 5])
                    total += _albedo(ti.cast(shape[i, 17], ti.i32), m, q, colors, stripes) * radiance
                    covered += 1.0
            count = ti.cast(rays.shape[0], ti.f32)
            for c in ti.static(range(3)):
                out[y, x, c] = total[c] / count
            out[y, x, 3] = covered / count


@ti.kernel
def _depth_kernel(
    origin: Array(dtype=ti.f32, ndim=1),
    rays: Array(dtype=ti.f32, ndim=4),  # (1, Z, Z, 3)
    frames: Array(dtype=ti.f32, ndim=3),
    shape: Array(dtype=ti.f32, ndim=2),
    materials: Array(dtype=ti.i32, ndim=1),
    first: Array(dtype=ti.i32, ndim=2),
    start: Array(dtype=ti.i32, ndim=1),
    primitives: Array(dtype=ti.i32, ndim=1),
    near_far: Array(dtype=ti.f32, ndim=2),
    out: Array(dtype=ti.f32, ndim=2),  # (Z, Z) metres along the ray, FAR_M before
):
    for flat in range(first.shape[0] * TILE * TILE):
        k = flat // (TILE * TILE)
        x = first[k, 0] + flat % TILE
        y = first[k, 1] + (flat // TILE) % TILE
        if x < rays.shape[2] and y < rays.shape[1]:
            o = vec3(origin[0], origin[1], origin[2])
            ray = vec3(rays[0, y, x, 0], rays[0, y, x, 1], rays[0, y, x, 2])
            t, _ = _trace(o, ray, near_far[k, 0], near_far[k, 1], 0, start[k], start[k + 1], primitives, frames, shape,
                          materials)  # fmt: skip
            out[y, x] = t


@ti.kernel
def _distance_kernel(
    points: Array(dtype=ti.f32, ndim=2),  # (P, 3)
    primitives: Array(dtype=ti.i32, ndim=1),
    frames: Array(dtype=ti.f32, ndim=3),
    shape: Array(dtype=ti.f32, ndim=2),
    materials: Array(dtype=ti.i32, ndim=1),
    out: Array(dtype=ti.f32, ndim=1),
):
    for n in range(points.shape[0]):
        p = vec3(points[n, 0], points[n, 1], points[n, 2])
        d, _ = _body(p, 0, 0, primitives.shape[0], primitives, frames, shape, materials)
        out[n] = d


@ti.kernel
def _composite_kernel(
    point: Array(dtype=ti.f32, ndim=3),  # (H, W, 3) what the pixel's centre sees of the room
    normal: Array(dtype=ti.f32, ndim=3),
    indirect: Array(dtype=ti.f32, ndim=3),  # (H, W, 3) reflected ambient light
    direct: Array(dtype=ti.f32, ndim=4),  # (L, H, W, 3) reflected light of each lamp
    light: Array(dtype=ti.f32, ndim=2),
    axes: Array(dtype=ti.f32, ndim=3),
    veil: Array(dtype=ti.f32, ndim=3),  # (L, Z, Z) share of the lamp that the actor hides
    spheres: Array(dtype=ti.f32, ndim=2),  # (B, 4) the body as seen by ambient light
    body: Array(dtype=ti.f32, ndim=3),  # (H, W, 4)
    out: Array(dtype=ti.f32, ndim=3),  # (H, W, 3)
):
    for y, x in ti.ndrange(point.shape[0], point.shape[1]):
        p = vec3(point[y, x, 0], point[y, x, 1], point[y, x, 2])
        n = vec3(normal[y, x, 0], normal[y, x, 1], normal[y, x, 2])
        hidden = 0.0
        for b in range(spheres.shape[0]):
            d = vec3(spheres[b, 0], spheres[b, 1], spheres[b, 2]) - p
            square = ti.max(d.norm_sqr(), 1e-4)
            # a sphere hides r²/d² of a hemisphere, weighted by the cosine
            hidden += ti.max(n.dot(d) / ti.sqrt(square), 0.0) * ti.min(spheres[b, 3] * spheres[b, 3] / square, 1.0)
        open_share = 1.0 - 0.8 * ti.min(hidden, 0.85)
        room = open_share * vec3(indirect[y, x, 0], indirect[y, x, 1], indirect[y, x, 2])
        for lamp in range(light.shape[0]):
            seen = _shade(p, light, axes, veil, lamp)
            room += seen * vec3(direct[lamp, y, x, 0], direct[lamp, y, x, 1], direct[lamp, y, x, 2])
        for c in ti.static(range(3)):
            out[y, x, c] = body[y, x, c] + (1.0 - body[y, x, 3]) * room[c]


def _f32(a: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.ascontiguousarray(a, dtype=np.float32)


@dataclass(frozen=True)
class Body:
    """Actors as kernel arguments: everything that does not change from frame to frame. Bit k of ``stripes`` is actor
    k's."""

    actor: Actor
    shape: NDArray[np.float32]
    materials: NDArray[np.int32]
    colors: NDArray[np.float32]
    stripes: int

    @staticmethod
    def of(actor: Actor, colors: NDArray[np.float64], stripes: bool) -> "Body":
        return Body(actor, _f32(actor.shape), actor.material.astype(np.int32), _f32(colors), int(stripes))

    @staticmethod
    def join(bodies: Sequence["Body"]) -> "Body":
        """Return several actors as one body; its poses are those of :meth:`Pose.join`."""
        actor, colors = join([body.actor for body in bodies]), np.concatenate([body.colors for body in bodies])
        stripes = sum(body.stripes << k for k, body in enumerate(bodies))
        return Body(actor, _f32(actor.shape), actor.material.astype(np.int32), colors, stripes)


def shadow_maps(body: Body, pose: Pose, lamps: Lamps) -> NDArray[np.float32]:
    """(L, Z, Z) distance from each lamp to the actor, metres, at one moment (``pose`` holds one)."""
    ensure_runtime()
    frames = _f32(body.actor.frames(pose))
    maps = []
    for camera, rays in zip(lamps.cameras, lamps.rays, strict=True):
        tiles = make_tiles(camera, body.actor, pose)
        out = np.full((camera.height, camera.width), FAR_M, dtype=np.float32)
        _depth_kernel(_f32(camera.center), rays, frames, body.shape, body.materials, tiles.first, tiles.start,
                      tiles.primitive, tiles.near_far, out)  # fmt: skip
        maps.append(out)
    return np.array(maps)


def render_actor(
    camera: Camera, rays: NDArray[np.float32], body: Body, poses: Pose, lamps: Lamps, shadow: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(H, W, 4) linear RGB, premultiplied, and coverage; ``poses`` holds one pose for each of the S sample rays."""
    ensure_runtime()
    out = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
    tiles = make_tiles(camera, body.actor, poses)
    _render_kernel(body.stripes, _f32(camera.center), rays, _f32(body.actor.frames(poses)), body.shape,
                   body.materials, body.colors, tiles.first, tiles.start, tiles.primitive, tiles.near_far,
                   lamps.light, lamps.axes, shadow, lamps.ambient, out)  # fmt: skip
    return out


def distances(body: Body, pose: Pose, points: NDArray[np.floating]) -> NDArray[np.float32]:
    """(P,) signed distance from (P, 3) world points to the actor in one pose, metres."""
    ensure_runtime()
    out = np.empty(len(points), dtype=np.float32)
    every = np.arange(len(body.materials), dtype=np.int32)
    _distance_kernel(_f32(points), every, _f32(body.actor.frames(pose)), body.shape, body.materials, out)
    return out


def composite(
    room: RoomView, lamps: Lamps, shadow: NDArray[np.float32], spheres: NDArray[np.float32], body: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(H, W, 3) linear RGB: the actor over the room, with his shadows.

    Args:
        room: what the camera sees of the empty room.
        lamps, shadow: the lamps and their shadow maps.
        spheres: (B, 4) centre and radius of balls that stand for the body in ambient light.
        body: from :func:`render_actor`.
    """
    ensure_runtime()
    out = np.empty((*body.shape[:2], 3), dtype=np.float32)
    # lamps have a size: their shadows have soft edges
    veil = np.array([cv2.GaussianBlur((z < FAR_M).astype(np.float32), (0, 0), PENUMBRA_PX) for z in shadow])
    _composite_kernel(room.point, room.normal, room.indirect, room.direct, lamps.light, lamps.axes, veil, spheres,
                      body, out)  # fmt: skip
    return out
