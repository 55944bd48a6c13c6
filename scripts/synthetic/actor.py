"""The actor's flesh and clothes: round cones on bones, blended by a smooth minimum within each material.

A round cone is the hull of two spheres. Each primitive lives in a bone frame that may be squeezed along its axes
(a flat chest, a flat palm) and may be cut by a plane (a hem, a sole). Lengths are written for a stature of 1.75 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.skeleton import SIDES, SOLE_M, Pose, Skeleton

Float = NDArray[np.float64]
Vec = tuple[float, float, float]

SKIN, HAIR, SHIRT, TROUSERS, SHOES, OBJECT = range(6)
NO_CUT = (0.0, 0.0, 1.0, -9.0)

# columns of `Actor.shape`
COL_A, COL_RA, COL_B, COL_RB, COL_SCALE, COL_CUT, COL_BLEND, COL_WRINKLE, COL_NUMBER = 0, 3, 4, 7, 8, 11, 15, 16, 17
SHAPE_COLUMNS = 18
MATERIALS = 6


@dataclass(frozen=True)
class Primitive:
    """A round cone from ``a`` (radius ``ra``) to ``b`` (``rb``), metres, in the frame of ``bone``.

    ``scale`` squeezes space before the cone is made, so ``a``, ``b`` and the radii are in squeezed units. ``cut``
    (nx, ny, nz, c), with n a unit vector, keeps the half space n·p >= c of the bone frame. ``blend`` is the
    radius of the smooth minimum, ``wrinkle`` the height of the folds.
    """

    bone: str
    material: int
    a: Vec
    ra: float
    b: Vec
    rb: float
    scale: Vec = (1.0, 1.0, 1.0)
    cut: tuple[float, float, float, float] = NO_CUT
    blend: float = 0.02
    wrinkle: float = 0.0


@dataclass(frozen=True)
class Look:
    """Linear-light RGB of each material, and the shirt's pattern (0 plain, 1 striped)."""

    skin: Vec = (0.55, 0.30, 0.20)
    hair: Vec = (0.045, 0.028, 0.018)
    shirt: Vec = (0.50, 0.045, 0.05)
    trousers: Vec = (0.050, 0.085, 0.20)
    shoes: Vec = (0.07, 0.065, 0.06)
    object: Vec = (0.05, 0.42, 0.08)
    stripes: bool = False

    def colors(self) -> Float:
        """(6, 3) in the order of the material numbers."""
        return np.array([self.skin, self.hair, self.shirt, self.trousers, self.shoes, self.object])


@dataclass(frozen=True)
class Actor:
    """Primitives as arrays, sorted by material.

    Attributes:
        bones: (N,) bone of each primitive.
        material: (N,) its material; 6 more for each actor before it, see :func:`join`.
        shape: (N, 18) float64, see the ``COL_`` constants.
        centers: (N, 3) centre of its bounding sphere in the bone frame, metres.
        radii: (N,) radius of that sphere, blending and wrinkles included, metres.
    """

    skeleton: Skeleton
    bones: NDArray[np.int64]
    material: NDArray[np.int64]
    shape: Float
    centers: Float
    radii: Float

    def spheres(self, pose: Pose) -> Float:
        """(T, N, 3) centres of the bounding spheres in the world."""
        rotation, origin = pose.rotation[:, self.bones], pose.origin[:, self.bones]
        return origin + np.einsum("tnij,nj->tni", rotation, self.centers)

    def balls(self, pose: Pose) -> tuple[Float, Float]:
        """Tight bounds: the cones' end spheres, (T, 2N, 3) centres in the world and (2N,) radii, metres."""
        scale = self.shape[:, COL_SCALE:COL_CUT]
        ends = [self.shape[:, COL_A:COL_RA] * scale, self.shape[:, COL_B:COL_RB] * scale]
        radii = np.concatenate([self.shape[:, COL_RA], self.shape[:, COL_RB]]) * np.tile(scale.max(axis=1), 2)
        # a cube's corners stick out of its inner ball
        radii = radii * np.where(np.tile(self.material, 2) == OBJECT, np.sqrt(3), 1.0)
        rotation, origin = pose.rotation[:, self.bones], pose.origin[:, self.bones]
        return np.concatenate([origin + np.einsum("tnij,nj->tni", rotation, end) for end in ends], axis=1), radii

    def capsules(self, pose: Pose) -> Float:
        """Return (N, 8) a capsule around each primitive at the first of T poses, metres, world.

        Columns: the ends (3, 3), the radius, and how far any point of the primitive moves from there in the other
        poses. Blending and wrinkles are inside.
        """
        ends, radii = self.balls(pose)
        ends = ends.reshape(len(ends), 2, -1, 3)
        radius = radii.reshape(2, -1).max(axis=0) + self.shape[:, COL_BLEND] + self.shape[:, COL_WRINKLE]
        turned = np.linalg.norm(pose.rotation - pose.rotation[0], axis=(2, 3))[:, self.bones] / np.sqrt(2)
        moved = np.linalg.norm(ends - ends[0], axis=-1).max(axis=1) + turned * radius
        return np.column_stack([ends[0, 0], ends[0, 1], radius, moved.max(axis=0)])

    def frames(self, pose: Pose) -> Float:
        """Return (T, N, 16): row by row the matrix (3, 4) from the world to each primitive's bone; bounding sphere."""
        inverse = pose.rotation[:, self.bones].swapaxes(-1, -2)
        shift = -inverse @ pose.origin[:, self.bones, :, None]
        matrix = np.concatenate([inverse, shift], axis=-1).reshape(*shift.shape[:2], 12)
        radii = np.broadcast_to(self.radii[:, None], (*shift.shape[:2], 1))
        return np.concatenate([matrix, self.spheres(pose), radii], axis=-1)


