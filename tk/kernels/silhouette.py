"""Occluding contours of a cone body against silhouettes: search along normals, normal equations.

The silhouette paper, sections 4.1, 4.3 and 4.4. A sample of a contour searches the silhouette along its normal, in one
direction: outwards where it lies in the mask, inwards where it does not, so that only foreground-to-background
transitions are found. Each edgel found adds a row n·Jπ·∂x/∂θ = d to the equations. The paper adds two rows, dx and dy,
which also hold a contour back along itself, where an edgel has no evidence; :attr:`SearchSettings.tangential` weighs
that second row, 0 removes it.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cone_arrays import PART_LIMB, PART_MOVED, ConeArrays, group_of, shape_of
from tk.kernels.cone_contours import (
    LENGTH,
    OUTLINE_NUMBERS,
    PARAMETERS,
    PLACED_NUMBERS,
    SIGN,
    VISIBLE,
    find_hider,
    find_hiders,
    nearest_rival,
    place_parts,
    trace_curve,
)
from tk.kernels.cones import point_on, unscaled
from tk.kernels.kinematics import forward_tree, load_rotation, load_translation
from tk.kernels.line_search import COLOR_BINS, Regions, SearchSettings, in_picture, search_colors, search_mask
from tk.kernels.newton import LENGTHS, LINEAR, TOLERANCE, NewtonSteps, newton_step
from tk.kernels.projection import camera_center, project
from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.taichi_internals import Launcher
from tk.kernels.vectors import cross, norm2, pulled, times, transposed_times
from tk.kernels.wrench import (
    INERTIA,
    INERTIA_NUMBERS,
    OF_VIEW,
    PULL_NUMBERS,
    VIEW_NUMBERS,
    add_displaced,
    collect_inertias,
    collect_pulls,
)

# Columns of an exported sample: see Edgels.
_EXPORT = 13
# Columns of the packed settings. SCALE: pixels of the full picture in one of this scale; the others: SearchSettings.
(
    SCALE, WINDOW, SPACING, AMBIGUOUS, TANGENTIAL, ROBUST, DISPLACED, COLORS, MOST_SAMPLES, INTERIOR, EXPORT, RATIO,
) = range(12)  # fmt: skip
# Columns of ``sums``: steps made; then the gradient.
STEPS, GRADIENT = range(2)


class Silhouettes(NamedTuple):
    """Masks of V views at one scale."""

    cameras: NDArray[np.floating]  # (V, 27) of :func:`tk.kernels.projection.pack_cameras`, of the full image
    sizes: NDArray[np.integer]  # (V, 2) width and height of each camera's mask
    # (V, H, W), between 0 and 255 where a pixel is partly covered, :data:`~tk.kernels.mask_values.OTHERS` where it
    # shows another person; or (B V, H, W), each pose's own
    masks: NDArray[np.uint8]
    scale: float  # pixels of the full image in one of this scale (1, 2, …)


class NormalEquations(NamedTuple):
    """The normal equations of B poses, distances in pixels of the full picture."""

    hessian: NDArray[np.float64]  # (B, D, D) JᵀWJ
    gradient: NDArray[np.float64]  # (B, D) JᵀWd: the step solves `hessian @ step = gradient`


class Edgels(NamedTuple):
    """The samples of contours that found an edge (N of them)."""

    # pose, view, part: (N,) index of the pose, camera and part
    pose: NDArray[np.int32]
    view: NDArray[np.int32]
    part: NDArray[np.int32]
    unscaled: NDArray[np.float64]  # (N, 3) the contour point as (x / a r, y / b r, z / h) in the part's frame
    distance: NDArray[np.float64]  # (N,) signed distance to the edgel, pixels, positive outwards
    weight: NDArray[np.float64]  # (N,) weight of the edgel's row
    # (N, 3) derivative of the contour's position along its normal by the point's world coordinates, pixels per metre
    row: NDArray[np.float64]
    pixel: NDArray[np.float64]  # (N, 2) the sample's image
    normal: NDArray[np.float64]  # (N, 2) unit normal of the contour in the image, outwards

    def of(self, rows: "slice | NDArray[np.integer]") -> "Edgels":
        """Return some edgels."""
        return Edgels._make(values[rows] for values in self)


@ti.func
def image_of(cameras: ti.template(), v: int, x, along, sign):
    """Return the pixel of a sample x of a curve, the pixel's derivative, the outward normal in the image, and whether
    that normal is defined; ``along``: the curve's tangent in the world."""
    pixel, J, _ = project(cameras, v, x)
    tangent = times(J, along)
    norm = norm2(tangent)
    n = ti.Vector([tangent[1], -tangent[0]]) * (sign / ti.max(norm, 1e-9))
    return pixel, J, n, norm > 1e-6


