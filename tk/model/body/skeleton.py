"""The skeleton: a tree of exponential twists with 24 degrees of freedom (Kehl 2006, section 5.1, figure 5a), and three
more for the waist if wanted.

A pose is a configuration vector p. The transform after degree of freedom k is

    T_k = T_parent(k) · exp(ξ_k p_k)

with the twist ξ_k given by an axis and a point on it in the *zero configuration* (silhouette paper, eqs. 2-5).
∂x/∂p_k of a point x below k is then ω_k × (x − q_k), axis and point carried along by T_parent(k) (eqs. 6-8).

Zero configuration, in the body frame (x forward, y to the left, z up; origin midway between the hip centres): legs hang
straight, both arms point horizontally forward and outward at 45°. Ball joints are three successive rotations whose
middle angle must stay within ±90°. The paper does not give its axes. Here they are chosen so that the singular
directions are hardly ever taken: a leg straight to the side, the trunk lying on its side, and, for an arm, the diagonal
back-out-up / forward-in-down, which is at least 54° away from hanging, raised, forward, backward and sideways.

Beyond the paper: a waist, three rotations between trunk and pelvis about the lumbar spine. A dancer's hips stay level
while the trunk leans; the paper's torso takes them along.
:func:`paper_poses` gives a pose in the paper's 24 degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.kernels.kinematics import ARM_UP
from tk.model.body.anthropometry import FRACTIONS, RAISED_SHOULDERS, BodyDimensions
from tk.model.cameras.up import up_vector

Float = NDArray[np.float64]

JOINTS = (
    "pelvis",
    "neck",
    "head_top",
    "shoulder_l",
    "elbow_l",
    "wrist_l",
    "shoulder_r",
    "elbow_r",
    "wrist_r",
    "hip_l",
    "knee_l",
    "ankle_l",
    "hip_r",
    "knee_r",
    "ankle_r",
)

SEGMENTS = (
    "torso",
    "head",
    "upper_arm_l",
    "forearm_l",
    "upper_arm_r",
    "forearm_r",
    "thigh_l",
    "calf_l",
    "thigh_r",
    "calf_r",
    "pelvis",
    "foot_l",
    "foot_r",
)

# The five chains that are refined one by one with the torso held (section 6.4): the segments of each.
CHAINS: dict[str, tuple[str, ...]] = {
    "head": ("head",),
    "arm_l": ("upper_arm_l", "forearm_l"),
    "arm_r": ("upper_arm_r", "forearm_r"),
    "leg_l": ("thigh_l", "calf_l", "foot_l"),
    "leg_r": ("thigh_r", "calf_r", "foot_r"),
}

# Zero configuration of the left arm (see the module's docstring).
_ARM = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
_ARM_POLE = np.array([-1.0, 1.0, 1.0]) / np.sqrt(3)
_ARM_RISE = np.cross(_ARM, _ARM_POLE)
# An elbow at zero twist bends inward and up: forward when the arm hangs, inward when it is raised.
_ELBOW = np.cross(_ARM, [0.5, -0.5, np.sqrt(0.5)])

# Ranges in degrees. Active ranges of healthy men with three standard deviations, Boone & Azen, J. Bone Joint Surg. Am.
# 61 (1979) 756-759, widened by 10° because a single hinge or ball stands for a whole joint complex (the shoulder
# girdle, the lumbar spine): hip flexion 122±6, extension 10±7, abduction 46±9, adduction 27±4, rotation 47±6; knee
# 143±5; elbow 143±6. The shoulder's ranges (flexion 167±5, extension 62±10, abduction 184±7, rotation 69/104) are given
# about other axes than ours: the box below holds them, and every direction of the arm but a cone of 10° about the
# singular diagonal (tests/model/test_skeleton.py samples them). Neck: Youdas et al., Phys. Ther. 72 (1992) 770-780:
# flexion and extension 60-70 together with the upper spine, lateral bending 40-45. Waist: what textbooks give for the
# lumbar spine (flexion 50, extension 15, bending 20-25, rotation 5-10), more for what the chest above it turns. Ankle:
# Boone & Azen, plantar flexion 56±6, dorsiflexion 13±4 (more when the knee is bent and loaded), inversion 37±5,
# eversion 21±5.
_LIMITS_DEG: dict[str, tuple[float, float]] = {
    "torso_yaw": (-np.inf, np.inf),
    "torso_roll": (-80.0, 80.0),
    "torso_pitch": (-np.inf, np.inf),
    "waist_pitch": (-25.0, 50.0),
    "waist_roll": (-30.0, 30.0),
    "waist_yaw": (-35.0, 35.0),
    "neck_pitch": (-70.0, 65.0),
    "neck_yaw": (-50.0, 50.0),
    "shoulder_yaw": (-180.0, 180.0),
    "shoulder_pitch": (-80.0, 80.0),
    "shoulder_roll": (-110.0, 110.0),
    "elbow_flexion": (-5.0, 155.0),
    "hip_pitch": (-150.0, 40.0),
    "hip_yaw": (-45.0, 80.0),
    "hip_roll": (-70.0, 70.0),
    "knee_flexion": (-10.0, 160.0),
    "ankle_flexion": (-60.0, 40.0),
    "ankle_inversion": (-30.0, 40.0),
}

WAIST = ("waist_roll", "waist_pitch", "waist_yaw")
# How stiff each is beside the first: nothing outlines the pelvis from the front, and a hip can turn as well as it.
WAIST_STIFFNESS = (1.0, 3.0, 5.0)
ANKLES = ("ankle_l_flexion", "ankle_l_inversion", "ankle_r_flexion", "ankle_r_inversion")
# Where the waist bends, as a share of the trunk's length above the hip centres: about L4, in the middle of what bends.
WAIST_HEIGHT = 0.25
# Single poses whose transforms are kept.
REMEMBERED = 8


@dataclass(frozen=True)
class Skeleton:
    """The kinematic tree as plain arrays: D = 24 degrees of freedom, S = 13 segments, J = 15 joints.

    A waist has three more degrees of freedom, ankles have two each; without them pelvis and feet are carried by torso
    and calves.

    Attributes:
        names: (D,) names of the degrees of freedom; translations first.
        units: (D,) "m" or "rad".
        axis: (D, 3) unit axes in the zero configuration, world frame.
        point: (D, 3) a point on each axis, metres; unused for translations.
        rise: (D, 3) how far a level arm that is raised upright lifts its shoulder, metres, in the first degree of
            freedom of each shoulder; zero elsewhere. See :attr:`anchor`.
        prismatic: (D,) True for translations.
        parent: (D,) index of the degree of freedom before, -1 at the root.
        lower, upper: (D,) limits, radians; infinite where there is none.
        segment_dof: (S,) the last degree of freedom above each segment.
        joint_segment: (J,) the segment that carries each joint.
        joint_position: (J, 3) joint centres in the zero configuration, metres.
        T_world_body: (3, 3) rotation of the body frame in the zero configuration (identity when z is up).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    axis: Float
    point: Float
    rise: Float
    prismatic: NDArray[np.bool_]
    parent: NDArray[np.int32]
    lower: Float
    upper: Float
    segment_dof: NDArray[np.int32]
    joint_segment: NDArray[np.int32]
    joint_position: Float
    T_world_body: Float

    @cached_property
    def is_waist(self) -> NDArray[np.bool_]:
        """(D,) True for the waist's degrees of freedom, where there are any."""
        return np.isin(self.names, WAIST)

    @cached_property
    def is_ankle(self) -> NDArray[np.bool_]:
        """(D,) True for the ankles' degrees of freedom, where there are any."""
        return np.isin(self.names, ANKLES)

    @cached_property
    def is_paper(self) -> NDArray[np.bool_]:
        """(D,) True for the paper's 24."""
        return ~(self.is_waist | self.is_ankle)

    def index(self, name: str) -> int:
        """The position of a degree of freedom in p."""
        return self.names.index(name)

    def clip(self, poses: Float) -> Float:
        """Poses (..., D) mapped into the limits (eq. 22)."""
        return np.clip(poses, self.lower, self.upper)

    @cached_property
    def _generators(self) -> tuple[Float, Float]:
        """(D, 3, 3) the skew matrices of the axes, zero for translations, and their squares."""
        K = np.zeros((len(self.names), 3, 3))
        for k, (x, y, z) in enumerate(self.axis):
            if not self.prismatic[k]:
                K[k] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        return K, K @ K

    @cached_property
    def _levels(self) -> tuple[NDArray[np.int64], ...]:
        """Degrees of freedom by their depth in the tree, the root's first."""
        depth = np.zeros(len(self.names), int)
        for k, parent in enumerate(self.parent):
            depth[k] = depth[parent] + 1 if parent >= 0 else 0
        return tuple(np.flatnonzero(depth == d) for d in range(depth.max() + 1))

    @cached_property
    def _raised(self) -> NDArray[np.int64]:
        """The degrees of freedom that lift a shoulder: with the one behind it each turns the arm up."""
        return np.flatnonzero(self.rise.any(axis=1))

    def transforms(self, pose: Float) -> Float:
        """(..., D, 4, 4) transforms T_k after each degree of freedom of poses (..., D), float64. Kernels have their
        own."""
        pose = np.asarray(pose, dtype=np.float64)
        if pose.ndim > 1:
            return self._transforms(pose)
        # joints, twists and directions of one pose are asked for in turn, and the joints once more in the next frame
        key = pose.tobytes()
        placed = self._placed.get(key)
        if placed is None:
            placed = self._transforms(pose)
            placed.flags.writeable = False
            if len(self._placed) >= REMEMBERED:
                self._placed.pop(next(iter(self._placed)), None)
            self._placed[key] = placed
        return placed

    @cached_property
    def _placed(self) -> dict[bytes, Float]:
        return {}

    def _transforms(self, pose: Float) -> Float:
        K, squares = self._generators
        steps = np.zeros((*pose.shape, 4, 4))
        R = np.eye(3) + np.sin(pose)[..., None, None] * K + (1 - np.cos(pose))[..., None, None] * squares
        steps[..., :3, :3] = R
        steps[..., :3, 3] = np.where(
            self.prismatic[:, None], self.axis * pose[..., None], self.point - (R @ self.point[:, :, None])[..., 0]
        )
        for k in self._raised:
            steps[..., k, :3, 3] += self.rise[k] * arm_elevation(pose[..., k], pose[..., k + 1])[..., None]
        steps[..., 3, 3] = 1.0
        result = steps
        for level in self._levels[1:]:
            result[..., level, :, :] = result[..., self.parent[level], :, :] @ steps[..., level, :, :]
        return result

    @property
    def anchor(self) -> Float:
        """(D, 6) point and rise, as the kernels take them (:func:`tk.kernels.kinematics.forward`)."""
        return np.concatenate([self.point, self.rise], axis=1)

    def twists(self, pose: Float) -> tuple[Float, Float]:
        """World twists (ω, v), each (..., D, 3), at poses (..., D): a point x below degree of freedom k moves at
        ω_k × x + v_k (eqs. 6-8)."""
        T = self.transforms(pose)
        above = np.where((self.parent >= 0)[:, None, None], T[..., self.parent, :, :], np.eye(4))
        axis = (above[..., :3, :3] @ self.axis[:, :, None])[..., 0]
        # the joint's place, its rise included, does not move when it turns
        q = (T[..., :3, :3] @ self.point[:, :, None])[..., 0] + T[..., :3, 3]
        v = np.where(self.prismatic[:, None], axis, np.cross(q, axis))
        for k in self._raised:
            lift = above[..., k, :3, :3] @ self.rise[k]
            for by in (0, 1):
                v[..., k + by, :] += lift * arm_elevation(pose[..., k], pose[..., k + 1], by=by)[..., None]
        return np.where(self.prismatic[:, None], 0.0, axis), v

    def rotation(self, dofs: Iterable[int], poses: Float) -> Float:
        """(..., 3, 3) the product of successive rotations about these axes of the zero configuration."""
        K, squares = self._generators
        R = np.eye(3)
        for k in dofs:
            angle = poses[..., k, None, None]
            R = R @ (np.eye(3) + np.sin(angle) * K[k] + (1 - np.cos(angle)) * squares[k])
        return R

    def segment_transforms(self, pose: Float) -> Float:
        """(..., S, 4, 4) transforms of the segments."""
        return self.transforms(pose)[..., self.segment_dof, :, :]

    def joints(self, pose: Float) -> Float:
        """(..., J, 3) joint centres in the world frame at poses (..., D), metres, in the order of :data:`JOINTS`."""
        T = self.segment_transforms(pose)[..., self.joint_segment, :, :]
        return np.asarray((T[..., :3, :3] @ self.joint_position[:, :, None])[..., 0] + T[..., :3, 3])

    def apart(self, poses: Float, joints: Float) -> Float:
        """(...) how far the joints of poses (..., D) lie at most from others (J, 3), metres."""
        return np.asarray(np.linalg.norm(self.joints(poses) - joints, axis=-1).max(axis=-1))

    def ancestors(self) -> NDArray[np.bool_]:
        """(S, D): True where a degree of freedom moves a segment."""
        return self._ancestors

    @cached_property
    def _ancestors(self) -> NDArray[np.bool_]:
        result = np.zeros((len(SEGMENTS), len(self.names)), dtype=bool)
        for s, k in enumerate(self.segment_dof):
            while k >= 0:
                result[s, k] = True
                k = self.parent[k]
        return result

    def chain_dofs(self, chain: str) -> NDArray[np.bool_]:
        """(D,) True for the degrees of freedom of one of :data:`CHAINS`; the torso's are none of them."""
        prefixes = {
            "head": ("neck",),
            "arm_l": ("shoulder_l", "elbow_l"),
            "arm_r": ("shoulder_r", "elbow_r"),
            "leg_l": ("hip_l", "knee_l", "ankle_l"),
            "leg_r": ("hip_r", "knee_r", "ankle_r"),
        }[chain]
        return np.array([name.startswith(prefixes) for name in self.names])