def make_actor(skeleton: Skeleton, *, cube_bone: str | None = None) -> Actor:
    """A man in T-shirt, trousers and shoes; with ``cube_bone`` he holds a cube of 20 cm in that hand."""
    primitives = _head() + _trunk()
    for side, s in SIDES:
        primitives += _arm(side, s) + _leg(side, s)
    if cube_bone is not None:
        primitives.append(_cube(cube_bone))
    primitives.sort(key=lambda p: p.material)  # stable: the render kernel folds one material at a time
    size = skeleton.stature_m / 1.75
    shape = np.zeros((len(primitives), SHAPE_COLUMNS))
    centers = np.empty((len(primitives), 3))
    radii = np.empty(len(primitives))
    for row, center, i in zip(shape, centers, range(len(primitives)), strict=True):
        p = primitives[i]
        a, b, scale = np.array(p.a) * size, np.array(p.b) * size, np.array(p.scale)
        ra, rb = p.ra * size, p.rb * size
        row[COL_A:COL_RA], row[COL_RA] = a, ra
        row[COL_B:COL_RB], row[COL_RB] = b, rb
        row[COL_SCALE:COL_CUT] = scale
        row[COL_CUT:COL_BLEND] = (*p.cut[:3], p.cut[3] * size)
        row[COL_BLEND], row[COL_WRINKLE], row[COL_NUMBER] = p.blend * size, p.wrinkle * size, i
        center[:] = (a + b) / 2 * scale
        axis_max = float(np.max(scale))
        reach = max(ra, rb) * (np.sqrt(3) if p.material == OBJECT else axis_max)
        radii[i] = np.linalg.norm((b - a) / 2 * scale) + reach + (p.blend + p.wrinkle) * size
    bones = np.array([skeleton.index(p.bone) for p in primitives])
    return Actor(skeleton, bones, np.array([p.material for p in primitives]), shape, centers, radii)


def join(actors: Sequence[Actor]) -> Actor:
    """Return several actors as one, whose poses are joined along the bones: what they touch does not blend."""
    bones = np.cumsum([0, *(len(actor.skeleton.names) for actor in actors)])
    return Actor(
        actors[0].skeleton,
        np.concatenate([actor.bones + first for actor, first in zip(actors, bones, strict=False)]),
        np.concatenate([actor.material + MATERIALS * k for k, actor in enumerate(actors)]),
        np.concatenate([actor.shape for actor in actors]),
        np.concatenate([actor.centers for actor in actors]),
        np.concatenate([actor.radii for actor in actors]),
    )


