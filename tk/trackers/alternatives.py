"""Other poses of the body and its limbs, tracked through a recording beside the present ones, and which are likeliest.

The first pass may have misplaced an arm, exchanged the legs, or taken the back for the front, for a while. So other
poses are tracked through the whole recording, forwards and backwards. They begin at the prediction from the
neighbouring frames, at the exchanged legs, or at what the limb searches of the first pass have found. A hidden Markov
model gives their probabilities in each frame, from the costs in all frames and the changes of the joints' velocities
(Rabiner, Proc. IEEE, 1989). The pose becomes the likeliest one, and σ includes the distances of all others from it.

All poses of the body are the states of one model; then all poses of each limb are. If only the present and one other
pose were compared at a time, a pose that has been replaced would be lost, although it may continue another one.

Neighbouring frames say nearly the same as long as nobody moves. So only some frames are compared: two neighbouring ones
of these say together no more than one independent frame (:func:`apart`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.model.body.limb_candidates import Limb, exchanged_limbs
from tk.model.body.skeleton import JOINTS, blocks
from tk.model.cues.ray_costs import Evidence
from tk.model.masks.silhouettes import Pyramid
from tk.trackers.hypotheses import DROPPED, RENEWAL, SAME_POSE_M

if TYPE_CHECKING:
    from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]

# How far a pose of the second pass may be from its start, degrees, and frames that are optimised in one launch.
NEAR_DEG, AT_ONCE = 15.0, 16
# Scale at which other poses are optimised.
SCALE = 1
# Frames are compared if they say at least this share of an independent frame; errors with and without it differ by
# 0.03 cm at most (docs/experiments.md, Running time).
APART = 0.5
# People keep their velocity: VELOCITY times a step predicts the next one best (docs/experiments.md, Second pass; the
# first pass, whose poses are less exact, predicts less), and the negative logarithm of a step's probability is the
# distance to this prediction, of the joint that is farthest from it, divided by CHANGE_M.
VELOCITY, CHANGE_M = 0.8, SAME_POSE_M


@dataclass(frozen=True)
class Alternative:
    """Another pose of some limbs.

    Attributes:
        dofs: the degrees of freedom in which it differs.
        limb: if they are a limb's, only this limb moves.
        begins: (K, D) the poses at which it begins in each frame, NaN where it does not; None: at the prediction from
            the neighbouring frames.
        moves: whether a pose at which it begins shows where it was in the frame before, and so its velocity.
    """

    dofs: NDArray[np.int64]
    limb: Limb | None = None
    begins: Float | None = None
    moves: bool = True

    def begins_anew(self, frame: int) -> bool:
        """Return whether it begins in a frame even if it is tracked: a search of this frame has found it."""
        return not self.moves and self.begins is not None and bool(np.isfinite(self.begins[frame, self.dofs]).all())


class Tracks(NamedTuple):
    """A alternatives, tracked through K frames in one direction.

    Attributes:
        poses: (A, K, D).
        found: (A, K) whether an alternative differs from the pose that was the present one, and is not improbable.
        cost: (A, K) by how much it costs more than that pose, nats; 0 where it is not found.
    """

    poses: Float
    found: NDArray[np.bool_]
    cost: Float


class Choice:
    """The choice between poses in K frames. Poses are in the tracker's own world.

    Args:
        tracker: with the person's body.
        shown, evidence: two scales of what a frame shows, and its costs, by its place among the K; they keep what they
            return, because a frame's are asked for many times.
        frames: (K,) their numbers, ascending.
        follows: (K - 1,) whether the person was tracked in all frames between two neighbouring ones.
        poses: (K, D) the present ones.
        share: (K,) of an independent frame that each says.
        advance: receives the parts of a comparison that are done; the body is compared, and each limb.

    Attributes:
        poses: (K, D) the likeliest ones.
        variance: (K, J) of the joints' positions along an axis, metres², that the choice leaves open.
    """

    def __init__(
        self,
        tracker: RegionTracker,
        shown: Callable[[int], Pyramid],
        evidence: Callable[[int], Evidence],
        frames: NDArray[np.int64],
        follows: NDArray[np.bool_],
        poses: Float,
        share: Float,
        advance: Callable[[float], None],
    ) -> None:
        self.tracker, self.poses, self.variance = tracker, poses.copy(), np.zeros((len(poses), len(JOINTS)))
        self._shown, self._evidence, self._advance = shown, evidence, advance
        self._frames, self._follows, self._share = frames, follows, share

    def decide(self, modes: Float | None) -> None:
        """Track other poses of the body, then of its limbs, in both directions, and take the likeliest ones.

        Args:
            modes: (K, M, D) poses of limbs that the first pass left open, NaN where it left none.
        """
        limbs, every, first = self.tracker.limbs, np.arange(self.poses.shape[1]), self.poses.copy()
        arms = [limb for limb in limbs if limb.name.startswith("arm")]
        legs = tuple(limb for limb in limbs if limb.name.startswith("leg"))
        rest = np.setdiff1d(every, np.concatenate([arm.dofs for arm in arms]))
        swapped = np.concatenate([exchanged_limbs(poses, [legs])[0] for poses in blocks(self.poses)])
        self._choose([Alternative(every), Alternative(rest, begins=swapped)])
        left_open = [] if modes is None else list(modes.swapaxes(0, 1))
        for limb in limbs:
            others = [Alternative(limb.dofs, limb, poses, moves=False) for poses in left_open]
            others.append(Alternative(limb.dofs, limb, first))  # where another pose of the body is likelier
            self._choose([*others, Alternative(limb.dofs, limb)] if limb in arms else others)

    def _choose(self, alternatives: Sequence[Alternative]) -> None:
        """Track alternatives in both directions, and replace the present poses by the likeliest ones; add the spread
        about these to the variance."""
        skeleton, every, begun = self.tracker.body.skeleton, np.arange(len(self.poses)), self._begun(alternatives)
        tracks = [self._track(alternatives, begun, step) for step in (1, -1)]
        states = [(track, k) for track in tracks for k in np.flatnonzero(track.found.any(axis=1))]
        poses = np.stack([self.poses, *(track.poses[k] for track, k in states)])  # (S, K, D)
        cost = np.stack([np.zeros(len(every)), *(track.cost[k] for track, k in states)])
        known = np.stack([np.ones(len(every), np.bool_), *(track.found[k] for track, k in states)])
        joints = np.stack([skeleton.joints(one) for one in poses])
        for n in range(1, len(poses)):
            same = np.linalg.norm(joints[:n] - joints[n], axis=-1).max(axis=-1) <= SAME_POSE_M
            known[n] &= ~(same & known[:n]).any(axis=0)
        share = self._shares(joints, known, cost)
        best = share.argmax(axis=0)
        square = ((joints - joints[best, every]) ** 2).sum(axis=-1) / 3
        self.variance += np.einsum("sk,skj->kj", share, square)
        self.poses = poses[best, every]

    def _shares(self, joints: Float, known: NDArray[np.bool_], cost: Float) -> Float:
        """Return (S, K) the probabilities of S states in each frame.

        Args:
            joints: (S, K, J, 3).
            known: (S, K) whether a frame has this state.
            cost: (S, K) nats.
        """
        states = [np.flatnonzero(one) for one in known.T]
        places = [joints[rows, k] for k, rows in enumerate(states)]
        costs = [cost[rows, k] for k, rows in enumerate(states)]
        result = np.zeros(known.shape)
        for k, (rows, share) in enumerate(zip(states, probabilities(costs, self._surprises(places)), strict=True)):
            result[rows, k] = share
        return result

    def _surprises(self, joints: Sequence[Float]) -> list[Float]:
        """Return for K - 1 steps the negative logarithm (P, S, T) of the probability of each state of a frame, last
        axis, after those of the two frames before; P is 1 where the velocity is not known. Anything may happen in lost
        frames.

        Args:
            joints: of K frames, (S, J, 3) for S states.
        """
        result, gap, past = [], np.diff(self._frames), None
        for k, (before, here) in enumerate(pairwise(joints)):
            step = here - before[:, None]
            if not self._follows[k]:
                result.append(np.zeros((1, *step.shape[:2])))
                past = None
                continue
            ahead = 0.0 if past is None else VELOCITY * gap[k] / gap[k - 1] * past[:, :, None]
            result.append(np.linalg.norm(step - ahead, axis=-1).max(axis=-1).reshape(-1, *step.shape[:2]) / CHANGE_M)
            past = step
        return result

    def _begun(self, alternatives: Sequence[Alternative]) -> Tracks:
        """Return what the poses at which alternatives begin converge to in each frame, those that are not improbable.
        Costs are not multiplied by the frame's share."""
        poses = np.repeat(self.poses[None], len(alternatives), axis=0)
        cost = np.full(poses.shape[:2], np.inf)
        for k, one in enumerate(alternatives):
            if one.begins is not None:
                known = np.flatnonzero(np.isfinite(one.begins[:, one.dofs]).all(axis=1))
                poses[k][np.ix_(known, one.dofs)] = one.begins[np.ix_(known, one.dofs)]
        rows = np.flatnonzero((poses != self.poses).any(axis=(0, 2)))
        for frames in (rows[k : k + AT_ONCE] for k in range(0, len(rows), AT_ONCE)):
            poses[:, frames] = self._settled(alternatives, poses[:, frames], frames)
            for i in frames.tolist():
                if len(differ := np.flatnonzero((poses[:, i] != self.poses[i]).any(axis=1))):
                    cost[differ, i] = self._more(i, poses[differ, i])
        found = cost <= DROPPED
        return Tracks(np.where(found[..., None], poses, self.poses), found, cost)

    def _more(self, i: int, poses: Float) -> Float:
        """Return (B,) by how much poses (B, D) cost more than the present one in frame i, nats."""
        cost = self._evidence(i).cost(self.tracker.body, np.concatenate([self.poses[i][None], poses]))
        return np.asarray(cost[1:] - cost[0])

    def _track(self, alternatives: Sequence[Alternative], begun: Tracks, step: int) -> Tracks:
        """Track alternatives forwards (``step`` 1) or backwards (-1) beside the present poses. ``begun``: what they
        begin as, see :meth:`_begun`."""
        order, result = np.arange(len(self.poses))[::step], np.repeat(self.poses[None], len(alternatives), axis=0)
        found, cost = np.zeros(result.shape[:2], bool), np.zeros(result.shape[:2])
        mean = nothing = np.full(len(alternatives), np.nan)  # of the cost; NaN: none is tracked
        pasts: list[Float | None] = [None] * len(alternatives)  # (D,) their poses in the frame before the last
        free = [k for k, one in enumerate(alternatives) if one.begins is None]
        for begin in range(0, len(order), AT_ONCE):
            frames = order[begin : begin + AT_ONCE]
            # most alternatives become the present pose at once: those that begin are settled together
            starts = begun.poses[:, frames].copy()
            if some := [alternatives[k] for k in free]:
                starts[free] = self._settled(some, self._starts(some, frames, step), frames)
            self._advance(len(frames) / (2 * len(self.poses)))
            for n, i in enumerate(frames.tolist()):
                joined, last, present, poses = self._joined(i, step), i - step, self.poses[i], starts[:, n]
                if np.isnan(mean).all() and (poses == present).all():
                    continue
                anew = [not joined or one.begins_anew(i) for one in alternatives]
                known, mean = np.where(anew, np.nan, mean), nothing.copy()
                if tracked := np.flatnonzero(np.isfinite(known)).tolist():
                    some = [alternatives[k] for k in tracked]
                    ahead = np.repeat(present[None, None], len(some), axis=0)
                    for start, k, one in zip(ahead[:, 0], tracked, some, strict=True):
                        start[one.dofs] = self._predicted(i, step, result[k, last], pasts[k])[one.dofs]
                    poses[tracked] = self._settled(some, ahead, frames[n : n + 1])[:, 0]
                each = zip(alternatives, result, np.isfinite(known).tolist(), strict=True)
                pasts = [self._past(*one, last) if joined else None for one in each]
                differ = (poses != present).any(axis=1)
                more = np.where(np.isnan(known), begun.cost[:, i], np.inf)
                if len(asked := np.flatnonzero(differ & ~np.isfinite(more))):
                    more[asked] = self._more(i, poses[asked])
                mean[differ] = np.where(np.isnan(known), more, known + RENEWAL * (more - known))[differ]
                mean[mean > DROPPED] = np.nan
                kept = np.flatnonzero(np.isfinite(mean))
                if len(kept):
                    result[kept, i], found[kept, i] = poses[kept], True
                    cost[kept, i] = self._share[i] * more[kept]
        return Tracks(result, found, cost)

    def _joined(self, i: int, step: int) -> bool:
        """Return whether the person was tracked from the frame before to frame i, going by ``step``."""
        before = i - step
        return 0 <= before < len(self.poses) and bool(self._follows[min(i, before)])

    def _predicted(self, i: int, step: int, pose: Float, past: Float | None) -> Float:
        """Return the pose (D,) in frame i after a pose (D,) and the one before it; no motion if that is unknown."""
        if past is None:
            return pose
        frame, last, before = self._frames[[i, i - step, i - 2 * step]]
        return np.asarray(pose + VELOCITY * (frame - last) / (last - before) * (pose - past))

    def _starts(self, alternatives: Sequence[Alternative], frames: NDArray[np.int64], step: int) -> Float:
        """Return the poses (A, N, D) in N frames that the neighbouring frames predict for the degrees of freedom of
        each alternative; the present ones after lost frames."""
        result = np.repeat(self.poses[frames][None], len(alternatives), axis=0)
        for n, i in enumerate(frames.tolist()):
            if self._joined(i, step):
                last = i - step
                past = self.poses[last - step] if self._joined(last, step) else None
                predicted = self._predicted(i, step, self.poses[last], past)
                for poses, one in zip(result, alternatives, strict=True):
                    poses[n, one.dofs] = predicted[one.dofs]
        return result

    def _past(self, one: Alternative, poses: Float, tracked: bool, frame: int) -> Float | None:
        """Return the pose (D,) in a frame of an alternative with poses (K, D), which was tracked there or begins in the
        next frame; None if it is unknown."""
        if tracked or one.begins is None:
            return np.asarray(poses[frame])
        return np.asarray(one.begins[frame]) if one.moves else None

    def _settled(
        self,
        alternatives: Sequence[Alternative],
        starts: Float,
        frames: NDArray[np.int64],
    ) -> Float:
        """Return what the starts (A, N, D) of alternatives converge to in N frames; the present pose where that, or the
        start, is near the present pose."""
        tracker, skeleton, present = self.tracker, self.tracker.body.skeleton, self.poses[frames]
        joints, result = skeleton.joints(present), np.repeat(present[None], len(alternatives), axis=0)
        far = skeleton.apart(starts, joints) > SAME_POSE_M
        for limb in dict.fromkeys(one.limb for one in alternatives):  # those of a limb are settled together
            own = far & np.array([one.limb is limb for one in alternatives])[:, None]
            if own.any():
                start, shown = starts[own], frames[np.nonzero(own)[1]]
                pyramid = Pyramid.of_all([self._shown(i) for i in shown.tolist()], SCALE)
                prior = tracker.prior(start, NEAR_DEG)
                result[own] = tracker.settle(pyramid, start, (SCALE,), prior=prior, limb=limb).states
        if far.any():
            result = np.where(skeleton.apart(result, joints)[..., None] > SAME_POSE_M, result, present)
        return result