def shoulder_angles(direction: Float) -> tuple[float, float]:
    """Yaw and pitch of the shoulder that point the arm along ``direction`` (3,): forward, outward, up."""
    arm = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    pole = np.array([-1.0, 1.0, 1.0]) / np.sqrt(3)
    third = np.cross(pole, arm)
    pitch = float(np.arcsin(np.clip(direction @ pole, -1, 1)))
    return float(np.arctan2(direction @ third, direction @ arm)), pitch


def arm_elevation(first: ArrayLike, second: ArrayLike, by: int | None = None) -> Float:
    """Sine of the arm's elevation over the horizontal in the trunk's frame, from a shoulder's first two angles.

    Args:
        by: 0 or 1 for the derivative by the first or the second angle.
    """
    a, b = ARM_UP
    if by == 0:
        return np.asarray(a * np.cos(second) * np.cos(first))
    if by == 1:
        return np.asarray(b * np.cos(second) - a * np.sin(second) * np.sin(first))
    return np.asarray(a * np.cos(second) * np.sin(first) + b * np.sin(second))


def convert_poses(poses: Float, source: Skeleton, target: Skeleton) -> Float:
    """(..., D') poses (..., D) of one skeleton as poses of another: angles by name, 0 where the source has none.

    If only the source has a waist, the hips take over its rotation: trunk, head and all limbs keep their orientation,
    and the legs move with their sockets.
    """
    if source.is_waist.any() and not target.is_waist.any():
        poses = _with_waist_in_hips(source, poses)
    result = np.zeros((*np.shape(poses)[:-1], len(target.names)))
    for k, name in enumerate(target.names):
        if name in source.names:
            result[..., k] = poses[..., source.index(name)]
    return result


