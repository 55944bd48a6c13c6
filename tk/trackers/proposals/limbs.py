"""The limbs elsewhere in their range: rays screen all candidates of a limb, and the best ones settle.

What a limb's candidates converge to are the modes of its posterior. The best of them are proposed; all of them tell
how much the frame leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.raycast import Cast
from tk.model.body.limb_candidates import Limb
from tk.model.body.skeleton import JOINTS, Skeleton, distinct
from tk.trackers.hypotheses import DROPPED, PROPOSED, SAME_POSE_M

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]

# Candidates of a limb that are refined, and modes that are kept for the second pass, at most; candidates of a limb that
# is known to be misplaced; random candidates near its pose that are screened beside the grid.
CANDIDATES, MORE_CANDIDATES, NEARBY = 8, 32, 80
# Screening stops at a candidate of which this share lies outside the silhouettes.
OUTSIDE = 0.4
# Poses that are proposed, at most.
FINISHED = 2


class Modes(NamedTuple):
    """Poses of one limb that may be right, in a frame in which the rest of the body has a pose.

    Attributes:
        limb: the limb.
        poses: (B, D), the cheapest first, all different from the present pose.
        cost: (B,) by how much they cost more than the present pose, nats.
    """

    limb: Limb
    poses: Float
    cost: Float


def modes(finder: ContourFinder, seen: Seen, pose: Float, misplaced: Sequence[Limb] = ()) -> list[Modes]:
    """Return the poses of each limb that are not improbable beside a present pose (D,).

    Args:
        finder, seen: the tracker, and what the frame shows.
        pose: the present pose.
        misplaced: limbs that are known to be misplaced, or of which nothing is known.
    """
    body, evidence = finder.body, seen.evidence
    skeleton = body.skeleton
    rng = np.random.default_rng([7, seen.frame.index, finder.seed])
    mismatch, met = evidence.cast(body, pose[None])
    own, surplus = float(evidence.cost_of(mismatch, pose[None])[0]), evidence.surplus(met.label[0])
    joints = skeleton.joints(pose)
    found = []
    for limb in finder.limbs:
        if limb not in misplaced and evidence.cast(body, pose[None], limb.still)[0][0] - mismatch[0] > surplus:
            continue  # what is beyond elbow or knee covers more than the surplus area that it could cover elsewhere
        _, rest = evidence.cast(body, pose[None], limb.rest)
        before = Cast(rest.label[0].copy(), rest.depth[0].copy())
        tried = limb.candidates(pose, NEARBY, rng)
        screened = evidence.cost(body, tried, limb.parts, before, most_outside=OUTSIDE)
        screened[screened > own + PROPOSED] = np.inf
        chosen = limb.distinct(tried, screened, MORE_CANDIDATES if limb in misplaced else CANDIDATES)
        if not len(chosen):
            continue
        settled = finder.settle(seen.pyramid, chosen, (finder.search_level,), seen.images, limb=limb).states
        more = evidence.cost(body, settled, limb.parts, before) - own
        kept = np.argsort(more, kind="stable")
        kept = kept[(more[kept] < DROPPED) & (skeleton.apart(settled[kept], joints) > SAME_POSE_M)]
        found.append(Modes(limb, settled[kept], more[kept]))
    return found


def weighed(finder: ContourFinder, seen: Seen, pose: Float, found: Sequence[Modes]) -> list[Modes]:
    """Return modes, arguments as for :func:`propose`, with their costs by what a frame shows now."""
    own, result = seen.evidence.cost(finder.body, pose[None])[0], []
    for one in found:
        more = seen.evidence.cost(finder.body, one.poses) - own
        kept = np.argsort(more, kind="stable")
        kept = kept[more[kept] < DROPPED]
        result.append(Modes(one.limb, one.poses[kept], more[kept]))
    return result


def propose(finder: ContourFinder, seen: Seen, pose: Float, found: Sequence[Modes]) -> Float:
    """Return the cheapest (B, D) of the best modes of each limb, and of combinations of two limbs.

    Where each of two limbs has taken the other's place, neither finds its own as long as the other stays.

    Args:
        finder, seen, pose, found: as for, and from, :func:`modes`.
    """
    alone = [(one.limb.dofs, one.poses[:2]) for one in found if len(one.poses)]
    result = [one for _, poses in alone for one in poses]
    for i, (_, first) in enumerate(alone):
        for dofs, second in alone[i + 1 :]:
            both = first[0].copy()
            both[dofs] = second[0][dofs]
            result.append(both)
    poses = np.array(result).reshape(-1, len(pose))
    return poses[np.argsort(seen.evidence.cost(finder.body, poses), kind="stable")[:FINISHED]] if result else poses


def others(pose: Float, before: Float, found: Sequence[Modes]) -> Float:
    """Return (CANDIDATES, D) other poses of the limbs that a frame leaves open, as angles in the columns of each limb,
    the cheapest first; NaN without one.

    Args:
        pose, before, found: as for :func:`spread`.
    """
    result = np.full((CANDIDATES, len(pose)), np.nan)
    for one in found:
        limb, skeleton = one.limb, one.limb.skeleton
        poses = np.repeat(pose[None], 1 + len(one.poses), axis=0)
        poses[:, limb.dofs] = np.concatenate([before[None], one.poses])[:, limb.dofs]
        differ = skeleton.apart(poses, skeleton.joints(pose)) > SAME_POSE_M
        kept = limb.distinct(poses, np.where(differ, np.append(0.0, one.cost), np.inf), CANDIDATES)
        result[: len(kept), limb.dofs] = kept[:, limb.dofs]
    return result


def spread(skeleton: Skeleton, pose: Float, before: Float, found: Sequence[Modes]) -> Float:
    """Return (J,) variance of the joints' positions along an axis, metres², about a pose (D,), over the modes of each
    limb.

    Args:
        skeleton: of D degrees of freedom.
        pose: the pose that was chosen.
        before: (D,) the pose for which the modes were found, one of them.
        found: candidates that converge to the same pose count once.
    """
    joints, variance = skeleton.joints(pose), np.zeros(len(JOINTS))
    for one in found:
        limb = np.concatenate([before[None], one.poses])[:, one.limb.dofs]
        poses = np.repeat(pose[None], len(limb), axis=0)
        poses[:, one.limb.dofs] = limb
        kept = distinct(skeleton.joints(poses), SAME_POSE_M)
        cost = np.append(0.0, one.cost)[kept]
        weight = np.exp(cost.min() - cost)  # of a person who was elsewhere, a mode may be a thousand nats likelier
        away = ((skeleton.joints(poses[kept]) - joints) ** 2).sum(axis=-1) / 3
        variance += weight @ away / weight.sum()
    return variance
