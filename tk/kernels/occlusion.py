"""Test whether a piece of the body hides a point from a camera (Kehl 2006, section 5.3, eqs. 6 and 7).

The paper's three steps for each other superellipsoid: clip the viewing ray to its bounding box, test whether the point
itself lies inside, search the clipped ray recursively from the middle. Before these, rays outside the cone in which the
camera sees the piece's bounding sphere are rejected: all rays end in the camera, so that takes one dot product.

For an ellipsoid the nearest approach to the ray has a closed form. For other pieces the recursion is a bisection.
G = F^(ε₁/2) is a norm for exponents in (0, 2), so it is convex along a ray: only the half towards which it falls can
contain a point inside, and the tangent in the middle bounds G from below. The first or second middle decides most rays.

The paper is silent about two cases. Here a point inside another piece (at the joints) counts as hidden, and pieces that
only touch do not hide each other, or every seam of the model would flicker.
"""

from tk.kernels.columns import SCALAR, TRANSFORM, VECTOR, columns
from tk.kernels.kinematics import load_rotation, load_translation, store_frame
from tk.kernels.pieces import PIECE_SHAPE, place_piece
from tk.kernels.runtime import ti
from tk.kernels.superellipsoid import implicit, inside_outside, is_quadric, power
from tk.kernels.vectors import dot, norm_sqr, transposed_times, triple, triple_in

# Rounds of the bisection. A ray undecided after them runs less than 1/4096 of its clipped length inside the piece.
DEPTH = 12
# A ray within the outermost thousandth of a piece only touches it. Chosen; at 0 seams flicker by rounding.
TOUCH = 1e-3

# Columns of a placed piece: its transform to the world; the camera's centre in the piece's frame; direction of the
# bounding sphere from the camera and cosine of the half angle of its cone; its least distance from the camera.
_FRAME, PLACED_CAMERA, PLACED_CONE, PLACED_NEAR, PLACED_NUMBERS = columns(TRANSFORM, VECTOR, VECTOR + SCALAR, SCALAR)
# The cone's cosine is lowered by this, for rounding: half a millimetre at the smallest of a body's pieces.
_SLACK = 1e-6


@ti.func
def place_pieces(
    joints: ti.template(),  # (T, D, 18) filled by kinematics.forward_tree
    c: int,
    pieces: ti.template(),  # (P, 20 or more) as in tk.kernels.pieces
    center,  # camera centre, world
    placed: ti.template(),  # (T, P, 20) out
):
    """Fill row c of ``placed`` with the pieces at a pose relative to one camera."""
    for i in range(pieces.shape[0]):
        R, t, sphere, radius = place_piece(joints, c, pieces, i)
        store_frame(placed, c, i, R, t)
        camera = transposed_times(R, center - t)
        ray = sphere - center
        distance = ti.max(ti.sqrt(norm_sqr(ray)), 1e-6)
        for a in ti.static(range(3)):
            placed[c, i, PLACED_CAMERA + a] = camera[a]
            placed[c, i, PLACED_CONE + a] = ray[a] / distance
        sine = radius / distance
        placed[c, i, PLACED_CONE + 3] = -2.0
        if sine < 1.0:
            placed[c, i, PLACED_CONE + 3] = ti.sqrt(1.0 - sine * sine) - _SLACK
        placed[c, i, PLACED_NEAR] = distance - radius


