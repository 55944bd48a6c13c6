"""Least squares over time: blocks of unknowns, one a frame, and unknowns that all frames share.

Gauss-Newton with Levenberg's damping. Neighbouring blocks may be coupled, as by a motion from frame to frame. Then the
matrix of the blocks is block tridiagonal, and one elimination from the first frame to the last solves it; where nothing
couples two frames, as at a cut, the chain ends and another one begins. The blocks are eliminated from the equations of
the shared unknowns by the Schur complement (Triggs et al. 2000, *Bundle adjustment: a modern synthesis*, section 6), so
the equations that remain have the size of the shared unknowns. The cost is linear in the number of frames. The
covariances of the blocks follow from the same elimination, from the last frame to the first (Rauch, Tung and Striebel
1965). The module knows nothing of bodies and cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
T = TypeVar("T")


class Equations:
    """Normal equations of B blocks of D unknowns each, in the order of time, and of S shared unknowns; begin at zero.

    Attributes:
        hessian: (B, D + S, D + S) JᵀWJ of each block's rows; its own unknowns come first.
        gradient: (B, D + S) JᵀW times the residuals, by which the rows' values should grow: the negative gradient.
        coupling: (B - 1, D, D) JᵀWJ of the unknowns of a block (rows) and of the next one (columns); None if nothing
            couples blocks.
        prior_hessian, prior_gradient: (S, S), (S,) the same of the shared unknowns' prior.
    """

    def __init__(self, blocks: int, own: int, shared: int) -> None:
        size = own + shared
        self.hessian, self.gradient = np.zeros((blocks, size, size)), np.zeros((blocks, size))
        self.coupling: Float | None = None
        self.prior_hessian, self.prior_gradient = np.zeros((shared, shared)), np.zeros(shared)

    @property
    def own(self) -> int:
        """D, the number of a block's own unknowns."""
        return self.gradient.shape[1] - len(self.prior_gradient)

    def add(
        self,
        blocks: NDArray[np.integer],
        columns: NDArray[np.integer],
        rows: Float,
        weight: Float,
        residual: Float,
    ) -> None:
        """Add N rows to the equations of their blocks.

        Args:
            blocks: (N,) index of each row's block, ascending.
            columns: (K,) the unknowns (of D + S) that the rows are derivatives by, each once; the same of all rows.
            rows: (N, K) derivatives.
            weight: (N,) information of each row.
            residual: (N,) by how much each row's value should grow.
        """
        root, K = np.sqrt(weight), rows.shape[1]
        present, first, count = np.unique(blocks, return_index=True, return_counts=True)
        # one product of each block, of as many rows as the largest has
        scaled = np.zeros((len(present), count.max(initial=0), K + 1))
        block, row = np.repeat(np.arange(len(present)), count), np.arange(len(blocks)) - np.repeat(first, count)
        scaled[block, row, :K] = rows * root[:, None]
        scaled[block, row, K] = residual * root
        products = scaled.swapaxes(1, 2) @ scaled
        places = (columns[:, None] * self.gradient.shape[1] + columns).ravel()
        for index, product in zip(present.tolist(), products, strict=True):
            # each place once: NumPy reads and writes numbered places five times as fast so as by `+=`
            np.add.at(self.hessian[index].reshape(-1), places, product[:K, :K].ravel())
        self.gradient[present[:, None], columns] += products[:, :K, K]

    def add_block_prior(self, block: int, precision: Float, difference: Float) -> None:
        """Add a prior on a block: precision (D,) and the difference (D,) from the estimate to the prior's mean."""
        index = np.arange(len(precision))
        self.hessian[block, index, index] += precision
        self.gradient[block, index] += precision * difference

    def add_normal(self, block: int, columns: NDArray[np.intp], hessian: Float, gradient: Float) -> None:
        """Add normal equations (K, K), (K,) of some unknowns (K,), indices of D + S, to a block's."""
        self.hessian[block][np.ix_(columns, columns)] += hessian
        self.gradient[block, columns] += gradient

    def couple(self, blocks: NDArray[np.intp], before: Float, after: Float, weight: Float, residual: Float) -> None:
        """Add rows that couple blocks to their next ones.

        Args:
            blocks: (N,) different indices of blocks, each below B - 1.
            before, after: (R, D) derivatives of R rows by the unknowns of a block and of the next one.
            weight: (N, R) information of each row.
            residual: (N, R) by how much each row's value should grow.
        """
        D = self.own
        if self.coupling is None:
            self.coupling = np.zeros((len(self.hessian) - 1, D, D))
        self.coupling[blocks] += before.T @ (weight[..., None] * after)
        for index, rows in ((blocks, before), (blocks + 1, after)):
            self.hessian[index, :D, :D] += rows.T @ (weight[..., None] * rows)
            self.gradient[index, :D] += (weight * residual) @ rows

    def reduced(self, damping: float = 0.0) -> Reduced:
        """Eliminate the blocks. ``damping`` is the share of each diagonal element that is added to it."""
        D, shared = self.own, self.hessian[:, self.own :, self.own :].sum(axis=0) + self.prior_hessian
        own, across = self.hessian[:, :D, :D], self.hessian[:, :D, D:]
        if damping:
            own = own + damping * own * np.eye(D)
        chain = Chain.of(own, self.coupling)
        solved = chain.solve(np.concatenate([self.gradient[:, :D, None], across], axis=2))
        plain, response = solved[..., 0], solved[..., 1:]
        by_block = self.gradient[:, D:] - (across * plain[..., None]).sum(axis=1)
        return Reduced(
            hessian=shared + damping * shared * np.eye(len(shared)) - np.tensordot(across, response, ([0, 1], [0, 1])),
            gradient=by_block.sum(axis=0) + self.prior_gradient,
            by_block=by_block,
            plain=plain,
            response=response,
            chain=chain,
        )


