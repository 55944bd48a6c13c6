"""What the objective's kernel says of one pose beside its value: pairs, their Jacobian, the Gauss-Newton Hessian."""

import functools
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Linearisation:
    """K = M + Q pairs at one pose.

    Attributes:
        residual: (K, 3) x − x̄, metres; zero where a pair is missing.
        jacobian: (K, 3, D) ∂x/∂p; (1, 3, D) zeros where it was not asked for.
        hessian: (D, D) Gauss-Newton Hessian of f, outliers weighing at least the floor asked for.
        partner: (K,) the voxel, -1 where missing.
        voxel_normals: (V, 3) of all voxels; share: (K,) weight of the distance along the data's surface.
        inv_sigma2: (K,) 1/σ², 1/m².
        nu: (K,) Leclerc's ν; scale: (K,) the pair's share of f.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    hessian: np.ndarray
    partner: np.ndarray
    voxel_normals: np.ndarray
    share: np.ndarray
    inv_sigma2: np.ndarray
    nu: np.ndarray
    scale: np.ndarray

    @functools.cached_property
    def metric(self) -> np.ndarray:
        """(K, 3, 3) how directions count: the identity, or less along the data's surface."""
        return metric_of(self.voxel_normals[self.partner], self.share)

    @property
    def decay(self) -> np.ndarray:
        """(K,) exp(−e/ν): near 1 for inliers, 0 for outliers and missing pairs."""
        e = 0.5 * np.einsum("ka,kab,kb->k", self.residual, self.metric, self.residual) * self.inv_sigma2
        return np.where(self.partner >= 0, np.exp(-e / self.nu), 0.0)

    def gauss_newton(self, floor: float = 0.0) -> np.ndarray:
        """(D, D) the Gauss-Newton Hessian of f, outliers weighing at least ``floor``."""
        weight = self.scale / self.nu * self.inv_sigma2 * np.maximum(self.decay, floor) * (self.partner >= 0)
        weighted = np.einsum("k,kab,kbd->kad", weight, self.metric, self.jacobian)
        D = self.jacobian.shape[2]
        return self.jacobian.reshape(-1, D).T @ weighted.reshape(-1, D)


def metric_of(normals: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(K, 3, 3) share·I + (1 − share)·n nᵀ; the identity where the normal is zero."""
    n = normals.astype(np.float64)
    share = np.where(n.any(axis=1), share, 1.0)[:, None, None]
    return share * np.eye(3) + (1 - share) * n[:, :, None] * n[:, None, :]
