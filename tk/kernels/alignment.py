"""Model contour against picture, once edges have been assigned: ρ(e) of one entry (Kehl 2006, eqs. 10, 13, 15).

An entry has two contour points a and b of one limb (a pair symmetric about its axis, or twice the same point), fixed as
material points, and the target in the image for the midpoint of their projections:

    e = ½ (n · (½ (x^a + x^b) − x̄) / σ)²,    ρ(e) = 1 − exp(−e / ν)

with n the contour's normal in the image. Only the distance across the contour counts, because an assigned edge does not
determine the position along a limb; the paper takes the whole distance. A contour slides over the limb as the limb
turns. The limb's normal there is perpendicular to the viewing ray, so to first order the sliding moves the image along
the contour only, and the derivative by the pose needs no term for it.

A hidden contour point, or a point without an edge, is an entry with ρ = 1 and no gradient (6.1.2).
"""

from tk.kernels.columns import PAIR, SCALAR, VECTOR, columns
from tk.kernels.kinematics import load_rotation, load_translation
from tk.kernels.projection import project
from tk.kernels.runtime import ti
from tk.kernels.vectors import cross, dot, norm_sqr, pulled, times, triple_in
from tk.kernels.wrench import MOTION, WRENCH, add_direction, add_wrench

# Columns of an entry. Points a and b are in the zero configuration, metres; target and unit normal in the image.
# 1/σ² in 1/px²; SCALE: the entry's share of f.
POINT_A, POINT_B, LAST_DOF, CAMERA, TARGET, NORMAL, INV_SIGMA2, STATE, SCALE, NU, ENTRY_NUMBERS = columns(
    VECTOR, VECTOR, SCALAR, SCALAR, PAIR, PAIR, SCALAR, SCALAR, SCALAR, SCALAR
)
# States of an entry: padding, assigned, and a contour point that can have no edge.
ABSENT, ASSIGNED, UNASSIGNABLE = range(3)


@ti.func
def image_residual(
    frames: ti.template(), c: int, cameras: ti.template(), entries: ti.template(), b: int, e: int, origin
):
    """Return (valid, residual, l (3,), t (3,)), pixels: a twist (ω, v) about the origin changes the residual by
    l · ω + t · v."""
    k = ti.cast(entries[b, e, LAST_DOF], ti.i32)
    v = ti.cast(entries[b, e, CAMERA], ti.i32)
    R, t = load_rotation(frames, c, k), load_translation(frames, c, k)
    target = ti.Vector([entries[b, e, TARGET], entries[b, e, TARGET + 1]])
    x = times(R, triple_in(entries, b, e, POINT_A)) + t
    pixel, T, z = project(cameras, v, x)
    L = _turned(T, x - origin)
    valid = z > 1e-3
    if norm_sqr(triple_in(entries, b, e, POINT_A) - triple_in(entries, b, e, POINT_B)) > 0.0:
        x = times(R, triple_in(entries, b, e, POINT_B)) + t
        other, J, depth = project(cameras, v, x)
        pixel = 0.5 * (pixel + other)
        L = 0.5 * (L + _turned(J, x - origin))
        T = 0.5 * (T + J)
        valid = valid and depth > 1e-3
    n = ti.Vector([entries[b, e, NORMAL], entries[b, e, NORMAL + 1]])
    return valid, n.dot(pixel - target), pulled(L, n), pulled(T, n)


@ti.func
def _turned(J, x):
    """Return L (2, 3) with L ω = J (ω × x)."""
    first = cross(x, ti.Vector([J[0, a] for a in ti.static(range(3))]))
    second = cross(x, ti.Vector([J[1, a] for a in ti.static(range(3))]))
    return ti.Matrix.rows([first, second])


@ti.func
def add_alignment(
    scratch: ti.template(),  # (C, D or more, 39)
    cameras: ti.template(),
    entries: ti.template(),
    sums: ti.template(),
    b: int,
    c: int,
    e: int,
):
    """Add scale·ρ(e) of entry e to row c of the sums, its gradient and Gauss-Newton product to the wrenches."""
    kind = ti.cast(entries[b, e, STATE], ti.i32)
    scale = entries[b, e, SCALE]
    if kind == UNASSIGNABLE:
        sums[c, 0] = sums[c, 0] + scale
    elif kind == ASSIGNED:
        valid, r, moment, force = image_residual(scratch, c, cameras, entries, b, e, ti.Vector([0.0, 0.0, 0.0]))
        if not valid:
            sums[c, 0] = sums[c, 0] + scale
        else:
            nu, inv_sigma2 = entries[b, e, NU], entries[b, e, INV_SIGMA2]
            decay = ti.exp(-0.5 * r * r * inv_sigma2 / nu)
            sums[c, 0] = sums[c, 0] + scale * (1.0 - decay)
            weight = scale * decay / nu * inv_sigma2
            k = ti.cast(entries[b, e, LAST_DOF], ti.i32)
            moved = dot(moment, triple_in(scratch, c, k, MOTION)) + dot(force, triple_in(scratch, c, k, MOTION + 3))
            add_wrench(scratch, c, k, WRENCH, weight * r * moment, weight * r * force)
            add_wrench(scratch, c, k, WRENCH + 6, weight * moved * moment, weight * moved * force)


@ti.func
def add_curvature(
    scratch: ti.template(),  # (C, D or more, 39)
    cameras: ti.template(),
    entries: ti.template(),
    c: int,
    e: int,
    floor,
    origin,
):
    """Add entry e of pose 0 to the inertias; outliers weigh at least ``floor``."""
    if ti.cast(entries[0, e, STATE], ti.i32) == ASSIGNED:
        valid, r, moment, force = image_residual(scratch, c, cameras, entries, 0, e, origin)
        if valid:
            nu, inv_sigma2 = entries[0, e, NU], entries[0, e, INV_SIGMA2]
            decay = ti.exp(-0.5 * r * r * inv_sigma2 / nu)
            weight = entries[0, e, SCALE] * ti.max(decay, floor) / nu * inv_sigma2
            add_direction(scratch, c, ti.cast(entries[0, e, LAST_DOF], ti.i32), moment, force, weight)