def paper_poses(skeleton: Skeleton, poses: Float) -> Float:
    """(..., 24) poses (..., D) in the degrees of freedom of the paper's body; the hips are angles against the trunk."""
    return convert_poses(poses, skeleton, build_skeleton(BodyDimensions.from_stature(1.75)))


def _with_waist_in_hips(skeleton: Skeleton, poses: Float) -> Float:
    """The poses (..., D) with hip angles against the trunk instead of the pelvis."""
    result = np.array(poses, dtype=np.float64)
    B = skeleton.T_world_body
    waist = skeleton.rotation(np.flatnonzero(skeleton.is_waist), result)
    for side, spin in (("l", 1.0), ("r", -1.0)):
        dofs = [skeleton.index(f"hip_{side}_{name}") for name in ("pitch", "yaw", "roll")]
        M = B.T @ waist @ skeleton.rotation(dofs, result) @ B  # rotations about y, then spin x, then -spin z
        result[..., dofs[0]] = np.arctan2(M[..., 0, 2], M[..., 2, 2])
        result[..., dofs[1]] = -spin * np.arcsin(np.clip(M[..., 1, 2], -1.0, 1.0))
        result[..., dofs[2]] = -spin * np.arctan2(M[..., 1, 0], M[..., 1, 1])
    return result