@dataclass(frozen=True)
class Chain:
    """A block tridiagonal, positive definite matrix of B blocks of D unknowns after elimination in the order of time.

    Attributes:
        left: (B, D, D) the matrix of each block after elimination of the blocks before it.
        gain: (B - 1, D, D) by which a block shrinks with the next one; None if nothing couples blocks.
    """

    left: Float
    gain: Float | None

    @classmethod
    def of(cls, own: Float, coupling: Float | None) -> Chain:
        """Eliminate the blocks of a matrix with diagonal blocks (B, D, D) and, above them, blocks (B - 1, D, D)."""
        if coupling is None:
            return cls(own, None)
        left, gain = own.copy(), np.zeros_like(coupling)
        for b in np.flatnonzero(coupling.any(axis=(1, 2))).tolist():
            gain[b] = np.linalg.solve(left[b], coupling[b])
            left[b + 1] -= coupling[b].T @ gain[b]
        return cls(left, gain)

    def solve(self, right: Float) -> Float:
        """Return the solution (B, D, K) of right sides (B, D, K)."""
        if self.gain is None:
            return np.asarray(np.linalg.solve(self.left, right))
        right = right.copy()
        for b, gain in enumerate(self.gain):
            right[b + 1] -= gain.T @ right[b]
        found = np.linalg.solve(self.left, right)
        for b in range(len(self.gain) - 1, -1, -1):
            found[b] -= self.gain[b] @ found[b + 1]
        return np.asarray(found)

    @cached_property
    def covariance(self) -> Float:
        """(B, D, D) the diagonal blocks of the matrix's inverse."""
        found = np.asarray(np.linalg.inv(self.left))
        if self.gain is not None:
            for b in range(len(self.gain) - 1, -1, -1):
                found[b] += self.gain[b] @ found[b + 1] @ self.gain[b].T
        return found


@dataclass(frozen=True)
class Reduced:
    """Equations of the S shared unknowns after elimination of B blocks of D unknowns."""

    # hessian, gradient: (S, S), (S,) of the shared unknowns, their prior included
    hessian: Float
    gradient: Float
    by_block: Float  # (B, S) what each block's rows add to the gradient
    plain: Float  # (B, D) step of the blocks if the shared unknowns stay
    response: Float  # (B, D, S) by which the blocks' step shrinks with a step of the shared unknowns
    chain: Chain  # the matrix of the blocks

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
