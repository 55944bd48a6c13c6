"""The occluding contours of a cone body at one pose: parts in the world, what may hide them, curves in the images.

Scratch of B poses, V cameras, P parts and Q curves:

``placed (B, P, 16)``
    Each part's 3×4 transform to the world; the centre and squared radius of a sphere that encloses the part.
``hiders (B, V, P)`` int64
    Bits of the parts that may hide each part from a camera.
``outlines (B V Q, 31)``
    Each curve in each image: whether it is visible, the two parameters of :func:`tk.kernels.cones.curve_of`, the length
    of its image in pixels, the sign that turns its image's normal outwards, and the corners of a polyline in pixels.
"""

from tk.kernels.columns import PAIR, SCALAR, TRANSFORM, VECTOR, columns
from tk.kernels.cone_arrays import NEAREST_M, PART_LIMB, kind_of, place_part, shape_of
from tk.kernels.cones import SIDE_B, curve_of, enclosing_radius, enter, interior_point, point_on
from tk.kernels.kinematics import load_rotation, load_translation, store_frame
from tk.kernels.projection import camera_center, project
from tk.kernels.runtime import ti
from tk.kernels.vectors import cross, dot, norm2, norm_sqr, times, transposed_times, triple_in

# Chords that approximate a curve when its length is measured and when edgels are compared with it: 30° each of a
# circle, at most 3.4 % of its radius off. Straight curves have one.
CHORDS = 12
# A sample is hidden by another part where its ray enters that part's cross-section shrunk to this: neighbours touch at
# a joint.
HIDING_SHRINK = 0.95
# Columns of ``placed``.
_FRAME, BALL, BALL_SQUARE, PLACED_NUMBERS = columns(TRANSFORM, VECTOR, SCALAR)
# Columns of ``outlines``.
VISIBLE, PARAMETERS, LENGTH, SIGN, CORNERS, OUTLINE_NUMBERS = columns(SCALAR, PAIR, SCALAR, SCALAR, (CHORDS + 1) * PAIR)


@ti.func
def place_parts(joints: ti.template(), parts: ti.template(), b: int, placed: ti.template()):
    """Fill row b of ``placed`` from the joints of pose b."""
    for p in range(parts.shape[0]):
        R, t = place_part(joints, parts, b, p)
        store_frame(placed, b, p, R, t)
        kind, shape = kind_of(parts, p), shape_of(parts, p)
        middle = times(R, interior_point(kind, shape)) + t
        for a in ti.static(range(3)):
            placed[b, p, BALL + a] = middle[a]
        placed[b, p, BALL_SQUARE] = enclosing_radius(kind, shape) ** 2


@ti.func
def may_hide(placed: ti.template(), b: int, p: int, eye):
    """Return the bits of the parts whose spheres overlap the sphere of part p in the image."""
    bits = ti.i64(0)
    own = triple_in(placed, b, p, BALL) - eye
    own_square = norm_sqr(own)
    own_sine = placed[b, p, BALL_SQUARE] / own_square
    for o in range(placed.shape[1]):
        to = triple_in(placed, b, o, BALL) - eye
        square = norm_sqr(to)
        sine = placed[b, o, BALL_SQUARE] / square
        # spheres overlap if the angle between their centres is at most the sum of their angular radii
        apart = 1.0 + 0.0 * square
        if own_sine < 0.5 and sine < 0.5:
            apart = ti.sqrt((1.0 - sine) * (1.0 - own_sine)) - ti.sqrt(sine * own_sine)
            apart = dot(own, to) - apart * ti.sqrt(own_square * square)
        if o != p and apart >= 0.0:
            bits |= ti.i64(1) << o
    return bits


@ti.func
def find_hiders(placed: ti.template(), cameras: ti.template(), b: int, hiders: ti.template()):
    """Fill row b of ``hiders``."""
    for v in range(cameras.shape[0]):
        eye = camera_center(cameras, v)
        for p in range(placed.shape[1]):
            hiders[b, v, p] = may_hide(placed, b, p, eye)


