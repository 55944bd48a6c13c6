# No `from __future__ import annotations` here: Taichi reads the annotations of kernels.
"""Taichi kernels of :mod:`scripts.synthetic.render`: sphere tracing, shadows, compositing over the room.

Rays are traced in bundles. A tile of 16 pixels keeps the primitives that its beam of rays can meet, a block of 4 pixels
those of the tile that its own beam can meet. The beam of each quarter of a block advances as one ray for as long as the
body is farther away than the beam is wide; only then each ray advances alone. A beam is as wide as its rays and as the
body's motion during the exposure. Distances to the body are computed for four points at once: processors then work on
four chains of operations at the same time.

A pixel has four samples. Each sample has its own place in the pixel and its own moment of the exposure: this gives
antialiasing, coverage and motion blur. A pixel that the body fills is lit once, and coloured at each sample.
"""

from scripts.synthetic.noise import noise3
from tk.kernels.runtime import ti

TILE, BLOCK = 16, 4  # pixels
MAX_STEPS = 120
STEP = 0.85  # squeezed and wrinkled space is not quite 1-Lipschitz
HIT_M = 0.0008
CLOSE_M = 0.02
GRAZE_M = 0.004
"""A ray that has used up its steps this near to the body counts as a hit."""
FLAT_M = 0.03
"""Light is computed once for a pixel whose samples differ by less than this in depth, metres."""
SHADOW_BIAS_M = 0.035
FAR_M = 1.0e4
CORNERS = ((1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, 1.0, 1.0))

vec3 = ti.types.vector(3, ti.f32)
vec4, int4 = ti.types.vector(4, ti.f32), ti.types.vector(4, ti.i32)
Points = ti.types.matrix(3, 4, ti.f32)
Array = ti.types.ndarray


@ti.func
def _in_bone(p, moment, i, frames: ti.template()):
    """The points in the frame of primitive i's bone, each at its own moment."""
    q = Points(0.0)
    for lane in ti.static(range(4)):
        for r in ti.static(range(3)):
            q[r, lane] = frames[moment[lane], i, 4 * r + 3]
            for c in ti.static(range(3)):
                q[r, lane] += frames[moment[lane], i, 4 * r + c] * p[c, lane]
    return q


@ti.func
def _row(p, r):
    """Row r of (3, 4) points."""
    return vec4(p[r, 0], p[r, 1], p[r, 2], p[r, 3])


@ti.func
def _primitive(p, moment, i, frames: ti.template(), shape: ti.template(), material):
    """Signed distances of four points to primitive i."""
    q = _in_bone(p, moment, i, frames)
    x, y, z = _row(q, 0), _row(q, 1), _row(q, 2)
    u, v, w = shape[i, 4] * x - shape[i, 0], shape[i, 5] * y - shape[i, 1], shape[i, 6] * z - shape[i, 2]
    size = shape[i, 3]
    result = vec4(0.0)
    if material % 6 == 5:  # a box with rounded edges
        edge = 0.006
        u, v, w = ti.abs(u) - (size - edge), ti.abs(v) - (size - edge), ti.abs(w) - (size - edge)
        outer = ti.sqrt(ti.max(u, 0.0) ** 2 + ti.max(v, 0.0) ** 2 + ti.max(w, 0.0) ** 2)
        result = outer + ti.min(ti.max(u, v, w), 0.0) - edge
    else:
        along = shape[i, 7] * u + shape[i, 8] * v + shape[i, 9] * w
        across = ti.sqrt(ti.max(u * u + v * v + w * w - along * along, 0.0))
        # the sphere of the family that is nearest to the point
        h = ti.min(ti.max(along - across * shape[i, 12], 0.0), shape[i, 10])
        u, v, w = u - h * shape[i, 7], v - h * shape[i, 8], w - h * shape[i, 9]
        square = u * u + v * v + w * w + 1e-12
        u, v, w = shape[i, 4] * u, shape[i, 5] * v, shape[i, 6] * w
        # back from squeezed space: divide by the gradient there
        result = (ti.sqrt(square) - (size - shape[i, 11] * h)) * ti.sqrt(square / (u * u + v * v + w * w + 1e-12))
    wrinkle, number = shape[i, 18], shape[i, 19]
    if wrinkle > 0.0 and result.min() < 0.02:
        # folds: warped waves, mostly across the bone
        fold = ti.sin(23.0 * z + 9.0 * x + 2.5 * ti.sin(17.0 * y + 11.0 * x + 1.7 * number))
        fold += 0.6 * ti.sin(47.0 * z - 21.0 * y + 2.0 * ti.sin(31.0 * x + 1.3 * number))
        result -= ti.select(result < 0.02, 0.6 * wrinkle * fold, 0.0)
    cut = shape[i, 13] * x + shape[i, 14] * y + shape[i, 15] * z - shape[i, 16]
    return ti.max(result, -cut)


