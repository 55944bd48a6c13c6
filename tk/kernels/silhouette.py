"""Occluding contours of a cone body against silhouettes: search along normals, normal equations.

The silhouette paper, sections 4.1, 4.3 and 4.4. A sample of a contour looks for the silhouette along its normal, in one
direction: outwards where it lies in the mask, inwards where it does not, so that only foreground-to-background
transitions are found. Each found edgel adds a row n·Jπ·∂x/∂θ = d to the equations. The paper adds two rows, dx and dy,
which also hold a contour back along itself, where an edgel says nothing; :attr:`SearchSettings.tangential` weighs that
second row, 0 leaves it out.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cone_arrays import NEAREST_M, ConeArrays, keep, place_part, shape_of
from tk.kernels.cones import (
    SIDE_B,
    curve_of,
    enclosing_radius,
    enter,
    interior_point,
    point_on,
    unscaled,
)
from tk.kernels.kinematics import forward, load_rotation, load_translation
from tk.kernels.launch import Launcher
from tk.kernels.line_search import COLOR_BINS, Regions, SearchSettings, in_picture, search_colors, search_mask
from tk.kernels.projection import camera_center, project
from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.vectors import cross, dot, norm_sqr, pulled, times, transposed_times
from tk.kernels.wrench import INERTIA_NUMBERS

# Chords that stand for a curve when its length is measured and when edgels are compared with it.
CHORDS = 12
# A sample is hidden by another part if it lies this far inside its cross-section: neighbours at a joint touch.
HIDING_SHRINK = 0.95
# Columns of an exported sample: see Edgels.
_EXPORT = 13


class NormalEquations(NamedTuple):
    """What the edgels of B poses add up to, distances in pixels of the full picture.

    Attributes:
        hessian: (B, D, D) JᵀWJ.
        gradient: (B, D) JᵀWd: the step solves ``hessian @ step = gradient``.
        cost: (B,) weighted mean square distance, samples without an edge counted as ``lost_px``; inf without samples.
        found: (B,) weight of the samples that found an edge, as a share of all.
    """

    hessian: NDArray[np.float64]
    gradient: NDArray[np.float64]
    cost: NDArray[np.float64]
    found: NDArray[np.float64]


class Edgels(NamedTuple):
    """The samples of one pose that found an edge (N of them).

    Attributes:
        view, part: (N,) camera and part.
        unscaled: (N, 3) the contour point as (x / a r, y / b r, z / h) in the part's frame.
        distance: (N,) signed distance to the edgel, pixels, positive outwards.
        weight: (N,) of the edgel.
        row: (N, 3) derivative of the contour's position along its normal by the point's world coordinates, pixels per
            metre.
        pixel: (N, 2) of the sample.
        normal: (N, 2) of the contour in the picture, outwards.
    """

    view: NDArray[np.int32]
    part: NDArray[np.int32]
    unscaled: NDArray[np.float64]
    distance: NDArray[np.float64]
    weight: NDArray[np.float64]
    row: NDArray[np.float64]
    pixel: NDArray[np.float64]
    normal: NDArray[np.float64]


@ti.func
def _to_segment(e, a, b):
    """Squared distance of e from the segment a b."""
    ab = b - a
    along = (e[0] - a[0]) * ab[0] + (e[1] - a[1]) * ab[1]
    t = ti.min(ti.max(along / ti.max(ab[0] * ab[0] + ab[1] * ab[1], 1e-12), 0.0), 1.0)
    off = e - a - t * ab
    return off[0] * off[0] + off[1] * off[1]


@ti.func
def _twist_about(twists: ti.template(), b: int, k: int, origin):
    """The twist of a degree of freedom with the velocity of the origin."""
    w = ti.Vector([twists[b, k, i] for i in ti.static(range(3))])
    v = ti.Vector([twists[b, k, 3 + i] for i in ti.static(range(3))]) + cross(w, origin)
    return ti.Vector([w[0], w[1], w[2], v[0], v[1], v[2]])


@ti.func
def _may_hide(ball: ti.template(), b: int, p: int, P: int, eye):
    """Bits of the parts whose spheres meet that of part p in the picture: most are far from it."""
    bits = ti.i64(0)
    own = ti.Vector([ball[b, p, a] for a in ti.static(range(3))]) - eye
    own_square = norm_sqr(own)
    own_sine = ball[b, p, 3] / own_square
    for o in range(P):
        to = ti.Vector([ball[b, o, a] for a in ti.static(range(3))]) - eye
        square = norm_sqr(to)
        sine = ball[b, o, 3] / square
        # the angle between them is at most the sum of their radii's
        apart = 1.0 + 0.0 * square
        if own_sine < 0.5 and sine < 0.5:
            apart = ti.sqrt((1.0 - sine) * (1.0 - own_sine)) - ti.sqrt(sine * own_sine)
            apart = dot(own, to) - apart * ti.sqrt(own_square * square)
        if o != p and apart >= 0.0:
            bits |= ti.i64(1) << o
    return bits


@functools.cache
def _equations_kernel(real, alone):
    @ti.kernel
    def silhouette_equations(
        # the body
        axis: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        point: ti.types.ndarray(dtype=real, ndim=2),  # (D, 3)
        prismatic: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        parent: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,)
        part_kind: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        part_shape: ti.types.ndarray(dtype=real, ndim=2),  # (P, 4)
        part_frame: ti.types.ndarray(dtype=real, ndim=2),  # (P, 12)
        part_dof: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        part_limb: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        curve_part: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (Q,)
        curve_kind: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (Q,)
        chain: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (D,) 0, 1, …
        # the frame
        camera: ti.types.ndarray(dtype=real, ndim=2),  # (V, 22)
        size: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (V, 2) width, height at this scale
        mask: ti.types.ndarray(dtype=ti.u8, ndim=3),  # (M V, H, W) at this scale, of M frames
        moment: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (B,) each pose's frame
        image: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (V, H, W, 3) of the full picture
        likelihood: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (G, COLOR_BINS)
        group: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (P,)
        # settings; scale: pixels of the full picture in one of this scale
        numbers: ti.types.ndarray(dtype=real, ndim=1),  # (8,) in _launch's order
        spread: ti.i32,
        most_samples: ti.i32,
        interior: ti.i32,
        export: ti.i32,
        # the poses
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        frames: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 12) scratch
        twists: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 6) scratch
        placed: ti.types.ndarray(dtype=real, ndim=3),  # (B, P, 12) scratch, parts to world
        ball: ti.types.ndarray(dtype=real, ndim=3),  # (B, P, 4) scratch, a sphere about each part, world
        hiders: ti.types.ndarray(dtype=ti.i64, ndim=3),  # (B, V, P) scratch, bits of the parts that may hide each one
        lines: ti.types.ndarray(dtype=real, ndim=3),  # (B V Q, CHORDS + 1, 2) scratch, pixels of the full picture
        facts: ti.types.ndarray(dtype=real, ndim=2),  # (B V Q, 5) scratch: visible, q0, q1, length, outward sign
        # scratch (B, D, 6 + 21): wrench of the pulls and inertia of the edgels about the root, see tk.kernels.wrench
        collected: ti.types.ndarray(dtype=real, ndim=3),
        samples: ti.types.ndarray(dtype=real, ndim=3),  # (V Q, most_samples, _EXPORT) out, if export
        total: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (B, 3 + D + D D) out
    ):
        B, V, Q = pose.shape[0], camera.shape[0], curve_part.shape[0]
        P, D = part_dof.shape[0], axis.shape[0]

        # a pose is one thread's: to wake the threads for a loop takes 0.1 ms, a sixth of its work
        ti.loop_config(serialize=alone)
        for turn in range(spread * B):
            if turn % spread != 0:
                continue
            b = turn // spread
            forward(axis, point, prismatic, parent, chain, pose, b, b, frames, twists)
            for p in range(P):
                R, t = place_part(frames, part_dof, part_frame, b, p)
                keep(placed, b, p, R, t)
                middle = times(R, interior_point(part_kind[p], shape_of(part_shape, p))) + t
                for a in ti.static(range(3)):
                    ball[b, p, a] = middle[a]
                ball[b, p, 3] = enclosing_radius(part_kind[p], shape_of(part_shape, p)) ** 2
            for v in range(V):
                eye = camera_center(camera, v)
                for p in range(P):
                    hiders[b, v, p] = _may_hide(ball, b, p, P, eye)
            for task in range(V * Q):
                c, v, q = b * V * Q + task, task // Q, task % Q
                p, kind = curve_part[q], curve_kind[q]
                shape = shape_of(part_shape, p)
                R, t = load_rotation(placed, b, p), load_translation(placed, b, p)
                center = transposed_times(R, camera_center(camera, v) - t)
                visible, params = curve_of(kind, shape, center)
                chords = CHORDS
                if kind <= SIDE_B:
                    chords = 1
                length = 0.0 * shape[0]
                sign = 0.0 * shape[0]
                last = ti.Vector([0.0 * length, 0.0 * length])
                for i in range(chords + 1):
                    if visible == 1:
                        x, tangent = point_on(kind, shape, center, params, (i + 0.0 * length) / chords)
                        pixel, J, z = project(camera, v, times(R, x) + t)
                        if z < NEAREST_M:
                            visible = 0
                        if i > 0:
                            length += (pixel - last).norm()
                        if i == 0:
                            # the plane of viewing ray and tangent, turned away from the part's inside
                            n = cross(tangent, x - center)
                            if dot(n, interior_point(part_kind[p], shape) - x) > 0.0:
                                n = -n
                            along, out = times(J, times(R, tangent)), times(J, times(R, n))
                            sign = 1.0 + 0.0 * length
                            if along[1] * out[0] - along[0] * out[1] < 0.0:
                                sign = -sign
                        last = pixel
                        lines[c, i, 0], lines[c, i, 1] = pixel[0], pixel[1]
                facts[c, 0] = visible
                facts[c, 1], facts[c, 2], facts[c, 3], facts[c, 4] = params[0], params[1], length, sign
            for i in range(total.shape[1]):
                total[b, i] = 0.0
            for k in range(D):
                for i in range(6 + INERTIA_NUMBERS):
                    collected[b, k, i] = 0.0
            for task in range(V * Q):
                c, v, q = b * V * Q + task, task // Q, task % Q
                p, kind = curve_part[q], curve_kind[q]
                scale, window, spacing, ambiguous = numbers[0], numbers[1], numbers[2], numbers[3]
                tangential, robust, lost, colors = numbers[4], numbers[5], numbers[6], numbers[7]
                cost, met, all_samples = 0.0 * scale, 0.0 * scale, 0.0 * scale
                pull = ti.Vector([0.0 * scale for _ in range(6)])
                inertia = ti.Vector([0.0 * scale for _ in range(INERTIA_NUMBERS)])
                origin = load_translation(placed, b, 0)
                if export == 1:
                    for i in range(most_samples):
                        samples[c, i, 0] = 0.0
                if facts[c, 0] > 0.0:
                    shape = shape_of(part_shape, p)
                    R, t = load_rotation(placed, b, p), load_translation(placed, b, p)
                    eye = camera_center(camera, v)
                    center = transposed_times(R, eye - t)
                    params = ti.Vector([facts[c, 1], facts[c, 2]])
                    length, sign = facts[c, 3], facts[c, 4]
                    width, height = size[v, 0], size[v, 1]
                    wanted = ti.cast(ti.ceil(length / (spacing * scale)), ti.i32)
                    count = ti.min(ti.max(wanted, 1), most_samples)
                    share = length / count
                    for i in range(count):
                        x_part, tangent = point_on(kind, shape, center, params, (i + 0.5 + 0.0 * scale) / count)
                        x = times(R, x_part) + t
                        pixel, J, _ = project(camera, v, x)
                        along = times(J, times(R, tangent))
                        norm = along.norm()
                        n = ti.Vector([along[1], -along[0]]) * (sign / ti.max(norm, 1e-9))
                        at = (pixel + 0.5) / scale - 0.5
                        use = norm > 1e-6 and in_picture(width, height, at)
                        behind, depth = -1, 1e9 + 0.0 * scale
                        if use:
                            ray = x - eye
                            long = norm_sqr(ray)
                            others = hiders[b, v, p]
                            o = -1
                            while use and others != 0:
                                o += 1
                                this = others & 1
                                others >>= 1
                                close = False
                                if this == 1:
                                    to = ti.Vector([ball[b, o, a] for a in ti.static(range(3))]) - eye
                                    ahead = dot(to, ray)
                                    close = ahead > 0.0 and norm_sqr(to) * long - ahead * ahead < ball[b, o, 3] * long
                                if close:
                                    Ro = load_rotation(placed, b, o)
                                    co = transposed_times(Ro, eye - load_translation(placed, b, o))
                                    ro = transposed_times(Ro, ray)
                                    t_o = enter(part_kind[o], shape_of(part_shape, o), co, ro, HIDING_SHRINK)
                                    # behind another part it is not seen
                                    if t_o > 0.0 and t_o < 1.0:
                                        use = False
                                    elif t_o > 0.0 and t_o < depth:
                                        behind = o
                                        depth = t_o
                        # before another part it is no edge of the silhouette
                        found, d, weight = 0, 0.0 * scale, share
                        if use and behind >= 0 and interior == 0:
                            use = False
                            if colors > 0.0 and part_limb[behind] != part_limb[p] and group[behind] != group[p]:
                                certainty, place = search_colors(
                                    image, likelihood, v, image.shape[2], image.shape[1], pixel, n, window, scale,
                                    group[p], group[behind],
                                )  # fmt: skip
                                weight = share * colors * certainty
                                d = place * scale
                                found = 2
                        elif use:
                            found, d = search_mask(mask, moment[b] * V + v, width, height, at, n, window)
                            d *= scale
                            if found == 0:
                                cost += share * lost * lost
                                all_samples += share
                            else:
                                if ambiguous > 0.0:
                                    edgel = pixel + d * n
                                    nearest = (ambiguous * scale) ** 2
                                    near = False
                                    for q2 in range(Q):
                                        c2 = c - q + q2
                                        if part_limb[curve_part[q2]] != part_limb[p] and facts[c2, 0] > 0.0:
                                            chords = CHORDS
                                            if curve_kind[q2] <= SIDE_B:
                                                chords = 1
                                            for s in range(chords):
                                                e0 = ti.Vector([lines[c2, s, 0], lines[c2, s, 1]])
                                                e1 = ti.Vector([lines[c2, s + 1, 0], lines[c2, s + 1, 1]])
                                                # an edge that faces the other way has its foreground on the other side
                                                facing = ti.Vector([e1[1] - e0[1], e0[0] - e1[0]]).dot(n) * facts[c2, 4]
                                                if facing > 0.0:
                                                    square = _to_segment(edgel, e0, e1)
                                                    if square < nearest:
                                                        nearest = square
                                                        near = True
                                    if near:
                                        other = ti.sqrt(nearest)
                                        weight *= 0.5 * other / ti.max(other + ti.abs(d), 1e-6)
                                if robust > 0.0:
                                    weight *= 1.0 / (1.0 + (d / (robust * scale)) ** 2) ** 2
                                cost += share * ti.min(d * d, lost * lost)
                                met += share
                                all_samples += share
                        if found > 0 and weight > 0.0:
                            g = pulled(J, n)
                            h = pulled(J, ti.Vector([-n[1], n[0]]))
                            # what a twist does to the distance, and to the place along the contour
                            arm = x - origin
                            gm, hm = cross(arm, g), cross(arm, h)
                            across = ti.Vector([gm[0], gm[1], gm[2], g[0], g[1], g[2]])
                            beside = ti.Vector([hm[0], hm[1], hm[2], h[0], h[1], h[2]])
                            pull += weight * d * across
                            for j in ti.static(range(6)):
                                for k in ti.static(range(j + 1)):
                                    inertia[j * (j + 1) // 2 + k] += weight * (
                                        across[j] * across[k] + tangential * beside[j] * beside[k]
                                    )
                            if export == 1:
                                s = unscaled(kind, shape, x_part)
                                samples[c, i, 0] = 1.0
                                samples[c, i, 1] = d
                                samples[c, i, 2] = weight
                                for a in ti.static(range(3)):
                                    samples[c, i, 3 + a] = s[a]
                                    samples[c, i, 6 + a] = g[a]
                                for a in ti.static(range(2)):
                                    samples[c, i, 9 + a] = pixel[a]
                                    samples[c, i, 11 + a] = n[a]

                # always in the same order: the same sums every time
                k = part_dof[p]
                total[b, 0] = total[b, 0] + cost
                total[b, 1] = total[b, 1] + met
                total[b, 2] = total[b, 2] + all_samples
                for a in ti.static(range(6)):
                    collected[b, k, a] = collected[b, k, a] + pull[a]
                for a in ti.static(range(INERTIA_NUMBERS)):
                    collected[b, k, 6 + a] = collected[b, k, 6 + a] + inertia[a]
            # handed down the tree, from the leaves to the root
            origin = load_translation(placed, b, 0)
            for back in range(D):
                k = D - 1 - back
                own = _twist_about(twists, b, k, origin)
                force = own * 0.0
                gradient = 0.0 * own[0]
                for i in ti.static(range(6)):
                    gradient += own[i] * collected[b, k, i]
                    for j in ti.static(range(6)):
                        low, high = min(i, j), max(i, j)
                        force[i] += collected[b, k, 6 + high * (high + 1) // 2 + low] * own[j]
                total[b, 3 + k] = gradient
                j = k
                while j >= 0:
                    shared = ti.cast(force.dot(_twist_about(twists, b, j, origin)), ti.f64)
                    total[b, 3 + D + k * D + j] = shared
                    total[b, 3 + D + j * D + k] = shared
                    j = parent[j]
                if parent[k] >= 0:
                    for i in range(6 + INERTIA_NUMBERS):
                        collected[b, parent[k], i] = collected[b, parent[k], i] + collected[b, k, i]

    return Launcher(silhouette_equations)


def _launch(
    body: ConeArrays,
    cameras: NDArray[np.floating],
    sizes: NDArray[np.integer],
    masks: NDArray[np.uint8],
    scale: float,
    poses: NDArray[np.floating],
    settings: SearchSettings,
    export: bool,
    regions: Regions | None,
) -> tuple[NDArray[np.float64], NDArray[np.floating]]:
    ensure_runtime()
    dtype = body.axis.dtype
    poses = np.ascontiguousarray(poses, dtype)
    B, D = poses.shape
    V, Q, P = len(cameras), len(body.curve_part), len(body.part_kind)
    tasks = B * V * Q
    regions = regions or _no_regions(len(body.part_kind))
    if len(masks) not in (V, B * V):
        raise ValueError(f"{len(masks)} masks of {V} views: one set, or one for each of {B} poses")
    total = np.empty((B, 3 + D + D * D))
    samples = np.zeros((tasks, settings.most_samples, _EXPORT) if export else (1, 1, _EXPORT), dtype)
    _equations_kernel(ti.f64 if dtype == np.float64 else ti.f32, B == 1)(
        *body,
        _all_of(D),
        np.ascontiguousarray(cameras, dtype),
        np.ascontiguousarray(sizes, np.int32),
        np.ascontiguousarray(masks),
        _all_of(B) if len(masks) > V else _zeros(B),
        regions.image,
        regions.log_likelihood,
        regions.group,
        _numbers(settings, scale, regions.weight, dtype),
        spread_of(B),
        settings.most_samples,
        int(settings.interior),
        int(export),
        poses,
        *_scratch(B, V, Q, D, P, dtype),
        samples,
        total,
    )
    return total, samples


@functools.cache
def _all_of(count: int) -> NDArray[np.int32]:
    return np.arange(count, dtype=np.int32)


@functools.cache
def _zeros(count: int) -> NDArray[np.int32]:
    return np.zeros(count, dtype=np.int32)


@functools.lru_cache(64)
def _numbers(s: SearchSettings, scale: float, weight: float, dtype: np.dtype) -> NDArray[np.floating]:
    return np.array(
        (scale, s.window_px, s.spacing_px, s.ambiguous_px, s.tangential, s.robust_px, s.lost_px, weight), dtype
    )


@functools.lru_cache(8)
def _scratch(B: int, V: int, Q: int, D: int, P: int, dtype: np.dtype) -> tuple[NDArray, ...]:
    tasks = B * V * Q
    before = (B, D, 12), (B, D, 6), (B, P, 12), (B, P, 4)
    behind = (tasks, CHORDS + 1, 2), (tasks, 5), (B, D, 6 + INERTIA_NUMBERS)
    arrays = [[np.empty(shape, dtype) for shape in shapes] for shapes in (before, behind)]
    return (*arrays[0], np.empty((B, V, P), np.int64), *arrays[1])


@functools.cache
def _no_regions(parts: int) -> Regions:
    return Regions(
        np.zeros((1, 1, 1, 3), np.uint8), np.zeros((1, COLOR_BINS), np.float32), np.zeros(parts, np.int32), 0.0
    )


def normal_equations(
    body: ConeArrays,
    cameras: np.ndarray,
    sizes: np.ndarray,
    masks: np.ndarray,
    scale: float,
    poses: np.ndarray,
    settings: SearchSettings,
    regions: Regions | None = None,
) -> NormalEquations:
    """Search the silhouettes from B poses and add up the equations (eqs. 9-11 of the silhouette paper).

    Args:
        body: the cone body; its real type is the precision of the computation.
        cameras: (V, 22) rows of :func:`tk.kernels.projection.pack_camera`, of the full picture.
        sizes: (V, 2) width and height of each camera's mask at this scale.
        masks: (V, H, W) uint8 at this scale; values between 0 and 255 where a pixel is partly covered. Or (B V, H, W),
            those of another frame for each pose.
        scale: pixels of the full picture in one of this scale (1, 2, …).
        poses: (B, D).
        settings: see :class:`SearchSettings`.
        regions: what colours tell inside the silhouette; None: nothing.

    Raises:
        ValueError: another number of masks.
    """
    total, _ = _launch(body, cameras, sizes, masks, scale, poses, settings, False, regions)
    B, D = poses.shape
    weight = total[:, 2]
    seen = weight > 0
    safe = np.where(seen, weight, 1.0)
    return NormalEquations(
        hessian=total[:, 3 + D :].reshape(B, D, D),
        gradient=total[:, 3 : 3 + D],
        cost=np.where(seen, total[:, 0] / safe, np.inf),
        found=np.where(seen, total[:, 1] / safe, 0.0),
    )


def find_edgels(
    body: ConeArrays,
    cameras: np.ndarray,
    sizes: np.ndarray,
    masks: np.ndarray,
    scale: float,
    pose: np.ndarray,
    settings: SearchSettings,
) -> Edgels:
    """The edgels that one pose (D,) finds; arguments as for :func:`normal_equations`."""
    _, samples = _launch(body, cameras, sizes, masks, scale, pose[None], settings, True, None)
    Q = len(body.curve_part)
    task, index = np.nonzero(samples[:, :, 0])
    chosen = samples[task, index].astype(np.float64)
    return Edgels(
        view=(task // Q).astype(np.int32),
        part=body.curve_part[task % Q],
        unscaled=chosen[:, 3:6],
        distance=chosen[:, 1],
        weight=chosen[:, 2],
        row=chosen[:, 6:9],
        pixel=chosen[:, 9:11],
        normal=chosen[:, 11:13],
    )
