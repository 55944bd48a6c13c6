"""The skeleton: a tree of exponential twists with 24 degrees of freedom (Kehl 2006, section 5.1, figure 5a), and eight
more for the waist, the ankles and the head's turn if wanted.

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
while the trunk leans; the paper's torso takes them along. The ankles turn, and the head turns about the neck.
:func:`paper_poses` gives a pose in the paper's 24 degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.kernels.kinematics import ARM_UP, pack_tree
from tk.model.body.anthropometry import AVERAGE_BODY, FRACTIONS, RAISED_SHOULDERS, BodyDimensions
from tk.model.body.joints import (
    ARM,
    ARM_POLE,
    BODIES,
    CHAINS,
    DOF_NAMES,
    HIPS,
    JOINTS,
    PAPER_DOF_NAMES,
    ROWS,
    SEGMENTS,
    SHOULDERS,
    TABLE,
    WAIST,
    Dof,
    Joint,
)
from tk.model.cameras.up import up_vector

__all__ = ["CHAINS", "JOINTS", "SEGMENTS"]

Float = NDArray[np.float64]

# The transforms of so many batches are kept, each of at most so many poses.
REMEMBERED = 32
# Poses of a recording that are placed at once: a pose needs 16 kB of temporary memory.
_BLOCK = 1024
# Up to so many poses are placed in few rounds of products, more of them with few products: a call takes as long as
# about 50 products.
_FEW = 8

_AHEAD, _BEHIND = (np.roll(range(3), step) for step in (-1, 1))  # axes after and before each of the three


@dataclass(frozen=True)
class Skeleton:
    """The kinematic tree as plain arrays: D = 24 degrees of freedom, S = 13 segments, J = 15 joints.

    tk's body has more: the waist three, the ankles two each, the neck one; without them pelvis and feet are carried by
    torso and calves.
    """

    names: tuple[str, ...]  # (D,) names of the degrees of freedom; translations first
    axis: Float  # (D, 3) unit axes in the zero configuration, world frame
    point: Float  # (D, 3) a point on each axis, metres; unused for translations
    # (D, 3) how far a level arm that is raised upright lifts its shoulder, metres, in the first degree of freedom of
    # each shoulder; zero elsewhere
    rise: Float
    prismatic: NDArray[np.bool_]  # (D,) True for translations
    parent: NDArray[np.int32]  # (D,) index of the degree of freedom before, -1 at the root
    # lower, upper: (D,) limits, radians; infinite where there is none
    lower: Float
    upper: Float
    # (D,) radians, standard deviation about zero of a joint that is nearly straight in most frames; infinite for the
    # others
    straight: Float
    # (D,) radians, standard deviation about zero of an angle that only landmarks show; infinite for the others
    by_landmarks: Float
    segment_dof: NDArray[np.int32]  # (S,) the last degree of freedom above each segment
    joint_segment: NDArray[np.int32]  # (J,) the segment that carries each joint
    joint_position: Float  # (J, 3) joint centres in the zero configuration, metres
    T_world_body: Float  # (3, 3) rotation of the body frame in the zero configuration (identity when z is up)

    @property
    def units(self) -> tuple[str, ...]:
        """(D,) "m" or "rad"."""
        return tuple("m" if p else "rad" for p in self.prismatic)

    @cached_property
    def is_waist(self) -> NDArray[np.bool_]:
        """(D,) True for the degrees of freedom between trunk and pelvis, where there are any."""
        return np.isin(self.names, ROWS[WAIST].dof_names)

    @cached_property
    def is_straight(self) -> NDArray[np.bool_]:
        """(D,) True where :attr:`straight` is finite."""
        return np.isfinite(self.straight)

    @cached_property
    def is_by_landmarks(self) -> NDArray[np.bool_]:
        """(D,) True where :attr:`by_landmarks` is finite: contours do not move it."""
        return np.isfinite(self.by_landmarks)

    def index(self, name: str) -> int:
        """Return the position of a degree of freedom in the pose vector."""
        return self.names.index(name)

    def clip(self, poses: Float) -> Float:
        """Map poses (..., D) into the limits (eq. 22)."""
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
    def _products(self) -> tuple[list[tuple[NDArray[np.integer], NDArray[np.integer]]], ...]:
        """Rounds of products of transforms, each degrees of freedom and those above them by whose transforms they are
        multiplied: with the fewest products, and with the fewest rounds, in each of which the way up doubles."""
        levels: list[tuple[NDArray[np.integer], NDArray[np.integer]]]
        doubling: list[tuple[NDArray[np.integer], NDArray[np.integer]]]
        levels = [(level, self.parent[level]) for level in self._levels[1:]]
        doubling, above = [], self.parent
        while (below := np.flatnonzero(above >= 0)).size:
            doubling.append((below, above[below]))
            above = np.where(above >= 0, above[above], -1)
        return levels, doubling

    @cached_property
    def _raised(self) -> NDArray[np.int64]:
        """The degrees of freedom that lift a shoulder: with the one behind it each turns the arm up."""
        return np.flatnonzero(self.rise.any(axis=1))

    def transforms(self, pose: Float) -> Float:
        """Return the transforms T_k (..., D, 4, 4) after each degree of freedom of poses (..., D), float64."""
        pose = np.asarray(pose, dtype=np.float64)
        if pose.size > REMEMBERED * pose.shape[-1]:
            return self._transforms(pose)
        # joints, twists and directions of poses are asked for in turn, and the joints once more in the next frame
        key = pose.tobytes()
        placed = self._placed.get(key)
        if placed is None:
            placed = self._transforms(pose.reshape(-1, pose.shape[-1]))
            placed.flags.writeable = False
            if len(self._placed) >= REMEMBERED:
                self._placed.pop(next(iter(self._placed)), None)
            self._placed[key] = placed
        return placed.reshape(*pose.shape, 4, 4)

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
        k = self._raised
        steps[..., :3, 3][..., k, :] += self.rise[k] * arm_elevation(pose[..., k], pose[..., k + 1])[..., None]
        steps[..., 3, 3] = 1.0
        result = steps
        # calls take most of the time of few poses, products that of many
        for below, above in self._products[pose.size <= _FEW * pose.shape[-1]]:
            result[..., below, :, :] = result[..., above, :, :] @ result[..., below, :, :]
        return result

    def segment_moves(self, poses: Float, point: Float, rise: Float) -> Float:
        """Return (M, S, 3, K) derivatives of the segments' places at poses (M, D) by K changes, given as derivatives
        (K, D, 3) of :attr:`point` and :attr:`rise`."""
        K, squares = self._generators
        turn = np.sin(poses)[..., None, None] * K + (1 - np.cos(poses))[..., None, None] * squares  # R - 1
        result = -turn @ np.where(self.prismatic[:, None], 0.0, point).transpose(1, 2, 0)
        for k in self._raised:
            result[:, k] += arm_elevation(poses[:, k], poses[:, k + 1])[:, None, None] * rise[:, k].T
        below = self.parent >= 0
        result[:, below] = self.transforms(poses)[:, self.parent[below], :3, :3] @ result[:, below]
        for level in self._levels[1:]:
            result[:, level] += result[:, self.parent[level]]
        return np.asarray(result[:, self.segment_dof])

    @cached_property
    def tree(self) -> Float:
        """(D, 11) the tree for the kernels, see :func:`tk.kernels.kinematics.pack_tree`."""
        return pack_tree(self.axis, self.point, self.rise, self.prismatic, self.parent)

    def in_world(self, T_body: Float) -> Float:
        """Return transforms (..., 4, 4) or (..., 3, 4) to the body frame as transforms to the world, at zero angles."""
        B = np.eye(4)
        B[:3, :3] = self.T_world_body
        return B[: np.shape(T_body)[-2], : np.shape(T_body)[-2]] @ T_body

    def twists(self, pose: Float) -> tuple[Float, Float]:
        """Return world twists (ω, v), each (..., D, 3), at poses (..., D): a point x below degree of freedom k moves at
        ω_k × x + v_k (eqs. 6-8)."""
        T = self.transforms(pose)
        above = np.where((self.parent >= 0)[:, None, None], T[..., self.parent, :, :], np.eye(4))
        axis = (above[..., :3, :3] @ self.axis[:, :, None])[..., 0]
        # the joint's place, its rise included, does not move when it turns
        q = (T[..., :3, :3] @ self.point[:, :, None])[..., 0] + T[..., :3, 3]
        v = np.where(self.prismatic[:, None], axis, cross(q, axis))
        k = self._raised
        lift = (above[..., k, :3, :3] @ self.rise[k][..., None])[..., 0]
        for by in (0, 1):
            v[..., k + by, :] += lift * arm_elevation(pose[..., k], pose[..., k + 1], by=by)[..., None]
        return np.where(self.prismatic[:, None], 0.0, axis), v

    def rotation(self, dofs: Iterable[int], poses: Float) -> Float:
        """Return the product (..., 3, 3) of successive rotations about these axes of the zero configuration."""
        K, squares = self._generators
        R = np.eye(3)
        for k in dofs:
            angle = poses[..., k, None, None]
            R = R @ (np.eye(3) + np.sin(angle) * K[k] + (1 - np.cos(angle)) * squares[k])
        return R

    def segment_transforms(self, pose: Float) -> Float:
        """Return the transforms (..., S, 4, 4) of the segments."""
        if np.ndim(pose) == 2 and len(pose) > _BLOCK:
            return np.concatenate([self.segment_transforms(block) for block in blocks(pose)])
        return self.transforms(pose)[..., self.segment_dof, :, :]

    def joints(self, pose: Float) -> Float:
        """Return joint centres (..., J, 3), metres, world frame, at poses (..., D), in the order of :data:`JOINTS`."""
        if np.ndim(pose) == 2 and len(pose) > _BLOCK:
            return np.concatenate([self.joints(block) for block in blocks(pose)])
        return self.points(pose, self.joint_segment, self.joint_position)

    def points(self, pose: Float, segment: NDArray[np.int32], place: Float) -> Float:
        """Return points (..., N, 3), metres, world frame, at poses (..., D).

        Args:
            pose: the poses.
            segment: (N,) the segment that carries each point.
            place: (N, 3) the points in the zero configuration, metres.
        """
        T = self.transforms(pose)[..., self.segment_dof[segment], :3, :]
        return np.asarray((T[..., :3] @ place[:, :, None])[..., 0] + T[..., 3])

    def apart(self, poses: Float, joints: Float) -> Float:
        """Return the largest distance (...) of the joints of poses (..., D) from others (J, 3), metres."""
        return np.asarray(np.linalg.norm(self.joints(poses) - joints, axis=-1).max(axis=-1))

    def steps(self, poses: Float) -> Float:
        """Return the steps (F - 1, D) of poses (F, D), of angles the shorter way round."""
        steps = np.diff(poses, axis=0)
        return np.where(self.prismatic, steps, (steps + np.pi) % (2 * np.pi) - np.pi)

    def joint_jacobian(self, poses: Float) -> Float:
        """Return the derivatives (..., J, 3, D) of :meth:`joints` at poses (..., D)."""
        return self.point_jacobian(poses, self.joint_segment, self.joints(poses))

    def point_jacobian(self, poses: Float, segment: NDArray[np.int32], points: Float) -> Float:
        """Return the derivatives (..., N, 3, D) of :meth:`points` (..., N, 3) at poses (..., D)."""
        w, v = self.twists(poses)
        generators = np.zeros((*w.shape, 4))  # ω × x + v of (x, 1)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            generators[..., i, j], generators[..., i, k] = -w[..., k], w[..., j]
        generators[..., 3] = v
        extended = np.ones((*points.shape[:-2], 4, points.shape[-2]))
        extended[..., :3, :] = np.swapaxes(points, -1, -2)
        moved = (generators.reshape(*w.shape[:-2], -1, 4) @ extended).reshape(*w.shape, -1)  # (..., D, 3, N)
        moved *= self.ancestors[segment].T[:, None]
        return np.moveaxis(moved, -1, -3).swapaxes(-1, -2)

    @cached_property
    def ancestors(self) -> NDArray[np.bool_]:
        """(S, D): True where a degree of freedom moves a segment."""
        result = np.zeros((len(SEGMENTS), len(self.names)), dtype=bool)
        for s, k in enumerate(self.segment_dof):
            while k >= 0:
                result[s, k] = True
                k = self.parent[k]
        return result

    @cached_property
    def contour_dof(self) -> NDArray[np.int32]:
        """(S,) the last degree of freedom above each segment that its contours move."""
        result = self.segment_dof.copy()
        while (hidden := self.is_by_landmarks[result]).any():
            result[hidden] = self.parent[result[hidden]]
        return result

    def chain_dofs(self, chain: str) -> NDArray[np.bool_]:
        """Return (D,) True for the degrees of freedom of one of :data:`CHAINS`; the torso's are in none of them."""
        return np.isin(self.names, [name for row in TABLE if row.chain == chain for name in row.dof_names])