@ti.func
def segment_enters(q, d, radii, e1, e2, z_lower, z_upper):
    """Return 1 if the segment q + λ d, 0 ≤ λ ≤ 1, enters a truncated superellipsoid, all in its frame."""
    low = ti.Vector([-radii[0], -radii[1], z_lower])
    high = ti.Vector([radii[0], radii[1], z_upper])
    start = q[0] * 0.0
    end = start + 1.0
    for a in ti.static(range(3)):
        rate = ti.select(d[a] < 0, ti.min(d[a], -1e-9), ti.max(d[a], 1e-9))
        first, second = (low[a] - q[a]) / rate, (high[a] - q[a]) / rate
        start = ti.max(start, ti.min(first, second))
        end = ti.min(end, ti.max(first, second))
    hit = 0
    if start < end and is_quadric(e1, e2):
        u, v = q / radii, d / radii
        nearest = ti.min(ti.max(-dot(u, v) / ti.max(norm_sqr(v), 1e-12), start), end)
        hit = ti.cast(ti.sqrt(norm_sqr(u + nearest * v)) < 1.0 - TOUCH, ti.i32)
    elif start < end:
        if start == 0.0 and power(inside_outside(q, radii, e1, e2), 0.5 * e1) < 1.0 - TOUCH:
            hit = 1
        level = 0
        while hit == 0 and level < DEPTH:
            middle = 0.5 * (start + end)
            g = implicit(q + middle * d, radii, e1, e2)
            slope = g[1] * d[0] + g[2] * d[1] + g[3] * d[2]
            if g[0] < 1.0 - TOUCH:
                hit = 1
            elif g[0] - ti.abs(slope) * 0.5 * (end - start) >= 1.0 - TOUCH:
                level = DEPTH
            elif slope > 0.0:
                end = middle
            else:
                start = middle
            level += 1
    return hit


@ti.func
def pieces_beside(
    placed: ti.template(),  # (T, P, 20)
    c: int,
    pieces: ti.template(),  # (P, 20 or more), at most 63
    own: int,
):
    """Return a bit mask of the other pieces that rays through piece ``own`` may meet.

    All points of a piece share the mask: it has the pieces whose bounding spheres overlap its own in the image.
    """
    beside = ti.cast(0, ti.i64)
    u = triple_in(placed, c, own, PLACED_CONE)
    cosine = placed[c, own, PLACED_CONE + 3]
    sine = ti.sqrt(ti.max(1.0 - cosine * cosine, 0.0))
    inside = cosine < 0.0
    for i in range(pieces.shape[0]):
        other = placed[c, i, PLACED_CONE + 3]
        limit = cosine * other - sine * ti.sqrt(ti.max(1.0 - other * other, 0.0)) - _SLACK
        meets = dot(u, triple_in(placed, c, i, PLACED_CONE)) > limit
        if i != own and (inside or other < 0.0 or meets):
            beside |= ti.cast(1, ti.i64) << ti.cast(i, ti.i64)
    return beside


@ti.func
def is_occluded(
    placed: ti.template(),  # (T, P, 20)
    c: int,
    pieces: ti.template(),  # (P, 20 or more)
    among: ti.i64,  # bit mask of the pieces tested; not the point's own, which is convex and cannot hide its rim
    x,  # world
    center,  # camera centre, world
):
    """Return 1 if one of the pieces lies between a point and the camera of row c of ``placed``."""
    ray = x - center
    distance = ti.max(ti.sqrt(norm_sqr(ray)), 1e-6)
    ray = ray / distance
    hit = 0
    i = 0
    rest = among
    while hit == 0 and rest != 0:
        if (
            rest & 1 == 1
            and dot(ray, triple_in(placed, c, i, PLACED_CONE)) > placed[c, i, PLACED_CONE + 3]
            and placed[c, i, PLACED_NEAR] < distance
        ):
            R = load_rotation(placed, c, i)
            q = transposed_times(R, x - load_translation(placed, c, i))
            hit = segment_enters(
                q,
                triple_in(placed, c, i, PLACED_CAMERA) - q,
                triple(pieces, i, PIECE_SHAPE),
                pieces[i, PIECE_SHAPE + 3],
                pieces[i, PIECE_SHAPE + 4],
                pieces[i, PIECE_SHAPE + 5],
                pieces[i, PIECE_SHAPE + 6],
            )
        rest >>= 1
        i += 1
    return hit
