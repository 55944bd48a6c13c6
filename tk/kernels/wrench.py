"""Gradients and Hessian-vector products of many points on a tree, each point in constant time.

A point x below degree of freedom k, with the world twist (ω, v), moves at ω × x + v. So a force F on it, the derivative
of f by x, contributes

    F · (ω × x + v) = ω · (x × F) + v · F

to ∂f/∂p_k: the wrench (x × F, F) contains the point's contribution for every degree of freedom above it. The wrenches
of a segment's points are summed, and at the end passed along the tree once, from the leaves to the root (as in the
recursive Newton-Euler algorithm; Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 5). In the same manner the
velocity of a point along a direction in p, the J·v of H·v = JᵀM J v, follows from its segment's twist.

The Gauss-Newton Hessian Σ JᵀMJ needs for each segment the 6×6 sum of PᵀMP over its points, where P (3, 6) maps a twist
to the point's velocity. The sum is an inertia and is passed along the tree like one (the composite rigid body
algorithm; Featherstone, chapter 6). It contains squares of distances, so it is taken about an origin near the body for
precision.

Columns of the scratch ``(C, D, 39)``, after frames and twists (:mod:`tk.kernels.kinematics`): the twist of the segment
along the direction, and two wrenches, of the gradient and of the Hessian-vector product; or instead the lower triangle
of the inertia, row by row.
"""

from tk.kernels.columns import SPATIAL
from tk.kernels.kinematics import JOINT_NUMBERS, TWIST, parent_of
from tk.kernels.runtime import ti
from tk.kernels.vectors import cross, dot, norm_sqr, times, triple_in

MOTION, WRENCH = JOINT_NUMBERS, JOINT_NUMBERS + SPATIAL
INERTIA = JOINT_NUMBERS
INERTIA_NUMBERS = 21
SCRATCH_NUMBERS = INERTIA + INERTIA_NUMBERS
# After the inertia, in the scratch of a kernel that needs both: a wrench about the origin of the inertias.
PULL, PULL_NUMBERS = SCRATCH_NUMBERS, SPATIAL
# After both, the inertia and the wrench of what one view shows of the segment.
OF_VIEW, VIEW_NUMBERS = PULL + PULL_NUMBERS, INERTIA_NUMBERS + PULL_NUMBERS


@ti.func
def start_wrenches(tree: ti.template(), state: ti.template(), row: int, c: int, scratch: ti.template()):
    """Clear the wrenches and store the segments' twists along the direction in a row of ``state``."""
    for k in range(tree.shape[0]):
        up = parent_of(tree, k)
        for a in range(6):
            along = state[row, k] * scratch[c, k, TWIST + a]
            if up >= 0:
                along += scratch[c, up, MOTION + a]
            scratch[c, k, MOTION + a] = along
        for a in range(12):
            scratch[c, k, WRENCH + a] = 0.0


@ti.func
def add_wrench(scratch: ti.template(), c: int, k: int, first: ti.template(), moment, force):
    """Add a wrench to row k from column ``first`` on."""
    for a in ti.static(range(3)):
        scratch[c, k, first + a] = scratch[c, k, first + a] + moment[a]
        scratch[c, k, first + 3 + a] = scratch[c, k, first + 3 + a] + force[a]


@ti.func
def collect_wrenches(tree: ti.template(), c: int, scratch: ti.template(), sums: ti.template()):
    """Write gradient and Hessian-vector product into the last 2 D columns of row c of the sums."""
    D = tree.shape[0]
    for back in range(D):
        k = D - 1 - back
        up = parent_of(tree, k)
        gradient, product = sums[c, 0] * 0.0, sums[c, 0] * 0.0
        for a in range(6):
            gradient += scratch[c, k, TWIST + a] * scratch[c, k, WRENCH + a]
            product += scratch[c, k, TWIST + a] * scratch[c, k, WRENCH + 6 + a]
        sums[c, 1 + k] = gradient
        sums[c, 1 + D + k] = product
        if up >= 0:
            for a in range(12):
                scratch[c, up, WRENCH + a] = scratch[c, up, WRENCH + a] + scratch[c, k, WRENCH + a]


@ti.func
def start_inertias(tree: ti.template(), c: int, scratch: ti.template()):
    """Clear the inertias."""
    for k in range(tree.shape[0]):
        for a in range(INERTIA_NUMBERS):
            scratch[c, k, INERTIA + a] = 0.0


@ti.func
def add_inertia(scratch: ti.template(), c: int, k: int, x, weight):
    """Add weight·PᵀP of a point x, relative to the origin, to row k."""
    square = norm_sqr(x)
    for i in ti.static(range(3)):
        for j in ti.static(range(i + 1)):
            a = INERTIA + i * (i + 1) // 2 + j
            scratch[c, k, a] = scratch[c, k, a] + weight * ((square if i == j else 0.0) - x[i] * x[j])
        # the translation's rows: the identity, and e_j × x
        b = INERTIA + (3 + i) * (4 + i) // 2
        scratch[c, k, b + 3 + i] = scratch[c, k, b + 3 + i] + weight
        ahead, behind = (i + 1) % 3, (i + 2) % 3
        scratch[c, k, b + ahead] = scratch[c, k, b + ahead] + weight * x[behind]
        scratch[c, k, b + behind] = scratch[c, k, b + behind] - weight * x[ahead]


