"""Small vectors and matrices: loaded from arrays, and their products written out.

Taichi's own operators (``@``, ``.dot``, ``.cross``, ``.norm``, ``.transpose``) are Taichi functions for every shape.
Taichi transforms each of their calls again, which is half of the time of a kernel's Python transformation at each
start. The functions below are one line each, for three dimensions, and do the same sums in the same order.
"""

from tk.kernels.runtime import ti


@ti.func
def triple(array: ti.template(), i: int, first: ti.template()):
    """Return three numbers of row i, from column ``first`` on."""
    return ti.Vector([array[i, first + a] for a in ti.static(range(3))])


@ti.func
def triple_in(array: ti.template(), c: int, i: int, first: ti.template()):
    """Return three numbers of row (c, i), from column ``first`` on."""
    return ti.Vector([array[c, i, first + a] for a in ti.static(range(3))])


@ti.func
def times(M, x):
    """Return M x, for M (n, 3) and x (3,)."""
    return ti.Vector([M[i, 0] * x[0] + M[i, 1] * x[1] + M[i, 2] * x[2] for i in ti.static(range(M.n))])


@ti.func
def transposed_times(M, x):
    """Return Mᵀ x, for M (3, 3) and x (3,)."""
    return ti.Vector([M[0, i] * x[0] + M[1, i] * x[1] + M[2, i] * x[2] for i in ti.static(range(3))])


@ti.func
def pulled(J, n):
    """Return Jᵀ n, for J (2, 3) and n (2,)."""
    return ti.Vector([J[0, i] * n[0] + J[1, i] * n[1] for i in ti.static(range(3))])


@ti.func
def product(A, B):
    """Return A B, for A (n, 3) and B (3, 3)."""
    return ti.Matrix(
        [
            [A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j] for j in ti.static(range(3))]
            for i in ti.static(range(A.n))
        ]
    )


@ti.func
def dot(a, b):
    """Return a · b, for vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def cross(a, b):
    """Return a × b, for vectors (3,)."""
    return ti.Vector([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@ti.func
def norm_sqr(a):
    """Return |a|², for a vector (3,)."""
    return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]


@ti.func
def norm2(a):
    """Return |a|, for a vector (2,)."""
    return ti.sqrt(a[0] * a[0] + a[1] * a[1])
