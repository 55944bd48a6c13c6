"""The actor's skeleton: proportions, joint tree, limits and forward kinematics.

Every bone frame is aligned with the world in the rest pose: x forward, y to the subject's left, z up, arms hanging.
Segment lengths follow Drillis & Contini (1966) as printed in Winter, "Biomechanics and Motor Control of Human
Movement", fig. 4.1: fractions of the stature. That table gives body breadths rather than distances between joint
centres; hip and shoulder centres are therefore set a little inside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Angles = Mapping[str, Float]  # angle name -> (T,) radians

JOINTS = (
    "pelvis", "neck", "head_top", "shoulder_l", "elbow_l", "wrist_l", "shoulder_r", "elbow_r", "wrist_r",
    "hip_l", "knee_l", "ankle_l", "hip_r", "knee_r", "ankle_r",
)  # fmt: skip
"""The joints of `truth.h5`, in the order of the contract."""

SIDES = (("_l", 1.0), ("_r", -1.0))
SOLE_M = 0.012
"""Thickness of the shoes' soles."""

# Active ranges of motion, degrees: Boone & Azen (1979) and the AAOS handbook, rounded; spine and neck as sums.
# Elevation beyond 120 degrees needs the shoulder girdle, which follows the arm (see `forward`).
_SIDE_LIMITS: dict[str, tuple[float, float]] = {
    "shoulder_abd": (-30, 175),
    "shoulder_flex": (-60, 170),
    "shoulder_in": (-90, 90),
    "elbow": (0, 145),
    "pronate": (-85, 85),
    "wrist_flex": (-70, 75),
    "fingers": (0, 90),
    "hip_abd": (-25, 45),
    "hip_flex": (-25, 120),
    "hip_in": (-45, 45),
    "hip_open": (-20, 45),  # horizontal abduction, which a bent hip needs: abduction turns a thigh at 90 about itself
    "knee": (0, 155),  # 140 by its own muscles; the body's weight bends it further in kneeling
    "ankle": (-45, 20),
}
LIMITS_DEG: dict[str, tuple[float, float]] = {
    "yaw": (-360, 360),
    "pitch": (-45, 45),
    "roll": (-30, 30),
    "spine_flex": (-25, 70),
    "spine_side": (-35, 35),
    "spine_turn": (-45, 45),
    "neck_flex": (-55, 50),
    "neck_side": (-40, 40),
    "neck_turn": (-70, 70),
} | {name + side: limits for side, _ in SIDES for name, limits in _SIDE_LIMITS.items()}
"""Every angle of the actor and its limits. Flexion bends forwards (knee: backwards), abduction leads away from the
trunk."""


@dataclass(frozen=True)
class Skeleton:
    """A joint tree. ``offsets`` (J, 3) are metres from the parent's origin, in the parent's frame at rest."""

    stature_m: float
    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float

    def index(self, name: str) -> int:
        return self.names.index(name)

    def branch(self, name: str) -> Skeleton:
        """Return the tree of a bone and of those that carry it."""
        bones = [self.index(name)]
        while self.parents[bones[0]] >= 0:
            bones.insert(0, self.parents[bones[0]])
        names = tuple(self.names[j] for j in bones)
        return Skeleton(self.stature_m, names, tuple(range(-1, len(bones) - 1)), self.offsets[bones])


@dataclass(frozen=True)
class Pose:
    """Bone frames of T poses: ``rotation`` (T, J, 3, 3) bone to world, ``origin`` (T, J, 3) metres."""

    rotation: Float
    origin: Float

    def point(self, bone: int, p_bone: Float) -> Float:
        """(T, 3) where a point given in a bone's frame lies in the world."""
        return self.origin[:, bone] + self.rotation[:, bone] @ p_bone

    @staticmethod
    def join(poses: Sequence[Pose]) -> Pose:
        """Return several bodies' poses as one, bones in a row."""
        rotation = np.concatenate([pose.rotation for pose in poses], axis=1)
        return Pose(rotation, np.concatenate([pose.origin for pose in poses], axis=1))

    def __getitem__(self, item: slice | NDArray[np.integer]) -> Pose:
        return Pose(self.rotation[item], self.origin[item])


