"""The objective's pairs and Gauss-Newton Hessian at one pose."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Linearisation:
    """K = M + Q pairs at one pose.

    Attributes:
        residual: (K, 3) x − x̄, metres; zero where a pair is missing.
        hessian: (D, D) Gauss-Newton Hessian of f; outliers weigh at least the given floor.
        partner: (K,) the voxel, -1 where missing.
        inv_sigma2: (K,) 1/σ², 1/m².
    """

    residual: np.ndarray
    hessian: np.ndarray
    partner: np.ndarray
    inv_sigma2: np.ndarray
