"""The cone body: elliptical cone frusta and an ellipsoid head on the skeleton (silhouette paper, section 3).

The paper prints no sizes; :func:`build_cone_body` places the parts by
:class:`~tk.model.body.anthropometry.BodyDimensions`. A hand belongs to the forearm's segment, because the skeleton has
no wrists that turn; a foot is a segment of its own, which turns at the ankle if the skeleton has ankles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import ConfigError
from tk.kernels.cone_arrays import MOST_PARTS, ConeArrays, pack_parts
from tk.kernels.cones import CONE, ELLIPSOID, END_FAR, END_NEAR, OUTLINE, SIDE_A, SIDE_B
from tk.model.body.anthropometry import (
    ANKLE_OUTWARD,
    CROTCH_DROP,
    ELBOW_FRONT,
    FRACTIONS,
    HAIR,
    KNEE_BACK,
    PELVIS_FORWARD,
    BodyDimensions,
)
from tk.model.body.body_points import SEGMENT, places
from tk.model.body.joints import ARM, CHAIN_OF_SEGMENT, CROOK, ELBOW_AXIS, LIMBS, ROWS, SEGMENTS, side_of
from tk.model.body.skeleton import Skeleton, build_skeleton, cross, up_rotation

Float = NDArray[np.float64]

# Radius of the calf at its thickest, as a factor of the straight line from knee to ankle. An estimate that the body fit
# changes.
CALF_BELLY = 1.1

# Angle, degrees, by which the head's longest axis, from the chin to the back of the crown, leans back.
SKULL_TILT_DEG = 15.0

_FORWARD = np.eye(3)[0]

# Groups of parts with one colour model each: the rigid components without their sides, because clothes are symmetric.
COLOR_GROUPS = ("pelvis", "torso", "head", "upper_arm", "forearm", "hand", "thigh", "calf", "foot")
# Numbers of a part that :meth:`ConeBody.reshaped` changes: logarithms of a, b, m and h; x and y of either end.
SHAPE_NUMBERS = 8


@dataclass(frozen=True)
class ConePart:
    """A frustum of an elliptical cone, or an ellipsoid."""

    name: str  # of the part
    segment: str  # of the skeleton, to which the part is fixed
    kind: int  # `tk.kernels.cones.CONE` or `tk.kernels.cones.ELLIPSOID`
    # cone: semi-axes a, b of the section at z = 0, height h, magnification m of the section at z = h; ellipsoid:
    # semi-axes along x, y, z, and 1. Metres.
    shape: tuple[float, float, float, float]
    # (4, 4) the part's frame in the zero configuration: a cone's axis goes from the origin along z, an ellipsoid is
    # centred on the origin
    T_body_part: Float
    ends: tuple[bool, bool] = (False, False)  # whether the rims at z = 0 and z = h are contours, too
    has_contours: bool = True  # False: it is drawn and hides others, but its outline is compared with no edge

    @property
    def component(self) -> str:
        """Rigid component of the part: its segment, or its own name if it is a hand or a foot."""
        name = self.name.replace("instep_", "foot_")
        return name if name.startswith(("hand_", "foot_")) else self.segment

    @property
    def color_group(self) -> int:
        """Index of the part's group in :data:`COLOR_GROUPS`."""
        return COLOR_GROUPS.index(self.component.removesuffix(side_of(self.component)))

    def __post_init__(self) -> None:
        if not all(0 < value < 3 for value in self.shape):
            raise ConfigError(f"part {self.name}: sizes {self.shape} must lie between 0 and 3")