def make_skeleton(stature_m: float = 1.75) -> Skeleton:
    """The skeleton of an adult of this stature (crown above floor without shoes)."""
    h = stature_m
    tree: list[tuple[str, str, tuple[float, float, float]]] = [
        ("pelvis", "", (0, 0, 0)),
        ("lumbar", "pelvis", (-0.015, 0, 0.055)),
        ("thorax", "lumbar", (0.005, 0, 0.075)),
        ("chest", "thorax", (-0.005, 0, 0.090)),
        ("neck", "chest", (-0.010, 0, 0.105)),  # C7/T1: 0.855 h above the floor
        ("head", "neck", (0.018, 0, 0.050)),
        ("crown", "head", (0.004, 0, 0.095)),
    ]
    for side, s in SIDES:
        tree += [
            ("clavicle" + side, "chest", (0.018, s * 0.015, 0.056)),
            ("shoulder" + side, "clavicle" + side, (-0.016, s * 0.089, 0.012)),
            ("elbow" + side, "shoulder" + side, (0, 0, -0.186)),
            ("wrist" + side, "elbow" + side, (0, 0, -0.146)),
            ("knuckles" + side, "wrist" + side, (0, 0, -0.052)),
            ("fingertips" + side, "knuckles" + side, (0, 0, -0.026)),
            ("hip" + side, "pelvis", (0, s * 0.050, 0)),
            ("knee" + side, "hip" + side, (0, 0, -0.245)),
            ("ankle" + side, "knee" + side, (0, 0, -0.246)),
            ("toes" + side, "ankle" + side, (0.072, 0, -0.026)),
        ]
    names = tuple(name for name, _, _ in tree)
    parents = tuple(names.index(parent) if parent else -1 for _, parent, _ in tree)
    return Skeleton(h, names, parents, np.array([offset for _, _, offset in tree]) * h)


def rot_x(angle_rad: Float) -> Float:
    """(T, 3, 3) rotations about x by (T,) radians."""
    return _rotation(angle_rad, 1, 2)


def rot_y(angle_rad: Float) -> Float:
    """(T, 3, 3) rotations about y."""
    return _rotation(angle_rad, 2, 0)


def rot_z(angle_rad: Float) -> Float:
    """(T, 3, 3) rotations about z."""
    return _rotation(angle_rad, 0, 1)


def _rotation(angle_rad: Float, i: int, j: int) -> Float:
    matrix = np.zeros((len(angle_rad), 3, 3))
    matrix[:, 3 - i - j, 3 - i - j] = 1.0
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    matrix[:, i, i] = matrix[:, j, j] = cos
    matrix[:, i, j], matrix[:, j, i] = -sin, sin
    return matrix