@ti.func
def _body(p, moment, tile, count, near: ti.template(), frames: ti.template(), shape: ti.template()):
    """Distances of four points to the body, each at its own moment, and the indices of the nearest primitives.

    The body consists of the first ``count`` primitives of ``near[tile, 1]``. Materials are blended within, not between.
    """
    best, group, group_nearest, outside = vec4(1e9), vec4(1e9), vec4(1e9), vec4(1e9)
    best_i, group_i = int4(-1), int4(-1)
    current = -1
    for k in range(count):
        i = near[tile, 1, k]
        m = ti.cast(shape[i, 20], ti.i32)
        if m != current:
            best_i = ti.select(group < best, group_i, best_i)
            best = ti.min(group, best)
            group, group_nearest, group_i, current = vec4(1e9), vec4(1e9), int4(-1), m
        bound = vec4(0.0)
        for lane in ti.static(range(4)):
            a = p[0, lane] - frames[moment[lane], i, 12]
            b = p[1, lane] - frames[moment[lane], i, 13]
            c = p[2, lane] - frames[moment[lane], i, 14]
            bound[lane] = a * a + b * b + c * c
        bound = ti.sqrt(bound) - frames[0, i, 15]
        far = bound > CLOSE_M  # too far to blend: its bounding sphere will do for the next step
        outside = ti.select(far, ti.min(outside, bound), outside)
        if bound.min() <= CLOSE_M:
            d = ti.select(far, 1e9, _primitive(p, moment, i, frames, shape, m))
            group_i = ti.select(d < group_nearest, i, group_i)
            group_nearest = ti.min(d, group_nearest)
            blend = shape[i, 17]
            h = ti.max(blend - ti.abs(d - group), 0.0)
            group = ti.min(d, group) - h * h / ti.max(4.0 * blend, 1e-9)
    best_i = ti.select(group < best, group_i, best_i)
    return ti.min(best, group, outside), best_i


@ti.func
def _along(origin, rays, t):
    """The points (3, 4) at the distances t along four rays."""
    p = Points(0.0)
    for lane in ti.static(range(4)):
        for r in ti.static(range(3)):
            p[r, lane] = origin[r] + t[lane] * rays[r, lane]
    return p


@ti.func
def _advance(origin, axes, start, far, width, spread, tile, count, near: ti.template(), frames: ti.template(),
             shape: ti.template()):  # fmt: skip
    """Distances up to which four beams with the radii ``width + spread * t`` are empty; FAR_M: empty up to ``far``.

    The body is the one at the first moment. A beam that starts at FAR_M stays there.
    """
    t, reached = start, vec4(FAR_M)
    active = ti.select(t < far, 1, 0)
    for _ in range(MAX_STEPS):
        if active.max() == 0:
            break
        d, _i = _body(_along(origin, axes, t), int4(0), tile, count, near, frames, shape)
        radius = width + spread * t
        room = STEP * d - radius
        full = ti.select(room < 0.25 * radius, active, 0)
        reached = ti.select(full == 1, t, reached)
        active -= full
        t += active * room
        active = ti.select(t < far, active, 0)
    return reached