def up_rotation(up: str) -> Float:
    """(3, 3) rotation of the body frame such that its z axis points along ``up`` (see
    :func:`tk.model.cameras.up.up_vector`).

    The body's x axis is the world axis that follows the one nearest to ``up``, made horizontal: y for x, z for y, x for
    z.
    """
    z = up_vector(up)
    x = np.zeros(3)
    x[(int(np.abs(z).argmax()) + 1) % 3] = 1.0
    x -= (x @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def build_skeleton(dimensions: BodyDimensions, up: str = "z", waist: bool = False, ankles: bool = False) -> Skeleton:
    """The skeleton with these dimensions, standing upright along ``up``: the paper's 24 degrees of freedom, three more
    with a waist, four more with ankles."""
    d = dimensions
    B = up_rotation(up) if up != "z" else np.eye(3)
    x, y, z = np.eye(3)
    pelvis = np.zeros(3)
    neck = np.array([0.0, 0.0, d.trunk])
    mirror = np.diag([1.0, -1.0, 1.0])
    shoulder = np.array([0.0, d.shoulder_half_width, d.trunk - d.shoulder_drop])
    hip = np.array([0.0, d.hip_half_width, 0.0])

    rows: list[tuple[str, Float, Float, int]] = []  # name, axis, point, parent

    def add(name: str, axis: Float, point: Float, parent: int) -> int:
        rows.append((name, np.asarray(axis, dtype=float), point, parent))
        return len(rows) - 1

    last = -1
    for name, axis in (("torso_x", x), ("torso_y", y), ("torso_z", z)):
        last = add(name, axis, pelvis, last)
    for name, axis in (("torso_yaw", z), ("torso_roll", x), ("torso_pitch", y)):
        last = add(name, axis, pelvis, last)
    torso = last
    lumbar = np.array([0.0, 0.0, WAIST_HEIGHT * d.trunk])
    for name, axis in zip(WAIST, (x, -y, z), strict=True) if waist else ():
        last = add(name, axis, lumbar, last)
    hips = last
    last = add("neck_pitch", y, neck, torso)
    head = add("neck_yaw", x, neck, last)
    segment_dof = {"torso": torso, "pelvis": hips, "head": head}

    joints: dict[str, tuple[str, Float]] = {
        "pelvis": ("pelvis", pelvis),
        "neck": ("torso", neck),
        "head_top": ("head", neck + d.head * z),
    }
    for side in ("l", "r"):
        M = np.eye(3) if side == "l" else mirror
        spin = 1.0 if side == "l" else -1.0  # a mirrored rotation turns about the negative mirrored axis
        arm = M @ _ARM
        s, e = M @ shoulder, M @ shoulder + d.upper_arm * arm
        last = add(f"shoulder_{side}_yaw", spin * M @ _ARM_POLE, s, torso)
        last = add(f"shoulder_{side}_pitch", spin * M @ _ARM_RISE, s, last)
        segment_dof[f"upper_arm_{side}"] = add(f"shoulder_{side}_roll", spin * M @ _ARM, s, last)
        segment_dof[f"forearm_{side}"] = add(
            f"elbow_{side}_flexion", spin * M @ _ELBOW, e, segment_dof[f"upper_arm_{side}"]
        )
        joints[f"shoulder_{side}"] = (f"upper_arm_{side}", s)
        joints[f"elbow_{side}"] = (f"upper_arm_{side}", e)
        joints[f"wrist_{side}"] = (f"forearm_{side}", e + d.forearm * arm)
    for side in ("l", "r"):
        M = np.eye(3) if side == "l" else mirror
        spin = 1.0 if side == "l" else -1.0
        h = M @ hip
        knee = h - d.thigh * z
        last = add(f"hip_{side}_pitch", y, h, hips)
        last = add(f"hip_{side}_yaw", spin * x, h, last)
        segment_dof[f"thigh_{side}"] = add(f"hip_{side}_roll", -spin * z, h, last)
        segment_dof[f"calf_{side}"] = add(f"knee_{side}_flexion", y, knee, segment_dof[f"thigh_{side}"])
        ankle = knee - d.calf * z
        last = segment_dof[f"calf_{side}"]
        for name, axis in (("flexion", -y), ("inversion", -spin * x)) if ankles else ():
            last = add(f"ankle_{side}_{name}", axis, ankle, last)
        segment_dof[f"foot_{side}"] = last
        joints[f"hip_{side}"] = ("pelvis", h)
        joints[f"knee_{side}"] = (f"thigh_{side}", knee)
        joints[f"ankle_{side}"] = (f"calf_{side}", ankle)

    names = tuple(row[0] for row in rows)
    lift = RAISED_SHOULDERS / FRACTIONS["trunk"] * d.trunk * z
    rise = np.array([lift * (n.startswith("shoulder") and n.endswith("yaw")) for n in names])
    prismatic = np.array([name in ("torso_x", "torso_y", "torso_z") for name in names])
    limits = np.array([_limits(name) for name in names])
    axis = np.array([row[1] for row in rows])
    axis[~prismatic] = axis[~prismatic] @ B.T
    return Skeleton(
        names=names,
        units=tuple("m" if p else "rad" for p in prismatic),
        axis=axis,
        point=np.array([row[2] for row in rows]) @ B.T,
        rise=rise @ B.T,
        prismatic=prismatic,
        parent=np.array([row[3] for row in rows], dtype=np.int32),
        lower=limits[:, 0],
        upper=limits[:, 1],
        segment_dof=np.array([segment_dof[s] for s in SEGMENTS], dtype=np.int32),
        joint_segment=np.array([SEGMENTS.index(joints[j][0]) for j in JOINTS], dtype=np.int32),
        joint_position=np.array([joints[j][1] for j in JOINTS]) @ B.T,
        T_world_body=B,
    )


def _limits(name: str) -> tuple[float, float]:
    if name in ("torso_x", "torso_y", "torso_z"):
        return -np.inf, np.inf
    key = name.replace("_l_", "_").replace("_r_", "_")
    lower, upper = _LIMITS_DEG[key]
    return float(np.radians(lower)), float(np.radians(upper))


def skeleton_of_names(names: Sequence[str], dimensions: BodyDimensions, up: str) -> Skeleton:
    """The skeleton whose pose vector has entries of these names, in this order.

    Raises:
        ValueError: no skeleton has them.
    """
    skeleton = build_skeleton(
        dimensions, up, waist=not {*WAIST}.isdisjoint(names), ankles=not {*ANKLES}.isdisjoint(names)
    )
    if skeleton.names != tuple(names):
        different = sorted({*skeleton.names} ^ {*names}) or ["other order"]
        raise ValueError(f"the pose vector is not one of this body ({different[0]})")
    return skeleton
