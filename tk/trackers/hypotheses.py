"""Poses that are tracked side by side until one of them is improbable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.model.body.skeleton import Skeleton

Float = NDArray[np.float64]

# A hypothesis is dropped if its probability is below 1e-3 of the best one's; nats. The prior of a pose that faces the
# other way than the person did in the frame before is as low.
DROPPED = float(np.log(1000.0))
# A pose that has not settled at the finest scale is not refined if it costs so much more than the present one, nats.
PROPOSED = 16.0
# Share of a hypothesis's running cost that a frame replaces.
RENEWAL = 0.4
# Poses whose joints all differ by less than this, metres, are one. (Before they settle: tk.model.body.limb_candidates.)
SAME_POSE_M = 0.05
# Prior of a person who moves forwards rather than backwards, nats, and the way, metres, of which the half shows it.
FORWARDS, WAY_M = 3.0, 0.5


@dataclass(frozen=True)
class Hypothesis:
    """A pose that is tracked.

    Attributes:
        pose, previous: (D,) in this frame and the one before.
        cost: running mean of its cost, nats. Only differences between hypotheses have a meaning: what a frame shows
            changes the costs of all of them.
        jumped: whether a limb search has just found it. ``previous`` is then that of the pose it replaces, so that the
            two may differ by a fast motion or by a jump.
    """

    pose: Float
    previous: Float
    cost: float
    jumped: bool = False


class TrajectoryHypothesis(NamedTuple):
    """Poses that may explain the opening.

    Attributes:
        poses: (F, D).
        cost: negative logarithm of their posterior, mean over the frames, nats.
    """

    poses: Float
    cost: float


def renewed(alive: Sequence[Hypothesis], poses: Float, costs: Float) -> list[Hypothesis]:
    """Return hypotheses at their poses (H, D) in the next frame, which have costs (H,), nats."""
    return [
        Hypothesis(pose, h.pose, h.cost + RENEWAL * float(cost - h.cost))
        for h, pose, cost in zip(alive, poses, costs, strict=True)
    ]


def disagreement(skeleton: Skeleton, poses: Float, cost: Float) -> Float:
    """Return (J,) variance of the joints' positions along an axis, metres², about the likeliest of poses (H, D) with
    costs (H,), nats."""
    weight = np.exp(cost.min() - cost)
    weight /= weight.sum()
    joints = skeleton.joints(poses)
    return np.asarray(np.einsum("h,hja->j", weight, (joints - joints[cost.argmin()]) ** 2) / 3)


def turning(skeleton: Skeleton, poses: Float, before: Float) -> Float:
    """Return (B,) the negative logarithm of the prior of the headings of poses (B, D) after a pose (D,), nats."""
    yaw = skeleton.index("torso_yaw")
    return np.asarray(DROPPED * (1.0 - np.cos(poses[:, yaw] - before[yaw])) / 2.0)


def walking(skeleton: Skeleton, poses: Float) -> Float:
    """Return (...) the negative logarithm of the prior of trajectories (..., F, D), nats: people walk forwards."""
    yaw = poses[..., skeleton.index("torso_yaw")]
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    along = (np.diff(poses[..., :2], axis=-2) * (ahead[..., 1:, :] + ahead[..., :-1, :])).sum(axis=-1) / 2.0
    return np.asarray(-FORWARDS / 2.0 * along.sum(axis=-1) / (np.abs(along).sum(axis=-1) + WAY_M))
