"""Least squares over blocks of unknowns, one block a frame, and over unknowns that all frames share.

Gauss-Newton with Levenberg's damping. Each block is eliminated on its own by its Schur complement (Triggs et al. 2000,
*Bundle adjustment: a modern synthesis*, section 6), so the equations that remain have the size of the shared unknowns.
The module knows nothing of bodies and cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
T = TypeVar("T")


class Equations:
    """Normal equations of B blocks of D unknowns each and of S shared unknowns; begin at zero.

    Attributes:
        hessian: (B, D + S, D + S) JᵀWJ of each block's rows; its own unknowns come first.
        gradient: (B, D + S) JᵀW times the residuals.
        prior_hessian, prior_gradient: (S, S), (S,) the same of the shared unknowns' prior.
    """

    def __init__(self, blocks: int, own: int, shared: int) -> None:
        size = own + shared
        self.hessian, self.gradient = np.zeros((blocks, size, size)), np.zeros((blocks, size))
        self.prior_hessian, self.prior_gradient = np.zeros((shared, shared)), np.zeros(shared)

    def add(self, block: int, columns: Sequence[slice], rows: Float, weight: Float, residual: Float) -> None:
        """Add rows to a block's equations.

        Args:
            block: index of the block.
            columns: the unknowns (of D + S) that the rows are derivatives by, as slices in the order of the rows.
            rows: (N, K) derivatives.
            weight: (N,) information of each row.
            residual: (N,) by how much each row's value should grow.
        """
        root = np.sqrt(weight)
        scaled = rows * root[:, None]
        A, y = scaled.T @ scaled, scaled.T @ (root * residual)  # a symmetric product takes half the time
        ends = np.cumsum([part.stop - part.start for part in columns])
        own = [slice(end - (part.stop - part.start), end) for part, end in zip(columns, ends.tolist(), strict=True)]
        for i, into in zip(own, columns, strict=True):
            self.gradient[block, into] += y[i]
            for j, across in zip(own, columns, strict=True):
                self.hessian[block, into, across] += A[i, j]

    def add_block_prior(self, block: int, precision: Float, difference: Float) -> None:
        """Add a prior on a block: precision (D,) and the difference (D,) from the estimate to the prior's mean."""
        index = np.arange(len(precision))
        self.hessian[block, index, index] += precision
        self.gradient[block, index] += precision * difference

    def add_normal(self, block: int, columns: NDArray[np.intp], hessian: Float, gradient: Float) -> None:
        """Add normal equations (K, K), (K,) of some unknowns (K,), indices of D + S, to a block's."""
        self.hessian[block][np.ix_(columns, columns)] += hessian
        self.gradient[block, columns] += gradient

    def reduced(self, damping: float = 0.0) -> Reduced:
        """Eliminate the blocks. ``damping`` is the share of each diagonal element that is added to it."""
        S = len(self.prior_gradient)
        D = self.gradient.shape[1] - S
        hessian, by_block = np.zeros((S, S)), np.zeros((len(self.hessian), S))
        plain, response = np.zeros((len(self.hessian), D)), np.zeros((len(self.hessian), D, S))
        diagonal = np.diag(self.prior_hessian).copy()
        for b, (H, g) in enumerate(zip(self.hessian, self.gradient, strict=True)):
            own, across = H[:D, :D].copy(), H[:D, D:]
            own[np.diag_indices_from(own)] *= 1.0 + damping
            solved = np.linalg.solve(own, np.column_stack([g[:D], across]))
            plain[b], response[b] = solved[:, 0], solved[:, 1:]
            hessian += H[D:, D:] - across.T @ solved[:, 1:]
            by_block[b] = g[D:] - across.T @ solved[:, 0]
            diagonal += np.diag(H)[D:]
        hessian += self.prior_hessian + np.diag(damping * diagonal)
        return Reduced(hessian, by_block.sum(axis=0) + self.prior_gradient, by_block, plain, response)


@dataclass(frozen=True)
class Reduced:
    """Equations of the S shared unknowns after elimination of B blocks of D unknowns."""

    # hessian, gradient: (S, S), (S,) of the shared unknowns, their prior included
    hessian: Float
    gradient: Float
    by_block: Float  # (B, S) what each block's rows add to the gradient
    plain: Float  # (B, D) step of the blocks if the shared unknowns stay
    response: Float  # (B, D, S) by which the blocks' step shrinks with a step of the shared unknowns

    def step(self) -> tuple[Float, Float]:
        """Solve the equations: return the steps (B, D) of the blocks and (S,) of the shared unknowns."""
        shared = np.asarray(np.linalg.solve(self.hessian, self.gradient), np.float64)
        return self.plain - self.response @ shared, shared


@dataclass(frozen=True)
class Solution(Generic[T]):
    """Result of :func:`minimise`."""

    state: T  # the estimate
    reduced: Reduced | None  # the equations of the last step; None if no step was made
    converged: bool  # whether the last step was below the tolerance


def minimise(
    start: T,
    linearise: Callable[[T, int], Equations],
    move: Callable[[T, Float, Float], T],
    levels: Sequence[int],
    longest: tuple[float, Float | float],
    tolerance: Float | float | None = None,
    damping: float = 0.0,
) -> Solution[T]:
    """Iterate from an estimate.

    Args:
        start: the estimate, of any type.
        linearise: the equations at an estimate and a level.
        move: the estimate after steps (B, D) of the blocks and (S,) of the shared unknowns.
        levels: the level of each iteration; 0 is the finest.
        longest: largest change of a number of a block, and of the shared unknowns (S,), in one iteration.
        tolerance: (S,) the iteration ends at level 0 once every shared unknown changes by less than this; None: all
            iterations are made.
        damping: share of each diagonal element that is added to it.
    """
    state, reduced = start, None
    for level in levels:
        reduced = linearise(state, level).reduced(damping)
        blocks, shared = reduced.step()
        state = move(state, np.clip(blocks, -longest[0], longest[0]), np.clip(shared, -longest[1], longest[1]))
        if tolerance is not None and level == 0 and (np.abs(shared) < tolerance).all():
            return Solution(state, reduced, True)
    return Solution(state, reduced, False)


def gauge_projection(modes: Float, precision: Float) -> Float:
    """Return the projection (S, S) that removes a gauge's modes from a step.

    Args:
        modes: (S, M) changes of the unknowns that change no residual, such as a motion of the whole world.
        precision: (S,) weights of the unknowns: the remaining step is orthogonal to the modes under them.
    """
    weighted = modes.T * precision
    return np.eye(len(modes)) - modes @ np.linalg.solve(weighted @ modes, weighted)