@ti.func
def _trace(origin, rays, start, far, moment, tile, count, near: ti.template(), frames: ti.template(),
           shape: ti.template()):  # fmt: skip
    """Distances along four rays to the body (FAR_M for a miss), and the primitives that were hit."""
    t, hit, hit_i = start, vec4(FAR_M), int4(-1)
    before, step = vec4(0.0), vec4(0.0)
    active = ti.select(t < far, 1, 0)
    for k in range(MAX_STEPS):
        if active.max() == 0:
            break
        d, i = _body(_along(origin, rays, t), moment, tile, count, near, frames, shape)
        touch = HIT_M
        if k == MAX_STEPS - 1:
            touch = GRAZE_M
        there = ti.select(d < touch, active, 0)
        # if inside, the surface lies between the last two points
        hit = ti.select(there == 1, t + ti.select(d < 0.0, step * d / ti.max(before - d, 1e-6), 0.0), hit)
        hit_i = ti.select(there == 1, i, hit_i)
        active -= there
        # near the surface the distance is nearly linear
        slope = ti.min(ti.max((before - d) / ti.max(step, 1e-6), 0.5), 1.0)
        secant = ti.select(step > 0.0, ti.select(d < CLOSE_M, d / slope, STEP * d), STEP * d)
        step = active * secant
        before = d
        t += step
        active = ti.select(t < far, active, 0)
    return hit, hit_i


@ti.func
def _meets(origin, axis, spread, i, capsules: ti.template()):
    """Whether a beam can meet primitive i, and the distances along the beam between which the primitive lies."""
    a = vec3(capsules[i, 0], capsules[i, 1], capsules[i, 2]) - origin
    b = vec3(capsules[i, 3], capsules[i, 4], capsules[i, 5]) - origin
    radius = capsules[i, 6] + capsules[i, 7]
    ta, tb = a.dot(axis), b.dot(axis)
    a -= ta * axis
    b -= tb * axis
    along = b - a
    s = ti.math.clamp(-a.dot(along) / ti.max(along.dot(along), 1e-12), 0.0, 1.0)
    reach = 1.02 * (radius + spread * ti.max(ta, tb))
    return (a + s * along).norm() < reach and ti.max(ta, tb) > -radius, ti.min(ta, tb) - reach, ti.max(ta, tb) + reach


@ti.func
def _beam(rays: ti.template(), x, y, size):
    """Axis and spread of the beam of rays through a square of pixels whose first one is (x, y)."""
    left, top = ti.min(x, rays.shape[2] - 1), ti.min(y, rays.shape[1] - 1)
    right, low = ti.min(x + size, rays.shape[2]) - 1, ti.min(y + size, rays.shape[1]) - 1
    axis = vec3(0.0)
    for corner in ti.static(range(4)):
        u, v = (right if corner & 1 else left), (low if corner & 2 else top)
        for s in range(rays.shape[0]):
            axis += vec3(rays[s, v, u, 0], rays[s, v, u, 1], rays[s, v, u, 2])
    axis = axis.normalized()
    spread = 0.0
    for corner in ti.static(range(4)):
        u, v = (right if corner & 1 else left), (low if corner & 2 else top)
        for s in range(rays.shape[0]):
            spread = ti.max(spread, (vec3(rays[s, v, u, 0], rays[s, v, u, 1], rays[s, v, u, 2]) - axis).norm())
    return axis, spread


@ti.func
def _tile(origin, rays: ti.template(), tile, x, y, capsules: ti.template(), near: ti.template()):
    """Fill ``near[tile, 0]`` with the primitives that a tile can show; return their number."""
    axis, spread = _beam(rays, x, y, TILE)
    count = 0
    for i in range(capsules.shape[0]):
        met, _, _ = _meets(origin, axis, spread, i, capsules)
        if met:
            near[tile, 0, count] = i
            count += 1
    return count


