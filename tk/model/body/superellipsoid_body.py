"""The superellipsoid body and its sampled surface (Kehl 2006, section 5).

The paper shows its model in figure 5 and prints no sizes. Here every part of a
:class:`~tk.model.body.cone_body.ConeBody` becomes a superellipsoid with the same ends, so one body fit serves both
surface models.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cones import CONE
from tk.kernels.pieces import PieceArrays, pack_pieces
from tk.model.body.cone_body import ConeBody, ConePart, group_of
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.skeleton import SEGMENTS, Skeleton, build_skeleton
from tk.model.body.superellipsoid import Superellipsoid

Float = NDArray[np.float64]

# ε₁ and ε₂ by group of parts, (1, 1) for the others: trunks are flatter than ellipses; hands and feet, at the end of a
# limb, are closed boxes with round edges. Estimates: the paper gives no numbers.
_TRUNK = dict.fromkeys(("abdomen", "belly", "chest", "shoulders"), (1.0, 0.8))
EXPONENTS: dict[str, tuple[float, float]] = {**_TRUNK, "hand_": (0.6, 1.0), "foot_": (0.6, 0.9)}
# Length of the ellipsoid from which a tapered piece is cut, as a factor of the piece's: its sides are then nearly
# straight, as a cone's.
SLENDER = 4.0
# Distance between neighbouring surface samples, metres: less than a voxel of the hull (37 mm at 64 along 2.4 m).
SPACING_M = 0.03


@dataclass(frozen=True)
class SuperellipsoidBody:
    """One person's surface: pieces and samples (N points) on a skeleton, all fixed during tracking."""

    skeleton: Skeleton  # the kinematic tree
    pieces: tuple[Superellipsoid, ...]  # of the surface
    points: Float  # (N, 3) surface samples in the zero configuration, world frame, metres
    segment: NDArray[np.int32]  # (N,) index of each sample's segment
    piece: NDArray[np.int32]  # (N,) index of each sample's piece
    patch: NDArray[np.int32]  # (N,) index of each sample's colour patch
    patch_names: tuple[str, ...]  # (P,) of the colour patches

    @cached_property
    def arrays(self) -> PieceArrays:
        """The body for the kernels."""
        skeleton = self.skeleton
        pieces = pack_pieces(
            frame=skeleton.in_world(np.array([p.T_body_piece for p in self.pieces]))[:, :3],
            shape=np.array([[*p.radii, p.e1, p.e2, p.z_lower, p.z_upper] for p in self.pieces]),
            dof=skeleton.segment_dof[[SEGMENTS.index(p.segment) for p in self.pieces]],
        )
        return PieceArrays(skeleton.tree, pieces)

    def place(self, pose: Float) -> Float:
        """Return surface samples (N, 3) at a pose, world frame, metres. Float64 reference for the kernels."""
        T = self.skeleton.segment_transforms(pose)[self.segment]
        return np.asarray(np.einsum("nab,nb->na", T[:, :3, :3], self.points) + T[:, :3, 3])


def build_superellipsoid_body(body: ConeBody, up: str = "z", spacing_m: float = SPACING_M) -> SuperellipsoidBody:
    """Build the superellipsoid body of a cone body, with the paper's 24 degrees of freedom: no waist, no ankles.

    Args:
        body: its dimensions and parts.
        up: the world axis that points up.
        spacing_m: distance between neighbouring surface samples.
    """
    skeleton = build_skeleton(body.dimensions, up, paper=True)
    pieces = tuple(piece_of(part) for part in body.parts if part.has_contours)  # others are inside, or nearly
    points, normals = [], []
    for piece in pieces:
        eta, omega = piece.samples(spacing_m)
        T = piece.T_body_piece
        points.append(piece.point(eta, omega) @ T[:3, :3].T + T[:3, 3])
        normals.append(piece.normal(eta, omega) @ T[:3, :3].T)
    p_zero, n_zero = np.concatenate(points), np.concatenate(normals)
    owner = np.repeat(np.arange(len(pieces), dtype=np.int32), [len(p) for p in points])
    segment = np.array([SEGMENTS.index(p.segment) for p in pieces], dtype=np.int32)[owner]
    B = skeleton.T_world_body
    keep = ~_buried(skeleton, pieces, p_zero @ B.T, segment, owner)
    # no samples at the crotch: the hull is too low there, because silhouettes cannot carve between the thighs
    keep &= ~((segment == SEGMENTS.index("pelvis")) & (n_zero[:, 2] < -0.3))
    patch, patch_names = _patches(p_zero, n_zero, segment)
    used, patch_of = np.unique(patch[keep], return_inverse=True)
    return SuperellipsoidBody(
        skeleton=skeleton,
        pieces=pieces,
        points=(p_zero @ B.T)[keep],
        segment=segment[keep],
        piece=owner[keep],
        patch=patch_of.astype(np.int32),
        patch_names=tuple(patch_names[i] for i in used),
    )


