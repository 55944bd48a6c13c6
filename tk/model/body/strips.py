"""Strips of surface points along circles of latitude of a body's pieces (Kehl 2006, 5.2, fig. 6).

Computed once for a body. Strips are equal distances apart on the surface. Along a strip the samples are at equal steps
of the angle: there the paper's interpolation (eq. 5) works, and flat sides, where the normal hardly turns, need few.

Contour points lie on the limbs only (6.1.2): on the tapered pieces of upper arms, forearms, thighs and calves. Their
caps lie inside joints; hands and feet have no wrist and no ankle in the paper's model. The paper also has strips along
meridians. They are left out: their contour points form no pairs, and only a limb seen from its end needs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body import joints
from tk.model.body.superellipsoid import Superellipsoid
from tk.model.body.superellipsoid_body import SuperellipsoidBody

Float = NDArray[np.float64]
Ints = NDArray[np.int32]

# segments with contour points
LIMBS = tuple(segment for limb in joints.LIMBS for segment in joints.CHAINS[limb][:2])
# Strips on each piece, and steps along each: with 32, eq. 5 is within 0.5 mm of the rim on a limb. More cost time only.
CIRCLES, STEPS = 20, 32


@dataclass(frozen=True)
class Strips:
    """S strips of N samples, :data:`CIRCLES` on each of some pieces."""

    angles: Float  # (S, N, 2) η and ω, radians. The last sample of a strip is its first.
    normals: Float  # (S, N, 3) n_d of eq. 2 in the piece's frame, 1/m; not of unit length
    piece: Ints  # (S,) index of each strip's piece


def limb_pieces(body: SuperellipsoidBody) -> list[int]:
    """Return the tapered piece of each of the :data:`LIMBS`: its segment's longest."""

    def length(i: int, segment: str) -> float:
        piece = body.pieces[i]
        return piece.z_upper - piece.z_lower if piece.segment == segment else 0.0

    return [max(range(len(body.pieces)), key=lambda i: length(i, segment)) for segment in LIMBS]


def build_strips(body: SuperellipsoidBody, pieces: Sequence[int]) -> Strips:
    """Build the strips of some of a body's pieces, piece by piece."""
    omega = np.linspace(-np.pi, np.pi, STEPS + 1)
    angles = [np.stack(np.broadcast_arrays(_circle_heights(body.pieces[i])[:, None], omega), axis=-1) for i in pieces]
    normals = [body.pieces[i].normal_direction(*np.moveaxis(a, -1, 0)) for i, a in zip(pieces, angles, strict=True)]
    return Strips(np.concatenate(angles), np.concatenate(normals), np.repeat(np.array(pieces, np.int32), CIRCLES))


def _circle_heights(piece: Superellipsoid) -> Float:
    """Return η (CIRCLES,) in the middle of equal lengths of the wider meridian."""
    eta = np.linspace(*piece.eta_range, 513)
    a1, a2, _ = piece.radii
    meridian = piece.point(eta, np.full_like(eta, 0.0 if a1 >= a2 else np.pi / 2))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(meridian, axis=0), axis=1))])
    return np.interp((np.arange(CIRCLES) + 0.5) / CIRCLES * length[-1], length, eta)
