"""Adapts a cone body to observed silhouettes (the silhouette paper's future work): its dimensions, then its shapes.

Gauss-Newton on the poses of several frames and shared parameters of the body at once: first the logarithms of the
dimensions; then, with the skeleton as it is, each part's own cross-sections and where they lie about its bone, which no
table of proportions knows. An edgel's row by a
dimension is n·Jπ·∂x/∂δ at the material point x of the contour, as it is by a degree of freedom: along an occluding
contour the surface slides in the image's tangent only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.kernels.silhouette import Edgels, SearchSettings
from tk.model.anthropometry import BodyDimensions
from tk.model.cone_body import SHAPE_NUMBERS, ConeBody, build_cone_body
from tk.model.silhouettes import Pyramid, Views

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

# One standard deviation of what changes a part, see ConeBody.reshaped: logarithms of a, b, m and h about what the
# dimensions make them, and metres off the bone along x and y, where the axis begins and where it ends. Parts between
# joints keep their lengths; what ends a limb has no joint behind it, so its length and direction are open. Half a
# centimetre for flesh about a limb's bone was chosen with the joints of the treadmill capture in view.
_FIXED = 1e-6
_LIMB = (0.15, 0.15, 0.15, _FIXED, 0.005, 0.005, 0.005, 0.005)
_TRUNK = (0.15, 0.15, 0.15, _FIXED, 0.01, _FIXED, 0.01, _FIXED)
_SHAPES = {
    "hand_": (0.15, 0.15, 0.15, 0.1, 0.005, 0.005, 0.02, 0.01),
    "foot_": (0.15, 0.15, 0.15, 0.1, 0.005, 0.005, 0.02, 0.01),
    "head": (0.15, 0.15, 0.15, 0.1, 0.005, _FIXED, 0.02, _FIXED),
}

# Step of the differences by a parameter.
_STEP = 1e-4


@dataclass(frozen=True)
class ConeFitConfig:
    """Settings.

    Attributes:
        frames: most frames that are used, evenly spaced.
        rounds: Gauss-Newton iterations.
        edge_noise_px: standard deviation of an edgel. Besides ragged masks it stands for shapes that no cone has, which
            err alike in all frames: too small a value bends lengths to make up for shapes.
        shapes: whether each part's own shape is adapted after the dimensions.
        shape_noise_px: edge_noise_px while shapes are adapted: what is left of it once they suit.
        correlation_px: along a contour this many pixels err together; edgels within them count as one.
        stature_deviation: of the logarithm of the stature about the given one.
        pose_deviation: of a degree of freedom, radians or metres, while shapes are adapted. A head that leans and a
            neck that bends look alike: the joints were found with the average shapes, and shapes make up for the rest.
    """

    frames: int = 16
    rounds: int = 4
    edge_noise_px: float = 6.0
    shapes: bool = True
    shape_noise_px: float = 2.0
    correlation_px: float = 10.0
    stature_deviation: float = 0.01
    pose_deviation: float = 0.03

    def __post_init__(self) -> None:
        if self.frames < 1 or self.rounds < 0:
            raise ConfigError(f"cone fit: frames = {self.frames} must be at least 1, rounds = {self.rounds} at least 0")
        for name in ("edge_noise_px", "shape_noise_px", "correlation_px", "stature_deviation", "pose_deviation"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"cone fit: {name} = {getattr(self, name)} must be positive")


def fit_dimensions(
    body: ConeBody,
    views: Views,
    pyramids: Sequence[Pyramid],
    poses: Float,
    up: str,
    settings: SearchSettings,
    stature_m: float | None,
    config: ConeFitConfig | None = None,
) -> tuple[ConeBody, Float]:
    """Dimensions that suit several frames, with their poses.

    Args:
        body: the body to start from; its dimensions are the prior's mean.
        views: the cameras.
        pyramids: F frames' silhouettes.
        poses: (F, D) their poses, close enough for the search to find the right edges.
        up: the world axis that points up.
        settings: of the search.
        stature_m: the subject's height, if known.
        config: see :class:`ConeFitConfig`.

    Returns:
        The body, and poses (F, D).
    """
    config = config or ConeFitConfig()
    names = [field.name for field in fields(BodyDimensions)]
    extra = None
    if stature_m is not None:
        # with shoes, as the proportions have it
        nominal = BodyDimensions.from_stature(stature_m).stature

        def extra(log: Float) -> tuple[Float, float]:
            d = _dimensions(log)
            row = np.array([_stature_rate(d, name) for name in names]) / config.stature_deviation
            return row, float(np.log(nominal / d.stature)) / config.stature_deviation

    problem = _Problem(
        build=lambda log: build_cone_body(_dimensions(log), up, body.preset),
        mean=_log(body.dimensions),
        deviation=np.array([_LENGTHS.get(name, _RADII) for name in names]),
        extra=extra,
    )
    log, poses = _adapt(problem, views, pyramids, poses, settings, config.edge_noise_px, config)
    return problem.build(log), poses


def fit_shapes(
    body: ConeBody,
    views: Views,
    pyramids: Sequence[Pyramid],
    poses: Float,
    settings: SearchSettings,
    config: ConeFitConfig | None = None,
) -> tuple[ConeBody, Float]:
    """Cross-sections of the parts that suit several frames, with their poses; arguments as for :func:`fit_dimensions`.

    The skeleton stays: only :meth:`~tk.model.cone_body.ConeBody.reshaped` is used. Left and right are alike.
    """
    config = config or ConeFitConfig()
    groups = body.shape_groups
    # what lies in the middle is symmetric
    deviation = np.array([_SHAPES.get(name, _LIMB if name.endswith("_") else _TRUNK) for name in groups])
    problem = _Problem(
        build=lambda change: body.reshaped(change.reshape(len(groups), SHAPE_NUMBERS)),
        mean=np.zeros(deviation.size),
        deviation=deviation.ravel(),
    )
    change, poses = _adapt(
        problem, views, pyramids, poses, settings, config.shape_noise_px, config, config.pose_deviation
    )
    return problem.build(change), poses


class Neighbours(NamedTuple):
    """Bodies with one parameter a little larger and a little smaller.

    ``moved`` (P,) says which parts have another shape or place about their bone.
    """

    larger: ConeBody
    smaller: ConeBody
    moved: NDArray[np.bool_]


def neighbours(larger: ConeBody, smaller: ConeBody) -> Neighbours:
    """Two bodies, compared part by part."""
    moved = [
        a.shape != b.shape or not np.array_equal(a.T_body_part, b.T_body_part)
        for a, b in zip(larger.parts, smaller.parts, strict=True)
    ]
    return Neighbours(larger, smaller, np.array(moved))


@dataclass(frozen=True)
class _Problem:
    """A family of bodies with K parameters.

    Attributes:
        build: the body with these parameters.
        mean, deviation: (K,) of the normal prior; a descent starts from the mean.
        extra: one more residual at some parameters, in standard deviations: its derivative (K,) and what it lacks.
    """

    build: Callable[[Float], ConeBody]
    mean: Float
    deviation: Float
    extra: Callable[[Float], tuple[Float, float]] | None = None

    def neighbours(self, here: Float) -> list[Neighbours]:
        """(K) bodies with each parameter a little larger and a little smaller."""
        steps = _STEP * np.eye(len(here))
        return [neighbours(self.build(here + step), self.build(here - step)) for step in steps]


def _adapt(
    problem: _Problem,
    views: Views,
    pyramids: Sequence[Pyramid],
    poses: Float,
    settings: SearchSettings,
    noise_px: float,
    config: ConeFitConfig,
    pose_deviation: float = np.inf,
) -> tuple[Float, Float]:
    """Gauss-Newton on the parameters (K,) and the poses (F, D), the latter held near their start."""
    shared = problem.mean.copy()
    poses = np.array(poses)
    start = poses.copy()
    F, D, K = len(poses), poses.shape[1], len(shared)
    # information of one pixel of contour
    information = 1.0 / (noise_px**2 * config.correlation_px)
    shape = slice(F * D, F * D + K)
    for _ in range(config.rounds):
        here = problem.build(shared)
        free = np.flatnonzero(here.free)
        pairs = problem.neighbours(shared)
        H = np.zeros((F * D + K, F * D + K))
        g = np.zeros(F * D + K)
        for f in range(F):
            edgels = views.edgels(here, pyramids[f], poses[f], 0, settings)
            rows = np.hstack([pose_rows(here, poses[f], edgels), parameter_rows(pairs, poses[f], edgels)])
            weight = edgels.weight * information
            A = rows.T @ (weight[:, None] * rows)
            y = rows.T @ (weight * edgels.distance)
            at = slice(f * D, (f + 1) * D)
            H[at, at] += A[:D, :D]
            H[at, shape] += A[:D, D:]
            H[shape, at] += A[D:, :D]
            H[shape, shape] += A[D:, D:]
            g[at] += y[:D]
            g[shape] += y[D:]
            # joints that the silhouettes leave open stay; those beyond a limit are pulled back
            excess = here.skeleton.clip(poses[f]) - poses[f]
            stay = np.where(excess != 0, 1e3, 10.0)
            H[at, at] += np.diag(stay) + pose_deviation**-2 * np.eye(D)
            g[at] += (start[f] - poses[f]) * pose_deviation**-2
            g[at] += np.where(excess != 0, stay * excess, 0.0)
        H[shape, shape] += np.diag(problem.deviation**-2)
        g[shape] += (problem.mean - shared) / problem.deviation**2
        if problem.extra is not None:
            row, lack = problem.extra(shared)
            H[shape, shape] += np.outer(row, row)
            g[shape] += row * lack
        chosen = np.concatenate([*(f * D + free for f in range(F)), F * D + np.arange(K)])
        delta = np.zeros(len(g))
        delta[chosen] = np.linalg.solve(H[np.ix_(chosen, chosen)], g[chosen])
        poses += np.clip(delta[: F * D].reshape(F, D), -0.3, 0.3)
        shared += np.clip(delta[shape], -0.1, 0.1)
    return shared, poses


def pose_rows(body: ConeBody, pose: Float, edgels: Edgels) -> Float:
    """(N, D) derivative of the contour's position along its normal by the pose, pixels."""
    s = body.skeleton
    w, v = s.twists(pose)
    x = body.place(pose, edgels.part, edgels.unscaled)
    moved = body.pack(np.float64).chain[edgels.part]
    rows = np.zeros((len(x), len(s.names)))
    for k in range(len(s.names)):
        below = (moved == k).any(axis=1)
        rows[below, k] = np.einsum("na,na->n", edgels.row[below], np.cross(w[k], x[below]) + v[k])
    return rows


