"""Fits a cone body to silhouettes of several frames: its dimensions, its parts' shapes and the poses, all at once.

One Gauss-Newton problem over the poses of F frames and the body's parameters: the logarithms of the dimensions, and for
each group of parts what :meth:`~tk.model.body.cone_body.ConeBody.reshaped` changes. An edgel's row by a parameter is
n·Jπ·∂x/∂δ at the material point x of the contour, as it is by a degree of freedom: along an occluding contour the
surface slides in the image's tangent only. Dimensions and shapes are fitted together because shapes make up for
dimensions and the other way round: thighs that taper otherwise than the average ones move the knee by centimetres if
only the dimensions may give way. (The silhouette paper leaves the adaptation of the body to future work.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cones import CONE
from tk.kernels.line_search import SearchSettings
from tk.kernels.silhouette import Edgels
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import SHAPE_NUMBERS, ConeBody, build_cone_body, group_of
from tk.model.body.skeleton import SEGMENTS
from tk.model.masks.silhouettes import Pyramid, Views
from tk.settings import BodyFitSettings

Float = NDArray[np.float64]

# One standard deviation of a dimension's logarithm about the proportions of the stature. Lengths between joints vary by
# 4 to 5 % at a given stature (Drillis & Contini 1966), radii by girth and by clothes.
_LENGTHS = {
    "trunk": 0.05,
    "head": 0.05,
    "upper_arm": 0.05,
    "forearm": 0.05,
    "thigh": 0.05,
    "calf": 0.05,
    "foot": 0.06,
    "hand": 0.1,
    "shoulder_drop": 0.25,
    "shoulder_half_width": 0.06,
    "hip_half_width": 0.06,
    "ankle_height": 0.1,
}
_RADII = 0.2
_UPRIGHT = ("head", "trunk", "thigh", "calf", "ankle_height")  # what adds up to the stature

# One standard deviation of what changes a part, see ConeBody.reshaped: logarithms of a, b, m and h about what the
# dimensions make them, and metres off the bone along x and y, where the axis begins and where it ends. Parts between
# joints keep their lengths; what ends a limb has no joint behind it, so its length and direction are open. What lies in
# the middle is symmetric.
_FIXED = 1e-6
_LIMB = (0.15, 0.15, 0.15, _FIXED, 0.005, 0.005, 0.005, 0.005)
_TRUNK = (0.15, 0.15, 0.15, _FIXED, 0.01, _FIXED, 0.01, _FIXED)
_SHAPES = {
    "hand_": (0.15, 0.15, 0.15, 0.1, 0.005, 0.005, 0.02, 0.01),
    "foot_": (0.15, 0.15, 0.15, 0.1, 0.005, 0.005, 0.02, 0.01),
    "head": (0.15, 0.15, 0.15, 0.1, 0.005, _FIXED, 0.02, _FIXED),
}
_STEP = 1e-6  # of the differences by a dimension's logarithm
# Standard deviation of an edgel, pixels. Besides ragged masks it stands for shapes that no cone has, which err alike in
# all frames.
_EDGE_NOISE_PX = 3.0
# So more frames than this tell more of the poses, but no more of the body.
_TELLING_FRAMES = 8
# Along a contour this many pixels err together.
_CORRELATION_PX = 10.0
# Between samples of a contour, pixels: no more than these are independent.
_SPACING_PX = 6.0
# Of a degree of freedom about the pose that the fit was given, radians or metres.
_POSE_DEVIATION = 0.3
# Of the waist and the ankles about a straight one, radians: a bent waist and another trunk look alike.
_STRAIGHT_DEVIATION = 0.3
_DIMENSIONS = tuple(field.name for field in fields(BodyDimensions))


# One standard deviation of the logarithm of the stature about a given height: 1 %, of shoes, posture and measurement.
STATURE_DEVIATION = 0.01


def fit_body(
    preset: str,
    views: Views,
    pyramids: Sequence[Pyramid],
    poses: Float,
    settings: SearchSettings,
    stature_m: float,
    config: BodyFitSettings,
    stature_deviation: float = STATURE_DEVIATION,
) -> tuple[ConeBody, Float]:
    """The body that suits several frames, with their poses.

    Args:
        preset: of :data:`~tk.model.body.cone_body.PRESETS`.
        views: the cameras.
        pyramids: F frames' silhouettes.
        poses: (F, D) their poses, close enough for the search to find the right edges.
        settings: of the search.
        stature_m: the subject's height without shoes, given or measured.
        config: see :class:`BodyFitSettings`.
        stature_deviation: one standard deviation of the logarithm of the stature about ``stature_m``.

    Returns:
        The body, and poses (F, D).
    """
    settings = replace(settings, spacing_px=_SPACING_PX)
    problem = BodyProblem(preset, BodyDimensions.from_stature(stature_m), stature_deviation)
    shared = problem.mean.copy()
    poses, start = np.array(poses), np.array(poses)
    K = len(shared)
    # of one pixel of contour
    information = 1.0 / (_EDGE_NOISE_PX**2 * _CORRELATION_PX * max(len(poses) / _TELLING_FRAMES, 1.0))
    for _ in range(config.rounds):
        here = problem.build(shared)
        skeleton = here.skeleton
        straight = skeleton.is_waist | skeleton.is_ankle
        pose_precision = np.where(straight, _STRAIGHT_DEVIATION, _POSE_DEVIATION) ** -2.0
        mean = np.where(straight, 0.0, start)
        seen = [views.edgels(here, pyramid, pose, 0, settings) for pyramid, pose in zip(pyramids, poses, strict=True)]
        by_dimension = problem.dimension_rows(shared, poses, seen)
        free = np.flatnonzero(here.free)
        H, g = np.zeros((K, K)), np.zeros(K)
        problem.add_prior(shared, H, g)
        transforms = skeleton.segment_transforms(poses)
        steps = []
        for f, edgels in enumerate(seen):
            rows = np.hstack(
                [pose_rows(here, poses[f], edgels)[:, free], by_dimension[f], shape_rows(here, transforms[f], edgels)]
            )
            weight = edgels.weight * information
            A = (rows * weight[:, None]).T @ rows
            y = rows.T @ (weight * edgels.distance)
            # joints beyond a limit are pulled back
            excess = skeleton.clip(poses[f]) - poses[f]
            limit = np.where(excess != 0, 1e3, 0.0)
            own = np.diag((pose_precision + limit)[free])
            pull = (pose_precision * (mean[f] - poses[f]) + limit * excess)[free]
            # a frame's pose is eliminated: what is left tells of the body alone (Schur complement)
            n = len(free)
            solved = np.linalg.solve(A[:n, :n] + own, np.column_stack([y[:n] + pull, A[:n, n:]]))
            H += A[n:, n:] - A[n:, :n] @ solved[:, 1:]
            g += y[n:] - A[n:, :n] @ solved[:, 0]
            steps.append(solved)
        change = np.linalg.solve(H, g)
        for pose, solved in zip(poses, steps, strict=True):
            pose[free] += np.clip(solved[:, 0] - solved[:, 1:] @ change, -0.3, 0.3)
        shared += np.clip(change, -0.1, 0.1)
    return problem.build(shared), poses


class BodyProblem:
    """The family of bodies: 24 logarithms of dimensions, then 8 numbers for each group of parts."""

    def __init__(self, preset: str, average: BodyDimensions, stature_deviation: float) -> None:
        self.preset, self.average = preset, average
        self.stature_deviation = stature_deviation
        self.groups = build_cone_body(average, preset=preset).shape_groups
        shapes = [_SHAPES.get(name, _LIMB if name.endswith("_") else _TRUNK) for name in self.groups]
        logs = np.log([getattr(average, name) for name in _DIMENSIONS])
        self.mean = np.concatenate([logs, np.zeros(SHAPE_NUMBERS * len(self.groups))])
        self.deviation = np.concatenate([[_LENGTHS.get(name, _RADII) for name in _DIMENSIONS], np.ravel(shapes)])

    def build(self, shared: Float) -> ConeBody:
        values = np.exp(shared[: len(_DIMENSIONS)])
        dimensions = BodyDimensions(**dict(zip(_DIMENSIONS, values.tolist(), strict=True)))
        change = shared[len(_DIMENSIONS) :].reshape(len(self.groups), SHAPE_NUMBERS)
        return build_cone_body(dimensions, preset=self.preset).reshaped(change)

    def dimension_rows(self, shared: Float, poses: Float, seen: Sequence[Edgels]) -> list[Float]:
        """For each frame (N, 24): rows by the dimensions, by differences of the surface points."""
        ends = np.cumsum([len(edgels.part) for edgels in seen])
        frame = np.repeat(np.arange(len(seen)), [len(edgels.part) for edgels in seen])
        part = np.concatenate([edgels.part for edgels in seen])
        unscaled = np.concatenate([edgels.unscaled for edgels in seen])
        row = np.concatenate([edgels.row for edgels in seen])
        rows = np.zeros((len(part), len(_DIMENSIONS)))

        # the cameras of a frame share its pose
        different, which = np.unique(poses, axis=0, return_inverse=True)
        frame = which.ravel()[frame]

        def points(values: Float) -> Float:
            body = self.build(values)
            placed = body.part_transforms(body.skeleton.segment_transforms(different))
            return body.placed(placed[frame, part], part, unscaled)

        here = points(shared)
        for k in range(len(_DIMENSIONS)):
            step = np.zeros(len(shared))
            step[k] = _STEP
            rows[:, k] = np.einsum("na,na->n", row, points(shared + step) - here) / _STEP
        return np.split(rows, ends[:-1])

    def add_prior(self, shared: Float, H: Float, g: Float) -> None:
        """Add what is known of bodies to the equations (K, K), (K,) of the parameters."""
        H += np.diag(self.deviation**-2)
        g += (self.mean - shared) / self.deviation**2
        lengths = dict(zip(_DIMENSIONS, np.exp(shared[: len(_DIMENSIONS)]), strict=True))
        stature = sum(lengths[name] for name in _UPRIGHT)
        row = np.zeros(len(shared))
        for name in _UPRIGHT:
            row[_DIMENSIONS.index(name)] = lengths[name] / stature / self.stature_deviation
        H += np.outer(row, row)
        g += row * np.log(self.average.stature / stature) / self.stature_deviation


def pose_rows(body: ConeBody, pose: Float, edgels: Edgels, x_world: Float | None = None) -> Float:
    """(N, D) derivative of the contour's position along its normal by the pose, pixels; ``x_world`` (N, 3) are the
    edgels' points on the surface, if at hand."""
    s = body.skeleton
    w, v = s.twists(pose)
    x = body.place(pose, edgels.part, edgels.unscaled) if x_world is None else x_world
    moves = s.ancestors()[[SEGMENTS.index(part.segment) for part in body.parts]][edgels.part]
    # n · (ω × x + v) = ω · (x × n) + v · n
    return np.where(moves, np.cross(x, edgels.row) @ w.T + edgels.row @ v.T, 0.0)


