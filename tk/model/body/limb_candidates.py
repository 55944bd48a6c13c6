"""Candidate poses of a limb over its whole range of motion, for the limb search.

The candidates are spread evenly over the ranges of the limb's angles. Ankles stay at right angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cone_arrays import ConeArrays
from tk.model.body.cone_body import ConeBody
from tk.model.body.joints import CHAINS, JOINTS, LEANS, LIMBS
from tk.model.body.skeleton import Skeleton, distinct

Float = NDArray[np.float64]

# Two poses that have not settled are different if a joint's positions differ by more than this, metres.
DISTINCT_M = 0.12

# Candidates of a limb, spread evenly over the ranges of its angles.
SPREAD = 1024
# Gauss-Newton steps of exchanged limbs, and their damping, m²: angles that move joints by less than 3 cm a radian stay.
_EXCHANGE_STEPS, _EXCHANGE_DAMPING = 6, 0.03**2
# Standard deviation of the angles of candidates near the current pose.
_NEAR_DEG = 25.0


@dataclass(frozen=True, eq=False)
class Limb:
    """A limb of a body."""

    name: str  # of `LIMBS`
    skeleton: Skeleton
    dofs: NDArray[np.int64]  # (L,) its degrees of freedom
    parts: NDArray[np.int32]  # (K,) its parts
    rest: NDArray[np.int32]  # (P - K,) all other parts of the body
    still: NDArray[np.int32]  # all parts of the body that bending elbow or knee does not move
    arrays: ConeArrays  # the body for the kernels, with the contours of these parts only
    joints: list[int]  # elbow and wrist, or knee and ankle, as indices into the skeleton's joints
    grid: Float  # (N, L) candidates

    def candidates(self, pose: Float, near: int, rng: np.random.Generator) -> Float:
        """Return (B, D) copies of a pose with the limb in all candidates of the grid, and in ``near`` random ones."""
        turned = pose[self.dofs] + rng.normal(scale=np.radians(_NEAR_DEG), size=(near, len(self.dofs)))
        near_angles = np.clip(turned, self.skeleton.lower[self.dofs], self.skeleton.upper[self.dofs])
        angles = np.concatenate([self.grid, near_angles])
        result = np.repeat(pose[None], len(angles), axis=0)
        result[:, self.dofs] = angles
        return result

    def distinct(self, poses: Float, cost: Float, count: int) -> Float:
        """Return (C, D) the cheapest different poses of the limb (:data:`DISTINCT_M`), at most ``count``."""
        best = np.argsort(cost, kind="stable")
        best = best[np.isfinite(cost[best])]
        chosen = np.zeros(0, np.int64)
        for many in (5 * count, 20 * count):  # the cheapest are mostly neighbours of each other
            if len(chosen) < count:
                chosen = distinct(self.skeleton.joints(poses[best[:many]])[:, self.joints], DISTINCT_M, count)
        return np.asarray(poses[best[chosen]])


def limbs_of(body: ConeBody) -> tuple[Limb, ...]:
    """Return the limbs of a body."""
    skeleton, arrays = body.skeleton, body.arrays
    result = []
    for name in LIMBS:
        parts = np.array([part.segment in CHAINS[name] for part in body.parts])
        moved = np.array([part.segment in CHAINS[name][1:] for part in body.parts])
        dofs = np.flatnonzero(skeleton.chain_dofs(name))
        bent = ~skeleton.is_straight[dofs]
        grid = np.zeros((SPREAD, len(dofs)))
        grid[:, bent] = _spread(skeleton.lower[dofs[bent]], skeleton.upper[dofs[bent]])
        result.append(
            Limb(
                name=name,
                skeleton=skeleton,
                dofs=dofs,
                parts=np.flatnonzero(parts).astype(np.int32),
                rest=np.flatnonzero(~parts).astype(np.int32),
                still=np.flatnonzero(~moved).astype(np.int32),
                arrays=arrays._replace(curves=arrays.curves[parts[arrays.curves[:, 0]]]),
                joints=[JOINTS.index(joint) for joint in LIMBS[name][1:]],
                grid=grid,
            )
        )
    return tuple(result)


def pairs(limbs: Sequence[Limb]) -> list[tuple[Limb, ...]]:
    """Return the pairs of arms and of legs."""
    kinds = [[limb for limb in limbs if limb.name.startswith(kind)] for kind in ("arm", "leg")]
    return [tuple(pair) for pair in kinds if len(pair) == 2]


def exchanged_limbs(poses: Float, both: Sequence[tuple[Limb, ...]]) -> Float:
    """Return poses (N, ..., D), one for each of N pairs of limbs: poses (..., D) with their joints at each other's
    places as nearly as the limits allow.

    Their angles are exchanged, then corrected by damped Gauss-Newton steps, since the limbs begin at different joints.
    """
    together = poses.copy()
    for one, other in both:
        together[..., one.dofs], together[..., other.dofs] = poses[..., other.dofs], poses[..., one.dofs]
    together = _placed(together, both, both[0][0].skeleton.joints(poses))
    result = np.repeat(poses[None], len(both), axis=0)
    for found, pair in zip(result, both, strict=True):
        for limb in pair:
            found[..., limb.dofs] = together[..., limb.dofs]
    return result


def turned(pose: Float, limbs: Sequence[Limb]) -> Float:
    """Return a pose (D,) with the opposite heading: the trunk leans as before, and each limb is at the place of that of
    the other side, as nearly as the limits allow."""
    skeleton, both = limbs[0].skeleton, pairs(limbs)
    result = pose.copy()
    result[skeleton.index("torso_yaw")] += np.pi
    result[[skeleton.index(name) for name in LEANS]] *= -1.0
    for one, other in both:
        result[one.dofs], result[other.dofs] = pose[other.dofs], pose[one.dofs]
    return _placed(result, both, skeleton.joints(pose))


def _placed(poses: Float, both: Sequence[tuple[Limb, ...]], joints: Float) -> Float:
    """Return poses (..., D) whose joints of each pair are as near to each other's places among ``joints`` (..., J, 3)
    as the limits allow. Pairs do not depend on each other."""
    skeleton, result = both[0][0].skeleton, poses.copy()
    for _ in range(_EXCHANGE_STEPS):
        jacobian, present = skeleton.joint_jacobian(result), skeleton.joints(result)
        for one, other in both:
            dofs, moved = np.concatenate([one.dofs, other.dofs]), one.joints + other.joints
            J = jacobian[..., moved, :, :][..., dofs].reshape(*result.shape[:-1], -1, len(dofs))
            missing = (joints[..., other.joints + one.joints, :] - present[..., moved, :]).reshape(*J.shape[:-1], 1)
            across = J.swapaxes(-1, -2)
            step = np.linalg.solve(across @ J + _EXCHANGE_DAMPING * np.eye(len(dofs)), across @ missing)[..., 0]
            result[..., dofs] = np.clip(result[..., dofs] + step, skeleton.lower[dofs], skeleton.upper[dofs])
    return result


def _spread(lower: Float, upper: Float) -> Float:
    """Return (N, L) angles between limits (L,), radians, by the additive recurrence whose steps are powers of the
    generalised golden ratio (Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018)."""
    count = len(lower)
    golden = np.roots([1.0, *np.zeros(count - 1), -1.0, -1.0]).real.max()  # x^(L + 1) = x + 1
    steps = golden ** -np.arange(1.0, count + 1)
    return np.asarray(lower + (upper - lower) * (np.arange(1.0, SPREAD + 1)[:, None] * steps % 1.0))
