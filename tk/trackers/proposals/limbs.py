"""The limbs elsewhere in their range: rays screen all candidates of a limb, and the best ones settle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.kernels.raycast import Cast
from tk.model.body.limb_candidates import Limb
from tk.trackers.hypotheses import PROPOSED, SAME_POSE_M

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]

# Candidates of a limb that are refined; of a limb that is known to be misplaced; random candidates near its pose that
# are screened beside the grid. With 3 and 8 refined candidates half as many more of the misplaced limbs stay misplaced
# (scripts/search_recall.py).
CANDIDATES, MORE_CANDIDATES, NEARBY = 8, 16, 80
# Screening stops at a candidate of which this share lies outside the silhouettes. With 0.2 and 0.8 the mean errors
# of dance and cube (60 frames) change by less than 0.05 cm.
OUTSIDE = 0.4
# A candidate is dropped if it costs so much more than the current pose after the limb alone has converged, nats. With
# four views this is a cost of 0.01, as chosen before.
PROMISING = 2.5
# Poses that are proposed, at most.
FINISHED = 2


def propose(finder: ContourFinder, seen: Seen, pose: Float, misplaced: Sequence[Limb] = ()) -> Float:
    """Return the cheapest (B, D) of the best poses of each limb, and of combinations of two limbs.

    Where each of two limbs has taken the other's place, neither finds its own as long as the other stays.

    Args:
        finder, seen: the tracker, and what the frame shows.
        pose: (D,) the present pose.
        misplaced: limbs that are known to be misplaced.
    """
    body, evidence = finder.body, seen.evidence
    rng = np.random.default_rng([7, seen.frame.index, finder.seed])
    cost, met = evidence.cast(body, pose[None])
    own, surplus = float(evidence.nats(cost, pose[None])[0]), evidence.surplus(met.label[0])
    joints = body.skeleton.joints(pose)

    def moved(limb: Limb) -> Float:
        """Return at most two poses (B, D) with a limb elsewhere."""
        without, rest = evidence.cast(body, pose[None], limb.rest)
        if limb not in misplaced and without[0] - cost[0] > surplus:
            return np.empty((0, len(pose)))  # the limb covers more than the surplus area that it could cover elsewhere
        before = Cast(rest.label[0].copy(), rest.depth[0].copy())
        tried = limb.candidates(pose, NEARBY, rng)
        screened = evidence.score(body, tried, limb.parts, before, most_outside=OUTSIDE)
        screened[screened > own + PROPOSED] = np.inf
        chosen = limb.distinct(tried, screened, MORE_CANDIDATES if limb in misplaced else CANDIDATES)
        if not len(chosen):
            return chosen
        settled = finder.settle(seen.pyramid, chosen, (finder.search_level,), seen.images, limb=limb).states
        found = evidence.score(body, settled, limb.parts, before)
        order = np.argsort(found, kind="stable")
        settled, found = settled[order], found[order]
        other = body.skeleton.apart(settled, joints) > SAME_POSE_M
        return np.asarray(settled[(found < own + PROMISING) & other][:2])

    alone = [(limb.dofs, poses) for limb in finder.limbs if len(poses := moved(limb))]
    result = [one for _, poses in alone for one in poses]
    for i, (_, first) in enumerate(alone):
        for dofs, second in alone[i + 1 :]:
            both = first[0].copy()
            both[dofs] = second[0][dofs]
            result.append(both)
    poses = np.array(result).reshape(-1, len(pose))
    return poses[np.argsort(evidence.score(body, poses), kind="stable")[:FINISHED]] if len(poses) else poses
