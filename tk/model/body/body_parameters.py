"""Parameters of a cone body, their prior, and the derivatives of its contours by them and by the pose.

The parameters are the logarithms of the dimensions and, for each group of parts, what
:meth:`~tk.model.body.cone_body.ConeBody.reshaped` changes. A contour point's row is n·Jπ·∂x/∂δ at the material point x:
along an occluding contour the surface slides in the image's tangent only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cones import CONE
from tk.kernels.silhouette import Edgels
from tk.model.body.anthropometry import DIMENSIONS, UPRIGHT, BodyDimensions
from tk.model.body.body_points import SEGMENT, places
from tk.model.body.cone_body import SHAPE_NUMBERS, ConeBody, ConePart, build_cone_body, group_of, part_arrays
from tk.model.body.skeleton import Skeleton, build_skeleton, cross

Float = NDArray[np.float64]

# Prior standard deviation of a dimension's logarithm about the proportions of the stature. Lengths between joints vary
# by 4 to 5 % at a given stature (Drillis & Contini 1966); definitions of the shoulder's centre differ by more.
# Fingers may be bent. Radii vary with girth and clothes; so do the ends of the body and the shoulder's drop, which both
# sources define loosely.
_LENGTHS = (
    dict.fromkeys(("trunk", "head", "forearm", "thigh", "calf"), 0.05)
    | dict.fromkeys(("foot", "shoulder_half_width", "hip_half_width"), 0.06)
    | {"upper_arm": 0.08, "ankle_height": 0.1, "hand": 0.15, "shoulder_drop": 0.25}
)
_RADII = 0.2

# Prior standard deviation of a part's shape: logarithms of a, b, m and h about the values that follow from the
# dimensions, and metres off the bone along x and y at the beginning and at the end of the axis. Parts between joints
# keep their lengths. Hands, feet and head end a chain, so their lengths and directions are free. Parts in the median
# plane are symmetric.
_FIXED = 1e-6
_WIDTHS = 3 * (0.15,)
_LIMB = (*_WIDTHS, _FIXED, *4 * (0.005,))
_TRUNK = (*_WIDTHS, _FIXED, *2 * (0.01, _FIXED))
_END = (*_WIDTHS, 0.1, 0.005, 0.005, 0.02, 0.01)
_HEAD = (*_WIDTHS, 0.1, 0.005, _FIXED, 0.02, _FIXED)
_SHAPES = {"hand_": _END, "foot_": _END, "head": _HEAD}

# Prior standard deviation of the logarithm of the stature about that of a body that other frames have shown.
FITTED_STATURE_DEVIATION = 0.03
# Difference of a dimension's logarithm for its derivative: curvature then changes the derivative by 1e-6, float64's
# rounding by less.
_STEP = 1e-6


class BodyFamily:
    """Bodies by their K parameters: 24 logarithms of dimensions, then 8 numbers for each of G groups of parts.

    Attributes:
        average: dimensions at the prior's mean.
        stature_deviation: prior standard deviation of the stature's logarithm.
        groups: (G,) names of the groups of parts.
        mean, deviation: (K,) mean and standard deviation of the prior.
        start: (K,) parameters to begin with.
    """

    def __init__(self, average: BodyDimensions, stature_deviation: float) -> None:
        self.average, self.stature_deviation = average, stature_deviation
        self.groups = build_cone_body(average).shape_groups
        shapes = [_SHAPES.get(name, _LIMB if name.endswith("_") else _TRUNK) for name in self.groups]
        self.mean = np.concatenate([np.log(average.values), np.zeros(SHAPE_NUMBERS * len(self.groups))])
        self.deviation = np.concatenate([[_LENGTHS.get(name, _RADII) for name in DIMENSIONS], np.ravel(shapes)])
        self.start = self.mean.copy()
        self._built: tuple[Float, ConeBody] | None = None

    @staticmethod
    def around(body: ConeBody) -> BodyFamily:
        """Return the family whose prior is about a body's dimensions and which begins at the body."""
        return BodyFamily(body.dimensions, FITTED_STATURE_DEVIATION).begun_at(body)

    def begun_at(self, body: ConeBody) -> BodyFamily:
        """Begin at a body; return the family."""
        self.start = np.concatenate([np.log(body.dimensions.values), shapes_of(body).ravel()])
        return self

    def build(self, shared: Float) -> ConeBody:
        """Return the body with parameters (K,). The last one is kept: its contours are searched, then derived."""
        if self._built is None or not np.array_equal(self._built[0], shared):
            self._built = shared.copy(), self._build(shared)
        return self._built[1]

    def _build(self, shared: Float) -> ConeBody:
        return build_cone_body(BodyDimensions.of(np.exp(shared[: len(DIMENSIONS)]))).reshaped(self._change(shared))

    def _change(self, shared: Float) -> Float:
        """Return the change (G, 8) of the parts' shapes that is among parameters (K,)."""
        return shared[len(DIMENSIONS) :].reshape(len(self.groups), SHAPE_NUMBERS)

    def linearised(self, shared: Float, poses: Float) -> LinearisedBody:
        """Return the body with parameters (K,) at poses (M, D), and its derivatives by the dimensions.

        A dimension moves a point in its segment's frame, alike at all poses, and it moves the segment.
        """
        body = self.build(shared)
        s = body.skeleton
        others = BodyDimensions.of(np.exp(self._around(shared)[1:]))
        shape, T = body.reshape(*part_arrays(others), self._change(shared))
        by_part = (_part_numbers(shape, s.in_world(T)) - _part_numbers(body.shape, body.frames[1])) / _STEP
        moves = self._segment_moves(shared, poses)[1]
        twists = np.concatenate(s.twists(poses), axis=-1).swapaxes(-1, -2)
        return LinearisedBody(body, s.segment_transforms(poses), twists, by_part.transpose(1, 2, 0), moves)

    def landmark_rows(self, shared: Float, poses: Float) -> Float:
        """Return the derivatives (F, L, 3, K) of the points that landmarks mark by the parameters (K,), at poses
        (F, D)."""
        here, *others = places(BodyDimensions.of(np.exp(self._around(shared))))
        return self._rows(shared, poses, SEGMENT, (np.array(others) - here) / _STEP)

    def joint_rows(self, shared: Float, poses: Float) -> Float:
        """Return the derivatives (F, J, 3, K) of the joints by the parameters (K,), at poses (F, D)."""
        skeleton = build_skeleton(BodyDimensions.of(np.exp(self._around(shared))))
        here, *others = skeleton.joint_position
        return self._rows(shared, poses, skeleton.joint_segment, (np.array(others) - here) / _STEP)

    def _rows(self, shared: Float, poses: Float, segment: NDArray[np.int32], moved: Float) -> Float:
        """Return the derivatives (F, N, 3, K) of points of the segments (N,) by the parameters (K,), at poses (F, D).

        ``moved``: (24, N, 3) derivatives of their places in the zero configuration.
        """
        skeleton, moves = self._segment_moves(shared, poses)
        inside = skeleton.segment_transforms(poses)[:, segment, :3, :3] @ moved.transpose(1, 2, 0)
        rows = np.zeros((*inside.shape[:3], len(shared)))
        rows[..., : len(DIMENSIONS)] = moves[:, segment] + inside
        return rows

    @staticmethod
    def _around(shared: Float) -> Float:
        """Return the dimensions' logarithms (25, 24): those in parameters (K,), and with a step of each."""
        return shared[: len(DIMENSIONS)] + _STEP * np.eye(len(DIMENSIONS) + 1, len(DIMENSIONS), -1)

    def _segment_moves(self, shared: Float, poses: Float) -> tuple[Skeleton, Float]:
        """Return the skeleton with parameters (K,), and the derivatives (F, S, 3, 24) of its segments' places by the
        dimensions, at poses (F, D)."""
        skeleton = self.build(shared).skeleton
        changed = build_skeleton(BodyDimensions.of(np.exp(self._around(shared)[1:])))
        point, rise = (changed.point - skeleton.point) / _STEP, (changed.rise - skeleton.rise) / _STEP
        return skeleton, skeleton.segment_moves(poses, point, rise)

    def add_prior(self, shared: Float, H: Float, g: Float) -> None:
        """Add the prior at parameters (K,) to their normal equations (K, K), (K,)."""
        H += np.diag(self.deviation**-2)
        g += (self.mean - shared) / self.deviation**2
        lengths = dict(zip(DIMENSIONS, np.exp(shared[: len(DIMENSIONS)]), strict=True))
        stature = sum(lengths[name] for name in UPRIGHT)
        row = np.zeros(len(shared))
        for name in UPRIGHT:
            row[DIMENSIONS.index(name)] = lengths[name] / stature / self.stature_deviation
        H += np.outer(row, row)
        g += row * np.log(self.average.stature / stature) / self.stature_deviation


