"""The model's occluding contour in the images, batched over poses, in one launch (Kehl 2006, sections 5.2 and 5.3).

A strip is a row of surface points of one superellipsoid along a circle of latitude. Where n·v changes its sign along
it, with n the normal and v the viewing ray, the contour passes (eq. 3). The camera is moved into the piece's
frame (eq. 4), with full perspective. The normals n_d of eq. 2 satisfy n_d · r = 1 at every surface point r (insert
eq. 1), so with C the moved camera's centre

    t = n_d · v = n_d · (r − C) = 1 − n_d · C,

and a strip needs only its angles and normals. Equation 5 as printed divides by t₁ + t₂, which have opposite signs: it
extrapolates, and fails where they cancel. Linear interpolation, which must be meant, takes their magnitudes,

    u_c = (u₁ |t₂| + u₂ |t₁|) / (|t₁| + |t₂|).

A superellipsoid is convex: on a strip n_d · C crosses 1 at most once in each direction. Slot 0 of a strip is the
crossing from the hidden to the visible side, slot 1 the opposite one, so the two points never swap: they are a pair
symmetric about the limb's axis.
"""

import functools
from dataclasses import dataclass

import numpy as np

from tk.kernels.kinematics import JOINT_NUMBERS, forward_tree, load_rotation, load_translation
from tk.kernels.occlusion import PLACED_CAMERA, PLACED_NUMBERS, is_occluded, pieces_beside, place_pieces
from tk.kernels.pieces import PIECE_SHAPE, PieceArrays, to_zero_configuration
from tk.kernels.projection import camera_center, project
from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.superellipsoid import power
from tk.kernels.vectors import times, triple, triple_in

# Strips of one parallel task. Each task has its own forward kinematics, some microseconds. Affects speed only.
STRIPS_PER_TASK = 10

FOUND, VISIBLE = 1, 2  # bits of a point's flags


@ti.func
def signed_power(base, exponent):
    """Return sign(b)·|b|^e."""
    result = base
    if exponent != 1.0:
        result = power(base, exponent)
        if base < 0:
            result = -result
    return result


@ti.func
def surface_point(turns, radii, e1, e2):
    """Return r(η, ω) (eq. 1); ``turns`` are cos η, sin η, cos ω, sin ω."""
    ring = signed_power(turns[0], e1)
    return ti.Vector(
        [
            radii[0] * ring * signed_power(turns[2], e2),
            radii[1] * ring * signed_power(turns[3], e2),
            radii[2] * signed_power(turns[1], e1),
        ]
    )


@ti.func
def surface_normal(turns, radii, e1, e2):
    """Return n_d(η, ω), outward, not of unit length (eq. 2)."""
    ring = signed_power(turns[0], 2.0 - e1)
    return ti.Vector(
        [
            ring * signed_power(turns[2], 2.0 - e2) / radii[0],
            ring * signed_power(turns[3], 2.0 - e2) / radii[1],
            signed_power(turns[1], 2.0 - e1) / radii[2],
        ]
    )


@ti.func
def strip_piece(strips: ti.template(), s: int):
    """Return the piece of strip s."""
    return ti.cast(strips[s, strips.shape[1] - 1, 0], ti.i32)


@ti.func
def rim_crossings(strips: ti.template(), s: int, camera):  # (S, N + 1, 5), camera centre in the piece's frame
    """Return where strip s crosses the rim: (found₀, η₀, ω₀, found₁, η₁, ω₁), slots as in the module's docstring."""
    zero = camera[0] * 0.0
    result = ti.Vector([zero, zero, zero, zero, zero, zero])
    before = zero
    for i in range(strips.shape[1] - 1):
        t = 1.0 - (strips[s, i, 2] * camera[0] + strips[s, i, 3] * camera[1] + strips[s, i, 4] * camera[2])
        if i > 0 and (t < 0) != (before < 0):
            share = ti.abs(before) / (ti.abs(before) + ti.abs(t))
            eta = strips[s, i - 1, 0] + share * (strips[s, i, 0] - strips[s, i - 1, 0])
            omega = strips[s, i - 1, 1] + share * (strips[s, i, 1] - strips[s, i - 1, 1])
            if t < 0:
                result[0], result[1], result[2] = 1.0, eta, omega
            else:
                result[3], result[4], result[5] = 1.0, eta, omega
        before = t
    return result