def forward(skeleton: Skeleton, angles: Angles, root: Float | None = None) -> Pose:
    """Bone frames for T configurations.

    The shoulder girdle follows the upper arm, and the ankles keep the soles level within their range, so that neither
    needs angles of its own; `ankle` is an offset from level (negative points the toes).

    Args:
        skeleton: the tree, or a branch of it.
        angles: any of :data:`LIMITS_DEG`, (T,) radians each; angles left out are zero.
        root: (T, 3) position of the pelvis, metres; the origin by default.
    """
    count = len(next(iter(angles.values())))
    zero = np.zeros(count)

    def get(name: str) -> Float:
        return np.asarray(angles.get(name, zero), dtype=np.float64)

    local: dict[str, Float] = {"pelvis": rot_z(get("yaw")) @ rot_y(get("pitch")) @ rot_x(get("roll"))}
    if "chest" in skeleton.names:
        for bone, share in (("lumbar", 0.35), ("thorax", 0.35), ("chest", 0.3)):
            local[bone] = (
                rot_z(share * get("spine_turn")) @ rot_y(share * get("spine_flex")) @ rot_x(share * get("spine_side"))
            )
        for bone in ("neck", "head"):
            local[bone] = rot_z(get("neck_turn") / 2) @ rot_y(get("neck_flex") / 2) @ rot_x(get("neck_side") / 2)
    for side, s in SIDES:
        if "clavicle" + side in skeleton.names:
            abd, flex = get("shoulder_abd" + side), get("shoulder_flex" + side)
            # scapulohumeral rhythm, much simplified: the girdle rises and protracts by a fraction of the arm's angle
            rise = 0.12 * np.maximum(abd, 0) + 0.05 * np.maximum(flex, 0)
            girdle = rot_z(-s * 0.12 * flex) @ rot_x(s * rise)
            local["clavicle" + side] = girdle
            upper = rot_x(s * abd) @ rot_y(-flex) @ rot_z(-s * get("shoulder_in" + side))
            local["shoulder" + side] = np.swapaxes(girdle, 1, 2) @ upper  # angles are relative to the chest
            local["elbow" + side] = rot_y(-get("elbow" + side))
            local["wrist" + side] = rot_z(-s * get("pronate" + side)) @ rot_x(-s * get("wrist_flex" + side))
            local["knuckles" + side] = local["fingertips" + side] = rot_x(-s * get("fingers" + side))
        if "hip" + side in skeleton.names:
            local["hip" + side] = (
                rot_z(s * get("hip_open" + side))
                @ rot_x(s * get("hip_abd" + side))
                @ rot_y(-get("hip_flex" + side))
                @ rot_z(-s * get("hip_in" + side))
            )
            local["knee" + side] = rot_y(get("knee" + side))

    rotation = np.empty((count, len(skeleton.names), 3, 3))
    origin = np.empty((count, len(skeleton.names), 3))
    for j, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        if parent < 0:
            rotation[:, j] = local[name]
            origin[:, j] = 0.0 if root is None else root
            continue
        if name.startswith("ankle"):
            local[name] = _level_foot(rotation[:, parent], get(name))
            # the toes stay level where the heel lifts: they bend back by what the ankle left over
            tilt = (rotation[:, parent] @ local[name])[:, 2, 0]
            local["toes" + name[-2:]] = rot_y(-np.clip(np.arcsin(np.clip(-tilt, -1, 1)), 0.0, np.radians(40)))
        rotation[:, j] = rotation[:, parent] @ local[name] if name in local else rotation[:, parent]
        origin[:, j] = origin[:, parent] + rotation[:, parent] @ skeleton.offsets[j]
    return Pose(rotation, origin)


def _level_foot(shank: Float, offset_rad: Float) -> Float:
    """Ankle rotation Ry(-dorsiflexion) Rx(tilt) that turns the sole's normal upwards, as far as an ankle goes."""
    up = shank[:, 2, :]  # the world's z in the shank's frame
    low, high = np.radians(LIMITS_DEG["ankle_l"])
    dorsiflexion = np.clip(np.arctan2(-up[:, 0], up[:, 2]), low, high)
    tilt = np.clip(np.arcsin(np.clip(-up[:, 1], -1, 1)), -np.radians(25), np.radians(25))
    return rot_y(-np.clip(dorsiflexion + offset_rad, low, high)) @ rot_x(tilt)


def joint_positions(skeleton: Skeleton, pose: Pose) -> Float:
    """(T, 15, 3) joint centres as `truth.h5` defines them, metres, in the order of :data:`JOINTS`."""
    rename = {"head_top": "crown"}
    return np.stack([pose.origin[:, skeleton.index(rename.get(name, name))] for name in JOINTS], axis=1)


def sole_points(skeleton: Skeleton, pose: Pose) -> Float:
    """(T, 2, 3, 3) heel, ball and toe tip of the left and the right sole, world, metres."""
    return np.stack([sole_of(skeleton, pose, side) for side, _ in SIDES], axis=1)


def sole_of(skeleton: Skeleton, pose: Pose, side: str) -> Float:
    """(T, 3, 3) heel, ball and toe tip of one sole, world, metres."""
    height = -skeleton.stature_m * 0.039 - SOLE_M
    toe_z = height + 0.026 * skeleton.stature_m
    ankle, toes = skeleton.index("ankle" + side), skeleton.index("toes" + side)
    points = [
        pose.point(ankle, np.array([-0.05, 0, height])),
        pose.point(ankle, np.array([0.11, 0, height])),
        pose.point(toes, np.array([0.06, 0, toe_z])),
    ]
    return np.stack(points, axis=1)