@dataclass(frozen=True)
class LinearisedBody:
    """A body at M poses, with derivatives by pose and parameters. Methods take N edgels, which tell their poses."""

    body: ConeBody
    T_world_segment: Float  # (M, S, 4, 4) transforms of its segments
    twists: Float  # (M, 6, D) twist (ω, v) of each degree of freedom
    by_part: Float  # (P, 17, 24) derivatives of `_part_numbers`
    moves: Float  # (M, S, 3, 24) derivatives of the segments' places

    @cached_property
    def _T_world_part(self) -> Float:
        return self.body.part_transforms(self.T_world_segment)

    def points(self, edgels: Edgels) -> Float:
        """Return the edgels' points (N, 3) on the surface, world frame, metres."""
        T = self._T_world_part[edgels.pose, edgels.part]
        local = self.body.local(edgels.part, edgels.unscaled)
        return np.asarray((T[:, :3, :3] @ local[:, :, None])[:, :, 0] + T[:, :3, 3])

    def pose_rows(self, part: int, edgels: Edgels, x_world: Float) -> tuple[NDArray[np.intp], Float]:
        """Return the degrees of freedom (k,) that move a part's contours, and the derivatives (N, k) by them of the
        contours' positions along their normals, pixels, at edgels of this part and their points (N, 3)."""
        skeleton = self.body.skeleton
        moved = skeleton.ancestors[self.body.frames[0][part]] & ~skeleton.is_by_landmarks
        # n · (ω × x + v) = ω · (x × n) + v · n
        wrench = np.hstack([cross(x_world, edgels.row), edgels.row])
        return np.flatnonzero(moved), (wrench[:, None] @ self.twists[:, :, moved][edgels.pose])[:, 0]

    def parameter_rows(self, part: int, edgels: Edgels) -> tuple[NDArray[np.intp], Float]:
        """Return the parameters of the body (k,) that change a part, and the derivatives (N, k) by them at edgels of
        this part."""
        moves, by_number = self.moves[:, self.body.frames[0][part]], self.by_part[part]
        used = np.flatnonzero(moves.any(axis=(0, 1)) | by_number.any(axis=0))
        rows = (edgels.row[:, None] @ moves[..., used][edgels.pose])[:, 0]
        rows += self._numbers(part, edgels) @ by_number[:, used]
        shape = shape_rows(self.body, part, self._T_world_part[edgels.pose, part], edgels)
        own = len(DIMENSIONS) + SHAPE_NUMBERS * self.body.group[part] + np.arange(SHAPE_NUMBERS)
        return np.concatenate([used, own]), np.hstack([rows, shape])

    def _numbers(self, part: int, edgels: Edgels) -> Float:
        """Return the derivatives (N, 17) by what :func:`_part_numbers` gives for a part, at edgels of this part."""
        u, segments, inside = edgels.unscaled, *self.body.frames
        n = (edgels.row[:, None] @ self.T_world_segment[edgels.pose, segments[part], :3, :3])[:, 0]
        local = np.column_stack([self.body.local(edgels.part, u), np.ones(len(u))])
        a, b, h = (n @ inside[part, :3, :3] * u).T
        place = (n[:, :, None] * local[:, None, :]).reshape(-1, 12)
        return np.column_stack([place, a, a * u[:, 2], b, b * u[:, 2], h])


