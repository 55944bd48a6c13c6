"""Poses that are tracked side by side until one of them costs more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.skeleton import Skeleton

Float = NDArray[np.float64]

# Frames during which a hypothesis is tracked beside the best one, and the share of its running cost that a frame
# replaces. A hypothesis is dropped if its probability is e^-DROPPED of the best one's. Half and twice of each change
# the mean errors of dance and cube (50 frames) by less than 0.1 cm.
PATIENCE, RENEWAL, DROPPED = 6, 0.4, 5.0


@dataclass(frozen=True)
class Hypothesis:
    """A pose that is tracked.

    Attributes:
        pose, previous: (D,) in this frame and the one before.
        cost: running mean of its cost, nats.
        age: frames since it was proposed.
        jumped: whether a limb search has just found it. ``previous`` is then that of the pose it replaces, so that the
            two may differ by a fast motion or by a jump.
    """

    pose: Float
    previous: Float
    cost: float
    age: int = 0
    jumped: bool = False


def disagreement(skeleton: Skeleton, poses: Float, cost: Float) -> Float:
    """Return (J,) variance of the joints' positions along an axis, metres², over poses (H, D) with costs (H,), nats."""
    weight = np.exp(cost.min() - cost)
    weight /= weight.sum()
    joints = skeleton.joints(poses)
    mean = np.einsum("h,hja->ja", weight, joints)
    return np.asarray(np.einsum("h,hja->j", weight, (joints - mean) ** 2) / 3)