def parameter_rows(pairs: Sequence[Neighbours], pose: Float, edgels: Edgels) -> Float:
    """(N, K) the same by shared parameters, by central differences of the surface points.

    Two bodies that share a skeleton differ in a few parts; only edgels on those are looked at.
    """
    rows = np.zeros((len(edgels.part), len(pairs)))
    shared, segments = None, None
    for k, (larger, smaller, moved) in enumerate(pairs):
        chosen = np.arange(len(edgels.part))
        if larger.skeleton is smaller.skeleton:
            if larger.skeleton is not shared:
                shared, segments = larger.skeleton, larger.skeleton.segment_transforms(pose)
            chosen = np.flatnonzero(moved[edgels.part])
        part, unscaled = edgels.part[chosen], edgels.unscaled[chosen]
        same = larger.skeleton is shared
        ends = [body.place(pose, part, unscaled, segments if same else None) for body in (larger, smaller)]
        rows[chosen, k] = np.einsum("na,na->n", edgels.row[chosen], ends[0] - ends[1]) / (2 * _STEP)
    return rows


def dimension_neighbours(body: ConeBody, up: str) -> list[Neighbours]:
    """(K) bodies with each dimension a little larger and a little smaller: what :func:`parameter_rows` differs."""
    log = _log(body.dimensions)
    problem = _Problem(lambda x: build_cone_body(_dimensions(x), up, body.preset), log, np.ones(len(log)))
    return problem.neighbours(log)


def _log(dimensions: BodyDimensions) -> Float:
    return np.log([getattr(dimensions, field.name) for field in fields(BodyDimensions)])


def _dimensions(log: Float) -> BodyDimensions:
    values = np.exp(log)
    return BodyDimensions(**{f.name: float(v) for f, v in zip(fields(BodyDimensions), values, strict=True)})


def _stature_rate(d: BodyDimensions, name: str) -> float:
    """d log stature / d log dimension."""
    return getattr(d, name) / d.stature if name in ("head", "trunk", "thigh", "calf", "ankle_height") else 0.0