def apart(frames: NDArray[np.int64], share: Float, needed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the indices of the frames to be compared: the ``needed`` ones (N,), the ends of every stretch of
    successive frames, and others so that between two neighbouring ones less than :data:`APART` of an independent frame
    is said, or nothing is left out.

    Args:
        frames: (N,) numbers of the frames in which the person is tracked, ascending.
        share: (N,) of an independent frame that each says.
        needed: (N,) bool.
    """
    ends = np.append(np.diff(frames) != 1, True)
    must = needed | ends | np.append(True, ends[:-1])
    chosen, said = [], 0.0
    for n, following in enumerate(np.append(share[1:], 0.0).tolist()):
        said += share[n]
        if must[n] or said + following > APART:
            chosen.append(n)
            said = 0.0
    return np.array(chosen, np.int64)


def probabilities(costs: Sequence[Float], steps: Sequence[Float]) -> list[Float]:
    """Return (S,) the probabilities of the states of each of F frames, by the forward-backward algorithm for pairs of
    states. Their number S may differ from frame to frame.

    Args:
        costs: F arrays (S,), negative logarithm of the states' likelihoods, up to a constant of the frame.
        steps: F - 1 arrays (P, S, T), negative logarithm of the probability of a frame's state, last axis, after those
            of the two frames before it; P may be 1.
    """
    forward = [costs[0][None]]  # of the states of the frame before, and of the frame
    for cost, step in zip(costs[1:], steps, strict=True):
        forward.append(cost - np.logaddexp.reduce(-(forward[-1][:, :, None] + step), axis=0))
    backward, result = np.zeros_like(forward[-1]), []
    for k in range(len(costs) - 1, -1, -1):
        share = np.logaddexp.reduce(-(forward[k] + backward), axis=0)
        result.append(np.exp(share - np.logaddexp.reduce(share)))
        if k:
            backward = -np.logaddexp.reduce(-(steps[k - 1] + costs[k] + backward), axis=2)
    return result[::-1]
