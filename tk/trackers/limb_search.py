"""Limb search: better poses of the limbs of one person in one frame, wherever in their range the limbs are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from tk.kernels.raycast import Cast
from tk.model.body.cone_body import ConeBody
from tk.model.body.limb_candidates import Limb, exchanged, pairs
from tk.model.cues.ray_costs import Evidence

Float = NDArray[np.float64]

# Candidates of a limb that are refined; of a limb that is known to be misplaced; random candidates near its pose that
# are screened beside the grid. With 3 and 8 refined candidates half as many more of the misplaced limbs stay misplaced
# (scripts/search_recall.py).
CANDIDATES, MORE_CANDIDATES, NEARBY = 8, 16, 80
# Screening stops at a candidate of which this share lies outside the silhouettes. With 0.2 and 0.8 the mean errors
# of dance and cube (60 frames) change by less than 0.05 cm.
OUTSIDE = 0.4
# A candidate is not refined if it costs so much more than the current pose, nats; after the limb alone has converged,
# it is dropped if it costs so much more. With four views this is half of a cost of 0.13, and 0.01, as chosen before.
PROPOSED, PROMISING = 16.0, 2.5
# Poses that a search returns, at most, to be refined with all limbs.
FINISHED = 2
# Poses that differ by more than this, mean over the joints, metres, are different.
SAME_POSE_M = 0.05


#: minimises from poses (B, D) in a frame at some scales, and returns the poses reached; with a limb, only that moves
Settle = Callable[[Float, Sequence[int], Limb | None], Float]


class LimbSearch:
    """The search around a pose (D,) of a body with limbs, given the frame's costs on a coarse grid.

    Attributes:
        own: the cost of the pose, nats.
    """

    def __init__(self, body: ConeBody, limbs: Sequence[Limb], evidence: Evidence, settle: Settle, pose: Float) -> None:
        self._body, self._limbs, self._evidence, self._settle, self._pose = body, limbs, evidence, settle, pose
        self._joints = body.skeleton.joints(pose)
        cost, met = evidence.cast(body, pose[None])
        self._rays, self._surplus = cost[0], evidence.surplus(met.label[0])
        self.own = float(evidence.nats(cost, pose[None])[0])

    def better(self, level: int, misplaced: Sequence[Limb], rng: np.random.Generator) -> Float:
        """Return the cheapest poses (B, D) that may be better than the current one: exchanged arms and legs, the best
        poses of each limb, and combinations of two limbs.

        Where each of two limbs has taken the other's place, neither finds its own as long as the other stays.

        Args:
            level: the scale at which limbs settle.
            misplaced: limbs that are known to be misplaced.
        """
        moved = [(limb.dofs, self._moved(limb, level, limb in misplaced, rng)) for limb in self._limbs]
        found = [(dofs, poses) for dofs, poses in moved if len(poses)]
        swaps = self._settle(exchanged(self._pose, pairs(self._limbs)), (level, 0), None)
        swaps = swaps[self._evidence.score(self._body, swaps) < self.own + PROMISING]
        poses = [*swaps, *(one for _, some in found for one in some)]
        for i, (_, first) in enumerate(found):
            for dofs, second in found[i + 1 :]:
                both = first[0].copy()
                both[dofs] = second[0][dofs]
                poses.append(both)
        if not poses:
            return np.empty((0, len(self._pose)))
        cost = self._evidence.score(self._body, np.array(poses))
        return np.array(poses)[np.argsort(cost, kind="stable")[:FINISHED]]

    def _moved(self, limb: Limb, level: int, misplaced: bool, rng: np.random.Generator) -> Float:
        """Return at most two poses (B, D) with a limb elsewhere: rays screen all its candidates in one launch, and the
        limb alone settles from the best ones."""
        body, evidence, pose = self._body, self._evidence, self._pose
        without, rest = evidence.cast(body, pose[None], limb.rest)
        if not misplaced and without[0] - self._rays > self._surplus:
            return np.empty((0, len(pose)))  # the limb covers more than the surplus area that it could cover elsewhere
        before = Cast(rest.label[0].copy(), rest.depth[0].copy())
        tried = limb.candidates(pose, NEARBY, rng)
        cost = evidence.score(body, tried, limb.parts, before, most_outside=OUTSIDE)
        cost[cost > self.own + PROPOSED] = np.inf
        chosen = limb.distinct(tried, cost, MORE_CANDIDATES if misplaced else CANDIDATES)
        if not len(chosen):
            return chosen
        settled = self._settle(chosen, (level,), limb)
        cost = evidence.score(body, settled, limb.parts, before)
        order = np.argsort(cost, kind="stable")
        settled, cost = settled[order], cost[order]
        other = body.skeleton.apart(settled, self._joints) > SAME_POSE_M
        return np.asarray(settled[(cost < self.own + PROMISING) & other][:2])