def _part_numbers(shape: Float, T_segment_part: Float) -> Float:
    """Return (..., P, 17) the numbers on which a point of each part depends linearly: the part's place in its segment
    (12), and with z = z / h the factors of x / a r, z x / a r, y / b r, z y / b r and z.

    ``shape`` (..., P, 4), ``T_segment_part`` (..., P, 4, 4).
    """
    a, b, h, m = np.moveaxis(shape, -1, 0)
    place = T_segment_part[..., :3, :].reshape(*shape.shape[:-1], 12)
    return np.concatenate([place, np.stack([a, a * (m - 1), b, b * (m - 1), h], axis=-1)], axis=-1)


def shape_rows(body: ConeBody, part: int, T_world_part: Float, edgels: Edgels) -> Float:
    """Return (N, 8) derivatives by the changes of :meth:`ConeBody.reshaped` at no change, to first order, of a part's
    contours at edgels of this part.

    An axis whose ends move apart tilts, and the cross-sections tilt with it. ``T_world_part`` (N, 4, 4) is the part's
    place at each edgel's pose.
    """
    u, (a, b, h, m) = edgels.unscaled, body.shape[part]
    n = (edgels.row[:, None, :] @ T_world_part[:, :3, :3])[:, 0]  # the row in the part's frame
    local = body.local(edgels.part, u)
    cone = body.is_cone[part]
    along = u[:, 2] if cone else 0.5 * (u[:, 2] + 1)  # 0 at the beginning of the axis, 1 at its end
    length = h if cone else 2 * h
    grown = m * u[:, 2] if cone else np.zeros(len(u))  # derivative of the radius factor by log m
    rows = np.zeros((len(u), SHAPE_NUMBERS))
    rows[:, 0] = n[:, 0] * local[:, 0]
    rows[:, 1] = n[:, 1] * local[:, 1]
    rows[:, 2] = grown * (n[:, 0] * a * u[:, 0] + n[:, 1] * b * u[:, 1])
    rows[:, 3] = n[:, 2] * local[:, 2]
    for axis in range(2):
        side = body.mirror[part] if axis == 1 else 1.0
        tilt = n[:, 2] * local[:, axis] / length
        rows[:, 4 + axis] = side * ((1 - along) * n[:, axis] + tilt)
        rows[:, 6 + axis] = side * (along * n[:, axis] - tilt)
    return rows


def shapes_of(body: ConeBody) -> Float:
    """Return the change (G, 8) by which :meth:`ConeBody.reshaped` makes a body from its dimensions.

    A group is zero if the body of these dimensions has no such part.
    """
    average = {part.name: part for part in build_cone_body(body.dimensions).parts}
    result = np.zeros((len(body.shape_groups), SHAPE_NUMBERS))
    for g, group in enumerate(body.shape_groups):
        # the right side is the left's mirror image
        part = next(part for part in body.parts if group_of(part.name) == group and not part.name.endswith("_r"))
        if part.name in average and average[part.name].kind == part.kind:
            result[g] = _change(average[part.name], part)
    return result


def _change(average: ConePart, part: ConePart) -> Float:
    (a, b, h, m), (a1, b1, h1, m1) = average.shape, part.shape
    T = np.linalg.inv(average.T_body_part) @ part.T_body_part
    slope = T[:2, 2] / T[2, 2]
    if part.kind == CONE:
        begin, end = T[:2, 3], T[:2, 3] + h * slope
    else:
        begin, end = T[:2, 3] - h * slope, T[:2, 3] + h * slope
    return np.concatenate([np.log([a1 / a, b1 / b, m1 / m, h1 / h]), begin, end])