def piece_of(part: ConePart) -> Superellipsoid:
    """Return the superellipsoid of a part: an ellipsoid is one; a frustum's has the same two ends, cut there or, at the
    end of a limb, closed."""
    e1, e2 = EXPONENTS.get(group_of(part.name), (1.0, 1.0))
    a, b, h, m = part.shape
    if part.kind != CONE:
        return Superellipsoid(part.segment, part.T_body_part, (a, b, h), e1, e2, -h, h)
    T = part.T_body_part.copy()
    mean = 0.5 * (1 + m)
    if e1 != 1.0:
        T[:3, 3] += 0.5 * h * T[:3, 2]
        radii = (a * mean, b * mean, 0.5 * h)
        return Superellipsoid(part.segment, T, radii, e1, e2, -0.5 * h, 0.5 * h)
    # r(z) = R √(1 − (u + w z/h)²) with r(0) = 1 and r(h) = m
    w, q = 1 / SLENDER, 1 - m**2
    u = (q - w**2) / (w + np.sqrt(w**2 + q**2 - q * w**2))
    R, begin = 1 / np.sqrt(1 - u**2), u * SLENDER * h
    T[:3, 3] -= begin * T[:3, 2]
    radii = (a * R, b * R, SLENDER * h)
    return Superellipsoid(part.segment, T, radii, e1, e2, begin, begin + h)


def _buried(
    skeleton: Skeleton,
    pieces: tuple[Superellipsoid, ...],
    points: Float,
    segment: NDArray[np.int32],
    piece: NDArray[np.int32],
) -> NDArray[np.bool_]:
    """Return (N,) True for samples inside another piece in the Da Vinci pose: armpits, crotch, inside of joints."""
    T = skeleton.segment_transforms(neutral_pose(skeleton))
    p_world = np.einsum("nab,nb->na", T[segment][:, :3, :3], points) + T[segment][:, :3, 3]
    buried = np.zeros(len(points), dtype=bool)
    for index, other in enumerate(pieces):
        T_piece_world = np.linalg.inv(T[SEGMENTS.index(other.segment)] @ skeleton.in_world(other.T_body_piece))
        p_piece = p_world @ T_piece_world[:3, :3].T + T_piece_world[:3, 3]
        buried |= other.contains(p_piece) & (piece != index)
    return buried


def _patches(points: Float, normals: Float, segment: NDArray[np.int32]) -> tuple[NDArray[np.int32], list[str]]:
    """Return each sample's colour patch (N,) and the patches' names.

    A segment is cut along its length, the trunk and the head also into front and back.
    """
    names: list[str] = []
    patch = np.zeros(len(points), dtype=np.int32)
    for s, name in enumerate(SEGMENTS):
        here = segment == s
        if not here.any():
            continue
        axis = np.array([1.0, np.sign(points[here][0, 1]), 0.0]) if "arm" in name else np.array([0.0, 0.0, 1.0])
        along = points[here] @ axis
        low, high = along.min(), along.max()
        rows = {"torso": 2, "pelvis": 2, "head": 2, "foot_l": 1, "foot_r": 1}.get(name, 3)
        level = np.clip(((along - low) / (high - low + 1e-9) * rows).astype(int), 0, rows - 1)
        sides = 2 if name in ("torso", "pelvis", "head") else 1
        face = (normals[here][:, 0] < 0).astype(int) if sides == 2 else np.zeros(here.sum(), dtype=int)
        patch[here] = len(names) + level * sides + face
        suffixes = ("_front", "_back") if sides == 2 else ("",)
        names += [f"{name}_{row}{suffix}" for row in range(rows) for suffix in suffixes]
    return patch, names
