"""One damped Gauss-Newton step from the normal equations of one state, see :mod:`tk.optim.gauss_newton`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.runtime import ti

# Rows of ``terms``.
LOWER, UPPER, LINEAR = range(3)
# Columns of ``numbers``: settings of :class:`tk.optim.gauss_newton.GaussNewtonSettings`, then the steps' lengths.
DAMPING, STIFFNESS, LIMIT_WEIGHT, LONGEST_STEP, TOLERANCE, LENGTHS = range(6)
# Keeps the factorisation defined without damping and stiffness, share of the mean diagonal element.
_LEAST = 1e-9


class NewtonSteps(NamedTuple):
    """What determines the steps of B states with D parameters, besides the equations."""

    free: NDArray[np.int32]  # (n,) int32 the parameters that may change
    # (2 + B, D) limits, see `LOWER`; from row `LINEAR` on the linear part of each state's quadratic cost
    terms: NDArray[np.float64]
    # (B, D, D), or (1, D, D) for all states, its matrix: the cost ½ pᵀ·matrix·p − linear·p is added to the equations
    matrix: NDArray[np.float64]
    # (5 + S,) see `DAMPING`; the lengths of S steps as multiples of the equations' solution. A step of length 0
    # evaluates the equations only.
    numbers: NDArray[np.float64]


@ti.func
def newton_step(
    free: ti.template(),  # (n,)
    terms: ti.template(),  # (2 + B, D)
    matrix: ti.template(),  # (B, D, D) or (1, D, D)
    numbers: ti.template(),  # (5 + S,)
    b: int,
    length,
    hessian: ti.template(),  # (B, D, D)
    gradient: ti.template(),  # (B, first + D)
    first: ti.template(),
    factor: ti.template(),  # (B, n, n + 1) scratch: Cholesky factor with inverse diagonal; right side and solution
    state: ti.template(),  # (B, D) in and out
):
    """Move state b by a step; return the largest change of a parameter."""
    n = free.shape[0]
    total, count = 0.0 * length, 0
    for i in range(n):
        element = hessian[b, free[i], free[i]]
        total += element
        if element > 0.0:
            count += 1
    unit = total / ti.max(count, 1)
    if unit <= 0.0:
        unit = 1.0 + 0.0 * unit
    pull = numbers[LIMIT_WEIGHT] * unit
    q = b % matrix.shape[0]
    for i in range(n):
        k = free[i]
        p, element = state[b, k], hessian[b, k, k]
        excess = ti.min(ti.max(p, terms[LOWER, k]), terms[UPPER, k]) - p
        element += numbers[DAMPING] * element + (numbers[STIFFNESS] + _LEAST) * unit + matrix[q, k, k]
        if excess != 0.0:
            element += pull
        for j in range(i):
            factor[b, i, j] = hessian[b, k, free[j]] + matrix[q, k, free[j]]
        factor[b, i, i] = element
        slope = terms[LINEAR + b, k]
        for j in range(state.shape[1]):
            slope -= matrix[q, k, j] * state[b, j]
        factor[b, i, n] = gradient[b, first + k] + pull * excess + slope
    for i in range(n):
        for j in range(i + 1):
            rest = factor[b, i, j]
            for k in range(j):
                rest -= factor[b, i, k] * factor[b, j, k]
            factor[b, i, j] = 1.0 / ti.sqrt(rest) if i == j else rest * factor[b, j, j]
        rest = factor[b, i, n]
        for k in range(i):
            rest -= factor[b, i, k] * factor[b, k, n]
        factor[b, i, n] = rest * factor[b, i, i]
    longest = 0.0 * length
    for back in range(n):
        i = n - 1 - back
        rest = factor[b, i, n]
        for k in range(i + 1, n):
            rest -= factor[b, k, i] * factor[b, k, n]
        factor[b, i, n] = rest * factor[b, i, i]
        longest = ti.max(longest, ti.abs(factor[b, i, n]))
    share = length * ti.min(1.0 + 0.0 * length, numbers[LONGEST_STEP] / ti.max(longest, 1e-12 + 0.0 * length))
    for i in range(n):
        state[b, free[i]] = state[b, free[i]] + share * factor[b, i, n]
    return share * longest