def cross(a: Float, b: Float) -> Float:
    """Return a × b of vectors (..., 3), as ``np.cross`` does, in a third of its time."""
    return a[..., _AHEAD] * b[..., _BEHIND] - a[..., _BEHIND] * b[..., _AHEAD]


def blocks(poses: Float) -> list[Float]:
    """Return poses (F, D) in pieces of at most :data:`_BLOCK`."""
    return [poses[i : i + _BLOCK] for i in range(0, max(len(poses), 1), _BLOCK)]


def shoulder_angles(direction: Float) -> tuple[float, float]:
    """Return yaw and pitch of the shoulder that point the arm along ``direction`` (3,): forward, outward, up."""
    pitch = float(np.arcsin(np.clip(direction @ ARM_POLE, -1, 1)))
    return float(np.arctan2(direction @ np.cross(ARM_POLE, ARM), direction @ ARM)), pitch


def arm_elevation(first: ArrayLike, second: ArrayLike, by: int | None = None) -> Float:
    """Return the sine of the arm's elevation in the trunk's frame, from a shoulder's first two angles.

    Args:
        by: 0 or 1 for the derivative by the first or the second angle.
    """
    a, b = ARM_UP
    if by == 0:
        return np.asarray(a * np.cos(second) * np.cos(first))
    if by == 1:
        return np.asarray(b * np.cos(second) - a * np.sin(second) * np.sin(first))
    return np.asarray(a * np.cos(second) * np.sin(first) + b * np.sin(second))