def _ball(bone: str, material: int, at: Vec, radius: float, scale: Vec = (1, 1, 1), blend: float = 0.02) -> Primitive:
    a = (at[0] / scale[0], at[1] / scale[1], at[2] / scale[2])
    return Primitive(bone, material, a, radius, (a[0], a[1], a[2] + 1e-4), radius, scale, blend=blend)


def _head() -> list[Primitive]:
    hair = _ball("head", HAIR, (-0.004, 0, 0.087), 0.092, (1.10, 0.90, 1.0))
    face_cut = (-0.80, 0.0, 0.60, -0.018)  # hair stops at the forehead and behind the ears
    return [
        Primitive("neck", SKIN, (0.0, 0, -0.03), 0.060, (0.030, 0, 0.085), 0.054, blend=0.03),
        _ball("head", SKIN, (0.008, 0, 0.079), 0.087, (1.12, 0.88, 1.0)),
        Primitive("head", SKIN, (0.040, 0, 0.055), 0.064, (0.060, 0, -0.022), 0.040, (1, 0.95, 1), blend=0.035),
        Primitive("head", SKIN, (0.103, 0, 0.050), 0.009, (0.118, 0, 0.018), 0.014, blend=0.012),
        _ball("head", SKIN, (0.004, 0.078, 0.045), 0.030, (0.8, 0.35, 1.1), blend=0.008),
        _ball("head", SKIN, (0.004, -0.078, 0.045), 0.030, (0.8, 0.35, 1.1), blend=0.008),
        replace(hair, cut=face_cut),
        Primitive("head", HAIR, (-0.035, 0, 0.06), 0.072, (-0.03, 0, 0.0), 0.050, (1, 1, 1), cut=face_cut),
    ]


def _trunk() -> list[Primitive]:
    deep, fold = (0.68, 1.0, 0.72), 0.006
    return [
        Primitive("pelvis", TROUSERS, (0, 0, 0.02), 0.160, (0, 0, 0.11), 0.150, (0.74, 1, 0.6), blend=0.03),
        _ball("pelvis", TROUSERS, (-0.050, 0.068, -0.025), 0.092, blend=0.04),
        _ball("pelvis", TROUSERS, (-0.050, -0.068, -0.025), 0.092, blend=0.04),
        # the hem hangs loosely over the belt
        Primitive(
            "pelvis",
            SHIRT,
            (-0.008, 0, -0.02),
            0.190,
            (-0.01, 0, 0.18),
            0.162,
            (0.80, 1, 1),
            (0, 0, 1, -0.055),
            0.05,
            0.004,
        ),
        Primitive("lumbar", SHIRT, (0.02, 0, 0.02), 0.158, (0.02, 0, 0.16), 0.160, deep, blend=0.06, wrinkle=fold),
        Primitive("thorax", SHIRT, (0.025, 0, 0.04), 0.163, (0.02, 0, 0.20), 0.172, deep, blend=0.06, wrinkle=0.004),
        Primitive("chest", SHIRT, (0.025, 0, 0.0), 0.168, (0.0, 0, 0.075), 0.138, deep, blend=0.05, wrinkle=0.003),
        _ball("chest", SHIRT, (0.075, 0.075, 0.0), 0.075, (0.8, 1.1, 1), blend=0.05),
        _ball("chest", SHIRT, (0.075, -0.075, 0.0), 0.075, (0.8, 1.1, 1), blend=0.05),
        Primitive("neck", SHIRT, (-0.005, 0, -0.045), 0.080, (0.0, 0, -0.012), 0.068, blend=0.03),
    ]


