"""Gradients and Hessian-vector products of many points on a tree, each point in constant time.

A point x below degree of freedom k, with the world twist (ω, v), moves at ω × x + v. So a force F on it, the derivative
of f by x, contributes

    F · (ω × x + v) = ω · (x × F) + v · F

to ∂f/∂p_k: the wrench (x × F, F) has all that any degree of freedom above asks of the point. The wrenches of the points
of a segment are added up, and at the end handed down the tree once, from the leaves to the root (as in the recursive
Newton-Euler algorithm; Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 5). In the same way the velocity of
a point along a direction in p, the J·v of H·v = JᵀM J v, comes from its segment's one twist.

Columns of the scratch ``(C, D, 36)``, after frames and twists (:mod:`tk.kernels.kinematics`): the twist of the segment
along the direction, and two wrenches: of the gradient, of the Hessian-vector product.
"""

from tk.kernels.kinematics import JOINT_NUMBERS, TWIST, parent_of
from tk.kernels.runtime import ti

MOTION, WRENCH, WRENCH_NUMBERS = JOINT_NUMBERS, JOINT_NUMBERS + 6, JOINT_NUMBERS + 18


@ti.func
def load_wrench(scratch: ti.template(), c: int, k: int, first: ti.template()):
    """Three numbers of row k from column ``first``."""
    return ti.Vector([scratch[c, k, first + a] for a in ti.static(range(3))])


@ti.func
def start_wrenches(tree: ti.template(), state: ti.template(), row: int, c: int, scratch: ti.template()):
    """Wrenches to zero, and the segments' twists along the direction in a row of ``state``; joints are placed."""
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
    """Add a wrench to that of row k from column ``first``."""
    for a in ti.static(range(3)):
        scratch[c, k, first + a] = scratch[c, k, first + a] + moment[a]
        scratch[c, k, first + 3 + a] = scratch[c, k, first + 3 + a] + force[a]


@ti.func
def collect_wrenches(tree: ti.template(), c: int, scratch: ti.template(), sums: ti.template()):
    """Gradient and Hessian-vector product into the last 2 D columns of row c of the sums."""
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