def distinct(points: Float, least_m: float, count: int | None = None) -> NDArray[np.int64]:
    """Return the indices of the first of the points (N, ..., 3), ``count`` at most, that differ from all chosen before
    them by more than ``least_m`` in one of their points, metres."""
    free = np.ones(len(points), np.bool_)
    chosen: list[int] = []
    while free.any() and len(chosen) != count:
        chosen.append(int(np.argmax(free)))
        away = np.linalg.norm(points - points[chosen[-1]], axis=-1)
        free &= away.reshape(len(points), -1).max(axis=1) > least_m
    return np.array(chosen, np.int64)


def convert_poses(poses: Float, source: Skeleton, target: Skeleton) -> Float:
    """Return poses (..., D) of one skeleton as poses (..., D') of another: angles by name, 0 where the source has none.

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
    """Return poses (..., D) in the paper's degrees of freedom (..., 24); the hips are angles against the trunk."""
    return convert_poses(poses, skeleton, build_skeleton(AVERAGE_BODY, paper=True))


def _with_waist_in_hips(skeleton: Skeleton, poses: Float) -> Float:
    """Return the poses (..., D) with hip angles against the trunk instead of the pelvis."""
    result = np.array(poses, dtype=np.float64)
    B = skeleton.T_world_body
    waist = skeleton.rotation(np.flatnonzero(skeleton.is_waist), result)
    for hip, spin in zip(HIPS, (1.0, -1.0), strict=True):
        dofs = [skeleton.index(name) for name in ROWS[hip].dof_names]
        M = B.T @ waist @ skeleton.rotation(dofs, result) @ B  # rotations about y, then spin x, then -spin z
        result[..., dofs[0]] = np.arctan2(M[..., 0, 2], M[..., 2, 2])
        result[..., dofs[1]] = -spin * np.arcsin(np.clip(M[..., 1, 2], -1.0, 1.0))
        result[..., dofs[2]] = -spin * np.arctan2(M[..., 1, 0], M[..., 1, 1])
    return result


