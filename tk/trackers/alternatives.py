"""Other poses of the limbs, tracked through a recording beside the present ones, and which of them are likelier.

The first pass may have misplaced an arm, exchanged the legs, or taken the back for the front, for a while. So other
poses of the body and of its arms are tracked through the whole recording, forwards and backwards. They begin at the
prediction from the neighbouring frames, or at the exchanged legs. A hidden Markov model with two states, the present
and the other pose, gives the probability of either in each frame, from the costs in all frames and the changes of the
joints' velocities (Rabiner, Proc. IEEE, 1989). The pose becomes the likelier one, and σ includes the difference. Other
poses that the first pass found in its limb searches are tracked in the same manner, from the frames of the searches on,
and only add to σ: the first pass has compared them with colours.

Neighbouring frames say nearly the same as long as nobody moves. So only some frames are compared: two neighbouring ones
of these say together no more than one independent frame (:func:`apart`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS
from tk.model.body.limb_candidates import Limb, exchanged
from tk.model.body.skeleton import JOINTS, blocks
from tk.model.masks.silhouettes import Pyramid
from tk.trackers.hypotheses import DROPPED, RENEWAL, SAME_POSE_M

if TYPE_CHECKING:
    from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]

# How far a pose of the second pass may be from its start, degrees, and frames that are optimised in one launch.
ANGLE_DEG, AT_ONCE = 15.0, 16
# Scale at which other poses are optimised.
LEVEL = 1
# Frames are compared if they say at least this share of an independent frame; errors with and without it differ by
# 0.03 cm at most (docs/experiments.md, Running time).
APART = 0.5
# People keep their velocity: VELOCITY times a step predicts the next one best (docs/experiments.md, Second pass; the
# first pass, whose poses are less exact, predicts less), and the negative logarithm of a step's probability is the
# distance to this prediction, of the joint that is farthest from it, divided by CHANGE_M. In frames with pixels of
# other people another pose costs SHARED nats more, because the masks do not show the colours by which the first pass
# has chosen.
VELOCITY, CHANGE_M, SHARED = 0.8, SAME_POSE_M, 1.0


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

    def of(self, rows: slice) -> Tracks:
        """Return some alternatives."""
        return Tracks(self.poses[rows], self.found[rows], self.cost[rows])

    def beside(self, other: Tracks) -> Tracks:
        """Return these alternatives, and in frames in which they are not found those of another direction."""
        own = self.found
        return Tracks(
            np.where(own[..., None], self.poses, other.poses),
            own | other.found,
            np.where(own, self.cost, other.cost),
        )


class Choice:
    """The choice between poses in K frames. Poses are in the tracker's own world.

    Args:
        tracker: with the person's body.
        shown: two scales of what a frame shows, by its place among the K.
        frames: (K,) their numbers, ascending.
        follows: (K - 1,) whether the person was tracked in all frames between two neighbouring ones.
        poses: (K, D) the present ones.
        share: (K,) of an independent frame that each says.
        advance: receives numbers of frames that are done; each counts four times.

    Attributes:
        poses: (K, D) the likelier ones.
        variance: (K, J) of the joints' positions along an axis, metres², that the choice leaves open.
    """

    def __init__(
        self,
        tracker: RegionTracker,
        shown: Callable[[int], Pyramid],
        frames: NDArray[np.int64],
        follows: NDArray[np.bool_],
        poses: Float,
        share: Float,
        advance: Callable[[int], None],
    ) -> None:
        self.tracker, self.poses, self.variance = tracker, poses.copy(), np.zeros((len(poses), len(JOINTS)))
        self._shown, self._frames, self._follows, self._share, self._advance = shown, frames, follows, share, advance

    def decide(self, modes: Float | None) -> None:
        """Track other poses of the limbs in both directions, and replace the present ones where these are likelier;
        with them those that the first pass left open, ``modes`` (K, 2, D), NaN where it left none."""
        limbs, every = self.tracker.limbs, np.arange(self.poses.shape[1])
        arms = [Alternative(limb.dofs, limb) for limb in limbs if limb.name.startswith("arm")]
        legs = tuple(limb for limb in limbs if limb.name.startswith("leg"))
        rest = np.setdiff1d(every, np.concatenate([arm.dofs for arm in arms]))
        rows = [] if modes is None else list(modes.swapaxes(0, 1))
        left_open = [Alternative(limb.dofs, limb, poses, moves=False) for limb in limbs for poses in rows]
        done: list[Tracks] = []
        for step in (1, -1):
            swapped = np.concatenate([exchanged(poses, [legs])[0] for poses in blocks(self.poses)])
            others = [Alternative(every), Alternative(rest, begins=swapped), *arms]
            tracks = self._track([*others, *left_open], step)
            for k, one in enumerate(others):
                other, likelier = self._compared(one, *(values[k] for values in tracks))
                self.poses[likelier] = other[likelier]
                change = tracks.cost[k, likelier].copy()  # costs are relative to the present pose
                for known in (*done, tracks):
                    known.cost[:, likelier] -= change
            done.append(tracks.of(slice(len(others), None)))
        for one, poses, found, cost in zip(left_open, *done[0].beside(done[1]), strict=True):
            self._compared(one, poses, found, cost)

    def _compared(
        self, one: Alternative, poses: Float, found: NDArray[np.bool_], cost: Float
    ) -> tuple[Float, NDArray[np.bool_]]:
        """Return the present poses (K, D) with an alternative's limbs, where it is found, and whether these are
        likelier in each frame; add the spread of the two to the variance. Arguments as in :class:`Tracks`."""
        other = self.poses.copy()
        other[np.ix_(found, one.dofs)] = poses[np.ix_(found, one.dofs)]
        joints = self.tracker.body.skeleton.joints(np.array([self.poses, other]))
        share = second_of_two(np.where(found, cost, 0.0), self._surprises(joints) / CHANGE_M)
        square = ((joints[1] - joints[0]) ** 2).sum(axis=-1) / 3
        self.variance += (share * (1.0 - share))[:, None] * square
        return other, (share > 0.5) & found

    def _surprises(self, joints: Float) -> Float:
        """Return (K, 2, 2, 2) how far a joint is from its prediction, metres, the joint for which this is most: in each
        of two states with joints (2, K, J, 3), last axis, predicted from each state of two frames before and of the
        frame before. Anything may happen in lost frames; after them the velocity is not known."""
        result = np.zeros((joints.shape[1], 2, 2, 2))
        steps = joints[None, :, 1:] - joints[:, None, :-1]
        result[1:] = np.linalg.norm(steps, axis=-1).max(axis=-1).transpose(2, 0, 1)[:, None]
        known, gap = np.flatnonzero(self._follows[1:] & self._follows[:-1]), np.diff(self._frames)
        past = (VELOCITY * gap[1:] / gap[:-1])[:, None, None] * steps[:, :, None, :-1]
        away = steps[None, :, :, 1:] - past
        result[2 + known] = np.linalg.norm(away[..., known, :, :], axis=-1).max(axis=-1).transpose(3, 0, 1, 2)
        result[1:][~self._follows] = 0.0
        return result

    def _track(self, alternatives: Sequence[Alternative], step: int) -> Tracks:
        """Track alternatives forwards (``step`` 1) or backwards (-1) beside the present poses."""
        order, result = np.arange(len(self.poses))[::step], np.repeat(self.poses[None], len(alternatives), axis=0)
        found, cost = np.zeros(result.shape[:2], bool), np.zeros(result.shape[:2])
        mean = nothing = np.full(len(alternatives), np.nan)  # of the cost; NaN: none is tracked
        pasts: list[Float | None] = [None] * len(alternatives)  # (D,) their poses in the frame before the last
        for begin in range(0, len(order), AT_ONCE):
            frames, seen = order[begin : begin + AT_ONCE], cache(self._shown)
            # most alternatives become the present pose at once: those that begin are settled together
            starts = np.stack([self._starts(one, frames, step) for one in alternatives])
            begun = self._settled(alternatives, starts, frames, seen)
            self._advance(2 * len(frames))
            for n, i in enumerate(frames.tolist()):
                joined, last, present, poses = self._joined(i, step), i - step, self.poses[i], begun[:, n]
                anew = [not joined or one.begins_anew(i) for one in alternatives]
                known, mean = np.where(anew, np.nan, mean), nothing.copy()
                if tracked := np.flatnonzero(np.isfinite(known)).tolist():
                    some = [alternatives[k] for k in tracked]
                    starts = np.repeat(present[None, None], len(some), axis=0)
                    for start, k, one in zip(starts[:, 0], tracked, some, strict=True):
                        start[one.dofs] = self._predicted(i, step, result[k, last], pasts[k])[one.dofs]
                    poses[tracked] = self._settled(some, starts, frames[n : n + 1], seen)[:, 0]
                each = zip(alternatives, result, np.isfinite(known).tolist(), strict=True)
                pasts = [self._past(*one, last) if joined else None for one in each]
                differ = np.flatnonzero((poses != present).any(axis=1))
                if not len(differ):
                    continue
                pyramid = seen(i)
                costs = self.tracker.cost(pyramid, np.concatenate([present[None], poses[differ]]))
                more = costs[1:] - costs[0]
                mean[differ] = np.where(np.isnan(known[differ]), more, known[differ] + RENEWAL * (more - known[differ]))
                mean[mean > DROPPED] = np.nan
                kept = differ[np.isfinite(mean[differ])]
                # a limb behind other people costs nothing, and only the first pass sees its colours
                hidden = SHARED * (pyramid.masks[0] == OTHERS).any()
                result[kept, i], found[kept, i] = poses[kept], True
                cost[kept, i] = self._share[i] * more[np.isfinite(mean[differ])] + hidden
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

    def _starts(self, one: Alternative, frames: NDArray[np.int64], step: int) -> Float:
        """Return the poses (N, D) from which an alternative begins in N frames; the present one where it does not."""
        poses = self.poses[frames]
        if one.begins is not None:
            angles = one.begins[frames][:, one.dofs]
            known = np.flatnonzero(np.isfinite(angles).all(axis=1))
            poses[np.ix_(known, one.dofs)] = angles[known]
        else:
            for n, i in enumerate(frames.tolist()):
                if self._joined(i, step):
                    last = i - step
                    past = self.poses[last - step] if self._joined(last, step) else None
                    poses[n, one.dofs] = self._predicted(i, step, self.poses[last], past)[one.dofs]
        return poses

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
        seen: Callable[[int], Pyramid],
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
                pyramid = Pyramid.of_all([seen(i) for i in shown.tolist()], LEVEL)
                prior = tracker.prior(start, ANGLE_DEG)
                result[own] = tracker.settle(pyramid, start, (LEVEL,), prior=prior, limb=limb).states
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


def second_of_two(cost: Float, steps: Float) -> Float:
    """Return (F,) the probability of the second of two states in each of F frames, by the forward-backward algorithm
    for pairs of states.

    Args:
        cost: (F,) negative logarithm of the second state's likelihood relative to the first's.
        steps: (F, 2, 2, 2) negative logarithm of the probability of a frame's state, last axis, after those two frames
            and one frame before it.
    """
    frame = np.stack([np.zeros_like(cost), cost], axis=1)
    forward = np.zeros((len(cost), 2, 2))  # of the states of the frame before, and of the frame
    backward = np.zeros_like(forward)
    forward[0] = frame[0]
    for k in range(1, len(cost)):
        before = forward[k - 1, :, :, None] + steps[k]
        forward[k] = frame[k] - np.logaddexp(-before[0], -before[1])
    for k in range(len(cost) - 1, 0, -1):
        after = steps[k] + frame[k] + backward[k]
        backward[k - 1] = -np.logaddexp(-after[..., 0], -after[..., 1])
    first, second = -np.logaddexp.reduce(-(forward + backward), axis=1).T
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(second - first, -500.0, 500.0))))