@dataclass(frozen=True)
class ConeBody:
    """One person's body, fixed during tracking."""

    dimensions: BodyDimensions  # lengths and radii, metres
    skeleton: Skeleton  # the kinematic tree
    parts: tuple[ConePart, ...]  # the cones and the ellipsoid

    def standing(self, up: str) -> ConeBody:
        """Return the same body in a world in which ``up`` (see :func:`tk.model.cameras.up.up_vector`) points up."""
        if np.array_equal(self.skeleton.T_world_body, up_rotation(up)):
            return self
        return replace(self, skeleton=build_skeleton(self.dimensions, up))

    @cached_property
    def arrays(self) -> ConeArrays:
        """Arrays for the kernels, float32."""
        return self.pack(np.float32)

    def pack(self, dtype: type[np.floating]) -> ConeArrays:
        """Return arrays for the kernels in a precision.

        Raises:
            ConfigError: the body has more parts than the kernels can number.
        """
        if len(self.parts) > MOST_PARTS:
            raise ConfigError(f"a body has {len(self.parts)} parts; {MOST_PARTS} are the most")
        segments, inside = self.frames
        curves: list[tuple[int, int]] = []
        for p, part in enumerate(self.parts):
            if not part.has_contours:
                continue
            sides = (SIDE_A, SIDE_B) if part.kind == CONE else (OUTLINE,)
            rims = [rim for rim, tracked in zip((END_NEAR, END_FAR), part.ends, strict=True) if tracked]
            curves += [(p, kind) for kind in (*sides, *rims)]
        parts = pack_parts(
            shape=self.shape,
            frame=inside[:, :3],
            kind=np.array([part.kind for part in self.parts]),
            dof=self.skeleton.segment_dof[segments],
            limb=CHAIN_OF_SEGMENT[segments],
            group=self.color_group,
            moved=self.skeleton.contour_dof[segments],
        )
        return ConeArrays(self.skeleton.tree.astype(dtype), parts.astype(dtype), np.array(curves, np.int32))

    @cached_property
    def marked(self) -> Float:
        """(L, 4) the points that landmarks mark, zero configuration, metres, and the last degree of freedom above."""
        return np.column_stack([
            places(self.dimensions) @ self.skeleton.T_world_body.T, self.skeleton.segment_dof[SEGMENT]
        ])  # fmt: skip

    @cached_property
    def color_group(self) -> NDArray[np.int32]:
        """(P,) index of each part's group in :data:`COLOR_GROUPS`."""
        return np.array([part.color_group for part in self.parts], np.int32)

    @cached_property
    def shape(self) -> Float:
        """(P, 4) shapes of the parts."""
        return np.array([part.shape for part in self.parts])

    @cached_property
    def is_cone(self) -> NDArray[np.bool_]:
        """(P,) True for a frustum, False for an ellipsoid."""
        return np.array([part.kind == CONE for part in self.parts])

    @cached_property
    def mirror(self) -> Float:
        """(P,) -1 for a part of the right side, which is the left one's mirror image, else 1."""
        return np.array([-1.0 if part.name.endswith("_r") else 1.0 for part in self.parts])

    @property
    def shape_groups(self) -> tuple[str, ...]:
        """(G,) names of the groups of parts with one shape: "thigh_" for the left and right thigh."""
        return tuple(dict.fromkeys(group_of(part.name) for part in self.parts))

    @cached_property
    def group(self) -> NDArray[np.int64]:
        """(P,) index of each part's group."""
        groups = self.shape_groups
        return np.array([groups.index(group_of(part.name)) for part in self.parts])

    def reshaped(self, change: Float) -> ConeBody:
        """Return a body whose parts have other sizes and positions about their bones; the skeleton stays.

        Args:
            change: (G, 8) for each of :attr:`shape_groups` the growth of the logarithms of a, b, m and h (of an
                ellipsoid: of the three semi-axes), and the displacement of the axis along the part's x and y, metres:
                two numbers at its beginning (a cone's z = 0, an ellipsoid's lower pole), two at its end. The right
                side is the left's mirror image.
        """
        T = np.array([part.T_body_part for part in self.parts])
        shape, frames = self.reshape(self.shape, T, change)
        return replace(
            self,
            parts=tuple(
                replace(part, shape=tuple(sizes), T_body_part=frame)
                for part, sizes, frame in zip(self.parts, shape.tolist(), frames, strict=True)
            ),
        )

    def reshape(self, shape: Float, T: Float, change: Float) -> tuple[Float, Float]:
        """Return shapes (..., P, 4) and frames (..., P, 4, 4) of parts of these names after a change, see
        :meth:`reshaped`."""
        rows, cone, side = change[self.group], self.is_cone, self.mirror
        h = shape[..., 2]
        # both ends of the axis in the part's frame, then in the body's
        ends = ((rows[:, 4], side * rows[:, 5], np.where(cone, 0.0, -h)), (rows[:, 6], side * rows[:, 7], h))
        begin, end = (
            (T[..., :3, :3] @ np.stack(np.broadcast_arrays(*point), axis=-1)[..., None])[..., 0] + T[..., :3, 3]
            for point in ends
        )
        frames = np.broadcast_to(np.eye(4), T.shape).copy()
        axis = _unit(end - begin)
        front = T[..., :3, 0]
        frames[..., :3, 0] = _unit(front - (front * axis).sum(axis=-1, keepdims=True) * axis)
        frames[..., :3, 1] = cross(axis, frames[..., :3, 0])
        frames[..., :3, 2] = axis
        frames[..., :3, 3] = np.where(cone[:, None], begin, 0.5 * (begin + end))
        growth = np.exp(rows[:, [0, 1, 3, 2]])
        growth[~cone, 3] = 1.0
        return shape * growth, frames

    def part_transforms(self, T_world_segment: Float) -> Float:
        """Return (..., P, 4, 4) from each part to the world, from the segments' (..., S, 4, 4)."""
        segments, inside = self.frames
        return np.asarray(T_world_segment[..., segments, :, :] @ inside)

    def local(self, part: NDArray[np.integer], unscaled: Float) -> Float:
        """Return points (N, 3) on the surface of parts (N,), in the parts' frames.

        ``unscaled`` (N, 3) are x / (a r), y / (b r), z / h; r is the radius at z relative to that at z = 0.
        """
        a, b, h, m = self.shape[part].T
        r = np.where(self.is_cone[part], 1 + (m - 1) * unscaled[:, 2], 1.0)
        return np.asarray(unscaled * np.column_stack([a * r, b * r, h]))

    @cached_property
    def frames(self) -> tuple[NDArray[np.int64], Float]:
        """Return (P,) the segment of each part, and (P, 4, 4) from the part to its segment."""
        segments = np.array([SEGMENTS.index(part.segment) for part in self.parts])
        return segments, self.skeleton.in_world(np.array([part.T_body_part for part in self.parts]))


