"""The body of superellipsoids on the skeleton, and its sampled surface (Kehl 2006, section 5).

The paper shows its model in figure 5 and prints no sizes; :func:`build_pieces` lays the pieces out from
:class:`~tk.model.anthropometry.BodyDimensions`. Hands and feet have no joints of their own (section 5.1), but they are
in the pictures, so a stump of a hand and a foot ride on the forearm and the calf; ``extremities=False`` leaves them
out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.anthropometry import (
    ANKLE_BACK,
    ANKLE_OUTWARD,
    CHEST_FORWARD,
    CROTCH_DROP,
    HAIR,
    HIP_HALF_WIDTH,
    PELVIS_FORWARD,
    SKULL_FORWARD,
    BodyDimensions,
)
from tk.model.skeleton import SEGMENTS, Skeleton, build_skeleton
from tk.model.superellipsoid import Superellipsoid

Float = NDArray[np.float64]


@dataclass(frozen=True)
class BodyConfig:
    """Settings of the body.

    Attributes:
        waist: whether the pelvis turns against the trunk, by three angles beyond the paper's 24 degrees of freedom. A
            dancer's hips stay level while the trunk leans; a rigid trunk takes them along.
    """

    waist: bool = True


@dataclass(frozen=True)
class Body:
    """One person's body: skeleton, pieces and surface samples (N points), all fixed during tracking.

    Attributes:
        dimensions: lengths and radii, metres.
        skeleton: the kinematic tree.
        pieces: the superellipsoids.
        points: (N, 3) surface samples in the zero configuration, world frame, metres.
        normals: (N, 3) their outward unit normals.
        segment: (N,) index of each sample's segment.
        piece: (N,) index of each sample's piece.
        diameter: (N,) the limb diameter σ at each sample, metres (eq. 10).
        patch: (N,) index of each sample's colour patch.
        patch_names: (P,) what the patches are.
    """

    dimensions: BodyDimensions
    skeleton: Skeleton
    pieces: tuple[Superellipsoid, ...]
    points: Float
    normals: Float
    segment: NDArray[np.int32]
    piece: NDArray[np.int32]
    diameter: Float
    patch: NDArray[np.int32]
    patch_names: tuple[str, ...]

    def place(self, pose: Float) -> tuple[Float, Float]:
        """Surface samples (N, 3) and normals (N, 3) at a pose, world frame. Float64 reference for the kernels."""
        T = self.skeleton.segment_transforms(pose)[self.segment]
        points = np.einsum("nab,nb->na", T[:, :3, :3], self.points) + T[:, :3, 3]
        return points, np.einsum("nab,nb->na", T[:, :3, :3], self.normals)


def build_body(
    dimensions: BodyDimensions, up: str = "z", spacing_m: float = 0.03, extremities: bool = True, waist: bool = False
) -> Body:
    """The body with these dimensions.

    Args:
        dimensions: lengths and radii, metres.
        up: the world axis that points up.
        spacing_m: distance between neighbouring surface samples.
        extremities: whether hands and feet are modelled (the paper leaves them out).
    """
    skeleton = build_skeleton(dimensions, up, waist)
    pieces = build_pieces(dimensions, extremities)
    points, normals, owner, eta, omega = [], [], [], [], []
    for index, piece in enumerate(pieces):
        e, w = piece.samples(spacing_m)
        T = piece.T_body_piece
        points.append(piece.point(e, w) @ T[:3, :3].T + T[:3, 3])
        normals.append(piece.normal(e, w) @ T[:3, :3].T)
        owner.append(np.full(len(e), index, dtype=np.int32))
        eta.append(e)
        omega.append(w)
    B = skeleton.T_world_body
    p_zero = np.concatenate(points)
    piece_of = np.concatenate(owner)
    segment_of = np.array([SEGMENTS.index(p.segment) for p in pieces], dtype=np.int32)[piece_of]
    keep = ~_buried(skeleton, pieces, p_zero @ B.T, segment_of, piece_of)
    # the crotch: silhouettes cannot carve between the thighs, so the hull is always too low there
    keep &= ~((segment_of == SEGMENTS.index("pelvis")) & (np.concatenate(normals)[:, 2] < -0.3))
    patch, patch_names = _patches(p_zero, np.concatenate(normals), segment_of)
    used, patch_of = np.unique(patch[keep], return_inverse=True)
    return Body(
        dimensions=dimensions,
        skeleton=skeleton,
        pieces=pieces,
        points=(p_zero @ B.T)[keep],
        normals=(np.concatenate(normals) @ B.T)[keep],
        segment=segment_of[keep],
        piece=piece_of[keep],
        diameter=np.array([p.diameter_m for p in pieces])[piece_of][keep],
        patch=patch_of.astype(np.int32),
        patch_names=tuple(patch_names[i] for i in used),
    )


def build_pieces(d: BodyDimensions, extremities: bool = True) -> tuple[Superellipsoid, ...]:
    """The superellipsoids of a body, placed in the zero configuration (body frame)."""
    x, _, z = np.eye(3)
    pieces: list[Superellipsoid] = []

    def add(
        segment: str,
        origin: Float,
        axis: Float,
        radii: tuple[float, float, float],
        e: tuple[float, float],
        cut: tuple[float, float],
        diameter: float,
        front: Float = x,
    ) -> None:
        pieces.append(Superellipsoid(segment, _frame(origin, axis, front), radii, *e, *cut, diameter))

    # The trunk: two halves that meet at the waist; the lower reaches down to the crotch, the upper to the shoulders'
    # top.
    waist = 0.42 * d.trunk
    top = d.trunk
    bottom = -CROTCH_DROP / HIP_HALF_WIDTH * d.hip_half_width
    trunk_width = d.chest_half_width + d.hips_half_width
    stature = d.stature
    for segment, axis, length, depth, width, forward in (
        ("pelvis", -z, waist - bottom, d.hips_half_depth, d.hips_half_width, PELVIS_FORWARD * stature),
        ("torso", z, top - waist, d.chest_half_depth, d.chest_half_width, CHEST_FORWARD * stature),
    ):
        origin = waist * z + forward * x
        add(segment, origin, axis, (depth, width, length), (0.45, 0.8), (0.0, length), trunk_width)

    skull = 0.46 * d.head
    add(
        "head",
        (d.trunk + d.head + HAIR * stature - skull) * z + SKULL_FORWARD * stature * x,
        z,
        (1.12 * d.head_radius, d.head_radius, skull),
        (1.0, 1.0),
        (-skull, skull),
        2 * d.head_radius,
    )
    neck = d.head - 1.5 * skull
    add(
        "head",
        (d.trunk - 0.02) * z,
        z,
        (d.neck_radius, d.neck_radius, 2 * neck),
        (0.3, 1.0),
        (0.02, neck + 0.02),
        2 * d.neck_radius,
    )

    arm = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    for side, sign in (("l", 1.0), ("r", -1.0)):
        M = np.diag([1.0, sign, 1.0])
        u = M @ arm
        shoulder = M @ np.array([0.0, d.shoulder_half_width, d.trunk - d.shoulder_drop])
        elbow = shoulder + d.upper_arm * u
        wrist = elbow + d.forearm * u
        _limb(add, f"upper_arm_{side}", shoulder, u, d.upper_arm, d.upper_arm_radius, d.elbow_radius, z)
        _cap(add, f"upper_arm_{side}", shoulder, -u, d.upper_arm_radius, z)
        _limb(add, f"forearm_{side}", elbow, u, d.forearm, d.elbow_radius, d.wrist_radius, z)
        if extremities:
            grip = 0.35 * d.hand
            add(
                f"forearm_{side}",
                wrist + grip * u,
                u,
                (0.45 * grip, 0.8 * grip, 1.15 * grip),
                (1.0, 1.0),
                (-grip, 1.15 * grip),
                2 * d.wrist_radius,
                z,
            )
        hip = M @ np.array([0.0, d.hip_half_width, 0.0])
        knee = hip - d.thigh * z
        ankle = knee - d.calf * z
        # the thigh begins below the crotch: beside the hip joint the body is no wider than the trunk
        _limb(add, f"thigh_{side}", hip, -z, d.thigh, d.thigh_radius, d.knee_radius, x, begin=0.2)
        _cap(add, f"thigh_{side}", hip, z, 0.65 * d.thigh_radius, x)
        shin = -d.calf * z + stature * (M @ np.array([-ANKLE_BACK, ANKLE_OUTWARD, 0.0]))
        _limb(add, f"calf_{side}", knee, shin / np.linalg.norm(shin), d.calf, d.knee_radius, d.ankle_radius, x)
        if extremities:
            half = 0.5 * d.foot
            add(
                f"calf_{side}",
                ankle - 0.45 * d.ankle_height * z + 0.3 * d.foot * x,
                x,
                (0.55 * d.ankle_height, 0.3 * half + 0.01, half),
                (0.6, 0.9),
                (-half, half),
                2 * d.ankle_radius,
                z,
            )
    return tuple(pieces)


def _limb(
    add: Callable[..., None],
    segment: str,
    origin: Float,
    axis: Float,
    length: float,
    r0: float,
    r1: float,
    front: Float,
    begin: float = 0.0,
) -> None:
    """A tapered limb from r0 to r1 along ``axis``, from ``begin`` of its length on, and its far cap."""
    slope = min(r1 / r0, 0.98)
    a3 = length / np.sqrt(1 - slope**2)  # the ellipsoid whose radius has fallen to r1 at the limb's end
    add(segment, origin, axis, (r0, r0, a3), (1.0, 1.0), (begin * length, length), 2 * r0, front)
    _cap(add, segment, origin + length * axis, axis, r1, front)


def _cap(add: Callable[..., None], segment: str, origin: Float, axis: Float, radius: float, front: Float) -> None:
    """Half an ellipsoid of revolution on the side of ``axis``, a little flatter than a sphere."""
    height = 0.6 * radius
    add(segment, origin, axis, (radius, radius, height), (1.0, 1.0), (0.0, height), 2 * radius, front)


def _frame(origin: Float, axis: Float, front: Float) -> Float:
    """(4, 4) frame at ``origin`` with z along ``axis`` and x along ``front`` (made perpendicular)."""
    z = axis / np.linalg.norm(axis)
    x = front - (front @ z) * z
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    # written out: the fit builds bodies by the thousand, and np.cross takes longer than all the rest
    y = (z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0])
    T[:3, 0], T[:3, 1], T[:3, 2] = x, y, z
    T[:3, 3] = origin
    return T


def neutral_pose(skeleton: Skeleton) -> Float:
    """(D,) the Da Vinci pose: upright, arms level and sideways, legs 15° apart (section 6.3)."""
    pose = np.zeros(len(skeleton.names))
    for side in ("l", "r"):
        pose[skeleton.index(f"shoulder_{side}_yaw")] = np.radians(30.0)
        pose[skeleton.index(f"shoulder_{side}_pitch")] = np.arcsin(1 / np.sqrt(3))
        pose[skeleton.index(f"hip_{side}_yaw")] = np.radians(15.0)
    return pose


def _buried(
    skeleton: Skeleton,
    pieces: tuple[Superellipsoid, ...],
    points: Float,
    segment: NDArray[np.int32],
    piece: NDArray[np.int32],
) -> NDArray[np.bool_]:
    """(N,) True for samples inside another piece in the neutral pose: armpits, the crotch, the inside of joints."""
    T = skeleton.segment_transforms(neutral_pose(skeleton))
    B = np.eye(4)
    B[:3, :3] = skeleton.T_world_body
    p_world = np.einsum("nab,nb->na", T[segment][:, :3, :3], points) + T[segment][:, :3, 3]
    buried = np.zeros(len(points), dtype=bool)
    for index, other in enumerate(pieces):
        T_piece_world = np.linalg.inv(T[SEGMENTS.index(other.segment)] @ B @ other.T_body_piece)
        p_piece = p_world @ T_piece_world[:3, :3].T + T_piece_world[:3, 3]
        buried |= other.contains(p_piece) & (piece != index)
    return buried


def _patches(points: Float, normals: Float, segment: NDArray[np.int32]) -> tuple[NDArray[np.int32], list[str]]:
    """Colour patches: each segment cut along its length, the trunk and head also into front and back."""
    names: list[str] = []
    patch = np.zeros(len(points), dtype=np.int32)
    for s, name in enumerate(SEGMENTS):
        here = segment == s
        if not here.any():  # feet are the calves'
            continue
        axis = np.array([1.0, np.sign(points[here][0, 1]), 0.0]) if "arm" in name else np.array([0.0, 0.0, 1.0])
        along = points[here] @ axis
        low, high = along.min(), along.max()
        rows = {"torso": 2, "pelvis": 2, "head": 2}.get(name, 3)
        level = np.clip(((along - low) / (high - low + 1e-9) * rows).astype(int), 0, rows - 1)
        sides = 2 if name in ("torso", "pelvis", "head") else 1
        face = (normals[here][:, 0] < 0).astype(int) if sides == 2 else np.zeros(here.sum(), dtype=int)
        patch[here] = len(names) + level * sides + face
        suffixes = ("_front", "_back") if sides == 2 else ("",)
        names += [f"{name}_{row}{suffix}" for row in range(rows) for suffix in suffixes]
    return patch, names
