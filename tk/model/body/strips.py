"""Strips of surface points along the circles of latitude and the meridians of a body's pieces (Kehl 2006, 5.2, fig. 6).

Computed once for a body. Strips are equal distances apart on the surface. Along a strip the samples are at equal steps
of the angle: there the paper's interpolation (eq. 5) works, and flat sides, where the normal hardly turns, need few.

Contour points lie on the limbs only (6.1.2): on the tapered pieces of upper arms, forearms, thighs and calves. Their
caps lie inside joints; hands and feet have no wrist and no ankle in the paper's model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.kernels.contour import ContourKernel
from tk.kernels.projection import pack_cameras
from tk.model.body import joints
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.superellipsoid import Superellipsoid
from tk.model.body.superellipsoid_body import SuperellipsoidBody
from tk.model.cameras.camera import Rig

Float = NDArray[np.float64]
Ints = NDArray[np.int32]

# segments with contour points
LIMBS = tuple(segment for limb in joints.LIMBS for segment in joints.CHAINS[limb][:2])


@dataclass(frozen=True)
class Strips:
    """Strips of N samples on every piece, S in all: first a piece's circles of latitude, then its meridians.

    Attributes:
        circles, meridians: number of strips of each kind on each piece.
        angles: (S, N, 2) η and ω, radians. The last sample of a circle is its first.
        normals: (S, N, 3) n_d of eq. 2 in the piece's frame, 1/m; not of unit length.
        piece: (S,) index of each strip's piece.
        segment: (S,) index of its body segment.
        paired: (S,) True for circles of latitude: their two contour points are symmetric about the limb's axis.
        limb_piece: (L,) the tapered piece of each of the :data:`LIMBS`.
    """

    circles: int
    meridians: int
    angles: Float
    normals: Float
    piece: Ints
    segment: Ints
    paired: NDArray[np.bool_]
    limb_piece: Ints

    def even(self, pairs: int = 5, singles: int = 0) -> Ints:
        """Return (K,) strips on the limbs, evenly spread, the same at every call: K = L (pairs + singles).

        Args:
            pairs: circles of latitude on each limb. The paper takes 10 contour points a limb and view: 5 pairs.
            singles: meridians on each limb; only a limb seen from its end has contour points on them.
        """
        self._check(pairs, singles)
        circle = ((np.arange(pairs) + 0.5) * self.circles / max(pairs, 1)).astype(np.int32)
        meridian = self.circles + ((np.arange(singles) + 0.5) * self.meridians / max(singles, 1)).astype(np.int32)
        return self._on_limbs(np.tile(np.concatenate([circle, meridian]), (1, len(self.limb_piece), 1)))[0]

    def draw(self, rng: np.random.Generator, batch: int = 1, pairs: int = 5, singles: int = 0) -> Ints:
        """Draw (batch, K) strips on the limbs for each pose without repetition; arguments as in :meth:`even`."""
        self._check(pairs, singles)
        parts = [
            first + np.sort(np.argsort(rng.random((batch, len(self.limb_piece), count)), axis=2)[..., :wanted], axis=2)
            for first, count, wanted in ((0, self.circles, pairs), (self.circles, self.meridians, singles))
        ]
        return self._on_limbs(np.concatenate(parts, axis=2))

    def _on_limbs(self, within: NDArray[np.integer]) -> Ints:
        """(B, L · n) strips from their indices (B, L, n) within each limb's piece."""
        first = self.limb_piece[:, None] * (self.circles + self.meridians)
        return (first + within).reshape(len(within), -1).astype(np.int32)

    def _check(self, pairs: int, singles: int) -> None:
        for name, wanted, count in (("pairs", pairs, self.circles), ("single points", singles, self.meridians)):
            if not 0 <= wanted <= count:
                raise ConfigError(f"{wanted} contour {name} a limb: choose 0 to {count}, or build more strips")


def build_strips(body: SuperellipsoidBody, circles: int = 20, meridians: int = 16, samples: int = 32) -> Strips:
    """Build the strips of a body.

    Args:
        body: only its pieces are used.
        circles, meridians: strips of each kind on each piece.
        samples: steps along each strip; with 32, eq. 5 is within 0.5 mm of the rim on a limb's circles.
    """
    if min(circles, meridians) < 1 or samples < 8:
        raise ConfigError(f"strips: {circles} circles and {meridians} meridians must be at least 1, {samples} steps 8")
    angles, normals = [], []
    for piece in body.pieces:
        heights, turns = _circle_heights(piece, circles), _meridian_turns(piece, meridians)
        around = np.linspace(-np.pi, np.pi, samples + 1)
        along = np.linspace(*piece.eta_range, samples + 1)
        eta = np.concatenate([np.repeat(heights[:, None], samples + 1, 1), np.tile(along, (meridians, 1))])
        omega = np.concatenate([np.tile(around, (circles, 1)), np.repeat(turns[:, None], samples + 1, 1)])
        angles.append(np.stack([eta, omega], -1))
        normals.append(piece.normal_direction(eta, omega))
    per_piece = circles + meridians
    segment = np.array([SEGMENTS.index(p.segment) for p in body.pieces], np.int32)
    return Strips(
        circles=circles,
        meridians=meridians,
        angles=np.concatenate(angles),
        normals=np.concatenate(normals),
        piece=np.repeat(np.arange(len(body.pieces), dtype=np.int32), per_piece),
        segment=np.repeat(segment, per_piece),
        paired=np.tile(np.arange(per_piece) < circles, len(body.pieces)),
        limb_piece=np.array([_longest_piece(body, limb) for limb in LIMBS], np.int32),
    )


def contour_kernel(body: SuperellipsoidBody, strips: Strips, rig: Rig, dtype: type = np.float32) -> ContourKernel:
    """Return the kernel that finds a body's contour points in cameras."""
    return ContourKernel(
        body.arrays,
        strip_angles=strips.angles,
        strip_normals=strips.normals,
        strip_piece=strips.piece,
        strip_segment=strips.segment,
        strip_paired=strips.paired,
        cameras=pack_cameras(rig),
        dtype=dtype,
    )


def _circle_heights(piece: Superellipsoid, count: int) -> Float:
    """(count,) η in the middle of equal lengths of the wider meridian."""
    eta = np.linspace(*piece.eta_range, 513)
    a1, a2, _ = piece.radii
    return _equal_lengths(eta, piece.point(eta, np.full_like(eta, 0.0 if a1 >= a2 else np.pi / 2)), count)


def _meridian_turns(piece: Superellipsoid, count: int) -> Float:
    """(count,) ω in the middle of equal lengths of the equator."""
    omega = np.linspace(-np.pi, np.pi, 1025)
    return _equal_lengths(omega, piece.point(np.zeros_like(omega), omega), count)


def _equal_lengths(parameter: Float, curve: Float, count: int) -> Float:
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    return np.interp((np.arange(count) + 0.5) / count * steps[-1], steps, parameter)


def _longest_piece(body: SuperellipsoidBody, segment: str) -> int:
    lengths = [p.z_upper - p.z_lower if p.segment == segment else 0.0 for p in body.pieces]
    return int(np.argmax(lengths))