@ti.func
def rim_point(placed: ti.template(), c: int, pieces: ti.template(), i: int, eta, omega):
    """Return a point of piece i in the piece's frame and in the world, and its unit normal in the world."""
    radii = triple(pieces, i, PIECE_SHAPE)
    e1, e2 = pieces[i, PIECE_SHAPE + 3], pieces[i, PIECE_SHAPE + 4]
    R = load_rotation(placed, c, i)
    turns = ti.Vector([ti.cos(eta), ti.sin(eta), ti.cos(omega), ti.sin(omega)])
    q = surface_point(turns, radii, e1, e2)
    n = times(R, surface_normal(turns, radii, e1, e2).normalized())
    return q, times(R, q) + load_translation(placed, c, i), n


@ti.func
def image_normal(J, n):
    """Return the unit normal (2,) of the contour's image at a rim point; J (2, 3) is the projection's derivative.

    Normal to the images J s of all tangents s of the surface, lens distortion included: on the rim n is perpendicular
    to the viewing ray, which is J's null space, so Jᵀ m ∝ n has the solution m ∝ (J Jᵀ)⁻¹ J n.
    """
    A = J @ J.transpose()
    g = times(J, n)
    m = ti.Vector([A[1, 1] * g[0] - A[0, 1] * g[1], A[0, 0] * g[1] - A[0, 1] * g[0]])
    return m / ti.sqrt(ti.max(m.norm_sqr(), 1e-30))


@functools.cache
def _contour_kernel(real):
    @ti.kernel
    def contour(
        tree: ti.types.ndarray(dtype=real, ndim=2),  # (D, 11)
        pieces: ti.types.ndarray(dtype=real, ndim=2),  # (P, 20)
        strips: ti.types.ndarray(dtype=real, ndim=3),  # (S, N + 1, 5) η, ω, n_d; in the last row the piece
        cameras: ti.types.ndarray(dtype=real, ndim=2),  # (C, 27)
        spread: ti.i32,
        chosen: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, K)
        pose: ti.types.ndarray(dtype=real, ndim=2),  # (B, D)
        joints: ti.types.ndarray(dtype=real, ndim=3),  # (T, D, 18) scratch
        placed: ti.types.ndarray(dtype=real, ndim=3),  # (T, P, 20) scratch
        geometry: ti.types.ndarray(
            dtype=real, ndim=3
        ),  # (B C K, 2, 8) out: zero configuration 3, pixel 2, normal 2, scale
        flags: ti.types.ndarray(dtype=ti.u8, ndim=2),  # (B C K, 2) out
    ):
        for turn in range(spread * joints.shape[0]):
            if turn % spread != 0:
                continue
            c = turn // spread
            C, K = cameras.shape[0], chosen.shape[1]
            blocks = (K + STRIPS_PER_TASK - 1) // STRIPS_PER_TASK
            b = c // (C * blocks)
            v = c // blocks % C
            first = c % blocks * STRIPS_PER_TASK
            forward_tree(tree, pose, b, c, joints)
            center = camera_center(cameras, v)
            place_pieces(joints, c, pieces, center, placed)
            near = ti.cast(0, ti.i64)
            near_to = -1
            for m in range(first, ti.min(first + STRIPS_PER_TASK, K)):
                s = chosen[b, m]
                i = -1
                crossings = ti.Vector([0.0 * center[0] for _ in range(6)])
                if s >= 0:
                    i = strip_piece(strips, s)
                    if i != near_to:
                        near, near_to = pieces_beside(placed, c, pieces, i), i
                    crossings = rim_crossings(strips, s, triple_in(placed, c, i, PLACED_CAMERA))
                row = (b * C + v) * K + m
                for slot in range(2):
                    # a dynamic index into a vector would spill it to memory
                    here = ti.select(slot == 0, crossings[0], crossings[3])
                    eta = ti.select(slot == 0, crossings[1], crossings[4])
                    omega = ti.select(slot == 0, crossings[2], crossings[5])
                    flag = 0
                    if here > 0:
                        q, x, n = rim_point(placed, c, pieces, i, eta, omega)
                        pixel, J, depth = project(cameras, v, x)
                        if depth > 1e-6:
                            flag = FOUND
                            if is_occluded(placed, c, pieces, near, x, center) == 0:
                                flag = FOUND | VISIBLE
                            normal = image_normal(J, n)
                            x_zero = to_zero_configuration(pieces, i, q)
                            for a in ti.static(range(3)):
                                geometry[row, slot, a] = x_zero[a]
                            for a in ti.static(range(2)):
                                geometry[row, slot, 3 + a] = pixel[a]
                                geometry[row, slot, 5 + a] = normal[a]
                            geometry[row, slot, 7] = ti.sqrt(0.5 * J.norm_sqr())
                    if flag == 0:
                        for a in range(8):
                            geometry[row, slot, a] = 0.0
                    flags[row, slot] = ti.cast(flag, ti.u8)

    return contour