@ti.func
def _block(origin, rays: ti.template(), tile, count, x, y, capsules: ti.template(), near: ti.template(),
           frames: ti.template(), shape: ti.template()):  # fmt: skip
    """Fill ``near[tile, 1]`` with the primitives of the tile that a block can show.

    Return their number; the distances (4,) along the rays up to which each quarter of the block is empty, FAR_M for one
    that shows nothing; and the distance at which the body ends.
    """
    axis, spread = _beam(rays, x, y, BLOCK)
    found = 0
    begin, end, moved = FAR_M, 0.0, 0.0
    for k in range(count):
        i = near[tile, 0, k]
        met, first, last = _meets(origin, axis, spread, i, capsules)
        if met:
            near[tile, 1, found] = i
            found += 1
            begin, end, moved = ti.min(begin, first), ti.max(end, last), ti.max(moved, capsules[i, 7])
    start = vec4(FAR_M)
    if found > 0:
        axes, spreads = _beams(rays, x, y, BLOCK // 2)
        start = _advance(origin, axes, vec4(ti.max(begin, 0.0)), end, moved, spreads, tile, found, near, frames, shape)
    return found, start, end


@ti.func
def _beams(rays: ti.template(), x, y, size):
    """Axes (3, 4) and spreads (4,) of the beams through four squares of pixels, whose first one is (x, y)."""
    axes, spreads = Points(0.0), vec4(0.0)
    for lane in ti.static(range(4)):
        axis, spread = _beam(rays, x + size * (lane % 2), y + size * (lane // 2), size)
        spreads[lane] = spread
        for r in ti.static(range(3)):
            axes[r, lane] = axis[r]
    return axes, spreads


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


@ti.func
def _light(p, moment, tile, count, near: ti.template(), frames: ti.template(), shape: ti.template(),
           light: ti.template(), axes: ti.template(), shadow: ti.template(),
           ambient: ti.template()):  # fmt: skip
    """Light that falls on a point of the body, RGB."""
    corners = Points(0.0)
    for lane in ti.static(range(4)):
        for r in ti.static(range(3)):
            corners[r, lane] = p[r] + 0.002 * CORNERS[lane][r]
    d, _ = _body(corners, int4(moment), tile, count, near, frames, shape)
    normal = vec3(0.0)
    for lane in ti.static(range(4)):  # gradient from the corners of a tetrahedron
        normal += d[lane] * vec3(CORNERS[lane][0], CORNERS[lane][1], CORNERS[lane][2])
    normal = normal.normalized(1e-9)
    # light bounced by the floor from below, by the room from above
    radiance = (0.72 + 0.28 * normal[2]) * vec3(ambient[0], ambient[1], ambient[2])
    for lamp in range(light.shape[0]):
        to_light = (vec3(light[lamp, 0], light[lamp, 1], light[lamp, 2]) - p).normalized(1e-9)
        facing = normal.dot(to_light)
        if facing > 0.0:
            lit = facing * _visibility(p, light, axes, shadow, lamp, SHADOW_BIAS_M)
            radiance += lit * vec3(light[lamp, 3], light[lamp, 4], light[lamp, 5])
    return radiance


@ti.kernel
def render_kernel(
    stripes: ti.i32,
    origin: Array(dtype=ti.f32, ndim=1),  # (3,)
    rays: Array(dtype=ti.f32, ndim=4),  # (S, H, W, 3)
    frames: Array(dtype=ti.f32, ndim=3),  # (S, N, 16)
    capsules: Array(dtype=ti.f32, ndim=2),  # (N, 8)
    shape: Array(dtype=ti.f32, ndim=2),  # (N, 21) see `_table`
    colors: Array(dtype=ti.f32, ndim=2),  # (6 P, 3)
    light: Array(dtype=ti.f32, ndim=2),  # (L, 7) position, colour, focal length of the shadow map
    axes: Array(dtype=ti.f32, ndim=3),  # (L, 3, 3)
    shadow: Array(dtype=ti.f32, ndim=3),  # (L, Z, Z)
    ambient: Array(dtype=ti.f32, ndim=1),  # (3,)
    near: Array(dtype=ti.i32, ndim=3),  # (tiles, 2, N) scratch
    out: Array(dtype=ti.f32, ndim=3),  # (H, W, 4) premultiplied colour and coverage, zero before
):
    for tile in range(near.shape[0]):
        o = vec3(origin[0], origin[1], origin[2])
        columns = (rays.shape[2] + TILE - 1) // TILE
        left, top = tile % columns * TILE, tile // columns * TILE
        right, low = ti.min(left + TILE, rays.shape[2]), ti.min(top + TILE, rays.shape[1])
        seen = _tile(o, rays, tile, left, top, capsules, near)
        for block in range((TILE // BLOCK) ** 2 if seen > 0 else 0):
            x0, y0 = left + block % (TILE // BLOCK) * BLOCK, top + block // (TILE // BLOCK) * BLOCK
            count, begin, end = 0, vec4(FAR_M), 0.0
            if x0 < right and y0 < low:
                count, begin, end = _block(o, rays, tile, seen, x0, y0, capsules, near, frames, shape)
            for quarter in range(4 if count > 0 else 0):
                x1, y1 = x0 + quarter % 2 * 2, y0 + quarter // 2 * 2
                if begin[quarter] == FAR_M or x1 >= right or y1 >= low:
                    continue
                for pixel in range(4):
                    x, y = x1 + pixel % 2, y1 + pixel // 2
                    ray = Points(0.0)
                    for lane in ti.static(range(4)):
                        for r in ti.static(range(3)):
                            ray[r, lane] = rays[lane, y, x, r]
                    moment = int4(0, 1, 2, 3)
                    t, hit = _trace(o, ray, vec4(begin[quarter]), end, moment, tile, count, near, frames, shape)
                    covered = ti.select(hit >= 0, 1, 0).sum()
                    flat = covered == 4 and t.max() - t.min() < FLAT_M
                    points = _along(o, ray, t)
                    total, radiance = vec3(0.0), vec3(0.0)
                    for s in range(4):
                        i = hit[s]
                        if i >= 0:
                            if s == 0 or not flat:
                                p = vec3(points[0, s], points[1, s], points[2, s])
                                radiance = _light(p, s, tile, count, near, frames, shape, light, axes, shadow, ambient)
                            q = _in_bone(points, moment, i, frames)
                            q_s = vec3(q[0, s], q[1, s], q[2, s])
                            number, material = ti.cast(shape[i, 19], ti.i32), ti.cast(shape[i, 20], ti.i32)
                            total += _albedo(number, material, q_s, colors, stripes) * radiance
                    for c in ti.static(range(3)):
                        out[y, x, c] = 0.25 * total[c]
                    out[y, x, 3] = 0.25 * covered


@ti.kernel
def depth_kernel(
    origin: Array(dtype=ti.f32, ndim=1),
    rays: Array(dtype=ti.f32, ndim=4),  # (1, Z, Z, 3)
    frames: Array(dtype=ti.f32, ndim=3),
    capsules: Array(dtype=ti.f32, ndim=2),
    shape: Array(dtype=ti.f32, ndim=2),
    near: Array(dtype=ti.i32, ndim=3),
    out: Array(dtype=ti.f32, ndim=2),  # (Z, Z) metres along the ray, FAR_M before
):
    for tile in range(near.shape[0]):
        o = vec3(origin[0], origin[1], origin[2])
        columns = (rays.shape[2] + TILE - 1) // TILE
        left, top = tile % columns * TILE, tile // columns * TILE
        seen = _tile(o, rays, tile, left, top, capsules, near)
        for block in range((TILE // BLOCK) ** 2 if seen > 0 else 0):
            x0, y0 = left + block % (TILE // BLOCK) * BLOCK, top + block // (TILE // BLOCK) * BLOCK
            count, begin, end = _block(o, rays, tile, seen, x0, y0, capsules, near, frames, shape)
            for quarter in range(4 if count > 0 else 0):
                x, y = x0 + quarter % 2 * 2, y0 + quarter // 2 * 2
                ray, _spreads = _beams(rays, x, y, 1)
                t, _hit = _trace(o, ray, vec4(begin[quarter]), end, int4(0), tile, count, near, frames, shape)
                for pixel in ti.static(range(4)):
                    out[y + pixel // 2, x + pixel % 2] = t[pixel]


@ti.kernel
def distance_kernel(
    points: Array(dtype=ti.f32, ndim=2),  # (P, 3)
    every: Array(dtype=ti.i32, ndim=3),  # (1, 2, N) all primitives
    frames: Array(dtype=ti.f32, ndim=3),
    shape: Array(dtype=ti.f32, ndim=2),
    out: Array(dtype=ti.f32, ndim=1),
):
    for n in range((points.shape[0] + 3) // 4):
        p = Points(0.0)
        for lane in ti.static(range(4)):
            for r in ti.static(range(3)):
                p[r, lane] = points[ti.min(4 * n + lane, points.shape[0] - 1), r]
        d, _ = _body(p, int4(0), 0, every.shape[2], every, frames, shape)
        for lane in ti.static(range(4)):
            if 4 * n + lane < points.shape[0]:
                out[4 * n + lane] = d[lane]


@ti.kernel
def composite_kernel(
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
