"""Truncated superellipsoids (Kehl 2006, sections 5.1 and 5.2).

A piece has its main axis along local z. Its surface is eq. 1 between two planes z = const. A limb is a truncated piece
and a cap; a cap is a piece of its own, with ε₁ = 1 and cut at its equator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Superellipsoid:
    """One piece of the body's surface."""

    segment: str  # the body segment to which the piece is fixed
    T_body_piece: Float  # (4, 4) from the piece's frame to the body frame in the zero configuration
    radii: tuple[float, float, float]  # a₁, a₂, a₃, metres
    # e1, e2: ε₁ (along the meridians) and ε₂ (along the circles of latitude), each in (0, 2)
    e1: float
    e2: float
    # z_lower, z_upper: the planes between which the surface exists, metres, within ±a₃
    z_lower: float
    z_upper: float

    def __post_init__(self) -> None:
        if min(self.radii) <= 0:
            raise ConfigError(f"superellipsoid of {self.segment}: radii {self.radii} must be positive")
        if not (0 < self.e1 < 2 and 0 < self.e2 < 2):
            raise ConfigError(f"superellipsoid of {self.segment}: exponents {self.e1}, {self.e2} must lie in (0, 2)")
        if not -self.radii[2] <= self.z_lower < self.z_upper <= self.radii[2]:
            raise ConfigError(f"superellipsoid of {self.segment}: cut at {self.z_lower} and {self.z_upper} m is empty")

    @property
    def eta_range(self) -> tuple[float, float]:
        """The angles η of the two cutting planes, radians."""
        return _eta(self.z_lower / self.radii[2], self.e1), _eta(self.z_upper / self.radii[2], self.e1)

    def point(self, eta: Float, omega: Float) -> Float:
        """Return (…, 3) r(η, ω), metres (eq. 1)."""
        a1, a2, a3 = self.radii
        ring = signed_power(np.cos(eta), self.e1)
        return np.stack(
            [
                a1 * ring * signed_power(np.cos(omega), self.e2),
                a2 * ring * signed_power(np.sin(omega), self.e2),
                a3 * signed_power(np.sin(eta), self.e1),
            ],
            axis=-1,
        )

    def normal(self, eta: Float, omega: Float) -> Float:
        """Return (…, 3) unit outward normals (eq. 2)."""
        n = self.normal_direction(eta, omega)
        return n / np.linalg.norm(n, axis=-1, keepdims=True)

    def normal_direction(self, eta: Float, omega: Float) -> Float:
        """Return (…, 3) n_d of eq. 2 in its own length, 1/m: with it, n_d · r(η, ω) = 1."""
        a1, a2, a3 = self.radii
        ring = signed_power(np.cos(eta), 2 - self.e1)
        return np.stack(
            [
                ring * signed_power(np.cos(omega), 2 - self.e2) / a1,
                ring * signed_power(np.sin(omega), 2 - self.e2) / a2,
                signed_power(np.sin(eta), 2 - self.e1) / a3,
            ],
            axis=-1,
        )

    def inside_outside(self, p_piece: Float) -> Float:
        """Return F(x, y, z) of section 5.3 at points (…, 3): below 1 inside, 1 on the surface, above 1 outside.

        The paper does not print F; this is Barr's. It ignores the truncation: see :meth:`contains`.
        """
        x, y, z = np.moveaxis(np.abs(np.asarray(p_piece, dtype=np.float64) / np.array(self.radii)), -1, 0)
        return (x ** (2 / self.e2) + y ** (2 / self.e2)) ** (self.e2 / self.e1) + z ** (2 / self.e1)

    def contains(self, p_piece: Float) -> NDArray[np.bool_]:
        """Return (…) True for points inside the truncated piece."""
        z = np.asarray(p_piece)[..., 2]
        return (self.inside_outside(p_piece) < 1) & (z >= self.z_lower) & (z <= self.z_upper)

    def samples(self, spacing_m: float) -> tuple[Float, Float]:
        """Return angles η (N,) and ω (N,) of surface points about ``spacing_m`` apart, uniform in area.

        Circles of latitude are laid at equal arc lengths along the meridian, and points at equal arc lengths along each
        circle, every other circle shifted by half a step (equal steps of η and ω would crowd the curved regions).
        """
        lower, upper = self.eta_range
        eta = np.linspace(lower, upper, 512)
        meridian = np.hypot(
            np.gradient(max(self.radii[:2]) * signed_power(np.cos(eta), self.e1)),
            np.gradient(self.radii[2] * signed_power(np.sin(eta), self.e1)),
        )
        arc = np.concatenate([[0.0], np.cumsum((meridian[1:] + meridian[:-1]) / 2)])
        rings = max(round(float(arc[-1]) / spacing_m), 1)
        etas = np.interp((np.arange(rings) + 0.5) / rings * arc[-1], arc, eta)

        omega = np.linspace(-np.pi, np.pi, 721)
        circle = self.point(np.zeros_like(omega), omega)
        steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(circle, axis=0), axis=1))])
        all_eta, all_omega = [], []
        for i, e in enumerate(etas):
            count = max(round(float(np.cos(e) ** self.e1 * steps[-1]) / spacing_m), 1)
            at = (np.arange(count) + 0.5 * (i % 2) + 0.25) / count * steps[-1]
            all_omega.append(np.interp(at, steps, omega))
            all_eta.append(np.full(count, e))
        return np.concatenate(all_eta), np.concatenate(all_omega)


def signed_power(base: Float, exponent: float) -> Float:
    """Return sign(b)·|b|^e, the power in the equations of superquadrics."""
    return np.sign(base) * np.abs(base) ** exponent


def _eta(height: float, e1: float) -> float:
    return float(np.arcsin(np.clip(signed_power(np.float64(height), 1 / e1), -1, 1)))
