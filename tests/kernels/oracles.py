"""Slow, obvious NumPy of what the kernels share."""

import numpy as np


def implicit(q, radii, e1, e2):
    """G = F^(ε₁/2) of points (N, 3), (N,)."""
    x, y, z = np.abs(q / radii).T
    F = (x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1)
    return F ** (e1 / 2)


def implicit_gradient(q, radii, e1, e2, h=1e-6):
    """(N, 3) by central differences."""
    return np.stack(
        [(implicit(q + d, radii, e1, e2) - implicit(q - d, radii, e1, e2)) / (2 * h) for d in h * np.eye(3)], -1
    )


def project(q, radii, e1, e2, z_lower, z_upper):
    """(N, 3) points: onto the planes of truncation, then one Newton step along G's gradient."""
    c = q.copy()
    c[:, 2] = np.clip(q[:, 2], z_lower, z_upper)
    gradient = implicit_gradient(c, radii, e1, e2)
    square = np.sum(gradient**2, axis=1)
    return c - ((implicit(c, radii, e1, e2) - 1) / square)[:, None] * gradient
