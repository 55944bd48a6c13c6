"""Fits the body to a standing person: pose and dimensions together (Kehl 2006, section 6.3).

The paper completes the skeleton from ratios and stops there. Here lengths and girths then follow the hull of a few
first frames, left and right alike, held to the ratios by a prior where the hull says little: where along a straight arm
the elbow lies cannot be seen. A surface point moves with the dimensions as eq. 1 says, in proportion to its piece's
radii.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from tk.kernels.nearest import SurfaceIndex
from tk.kernels.objective import ObjectiveSettings
from tk.model.anthropometry import BodyDimensions
from tk.model.body import Body, build_body, build_pieces
from tk.model.objective import BodyObjective, FrameObjective, SamplingConfig
from tk.model.skeleton import SEGMENTS, build_skeleton
from tk.model.superellipsoid import Superellipsoid

Float = NDArray[np.float64]

# Parameters of the fit: dimensions that share a factor, and the prior's standard deviation of its logarithm. Lengths of
# a stature scatter by some 4 % (NASA-STD-3000, vol. 1, sec. 3.3); an arm's or leg's two lengths keep their ratio
# better. So do a trunk's depth and width, by some 10 %: four cameras at the corners of a room see all but the sum of
# their squares.
GROUPS: tuple[tuple[tuple[str, ...], float], ...] = (
    (("trunk",), 0.03),
    (("head",), 0.06),
    (("shoulder_drop",), 0.15),
    (("shoulder_half_width",), 0.04),
    (("hip_half_width",), 0.02),
    (("upper_arm", "forearm"), 0.05),
    (("upper_arm",), 0.02),
    (("hand",), 0.15),
    (("thigh", "calf"), 0.03),
    (("thigh",), 0.02),
    (("chest_half_width", "chest_half_depth"), 0.15),
    (("chest_half_depth",), 0.1),
    (("hips_half_width", "hips_half_depth"), 0.15),
    (("hips_half_depth",), 0.1),
    (("head_radius",), 0.15),
    (("neck_radius",), 0.1),
    (("upper_arm_radius",), 0.2),
    (("elbow_radius",), 0.2),
    (("wrist_radius",), 0.2),
    (("thigh_radius",), 0.2),
    (("knee_radius",), 0.2),
    (("ankle_radius",), 0.2),
    (("foot",), 0.1),
)


# Standard deviation of a voxel's distance from the body, metres: what the prior is weighed against.
NOISE_M = 0.02
# How many neighbouring pairs count as one observation; voxels err together.
REDUNDANCY = 8.0
# Weight of a pair's distance along the surface beside that across it. Nearest neighbours hold a limb where it is along
# its axis; with little weight on that, the fit slides into place in a few rounds.
SLIDING = 0.03


@dataclass(frozen=True)
class FitConfig:
    """Settings of the fit.

    Attributes:
        rounds: times that pairs are found anew and pose and dimensions move.
    """

    rounds: int = 25


def apply_factors(dimensions: BodyDimensions, log_factors: Float) -> BodyDimensions:
    """Dimensions with each group of :data:`GROUPS` scaled by exp of its entry."""
    values = {f.name: getattr(dimensions, f.name) for f in fields(dimensions)}
    for (names, _), log_factor in zip(GROUPS, log_factors, strict=True):
        for name in names:
            values[name] *= float(np.exp(log_factor))
    return replace(dimensions, **values)


def fit_body(
    dimensions: BodyDimensions,
    poses: Float,
    frames: list[SurfaceIndex],
    up: str,
    settings: ObjectiveSettings,
    sampling: SamplingConfig,
    anchor: Float,
    config: FitConfig | None = None,
) -> tuple[BodyDimensions, Float]:
    """Pose and dimensions that explain several frames at once.

    Args:
        dimensions: the prior's mean and the start.
        poses: (F, D) start poses.
        frames: F frames' surface voxels.
        up: the world axis that points up.
        settings, sampling: of the objective.
        anchor: (D,) standard deviations of the start poses: what is known of them, radians and metres. Rotation about
            a straight limb and the bend of a knee that no camera resolves stay where they were put.

    Returns:
        The fitted dimensions and the poses (F, D).
    """
    config = config or FitConfig()
    G, F = len(GROUPS), len(frames)
    prior = np.array([1 / deviation**2 for _, deviation in GROUPS])
    log_factors = np.zeros(G)
    poses = np.array(poses, np.float64)
    start = poses.copy()
    D = poses.shape[1]
    for _ in range(config.rounds):
        now = apply_factors(dimensions, log_factors)
        body = build_body(now, up)
        objective = BodyObjective(body, settings, sampling)
        H = np.zeros((G + F * D, G + F * D))
        g = np.zeros(G + F * D)
        H[:G, :G] += np.diag(prior)
        g[:G] += prior * log_factors
        for f, index in enumerate(frames):
            A, r, w = _equations(objective, index, poses[f], dimensions, log_factors, up)
            weighted = A * w[:, None, None]
            own = np.r_[0:G, G + f * D : G + (f + 1) * D]
            H[np.ix_(own, own)] += np.einsum("kai,kaj->ij", A, weighted)
            g[own] += np.einsum("kai,ka->i", weighted, r)
        H[range(G, G + F * D), range(G, G + F * D)] += np.tile(1 / anchor**2, F)
        g[G:] += ((poses - start) / anchor**2).ravel()
        step = np.linalg.solve(H, -g)
        step[:G] = np.clip(step[:G], -0.1, 0.1)
        log_factors = np.clip(log_factors + step[:G], -0.6, 0.6)
        poses = body.skeleton.clip(poses + np.clip(step[G:].reshape(F, D), -0.2, 0.2))
        if np.abs(step).max() < 1e-3:
            break
    return apply_factors(dimensions, log_factors), poses


def _equations(
    objective: BodyObjective,
    index: SurfaceIndex,
    pose: Float,
    dimensions: BodyDimensions,
    log_factors: Float,
    up: str,
) -> tuple[Float, Float, Float]:
    """Linear equations of one frame: A (K, 3, G + D), residuals (K, 3), weights (K,)."""
    body = objective.body
    fit = FrameObjective(objective, index, np.random.default_rng(0), with_jacobian=True).fit(pose)
    M = len(fit.samples)
    Q = len(fit.linear.residual) - M  # none where the coverage term is off
    piece = np.concatenate([body.piece[fit.samples], fit.held.covering[0, :Q, 0].astype(np.int64)])
    x0 = np.concatenate([body.points[fit.samples], fit.held.covering[0, :Q, 1:]])
    keep = (fit.linear.partner >= 0) & (fit.linear.decay > 0.2)
    piece, x0 = piece[keep], x0[keep]
    # both terms see the same surfaces; together they should count as much as the voxels alone
    share = np.concatenate([np.full(M, len(fit.voxels) / max(M, 1)), np.ones(Q)])[keep] / (2 if Q else 1)
    weight = fit.linear.decay[keep] * share / NOISE_M**2 / REDUNDANCY

    here = _surface(apply_factors(dimensions, log_factors), piece, None, x0, pose, up)
    columns = []
    delta = 0.01
    for i in range(len(GROUPS)):
        moved = log_factors.copy()
        moved[i] += delta
        there = _surface(apply_factors(dimensions, moved), piece, body.pieces, x0, pose, up)
        columns.append((there - here) / delta)
    A = np.concatenate([np.stack(columns, axis=-1), fit.linear.jacobian[keep]], axis=2)
    # the square root of the metric n nᵀ + sliding · (I − n nᵀ)
    n = index.normals[fit.linear.partner[keep]].astype(np.float64)
    across = n[:, :, None] * n[:, None, :]
    root = across + np.sqrt(SLIDING) * (np.eye(3) - across)
    root[~n.any(axis=1)] = np.eye(3)
    return root @ A, np.einsum("kab,kb->ka", root, fit.linear.residual[keep]), weight


def _surface(
    dimensions: BodyDimensions,
    piece: NDArray[np.integer],
    old_pieces: tuple[Superellipsoid, ...] | None,
    x0: Float,
    pose: Float,
    up: str,
) -> Float:
    """(K, 3) world positions of surface points when the body has these dimensions.

    ``x0`` (K, 3) are the points in the zero configuration of a body whose pieces are ``old_pieces``; without those they
    are taken as they stand.
    """
    skeleton = build_skeleton(dimensions, up)
    pieces = build_pieces(dimensions)
    B = skeleton.T_world_body
    if old_pieces is not None:
        old_T = np.array([p.T_body_piece for p in old_pieces])[piece]
        new_T = np.array([p.T_body_piece for p in pieces])[piece]
        growth = [np.array(n.radii) / np.array(o.radii) for n, o in zip(pieces, old_pieces, strict=True)]
        q = np.einsum("kba,kb->ka", old_T[:, :3, :3], x0 @ B - old_T[:, :3, 3]) * np.array(growth)[piece]
        x0 = (np.einsum("kab,kb->ka", new_T[:, :3, :3], q) + new_T[:, :3, 3]) @ B.T
    segment = np.array([SEGMENTS.index(p.segment) for p in pieces])[piece]
    T = skeleton.segment_transforms(pose)[segment]
    return np.einsum("kab,kb->ka", T[:, :3, :3], x0) + T[:, :3, 3]


def fitted_body(dimensions: BodyDimensions, up: str) -> Body:
    """The body that tracking uses."""
    return build_body(dimensions, up)
