"""Quadratic terms of a cost over the parameters of B states."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class Quadratic(NamedTuple):
    """The cost ½ pᵀ·matrix·p − linear·p of B states p (D,), up to a constant."""

    linear: Float  # (B, D), or (1, D) for all states
    matrix: Float  # (B, D, D), or (1, D, D) for all states

    @staticmethod
    def about(mean: Float, precision: Float) -> Quadratic:
        """Return the cost of a normal prior with means (D,) or (B, D) and precisions (D,)."""
        return Quadratic(np.atleast_2d(precision * mean), np.diag(precision)[None])

    def __add__(self, other: Quadratic) -> Quadratic:  # type: ignore[override]
        return Quadratic(self.linear + other.linear, self.matrix + other.matrix)

    def scaled(self, factor: float) -> Quadratic:
        """Return the cost times a factor."""
        return Quadratic(factor * self.linear, factor * self.matrix)