def shape_rows(body: ConeBody, T_world_segment: Float, edgels: Edgels) -> Float:
    """(N, 8 G) the same by what :meth:`ConeBody.reshaped` changes, at no change, to first order.

    An axis whose ends move apart tilts, and the cross-sections tilt with it.
    """
    groups = body.shape_groups
    part = edgels.part
    T = body.part_transforms(T_world_segment)[part]
    n = np.einsum("nab,na->nb", T[:, :3, :3], edgels.row)  # the row in the part's frame
    shape, _, local = body.local(part, edgels.unscaled)
    cone = np.array([p.kind == CONE for p in body.parts])[part]
    mirror = np.array([-1.0 if p.name.endswith("_r") else 1.0 for p in body.parts])[part]
    u = edgels.unscaled
    along = np.where(cone, u[:, 2], 0.5 * (u[:, 2] + 1))  # 0 where the axis begins, 1 where it ends
    length = np.where(cone, shape[:, 2], 2 * shape[:, 2])
    grown = np.where(cone, shape[:, 3] * u[:, 2], 0.0)  # of the radius factor with log m
    rows = np.zeros((len(part), SHAPE_NUMBERS))
    rows[:, 0] = n[:, 0] * local[:, 0]
    rows[:, 1] = n[:, 1] * local[:, 1]
    rows[:, 2] = grown * (n[:, 0] * shape[:, 0] * u[:, 0] + n[:, 1] * shape[:, 1] * u[:, 1])
    rows[:, 3] = n[:, 2] * local[:, 2]
    for axis in range(2):
        side = mirror if axis == 1 else 1.0
        tilt = n[:, 2] * local[:, axis] / length
        rows[:, 4 + axis] = side * ((1 - along) * n[:, axis] + tilt)
        rows[:, 6 + axis] = side * (along * n[:, axis] - tilt)
    result = np.zeros((len(part), len(groups), SHAPE_NUMBERS))
    column = np.array([groups.index(group_of(p.name)) for p in body.parts])[part]
    result[np.arange(len(part)), column] = rows
    return result.reshape(len(part), SHAPE_NUMBERS * len(groups))
