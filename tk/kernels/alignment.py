"""Model contour against picture, once edges have been assigned: ρ(e) of one entry (Kehl 2006, eqs. 10, 13, 15).

An entry is two contour points a and b of one limb (a pair symmetric about its axis, or twice the same point), which are
held as material points, and the picture point that their images' midpoint should meet:

    e = ½ (‖½ (x^a + x^b) − x̄‖ / σ)²,    ρ(e) = 1 − exp(−e / ν)

A contour slides over the limb as it turns; as the limb's normal there is perpendicular to the viewing ray, the sliding
moves the image along the contour only, to first order, so the derivative by the pose needs no term for it across. The
distance along the contour may count less (``share``): edges do not tell how far along a limb one is.

A hidden contour point, or one without an edge, is an entry that costs ρ = 1 and pulls nowhere (6.1.2).
"""

from tk.kernels.kinematics import load_rotation, load_translation, parent_of, velocity
from tk.kernels.projection import project
from tk.kernels.runtime import ti

# Columns of an entry. Points a and b are in the zero configuration (metres), target and unit normal in the picture.
POINT_A, POINT_B, LAST_DOF, CAMERA, TARGET, NORMAL = 0, 3, 6, 7, 8, 10
INV_SIGMA2, STATE, SCALE, NU, SHARE, ENTRY_NUMBERS = 12, 13, 14, 15, 16, 17  # 1/px²; its share of f
# States of an entry: padding, assigned, and a contour point that can have no edge.
ABSENT, ASSIGNED, UNASSIGNABLE = 0, 1, 2


@ti.func
def load_entry(entries: ti.template(), b: int, e: int, first: ti.template()):
    return ti.Vector([entries[b, e, first + a] for a in ti.static(range(3))])


@ti.func
def image_residual(frames: ti.template(), c: int, cameras: ti.template(), entries: ti.template(), b: int, e: int):
    """(valid, residual (2,), world points a and b, their projections' derivatives ½J_a, ½J_b (2, 3))."""
    k = ti.cast(entries[b, e, LAST_DOF], ti.i32)
    v = ti.cast(entries[b, e, CAMERA], ti.i32)
    R, t = load_rotation(frames, c, k), load_translation(frames, c, k)
    xa = R @ load_entry(entries, b, e, POINT_A) + t
    xb = R @ load_entry(entries, b, e, POINT_B) + t
    pa, Ja, za = project(cameras, v, xa)
    pb, Jb, zb = project(cameras, v, xb)
    target = ti.Vector([entries[b, e, TARGET], entries[b, e, TARGET + 1]])
    valid = 1 if za > 1e-3 and zb > 1e-3 else 0
    return valid, 0.5 * (pa + pb) - target, xa, xb, 0.5 * Ja, 0.5 * Jb


@ti.func
def metric_product(entries: ti.template(), b: int, e: int, r):
    """(share·I + (1 − share)·n nᵀ) r."""
    n = ti.Vector([entries[b, e, NORMAL], entries[b, e, NORMAL + 1]])
    share = entries[b, e, SHARE]
    return share * r + (1.0 - share) * n.dot(r) * n


@ti.func
def add_alignment(
    tree: ti.template(),
    frames: ti.template(),  # (C, D or more, 18) scratch
    state: ti.template(),  # (2 B, D) poses, then directions
    cameras: ti.template(),
    entries: ti.template(),
    sums: ti.template(),
    b: int,
    c: int,
    e: int,
):
    """Add scale·ρ(e) of entry e, its gradient and its Gauss-Newton product to row c of the sums."""
    kind = ti.cast(entries[b, e, STATE], ti.i32)
    scale = entries[b, e, SCALE]
    if kind == UNASSIGNABLE:
        sums[c, 0] = sums[c, 0] + scale
    elif kind == ASSIGNED:
        D = (sums.shape[1] - 1) // 2
        valid, r, xa, xb, Ja, Jb = image_residual(frames, c, cameras, entries, b, e)
        if valid == 0:
            sums[c, 0] = sums[c, 0] + scale
        else:
            nu, inv_sigma2 = entries[b, e, NU], entries[b, e, INV_SIGMA2]
            Mr = metric_product(entries, b, e, r)
            decay = ti.exp(-0.5 * r.dot(Mr) * inv_sigma2 / nu)
            sums[c, 0] = sums[c, 0] + scale * (1.0 - decay)
            weight = scale * decay / nu * inv_sigma2
            Jv = r * 0.0
            toward = state.shape[0] // 2 + b
            k_last = ti.cast(entries[b, e, LAST_DOF], ti.i32)
            k = k_last
            while k >= 0:
                J = Ja @ velocity(frames, c, k, xa) + Jb @ velocity(frames, c, k, xb)
                sums[c, 1 + k] = sums[c, 1 + k] + weight * J.dot(Mr)
                Jv += J * state[toward, k]
                k = parent_of(tree, k)
            MJv = metric_product(entries, b, e, Jv)
            k = k_last
            while k >= 0:
                J = Ja @ velocity(frames, c, k, xa) + Jb @ velocity(frames, c, k, xb)
                sums[c, 1 + D + k] = sums[c, 1 + D + k] + weight * J.dot(MJv)
                k = parent_of(tree, k)


@ti.func
def add_curvature(
    tree: ti.template(),
    frames: ti.template(),
    cameras: ti.template(),
    entries: ti.template(),
    hessian: ti.template(),
    c: int,
    e: int,
    floor,
):
    """Add entry e of pose 0 to the lower triangle of the Gauss-Newton Hessian in row c; outliers weigh ``floor``."""
    if ti.cast(entries[0, e, STATE], ti.i32) == ASSIGNED:
        valid, r, xa, xb, Ja, Jb = image_residual(frames, c, cameras, entries, 0, e)
        if valid == 1:
            nu, inv_sigma2 = entries[0, e, NU], entries[0, e, INV_SIGMA2]
            decay = ti.exp(-0.5 * r.dot(metric_product(entries, 0, e, r)) * inv_sigma2 / nu)
            weight = entries[0, e, SCALE] * ti.max(decay, floor) / nu * inv_sigma2
            k = ti.cast(entries[0, e, LAST_DOF], ti.i32)
            while k >= 0:
                J = Ja @ velocity(frames, c, k, xa) + Jb @ velocity(frames, c, k, xb)
                MJ = weight * metric_product(entries, 0, e, J)
                j = k
                while j >= 0:
                    Jj = Ja @ velocity(frames, c, j, xa) + Jb @ velocity(frames, c, j, xb)
                    hessian[c, k, j] = hessian[c, k, j] + MJ.dot(Jj)
                    j = parent_of(tree, j)
                k = parent_of(tree, k)