@dataclass(frozen=True)
class ContourPoints:
    """Contour points of B poses in C cameras on K strips, two slots each. Values of points not found are zero."""

    strip: np.ndarray  # (B, K) the strips
    # (B, C, K, 2, 3) the points in the zero configuration, metres: they move with p as material points
    points_zero: np.ndarray
    # (B, C, K, 2, 2) their projections (x, y), lens distortion included; they may lie outside the image
    pixels: np.ndarray
    normals: np.ndarray  # (B, C, K, 2, 2) unit normals of the contour in the image, outward
    scale: np.ndarray  # (B, C, K, 2) pixels per metre there
    found: np.ndarray  # (B, C, K, 2) uint8, 1 where the strip crosses the rim in front of the camera
    visible: np.ndarray  # (B, C, K, 2) uint8, 1 where found and not hidden by another piece


@functools.lru_cache(8)
def _scratch(tasks: int, degrees: int, pieces: int, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Return the scratch of T tasks: joints (T, D, 18) and placed pieces (T, P, 20)."""
    return np.empty((tasks, degrees, JOINT_NUMBERS), dtype), np.empty((tasks, pieces, PLACED_NUMBERS), dtype)


class ContourKernel:
    """The contours of one body in a rig's cameras. Constants and scratch are prepared once.

    Args:
        body: the body.
        angles: (S, N, 2) η and ω along each strip, radians; the last sample is the first.
        normals: (S, N, 3) n_d of eq. 2 there, in the piece's frame, 1/m.
        piece: (S,) the piece of each strip.
        cameras: (C, 27) of :func:`tk.kernels.projection.pack_cameras`.
        dtype: np.float32, or np.float64 for checks.
    """

    def __init__(
        self,
        body: PieceArrays,
        angles: np.ndarray,
        normals: np.ndarray,
        piece: np.ndarray,
        cameras: np.ndarray,
        dtype: type = np.float32,
    ) -> None:
        ensure_runtime()
        self._dtype = dtype
        self._kernel = _contour_kernel(ti.f64 if dtype == np.float64 else ti.f32)
        last = np.zeros((len(piece), 1, 5))
        last[:, 0, 0] = piece
        strips = np.concatenate([np.concatenate([angles, normals], axis=2), last], axis=1)
        self._constants: tuple[np.ndarray, ...] = tuple(
            np.ascontiguousarray(a, dtype) for a in (body.tree, body.pieces, strips, cameras)
        )

    def __call__(self, pose: np.ndarray, chosen: np.ndarray) -> ContourPoints:
        """Return the contour points of B poses in all C cameras, occlusion included; one launch.

        Args:
            pose: (B, D).
            chosen: (B, K) strips of each pose; -1: none.
        """
        chosen = np.ascontiguousarray(chosen, np.int32)
        tree, pieces, strips, cameras = self._constants
        if chosen.size and not -1 <= chosen.min() <= chosen.max() < len(strips):
            raise IndexError(f"strips {chosen.min()} to {chosen.max()}: there are 0 to {len(strips) - 1}")
        B, K = chosen.shape
        C = len(cameras)
        geometry = np.empty((B * C * K, 2, 8), self._dtype)
        flags = np.empty((B * C * K, 2), np.uint8)
        if B * C * K:
            tasks = B * C * -(-K // STRIPS_PER_TASK)
            self._kernel(
                *self._constants,
                spread_of(tasks),
                chosen,
                np.ascontiguousarray(pose, self._dtype),
                *_scratch(tasks, len(tree), len(pieces), np.dtype(self._dtype)),
                geometry,
                flags,
            )
        geometry = geometry.reshape(B, C, K, 2, 8)
        flags = flags.reshape(B, C, K, 2)
        return ContourPoints(
            strip=chosen,
            points_zero=geometry[..., :3],
            pixels=geometry[..., 3:5],
            normals=geometry[..., 5:7],
            scale=geometry[..., 7],
            found=flags & FOUND,
            visible=flags >> 1 & 1,
        )