@ti.func
def add_direction(scratch: ti.template(), c: int, k: int, moment, force, weight):
    """Add weight·g gᵀ with g = (moment, force) to row k."""
    g = ti.Vector([moment[0], moment[1], moment[2], force[0], force[1], force[2]])
    for i in ti.static(range(6)):
        for j in ti.static(range(i + 1)):
            a = INERTIA + i * (i + 1) // 2 + j
            scratch[c, k, a] = scratch[c, k, a] + weight * g[i] * g[j]


@ti.func
def add_displaced(scratch: ti.template(), c: int, k: int, precision):
    """Add a view's inertia and wrench of row k to the row's own and clear them. In this view all points of the segment
    are displaced together; the displacement has this precision about zero along each axis and is eliminated."""
    view = ti.Vector([0.0 * precision for _ in range(3)])
    own = ti.Matrix([[0.0 * precision for _ in range(3)] for _ in range(3)])
    for i in ti.static(range(3)):
        view[i] = scratch[c, k, OF_VIEW + INERTIA_NUMBERS + 3 + i]
        for j in ti.static(range(3)):
            own[i, j] = scratch[c, k, OF_VIEW + _lower(3 + i, 3 + j)] + (precision if i == j else 0.0 * precision)
    inverse = own.inverse()
    for i in range(6):
        gain = times(inverse, _forces(scratch, c, k, i))
        wrench = OF_VIEW + INERTIA_NUMBERS + i
        scratch[c, k, PULL + i] = scratch[c, k, PULL + i] + scratch[c, k, wrench] - dot(gain, view)
        for j in range(i + 1):
            a, rest = i * (i + 1) // 2 + j, dot(gain, _forces(scratch, c, k, j))
            scratch[c, k, INERTIA + a] = scratch[c, k, INERTIA + a] + scratch[c, k, OF_VIEW + a] - rest
    for a in range(VIEW_NUMBERS):
        scratch[c, k, OF_VIEW + a] = 0.0


@ti.func
def _lower(i, j):
    """Return the place of element (i, j) in the lower triangle of an inertia."""
    low, high = ti.min(i, j), ti.max(i, j)
    return high * (high + 1) // 2 + low


@ti.func
def _forces(scratch: ti.template(), c: int, k: int, i: int):
    """Return the elements (i, 3) to (i, 5) of a view's inertia in row k."""
    return ti.Vector([scratch[c, k, OF_VIEW + _lower(i, 3 + j)] for j in ti.static(range(3))])


@ti.func
def _twist_about(scratch: ti.template(), c: int, k: int, origin):
    w, v = triple_in(scratch, c, k, TWIST), triple_in(scratch, c, k, TWIST + 3)
    v += cross(w, origin)
    return ti.Vector([w[0], w[1], w[2], v[0], v[1], v[2]])


@ti.func
def collect_inertias(tree: ti.template(), c: int, scratch: ti.template(), origin, hessian: ti.template()):
    """Write the Hessian into row c. Entries of two degrees of freedom on different branches are left as they are."""
    D = tree.shape[0]
    for back in range(D):
        k = D - 1 - back
        s = _twist_about(scratch, c, k, origin)
        force = s * 0.0
        for i in ti.static(range(6)):
            for j in ti.static(range(6)):
                low, high = min(i, j), max(i, j)
                force[i] += scratch[c, k, INERTIA + high * (high + 1) // 2 + low] * s[j]
        j = k
        while j >= 0:
            shared = force.dot(_twist_about(scratch, c, j, origin))
            hessian[c, k, j] = shared
            hessian[c, j, k] = shared
            j = parent_of(tree, j)
        up = parent_of(tree, k)
        if up >= 0:
            for a in range(INERTIA_NUMBERS):
                scratch[c, up, INERTIA + a] = scratch[c, up, INERTIA + a] + scratch[c, k, INERTIA + a]


@ti.func
def collect_pulls(
    tree: ti.template(), c: int, scratch: ti.template(), origin, sums: ti.template(), first: ti.template()
):
    """Write the gradient (D,) into row c of the sums from column ``first`` on."""
    D = tree.shape[0]
    for back in range(D):
        k = D - 1 - back
        s = _twist_about(scratch, c, k, origin)
        gradient = 0.0 * s[0]
        for i in ti.static(range(PULL_NUMBERS)):
            gradient += s[i] * scratch[c, k, PULL + i]
        sums[c, first + k] = gradient
        up = parent_of(tree, k)
        if up >= 0:
            for a in range(PULL_NUMBERS):
                scratch[c, up, PULL + a] = scratch[c, up, PULL + a] + scratch[c, k, PULL + a]