@ti.func
def robust_weight(d, soft):
    """Return the Geman-McClure weight of a distance: ¼ where it equals ``soft``."""
    return 1.0 / (1.0 + (d / soft) ** 2) ** 2


@ti.func
def shared_weight(d, rival_sqr):
    """Return the weight of an edgel at distance d that lies at a rival edge's squared distance (section 4.4)."""
    other = ti.sqrt(rival_sqr)
    return 0.5 * other / ti.max(other + ti.abs(d), 1e-6)


@ti.func
def add_row(pull: ti.template(), inertia: ti.template(), arm, J, n, d, weight, tangential):
    """Add the rows of an edgel to a wrench (6,) and an inertia (21,) about the origin that ``arm`` starts from."""
    g = pulled(J, n)
    h = pulled(J, ti.Vector([-n[1], n[0]]))
    # what a twist does to the distance, and to the place along the contour
    gm, hm = cross(arm, g), cross(arm, h)
    across = ti.Vector([gm[0], gm[1], gm[2], g[0], g[1], g[2]])
    beside = ti.Vector([hm[0], hm[1], hm[2], h[0], h[1], h[2]])
    pull += weight * d * across
    for j in ti.static(range(6)):
        for k in ti.static(range(j + 1)):
            inertia[j * (j + 1) // 2 + k] += weight * (across[j] * across[k] + tangential * beside[j] * beside[k])


@ti.func
def export_sample(samples: ti.template(), c: int, i: int, x_unscaled, pixel, g, n, d, weight):
    """Store an edgel as sample i of row c, see :class:`Edgels`."""
    samples[c, i, 0] = 1.0
    samples[c, i, 1] = d
    samples[c, i, 2] = weight
    for a in ti.static(range(3)):
        samples[c, i, 3 + a] = x_unscaled[a]
        samples[c, i, 6 + a] = g[a]
    for a in ti.static(range(2)):
        samples[c, i, 9 + a] = pixel[a]
        samples[c, i, 11 + a] = n[a]


@ti.func
def prepare_pose(
    tree: ti.template(), parts: ti.template(), curves: ti.template(), cameras: ti.template(), pose: ti.template(),
    b: int, joints: ti.template(), placed: ti.template(), hiders: ti.template(), outlines: ti.template(),
):  # fmt: skip
    """Place the body of pose b, and trace its contours in every view; arguments as in the kernel."""
    V, Q = cameras.shape[0], curves.shape[0]
    forward_tree(tree, pose, b, b, joints)
    place_parts(joints, parts, b, placed)
    find_hiders(placed, cameras, b, hiders)
    for task in range(V * Q):
        v, q = task // Q, task % Q
        trace_curve(parts, placed, cameras, b, v, curves[q, 0], curves[q, 1], b * V * Q + task, outlines)
    for k in range(tree.shape[0]):
        for i in range(2 * VIEW_NUMBERS):
            joints[b, k, INERTIA + i] = 0.0


@ti.func
def weigh_edgel(
    parts: ti.template(), curves: ti.template(), outlines: ti.template(), numbers: ti.template(), first: int, p: int,
    edgel, n, d, weight,
):  # fmt: skip
    """Return the weight of an edgel at distance d: less near the edge of another part, and less for a large d.

    ``first``: row of the view's first contour in ``outlines``. ``weight``: the weight of a sample without either.
    """
    scaled = weight
    scale = numbers[SCALE]
    if numbers[AMBIGUOUS] > 0.0:
        near, square = nearest_rival(parts, curves, outlines, first, p, edgel, n, (numbers[AMBIGUOUS] * scale) ** 2)
        if near:
            scaled *= shared_weight(d, square)
    if numbers[ROBUST] > 0.0:
        scaled *= robust_weight(d, numbers[ROBUST] * scale)
    return scaled


@ti.func
def search_contours(
    parts: ti.template(), curves: ti.template(), cameras: ti.template(), size: ti.template(), mask: ti.template(),
    frame: int, image: ti.template(), likelihood: ti.template(), numbers: ti.template(), b: int, origin,
    joints: ti.template(), placed: ti.template(), hiders: ti.template(), outlines: ti.template(),
    samples: ti.template(),
):  # fmt: skip
    """Sum the rows of all edgels of pose b, which :func:`prepare_pose` has placed; arguments as in the kernel."""
    V, Q = cameras.shape[0], curves.shape[0]
    for task in range(V * Q):
        c, v, q = b * V * Q + task, task // Q, task % Q
        p, kind = curves[q, 0], curves[q, 1]
        scale, window, most_samples = numbers[SCALE], numbers[WINDOW], ti.cast(numbers[MOST_SAMPLES], ti.i32)
        pull = ti.Vector([0.0 * scale for _ in range(PULL_NUMBERS)])
        inertia = ti.Vector([0.0 * scale for _ in range(INERTIA_NUMBERS)])
        if numbers[EXPORT] == 1.0:
            for i in range(most_samples):
                samples[c, i, 0] = 0.0
        if outlines[c, VISIBLE] > 0.0:
            shape = shape_of(parts, p)
            R, t = load_rotation(placed, b, p), load_translation(placed, b, p)
            eye = camera_center(cameras, v)
            center = transposed_times(R, eye - t)
            params = ti.Vector([outlines[c, PARAMETERS], outlines[c, PARAMETERS + 1]])
            length, sign = outlines[c, LENGTH], outlines[c, SIGN]
            width, height = size[v, 0], size[v, 1]
            wanted = ti.cast(ti.ceil(length / (numbers[SPACING] * scale)), ti.i32)
            count = ti.min(ti.max(wanted, 1), most_samples)
            share = length / count
            for i in range(count):
                u = (i + 0.5 + 0.0 * scale) / count
                x_part, tangent = point_on(kind, shape, center, params, u)
                x = times(R, x_part) + t
                hidden, behind = find_hider(parts, placed, b, hiders[b, v, p], eye, x - eye)
                if hidden:  # as many samples are
                    continue
                pixel, J, n, use = image_of(cameras, v, x, times(R, tangent), sign)
                at = (pixel + 0.5) / scale - 0.5
                use = use and in_picture(width, height, at)
                found, d, weight = 0, 0.0 * scale, share
                if use and behind >= 0 and numbers[INTERIOR] == 0.0:
                    # in front of another part no edge of the silhouette is expected, but a border of colours
                    front, back = group_of(parts, p), group_of(parts, behind)
                    other_limb = parts[behind, PART_LIMB] != parts[p, PART_LIMB]
                    if numbers[COLORS] > 0.0 and other_limb and front != back:
                        certainty, place = search_colors(
                            image, likelihood, v, width, height, numbers[RATIO], pixel, n, window, scale, front, back
                        )
                        found, d, weight = 2, place * scale, share * numbers[COLORS] * certainty
                elif use:
                    found, d = search_mask(mask, frame * V + v, width, height, at, n, window)
                    d *= scale
                    if found > 0:
                        at_edgel = pixel + d * n
                        weight = weigh_edgel(parts, curves, outlines, numbers, c - q, p, at_edgel, n, d, share)
                if found > 0 and weight > 0.0:
                    add_row(pull, inertia, x - origin, J, n, d, weight, numbers[TANGENTIAL])
                    if numbers[EXPORT] == 1.0:
                        at_unit = unscaled(kind, shape, x_part)
                        export_sample(samples, c, i, at_unit, pixel, pulled(J, n), n, d, weight)
        # always in the same order: the same sums every time
        k = ti.cast(parts[p, PART_MOVED], ti.i32)
        into = OF_VIEW if numbers[DISPLACED] > 0.0 else INERTIA
        for a in ti.static(range(INERTIA_NUMBERS)):
            joints[b, k, into + a] = joints[b, k, into + a] + inertia[a]
        for a in ti.static(range(PULL_NUMBERS)):
            joints[b, k, into + INERTIA_NUMBERS + a] = joints[b, k, into + INERTIA_NUMBERS + a] + pull[a]
        if numbers[DISPLACED] > 0.0 and q == Q - 1:
            for j in range(joints.shape[1]):
                add_displaced(joints, b, j, numbers[DISPLACED])


@functools.cache
def _descent_kernel(real):
    @ti.kernel
    def silhouette_descent(
        # the body
        tree: ti.types.ndarray(dtype=real, ndim=2),  # (D, 11)
        parts: ti.types.ndarray(dtype=real, ndim=2),  # (P, 21)
        curves: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (Q, 2)
        # the frame
        cameras: ti.types.ndarray(dtype=real, ndim=2),  # (V, 27)
        size: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (V, 2) width, height at this scale
        mask: ti.types.ndarray(dtype=ti.u8, ndim=3),  # (F V, H, W) at this scale, of F = 1 or B frames
        image: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (V, H, W, 3) of the full picture
        likelihood: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (G, COLOR_BINS)
        # settings
        numbers: ti.types.ndarray(dtype=real, ndim=1),  # (12,) from SCALE to RATIO
        free: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (n,) this and the next three: :class:`NewtonSteps`
        terms: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (2 + B, D)
        matrix: ti.types.ndarray(dtype=ti.f64, ndim=3),  # (B, D, D) or (1, D, D)
        steps: ti.types.ndarray(dtype=ti.f64, ndim=1),  # (5 + S,)
        spread: ti.i32,
        # the poses
        state: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (B, D) in and out
        # scratch: joints, inertias and pulls (:mod:`tk.kernels.wrench`), contours (:mod:`tk.kernels.cone_contours`)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        joints: ti.types.ndarray(dtype=real, ndim=3),  # (B, D, 72)
        placed: ti.types.ndarray(dtype=real, ndim=3),  # (B, P, 16)
        hiders: ti.types.ndarray(dtype=ti.i64, ndim=3),  # (B, V, P)
        outlines: ti.types.ndarray(dtype=real, ndim=2),  # (B V Q, 31)
        factor: ti.types.ndarray(dtype=ti.f64, ndim=3),  # (B, n, n + 1)
        # out
        samples: ti.types.ndarray(dtype=real, ndim=3),  # (B V Q, most_samples, _EXPORT), if EXPORT
        sums: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (B, 1 + D) see STEPS, before the last step
        hessian: ti.types.ndarray(dtype=ti.f64, ndim=3),  # (B, D, D) likewise; zeroed by the caller
    ):
        # one thread handles a pose from end to end; a variant without threads costs 0.4 s to compile and saves nothing
        for turn in range(spread * state.shape[0]):
            if turn % spread != 0:
                continue
            b = turn // spread
            frame = b % (mask.shape[0] // cameras.shape[0])
            moves, step = True, 0
            while moves:
                for k in range(tree.shape[0]):
                    pose[b, k] = ti.cast(state[b, k], real)
                prepare_pose(tree, parts, curves, cameras, pose, b, joints, placed, hiders, outlines)
                origin = load_translation(placed, b, 0)
                search_contours(
                    parts, curves, cameras, size, mask, frame, image, likelihood, numbers, b, origin, joints, placed,
                    hiders, outlines, samples,
                )  # fmt: skip
                collect_pulls(tree, b, joints, origin, sums, GRADIENT)
                collect_inertias(tree, b, joints, origin, hessian)
                length = steps[LENGTHS + step]
                step += 1
                moves = step < steps.shape[0] - LENGTHS
                if length > 0.0:
                    change = newton_step(free, terms, matrix, steps, b, length, hessian, sums, GRADIENT, factor, state)
                    moves = moves and change > steps[TOLERANCE]
            sums[b, STEPS] = step

    return Launcher(silhouette_descent)


class Descent(NamedTuple):
    """B poses after some steps."""

    poses: NDArray[np.float64]  # (B, D)
    steps: NDArray[np.int32]  # (B,) number of steps made


def _launch(
    body: ConeArrays,
    seen: Silhouettes,
    poses: NDArray[np.floating],
    settings: SearchSettings,
    regions: Regions | None,
    newton: NewtonSteps | None = None,
    export: bool = False,
) -> tuple[Descent, NormalEquations, NDArray[np.floating]]:
    """Return the poses after the steps; equations, and samples (see the kernel), before the last step. Without
    ``newton`` the poses stay as they are."""
    ensure_runtime()
    dtype = body.tree.dtype
    state = np.array(poses, np.float64)
    B, D = state.shape
    V, Q, P = len(seen.cameras), len(body.curves), len(body.parts)
    regions = regions or _no_regions()
    if len(seen.masks) not in (V, B * V):
        raise ValueError(f"{len(seen.masks)} masks of {V} views: one set, or one for each frame of the {B} poses")
    sums, hessian = np.empty((B, GRADIENT + D)), np.zeros((B, D, D))
    samples = np.zeros((B * V * Q, settings.most_samples, _EXPORT) if export else (1, 1, _EXPORT), dtype)
    _descent_kernel(ti.f64 if dtype == np.float64 else ti.f32)(
        *body,
        np.ascontiguousarray(seen.cameras, dtype),
        np.ascontiguousarray(seen.sizes, np.int32),
        np.ascontiguousarray(seen.masks),
        regions.image,
        regions.log_likelihood,
        _numbers(settings, seen.scale, regions.weight, regions.step, export, dtype),
        *(newton or _no_steps(D)),
        spread_of(B),
        state,
        *_scratch(B, V, Q, D, P, dtype),
        samples,
        sums,
        hessian,
    )
    return Descent(state, sums[:, STEPS].astype(np.int32)), NormalEquations(hessian, sums[:, GRADIENT:]), samples


@functools.cache
def _no_steps(parameters: int) -> NewtonSteps:
    """Return the arguments of a launch that evaluates the equations only."""
    nothing = np.zeros((1, parameters, parameters))
    return NewtonSteps(np.zeros(1, np.int32), np.zeros((LINEAR + 1, parameters)), nothing, np.zeros(LENGTHS + 1))


@functools.lru_cache(64)
def _numbers(
    s: SearchSettings, scale: float, weight: float, step: int, export: bool, dtype: np.dtype
) -> NDArray[np.floating]:
    """Pack the settings in the order from SCALE to RATIO."""
    pixels = scale, s.window_px, s.spacing_px, s.ambiguous_px, s.tangential, s.robust_px, s.displacement
    return np.array((*pixels, weight, s.most_samples, s.interior, export, 1 / step), dtype)


@functools.cache
def _no_regions() -> Regions:
    return Regions(np.zeros((1, 1, 1, 3), np.uint8), np.zeros((1, COLOR_BINS), np.float32), 0.0)


@functools.lru_cache(32)
def _scratch(B: int, V: int, Q: int, D: int, P: int, dtype: np.dtype) -> tuple[NDArray, ...]:
    return (
        np.empty((B, D), dtype),
        np.empty((B, D, OF_VIEW + VIEW_NUMBERS), dtype),
        np.empty((B, P, PLACED_NUMBERS), dtype),
        np.empty((B, V, P), np.int64),
        np.empty((B * V * Q, OUTLINE_NUMBERS), dtype),
        np.empty((B, D, D + 1)),
    )


def normal_equations(
    body: ConeArrays,
    seen: Silhouettes,
    poses: np.ndarray,
    settings: SearchSettings,
    regions: Regions | None = None,
) -> NormalEquations:
    """Search the silhouettes from B poses and return the normal equations (eqs. 9-11 of the silhouette paper).

    Args:
        body: the cone body; its real type is the precision of the computation.
        seen: the silhouettes.
        poses: (B, D).
        settings: see :class:`SearchSettings`.
        regions: colours of the parts, for contours inside the silhouette; None ignores colours.

    Raises:
        ValueError: the masks are neither of one frame nor of one for each pose.
    """
    return _launch(body, seen, poses, settings, regions)[1]


def descend(
    body: ConeArrays,
    seen: Silhouettes,
    poses: np.ndarray,
    settings: SearchSettings,
    newton: NewtonSteps,
    regions: Regions | None = None,
) -> Descent:
    """Move B poses by damped Gauss-Newton steps at one scale: edges and equations are found anew before each step.

    A pose stops once no parameter moves by more than the tolerance. Poses do not depend on each other.

    Args:
        newton: the steps; other arguments as for :func:`normal_equations`.
    """
    return _launch(body, seen, poses, settings, regions, newton=newton)[0]


def find_edgels(
    body: ConeArrays,
    seen: Silhouettes,
    poses: np.ndarray,
    settings: SearchSettings,
) -> Edgels:
    """Return the edgels that poses (B, D) find, in the order of poses and views; arguments as for
    :func:`normal_equations`."""
    _, _, samples = _launch(body, seen, poses, settings, None, export=True)
    V, Q = len(seen.cameras), len(body.curves)
    task, index = np.nonzero(samples[:, :, 0])
    chosen = samples[task, index].astype(np.float64)
    return Edgels(
        pose=(task // (V * Q)).astype(np.int32),
        view=(task // Q % V).astype(np.int32),
        part=body.curves[task % Q, 0],
        unscaled=chosen[:, 3:6],
        distance=chosen[:, 1],
        weight=chosen[:, 2],
        row=chosen[:, 6:9],
        pixel=chosen[:, 9:11],
        normal=chosen[:, 11:13],
    )