@ti.func
def find_hider(parts: ti.template(), placed: ti.template(), b: int, candidates: ti.i64, eye, ray):
    """Return whether a part hides the point eye + ray, and else the nearest part behind the point, or -1.

    Only the parts whose bits are set in ``candidates`` are tested.
    """
    hidden, behind, depth = False, -1, 1e9 + 0.0 * ray[0]
    long = norm_sqr(ray)
    others = candidates
    while not hidden and others != 0:
        o = ti.math.popcnt((others & -others) - 1)  # the lowest bit
        others &= others - 1
        to = triple_in(placed, b, o, BALL) - eye
        ahead = dot(to, ray)
        if ahead > 0.0 and norm_sqr(to) * long - ahead * ahead < placed[b, o, BALL_SQUARE] * long:
            R = load_rotation(placed, b, o)
            center = transposed_times(R, eye - load_translation(placed, b, o))
            t = enter(kind_of(parts, o), shape_of(parts, o), center, transposed_times(R, ray), HIDING_SHRINK)
            if t > 0.0 and t < 1.0:
                hidden = True
            elif t > 0.0 and t < depth:
                behind = o
                depth = t
    return hidden, behind


@ti.func
def load_corner(outlines: ti.template(), c: int, i: int):
    """Return the pixel (2,) of corner i of a curve."""
    return ti.Vector([outlines[c, CORNERS + 2 * i], outlines[c, CORNERS + 2 * i + 1]])


@ti.func
def trace_curve(
    parts: ti.template(),  # (P, 21)
    placed: ti.template(),  # (B, P, 16)
    cameras: ti.template(),  # (V, 27)
    b: int,
    v: int,
    p: int,
    kind: int,
    c: int,
    outlines: ti.template(),  # (B V Q, 31) out
):
    """Fill row c of ``outlines`` with the curve of one kind on part p in camera v."""
    shape = shape_of(parts, p)
    R, t = load_rotation(placed, b, p), load_translation(placed, b, p)
    center = transposed_times(R, camera_center(cameras, v) - t)
    visible, params = curve_of(kind, shape, center)
    chords = ti.select(kind <= SIDE_B, 1, CHORDS)
    length = 0.0 * shape[0]
    sign = 0.0 * shape[0]
    last = ti.Vector([0.0 * length, 0.0 * length])
    for i in range(chords + 1):
        if visible == 1:
            x, tangent = point_on(kind, shape, center, params, (i + 0.0 * length) / chords)
            pixel, J, z = project(cameras, v, times(R, x) + t)
            if z < NEAREST_M:
                visible = 0
            if i > 0:
                length += norm2(pixel - last)
            if i == 0:
                # the plane of viewing ray and tangent, turned away from the part's inside
                n = cross(tangent, x - center)
                if dot(n, interior_point(kind_of(parts, p), shape) - x) > 0.0:
                    n = -n
                along, out = times(J, times(R, tangent)), times(J, times(R, n))
                sign = 1.0 + 0.0 * length
                if along[1] * out[0] - along[0] * out[1] < 0.0:
                    sign = -sign
            last = pixel
            outlines[c, CORNERS + 2 * i], outlines[c, CORNERS + 2 * i + 1] = pixel[0], pixel[1]
    outlines[c, VISIBLE] = visible
    outlines[c, PARAMETERS], outlines[c, PARAMETERS + 1] = params[0], params[1]
    outlines[c, LENGTH], outlines[c, SIGN] = length, sign


@ti.func
def distance_sqr(e, a, b):
    """Return the squared distance of e (2,) from the segment a b."""
    ab = b - a
    along = (e[0] - a[0]) * ab[0] + (e[1] - a[1]) * ab[1]
    t = ti.min(ti.max(along / ti.max(ab[0] * ab[0] + ab[1] * ab[1], 1e-12), 0.0), 1.0)
    off = e - a - t * ab
    return off[0] * off[0] + off[1] * off[1]


@ti.func
def nearest_rival(
    parts: ti.template(),  # (P, 21)
    curves: ti.template(),  # (Q, 2)
    outlines: ti.template(),  # (B V Q, 31)
    first: int,  # row of the view's first curve
    p: int,
    edgel,
    n,
    reach_sqr,
):
    """Return whether a model edge of another limb lies within the reach of an edgel, and its squared distance (4.4).

    Edges that face away from the normal ``n`` have their foreground on the other side and are no rivals.
    """
    near, nearest = False, reach_sqr
    for q in range(curves.shape[0]):
        c = first + q
        if parts[curves[q, 0], PART_LIMB] != parts[p, PART_LIMB] and outlines[c, VISIBLE] > 0.0:
            for s in range(ti.select(curves[q, 1] <= SIDE_B, 1, CHORDS)):
                e0, e1 = load_corner(outlines, c, s), load_corner(outlines, c, s + 1)
                facing = ti.Vector([e1[1] - e0[1], e0[0] - e1[0]]).dot(n) * outlines[c, SIGN]
                if facing > 0.0:
                    square = distance_sqr(edgel, e0, e1)
                    if square < nearest:
                        nearest = square
                        near = True
    return near, nearest