def up_rotation(up: str) -> Float:
    """Return the rotation (3, 3) of the body frame such that its z axis points along ``up`` (see
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


def build_skeleton(dimensions: BodyDimensions, up: str = "z", paper: bool = False) -> Skeleton:
    """Return the skeleton with these dimensions, standing upright along ``up``.

    Args:
        dimensions: lengths, metres. Of N bodies, (N, 1): :attr:`~Skeleton.point`, :attr:`~Skeleton.rise` and
            :attr:`~Skeleton.joint_position` are (N, ...).
        up: see :func:`up_rotation`.
        paper: whether it has the paper's 24 degrees of freedom only: no waist, no ankles, and the head does not turn.
    """
    return _build(dimensions, up, PAPER_DOF_NAMES if paper else DOF_NAMES)


def _build(dimensions: BodyDimensions, up: str, names: Sequence[str]) -> Skeleton:
    """Return the skeleton with the degrees of freedom of these names; see :func:`build_skeleton`."""
    B = up_rotation(up) if up != "z" else np.eye(3)
    dofs: list[tuple[Joint, Dof, str]] = []
    parents: list[int] = []
    last = {"": -1}  # joint: its last degree of freedom
    segment_dof: dict[str, int] = {}
    for row in TABLE:
        last[row.name] = last[row.above]
        for dof, name in zip(row.dofs, row.dof_names, strict=True):
            if name in names:
                parents.append(last[row.name])
                dofs.append((row, dof, name))
                last[row.name] = len(dofs) - 1
        if row.turns:
            segment_dof[row.turns] = last[row.name]
    lift = RAISED_SHOULDERS / FRACTIONS["trunk"] * dimensions.trunk * np.array([0.0, 0.0, 1.0])
    lifting = {ROWS[name].dof_names[0] for name in SHOULDERS}
    prismatic = np.array([dof.prismatic for _, dof, _ in dofs])
    axis = np.array([dof.axis for _, dof, _ in dofs])
    axis[~prismatic] = axis[~prismatic] @ B.T
    joints = [ROWS[name] for name in JOINTS]
    return Skeleton(
        names=tuple(name for _, _, name in dofs),
        axis=axis,
        point=_rows(row.place(dimensions) for row, _, _ in dofs) @ B.T,
        rise=_rows(lift * (name in lifting) for _, _, name in dofs) @ B.T,
        prismatic=prismatic,
        parent=np.array(parents, dtype=np.int32),
        lower=np.radians([dof.lower for _, dof, _ in dofs]),
        upper=np.radians([dof.upper for _, dof, _ in dofs]),
        straight=np.radians([dof.straight_deg for _, dof, _ in dofs]),
        by_landmarks=np.radians([dof.landmarks_deg for _, dof, _ in dofs]),
        segment_dof=np.array([segment_dof[s] for s in SEGMENTS], dtype=np.int32),
        joint_segment=np.array([SEGMENTS.index(row.carrier) for row in joints], dtype=np.int32),
        joint_position=_rows(row.place(dimensions) for row in joints) @ B.T,
        T_world_body=B,
    )


def _rows(vectors: Iterable[Float]) -> Float:
    """Return vectors (..., 3) as rows (..., M, 3)."""
    return np.stack(np.broadcast_arrays(*vectors), axis=-2)


def skeleton_of_names(names: Sequence[str], dimensions: BodyDimensions, up: str) -> Skeleton:
    """Return the skeleton whose pose vector has entries of these names, in this order, one of
    :data:`~tk.model.body.joints.BODIES`.

    Raises:
        ValueError: no skeleton has them.
    """
    if tuple(names) in BODIES:
        return _build(dimensions, up, names)
    different = sorted({*DOF_NAMES} ^ {*names}) or ["other order"]
    raise ValueError(f"the pose vector is not one of this body ({different[0]})")