def _arm(side: str, s: float) -> list[Primitive]:
    shoulder, elbow, wrist = "shoulder" + side, "elbow" + side, "wrist" + side
    sleeve_end = (0.0, 0.0, 1.0, -0.175)
    parts = [
        Primitive(
            "clavicle" + side, SHIRT, (0.0, s * 0.02, -0.03), 0.066, (-0.028, s * 0.145, -0.004), 0.054, blend=0.05
        ),
        Primitive("chest", SHIRT, (-0.020, s * 0.040, 0.160), 0.048, (-0.018, s * 0.140, 0.112), 0.046, blend=0.04),
        Primitive(
            shoulder, SHIRT, (0, 0, -0.014), 0.055, (0, 0, -0.20), 0.064, (1.05, 0.95, 1), sleeve_end, 0.035, 0.005
        ),
        Primitive(shoulder, SKIN, (0, 0, -0.06), 0.048, (0, 0, -0.325), 0.039),
        _ball(shoulder, SKIN, (0.014, 0, -0.19), 0.042, (1, 0.95, 1.5)),
        Primitive(elbow, SKIN, (0, 0, 0), 0.039, (0, 0, -0.255), 0.027, (1.08, 0.92, 1)),
        _ball(elbow, SKIN, (0.006, 0, -0.075), 0.043, (1, 0.95, 1.6)),
        # the palm: flat across y, the thumb in front
        Primitive(wrist, SKIN, (0.0, 0, -0.025), 0.033, (0.002, 0, -0.072), 0.040, (1, 0.42, 1), blend=0.015),
        Primitive(wrist, SKIN, (0.028, -s * 0.006, -0.03), 0.015, (0.052, -s * 0.020, -0.075), 0.011, blend=0.012),
        Primitive(wrist, SKIN, (0.052, -s * 0.020, -0.075), 0.011, (0.055, -s * 0.022, -0.100), 0.009, blend=0.006),
    ]
    for x, length in ((0.030, 0.040), (0.010, 0.045), (-0.010, 0.042), (-0.028, 0.034)):
        knuckles, tips = "knuckles" + side, "fingertips" + side
        parts.append(Primitive(knuckles, SKIN, (x, 0, 0.0), 0.0105, (x, 0, -0.0455), 0.009, blend=0.005))
        parts.append(Primitive(tips, SKIN, (x, 0, 0.0), 0.009, (x, 0, -length + 0.008), 0.0075, blend=0.005))
    return parts


def _leg(side: str, s: float) -> list[Primitive]:
    hip, knee, ankle, toes = "hip" + side, "knee" + side, "ankle" + side, "toes" + side
    sole = -1.75 * 0.039 - SOLE_M
    trouser_end = (0.0, 0.0, 1.0, -0.432)
    foot_cut, toe_cut = (0.0, 0.0, 1.0, sole), (0.0, 0.0, 1.0, sole + 0.026 * 1.75)
    wide = (1.0, 1.1, 1.0)
    return [
        Primitive(hip, TROUSERS, (0, s * 0.004, -0.03), 0.092, (0, 0, -0.42), 0.064, blend=0.045, wrinkle=0.004),
        Primitive(hip, TROUSERS, (0.022, 0, -0.12), 0.076, (0.008, 0, -0.30), 0.064, blend=0.04),
        Primitive(
            knee, TROUSERS, (0.002, 0, 0.0), 0.063, (-0.012, 0, -0.46), 0.062, (1, 1, 1), trouser_end, 0.04, 0.006
        ),
        _ball(knee, TROUSERS, (-0.022, 0, -0.13), 0.058, (1, 1, 1.5), blend=0.03),
        Primitive(ankle, SHOES, (-0.008, 0, 0.06), 0.036, (-0.008, 0, -0.03), 0.036),  # the sock
        Primitive(ankle, SHOES, (-0.030, 0, -0.035), 0.042, (0.05, 0, -0.040), 0.041, wide, foot_cut, 0.03),
        Primitive(ankle, SHOES, (0.04, 0, -0.035), 0.042, (0.12, s * 0.004, -0.055), 0.040, wide, foot_cut, 0.03),
        Primitive(
            toes, SHOES, (-0.005, s * 0.004, -0.010), 0.040, (0.045, -s * 0.004, -0.014), 0.031, wide, toe_cut, 0.03
        ),
        _ball(ankle, SHOES, (-0.02, 0, 0.0), 0.046, blend=0.03),
    ]


def _cube(bone: str) -> Primitive:
    """Rounded cube of 20 cm on the palm; the render kernel draws material OBJECT as a box of half side ``ra``."""
    s = 1.0 if bone.endswith("_l") else -1.0
    centre = (0.0, -s * 0.115, -0.08)
    return Primitive(bone, OBJECT, centre, 0.100, centre, 0.100, blend=0.0)