def _unit(vectors: Float) -> Float:
    """Return vectors (..., 3) of length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


class _Part(NamedTuple):
    """A part of N bodies, see :class:`ConePart`."""

    name: str
    segment: str
    kind: int
    shape: Float  # (N, 4)
    T_body_part: Float  # (N, 4, 4)
    ends: tuple[bool, bool] = (False, False)
    has_contours: bool = True


def build_cone_body(dimensions: BodyDimensions, up: str = "z") -> ConeBody:
    """Build the cone body of these dimensions.

    The torso consists of four frusta, the calf of two; the head has a neck, the foot an instep ("variable resolution",
    silhouette paper, section 3). Between the frusta of thigh and calf, which end in discs, a ball fills the front of a
    bent knee. It has no contours: those of a straight leg would be compared twice, and move the knee along the leg.

    Args:
        dimensions: lengths and radii, metres.
        up: the world axis that points up.
    """
    parts = tuple(
        ConePart(name, segment, kind, tuple(shape[0].tolist()), T[0], ends, has_contours)
        for name, segment, kind, shape, T, ends, has_contours in _parts(BodyDimensions.of(dimensions.values[None]))
    )
    return ConeBody(dimensions, build_skeleton(dimensions, up), parts)


def part_arrays(dimensions: BodyDimensions) -> tuple[Float, Float]:
    """Return the shapes (N, P, 4) and frames (N, P, 4, 4) of the parts of N bodies of dimensions (N, 1)."""
    parts = _parts(dimensions)
    return np.stack([part.shape for part in parts], axis=1), np.stack([part.T_body_part for part in parts], axis=1)


def _parts(d: BodyDimensions) -> list[_Part]:
    """Return the parts of N bodies of dimensions (N, 1)."""
    x, y, z = np.eye(3)
    parts = _trunk_and_head(d)
    for side, sign in (("l", 1.0), ("r", -1.0)):
        M = np.diag([1.0, sign, 1.0])
        shoulder, elbow, wrist = (ROWS[name].place(d) for name in LIMBS[f"arm_{side}"])
        # the muscles lie on the side to which the elbow bends
        crook = elbow + ELBOW_FRONT * d.stature * (M @ CROOK)
        upper_arm, forearm = f"upper_arm_{side}", f"forearm_{side}"
        parts.append(_between(upper_arm, upper_arm, shoulder, crook, d.upper_arm_radius, d.elbow_radius, z))
        parts.append(_between(forearm, forearm, crook, wrist, d.elbow_radius, d.wrist_radius, z))
        # half open: a little shorter than the stretched hand, wider than the wrist across the palm; the thumb's
        # side is the one to which the elbow bends
        shape = _shape(0.9 * d.wrist_radius, 1.4 * d.wrist_radius, 0.95 * d.hand, 0.6)
        frame = _frame(wrist, M @ ARM, M @ ELBOW_AXIS)
        parts.append(_Part(f"hand_{side}", forearm, CONE, shape, frame, ends=(False, True)))
        hip, knee, ankle = (ROWS[name].place(d) for name in LIMBS[f"leg_{side}"])
        # the surface lies in front of the hip, behind the knee and outside of the ankle
        top = hip + PELVIS_FORWARD * d.stature * x
        hollow = knee - KNEE_BACK * d.stature * x
        low = ankle + ANKLE_OUTWARD * d.stature * (M @ y)
        parts.append(_between(f"thigh_{side}", f"thigh_{side}", top, hollow, d.thigh_radius, d.knee_radius))
        ball = _shape(d.knee_radius, d.knee_radius, d.knee_radius, 1.0)
        parts.append(_Part(f"knee_{side}", f"thigh_{side}", ELLIPSOID, ball, _frame(hollow, -z, x), has_contours=False))
        parts += _calf(side, hollow, low, d) + _foot(side, ankle, d)
    return parts


def _calf(side: str, knee: Float, ankle: Float, d: BodyDimensions) -> list[_Part]:
    """Return two frusta that meet where the muscle is thickest."""
    share = 0.35
    belly = knee + share * (ankle - knee)
    radius = CALF_BELLY * (d.knee_radius + share * (d.ankle_radius - d.knee_radius))
    segment = f"calf_{side}"
    return [
        _between(segment, segment, knee, belly, d.knee_radius, radius),
        _between(f"shin_{side}", segment, belly, ankle, radius, d.ankle_radius),
    ]


def _between(
    name: str, segment: str, begin: Float, end: Float, r0: float, r1: float, toward: Float = _FORWARD
) -> _Part:
    """Return a frustum whose x axis is as close as possible to the direction ``toward``."""
    length = np.linalg.norm(end - begin, axis=-1, keepdims=True)
    axis = (end - begin) / length
    front = toward - (axis @ toward)[:, None] * axis
    return _Part(name, segment, CONE, _shape(r0, r0, length, r1 / r0), _frame(begin, axis, _unit(front)))


def _foot(side: str, ankle: Float, d: BodyDimensions) -> list[_Part]:
    """Return a flat sole from heel to toes, and the instep from the ankle down to the ball."""
    x, y, z = np.eye(3)
    ground = ankle - d.ankle_height * z
    thick, thin = 0.45 * d.ankle_height, 0.3 * d.ankle_height

    def between(name: str, start: Float, end: Float, sizes: tuple[float, float], m: float, far: bool) -> _Part:
        length = np.linalg.norm(end - start, axis=-1, keepdims=True)
        axis = (end - start) / length
        frame = _frame(start, axis, cross(axis, y))
        return _Part(f"{name}_{side}", f"foot_{side}", CONE, _shape(*sizes, length, m), frame, ends=(far, far))

    heel, toes = ground + thick * z - 0.2 * d.foot * x, ground + thin * z + 0.8 * d.foot * x
    ball = ground + thick * z + 0.45 * d.foot * x
    return [
        between("foot", heel, toes, (thick, 0.17 * d.foot), 0.8, True),
        between("instep", ankle, ball, (d.ankle_radius, d.ankle_radius), 0.6, False),
    ]


def _trunk_and_head(d: BodyDimensions) -> list[_Part]:
    """Return the parts of torso and head: abdomen, belly, chest, shoulders; skull, neck.

    At the hips the trunk lies in front of the line of the joints, at the shoulders on it; hair stands on the crown.
    """
    x, _, z = np.eye(3)
    bottom = -0.9 * CROTCH_DROP / FRACTIONS["hip_half_width"] * d.hip_half_width
    waist, shoulders = 0.42 * d.trunk, d.trunk - 0.7 * d.shoulder_drop
    breast = 0.5 * (waist + shoulders)
    taper = 0.93
    hips = (d.hips_half_depth, d.hips_half_width)
    chest = (d.chest_half_depth, d.chest_half_width)

    def slice_of(name: str, low: float, high: float, sizes: tuple[float, float], m: float) -> _Part:
        # as far forward as the pelvis up to the waist, on the line at the shoulders
        begin, end = (
            h * z + PELVIS_FORWARD * d.stature * np.clip((shoulders - h) / (shoulders - waist), 0, 1) * x
            for h in (low, high)
        )
        part = _between(name, "pelvis" if name == "abdomen" else "torso", begin, end, 1.0, m)
        return part._replace(shape=_shape(*sizes, part.shape[:, 2:3], m))

    skull = 0.46 * d.head
    forward = 0.1 * d.head
    # its long axis goes from the chin to the back of the crown
    lean = float(np.radians(SKULL_TILT_DEG))
    vertex, face = np.cos(lean) * z - np.sin(lean) * x, np.cos(lean) * x + np.sin(lean) * z
    crown = d.trunk + (1 + HAIR / FRACTIONS["head"]) * d.head
    return [
        slice_of("abdomen", bottom, waist, hips, taper),
        slice_of("belly", waist, breast, (taper * chest[0], taper * chest[1]), 1 / taper),
        slice_of("chest", breast, shoulders, chest, 0.95),
        slice_of("shoulders", shoulders, d.trunk, (0.85 * chest[0], chest[1]), 0.5),
        _Part(
            "head",
            "head",
            ELLIPSOID,
            _shape(1.12 * d.head_radius, d.head_radius, skull, 1.0),
            _frame((crown - skull) * z + forward * x, vertex, face),
        ),
        _Part(
            "neck",
            "head",
            CONE,
            _shape(d.neck_radius, d.neck_radius, 0.5 * d.head, 0.95),
            _frame((d.trunk - 0.15 * d.head) * z + 0.5 * forward * x, z, x),
        ),
    ]


def group_of(name: str) -> str:
    """Return a part's name without its side; it ends with an underscore if there are two sides."""
    return name[:-1] if name.endswith(("_l", "_r")) else name


def _shape(*sizes: ArrayLike) -> Float:
    """Return four sizes (N, 1), or numbers, as a shape (N, 4)."""
    return np.hstack(np.broadcast_arrays(*sizes))


def _frame(origin: Float, axis: Float, front: Float) -> Float:
    """Return the frame (N, 4, 4) at ``origin`` (N, 3) with z along ``axis`` and x along ``front`` (perpendicular)."""
    T = np.tile(np.eye(4), (len(origin), 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2], T[:, :3, 3] = front, cross(axis, front), axis, origin
    return T
