"""The second pass of the region tracker: what all frames together tell about each one.

Frames of different poses show what an opening hides, even one in the initialisation pose: only a bent knee or elbow
shows where it is. So the body is fitted to frames of the whole recording, and all frames are optimised again with it.
Each frame stays near its pose of the first pass, because that has used colours to locate limbs inside the silhouette.
This matters with the same body and cameras, too: without it, the limbs' mean error on the eight captures is 0.03 cm
larger, with two cameras 0.1 cm, and more limbs stay more than 10 cm off.

The first pass may have misplaced an arm, exchanged the legs, or taken the back for the front, for a while. So other
poses of the body and of its arms are tracked through the whole recording, forwards and backwards. They begin at the
prediction from the neighbouring frames, or at the exchanged legs. A hidden Markov model with two states, the present
and the other pose, gives the probability of either in each frame, from the costs in all frames and the changes of the
joints' velocities (Rabiner, Proc. IEEE, 1989). The pose becomes the likelier one, and σ includes the difference. Other
poses that the first pass found in its limb searches are tracked in the same manner, from the frames of the searches on,
and only add to σ: the first pass has compared them with colours.

Then one problem of all frames, coupled by the motion, gives the poses and their covariances
(:mod:`tk.optim.trajectory`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.body.body_fit import STATURE_DEVIATION
from tk.model.body.joint_sigma import CONSTANT_M, directions, posture_variance
from tk.model.body.limb_candidates import Limb, exchanged
from tk.model.body.skeleton import JOINTS, blocks
from tk.model.cameras.bundle import LONGEST_STEP, SEGMENT_M
from tk.model.cues import landmarks
from tk.model.cues.cue import Measured, in_frames
from tk.model.cues.ray_costs import residual_of
from tk.model.masks.silhouettes import Pyramid
from tk.model.motion.coupling import MotionTerm
from tk.optim.trajectory import Equations
from tk.trackers.hypotheses import DROPPED, RENEWAL, SAME_POSE_M

if TYPE_CHECKING:
    from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]

# Frames of the body fit, and how far a frame may move from its pose in the first pass.
FIT_FRAMES = 24
ANGLE_DEG = 15.0
# Standard deviation of the logarithm of the stature about that of the first fit, where no height was given.
STATURE = 0.03
# Frames that are refined in one launch.
AT_ONCE = 16
# Iterations over all frames together; frames of which the equations are in memory at once, and frames before and after
# them that are solved with them: what a frame shows about others fades within some frames.
ROUNDS, WINDOW, OVERLAP = 2, 1000, 30
# Scale at which other poses are optimised.
LEVEL = 1
# Clothes, shadows and the shapes of the model err alike as long as the pose is the same. So the likelihood of a frame
# counts by the share of CORRELATED_M, metres, that the fastest joint moves in it, and at least by its share of STILL_S,
# seconds: a person who stands still is seen once, not once a frame. CORRELATED_M was chosen on rendered people
# (docs/experiments.md, Sigma); STILL_S is assumed.
CORRELATED_M, STILL_S = 0.2, 1.0
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
        begins: (F, D) the poses at which it begins in each frame, NaN where it does not; None: at the prediction from
            the neighbouring frames.
        moves: whether a pose at which it begins shows where it was in the frame before, and so its velocity.
    """

    dofs: NDArray[np.int64]
    limb: Limb | None = None
    begins: Float | None = None
    moves: bool = True


class Tracks(NamedTuple):
    """A alternatives, tracked through F frames in one direction.

    Attributes:
        poses: (A, F, D).
        found: (A, F) whether an alternative differs from the pose that was the present one, and is not improbable.
        cost: (A, F) by how much it costs more than that pose, nats; 0 where it is not found.
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


class SecondPass:
    """The second pass over F frames. Poses are in the tracker's own world.

    Args:
        tracker: with the body and the cameras of this pass.
        masks: (C, H, W) of each frame, cleaned.
        measured: of F frames, see :mod:`tk.model.cues.cue`.
        modes: (F, 2, D) other poses of the limbs that each frame leaves open; None if they are unknown.
        poses: (F, D) of the first pass.
        lost: (F,) bool; such frames are not used and do not change.
        residual: (F, C, 2) of the first pass; a camera whose residual is NaN in a frame is not used in it.
        report: receives the share of the work that is done.

    Attributes:
        tracked: the frames that are not lost.
        poses, residual: (F, D), (F, C, 2) the result.
    """

    def __init__(
        self,
        tracker: RegionTracker,
        masks: Sequence[NDArray[np.uint8]],
        measured: Measured,
        modes: Float | None,
        poses: Float,
        lost: NDArray[np.bool_],
        residual: Float,
        report: Callable[[float], None],
    ) -> None:
        self.tracker, self._masks, self._report = tracker, masks, report
        self._measured, self._modes = measured, modes
        self.tracked = np.flatnonzero(~lost)
        self._seen = frozenset(self.tracked.tolist())
        self._share = np.ones(len(poses))
        steps, seen = _steps(tracker.body.skeleton.joints(poses[self.tracked])), len(self.tracked)
        self._share[self.tracked] = np.clip(steps / CORRELATED_M, 1.0 / min(tracker.fps * STILL_S, seen), 1.0)
        self.poses, self.residual = poses.copy(), np.array(residual)
        self._variance = np.zeros((2, len(poses), len(JOINTS)))  # of the pose, and of the choice between two
        # in a recording they are constant offsets, which sigma leaves out; few frames do not tell them from errors
        self._few = seen <= FIT_FRAMES
        self._constant = np.full(len(JOINTS), SEGMENT_M**2 if self._few else 0.0)
        self._view_m = float(np.hypot(tracker.view_m, CONSTANT_M)) if self._few else tracker.view_m
        self._done = 0

    @property
    def sigma(self) -> Float:
        """(F, J) metres, one standard deviation of the joints' positions along an axis; 0 in lost frames."""
        skeleton, tracked = self.tracker.body.skeleton, self.tracked
        variance = self._variance.sum(axis=0)
        posture = np.median(directions(skeleton, self.poses[tracked]), axis=0)
        variance[tracked] += posture_variance(skeleton, self.poses[tracked], posture) + self._constant
        return np.sqrt(variance)

    def fit_body(self, height_m: float | None) -> None:
        """Fit the tracker's body to frames of the opening and to the best frames of all stretches."""
        tracker, tracked = self.tracker, self.tracked
        opening = tracked[: tracker.contours.init_frames : 3]
        error = np.nanmean(self.residual[tracked].sum(axis=2), axis=1)
        chosen = np.union1d(opening, _lowest(tracked, error, FIT_FRAMES - len(opening)))
        stature = height_m or tracker.body.dimensions.barefoot
        deviation = STATURE_DEVIATION if height_m else STATURE
        seen = [self._pyramid(i) for i in chosen]
        fitted = tracker.fit(seen, self.poses[chosen], np.arange(len(chosen)), stature, deviation, tracker.body)
        tracker.take_body(fitted.body)
        if self._few:
            self._constant += fitted.variance() / len(tracked)

    def settle(self) -> None:
        """Optimise every frame by itself, near its pose of the first pass."""
        for frames in _chunks(self.tracked):
            prior = self.tracker.prior(self.poses[frames], ANGLE_DEG)
            settled = self.tracker.settle(self._together(frames), self.poses[frames], (0,), prior=prior)
            self.poses[frames] = settled.states
            self._advance(len(frames))

    def follow(self) -> None:
        """Optimise every frame by itself from its pose of the first pass, which other cameras have given; give each its
        residual."""
        for frames in _chunks(self.tracked):
            for level in (LEVEL, 0):
                seen = Pyramid.of_all([self._pyramid(i, LEVEL + 1) for i in frames], level)
                self.poses[frames] = self.tracker.settle(seen, self.poses[frames], (level,)).states
            label = self.tracker.coarse_grid.render(self.tracker.body, self.poses[frames]).label
            self.residual[frames] = self._residual(seen, label)

    def smooth(self) -> None:
        """Optimise all frames together, each near its present pose and coupled to its neighbours by the motion; give
        each its residual and its variance."""
        near, skeleton = self.poses.copy(), self.tracker.body.skeleton
        motion = MotionTerm(skeleton, near[self.tracked], self.tracked)
        for begin in range(0, len(self.tracked), WINDOW):
            first = max(begin - OVERLAP, 0)
            frames = self.tracked[first : begin + WINDOW + OVERLAP]
            poses, covariance = self._smoothed(frames, near[frames], motion)
            for rows in _chunks(np.arange(begin - first, min(begin - first + WINDOW, len(frames)))):
                self.poses[frames[rows]] = poses[rows]
                self._judge(frames[rows], covariance[rows])
        self._interpolate()

    def _smoothed(self, frames: NDArray[np.int64], near: Float, motion: MotionTerm) -> tuple[Float, Float]:
        """Return the poses (N, D) of frames, near poses (N, D), and their covariances (N, D, D)."""
        poses = near.copy()

        def linearised(view_m: float) -> Equations:
            equations, share = Equations(len(poses), poses.shape[1], 0), self._share[frames]
            for rows in _chunks(np.arange(len(frames))):
                prior = self.tracker.prior(near[rows], ANGLE_DEG)
                hessian, gradient = self.tracker.equations(self._together(frames[rows]), poses[rows], prior, view_m)
                equations.hessian[rows] = share[rows, None, None] * hessian
                equations.gradient[rows] = share[rows, None] * gradient
            motion.add(equations, poses, frames)
            return equations

        for _ in range(ROUNDS):
            equations = linearised(0.0)
            poses += np.clip(equations.reduced().plain, -LONGEST_STEP[0], LONGEST_STEP[0])
            self._advance(len(frames))
        return poses, linearised(self._view_m).reduced().chain.covariance

    def _judge(self, frames: NDArray[np.int64], covariance: Float) -> None:
        """Set the residuals and the variances of frames, whose poses have covariances (N, D, D)."""
        tracker, seen, poses = self.tracker, self._together(frames), self.poses[frames]
        label = tracker.coarse_grid.render(tracker.body, poses).label
        self.residual[frames] = residual = self._residual(seen, label)
        variance = tracker.variance(poses, covariance, residual)
        self._variance[0, frames] = variance + tracker.contradiction(seen, poses)

    def _residual(self, seen: Pyramid, label: NDArray[np.uint8]) -> Float:
        """Return the residuals (N, C, 2) of bodies, labels (N, C, h, w), in N frames at the finest scale."""
        sampled = self.tracker.coarse_grid.sample(seen.masks[0]).reshape(label.shape)
        return residual_of(label > 0, sampled >= PERSON, sampled == OTHERS)

    def decide(self) -> None:
        """Track other poses of the limbs in both directions, and replace the present ones where these are likelier;
        with them those that the first pass left open."""
        limbs, every = self.tracker.limbs, np.arange(self.poses.shape[1])
        arms = [Alternative(limb.dofs, limb) for limb in limbs if limb.name.startswith("arm")]
        legs = tuple(limb for limb in limbs if limb.name.startswith("leg"))
        rest = np.setdiff1d(every, np.concatenate([arm.dofs for arm in arms]))
        rows = [] if self._modes is None else list(self._modes.swapaxes(0, 1))
        modes = [Alternative(limb.dofs, limb, poses, moves=False) for limb in limbs for poses in rows]
        done: list[Tracks] = []
        for step in (1, -1):
            swapped = np.full_like(self.poses, np.nan)
            tracked = [exchanged(poses, [legs])[0] for poses in blocks(self.poses[self.tracked])]
            swapped[self.tracked] = np.concatenate(tracked)
            others = [Alternative(every), Alternative(rest, begins=swapped), *arms]
            tracks = self._track([*others, *modes], step)
            for k, one in enumerate(others):
                other, likelier = self._compared(one, *(values[k] for values in tracks))
                self.poses[likelier] = other[likelier]
                change = tracks.cost[k, likelier].copy()  # costs are relative to the present pose
                for known in (*done, tracks):
                    known.cost[:, likelier] -= change
            done.append(tracks.of(slice(len(others), None)))
        for one, poses, found, cost in zip(modes, *done[0].beside(done[1]), strict=True):
            self._compared(one, poses, found, cost)

    def _compared(
        self, one: Alternative, poses: Float, found: NDArray[np.bool_], cost: Float
    ) -> tuple[Float, NDArray[np.int64]]:
        """Return the present poses (F, D) with an alternative's limbs, where it is found, and the frames in which these
        are likelier; add the spread of the two to the variance. Arguments as in :class:`Tracks`."""
        skeleton, frames, other = self.tracker.body.skeleton, self.tracked, self.poses.copy()
        other[np.ix_(found, one.dofs)] = poses[np.ix_(found, one.dofs)]
        joints = skeleton.joints(np.array([self.poses[frames], other[frames]]))
        share = second_of_two(np.where(found, cost, 0.0)[frames], _surprises(joints, frames) / CHANGE_M)
        apart = ((joints[1] - joints[0]) ** 2).sum(axis=-1) / 3
        self._variance[1, frames] += (share * (1.0 - share))[:, None] * apart
        return other, frames[(share > 0.5) & found[frames]]

    def _interpolate(self) -> None:
        """Set angles that only landmarks show between those of the frames in which two images or more have landmarks:
        neither joints nor contours depend on them."""
        if (marked := self._measured.get(landmarks.NAME)) is None:
            return
        images = np.isfinite(marked[self.tracked]).any(axis=(2, 3)).sum(axis=1)
        seen = self.tracked[images > 1]
        for k in np.flatnonzero(self.tracker.body.skeleton.is_by_landmarks) if len(seen) else ():
            self.poses[self.tracked, k] = np.interp(self.tracked, seen, self.poses[seen, k])

    def _track(self, alternatives: Sequence[Alternative], step: int) -> Tracks:
        """Track alternatives forwards (``step`` 1) or backwards (-1) beside the present poses."""
        order, result = self.tracked[::step], np.repeat(self.poses[None], len(alternatives), axis=0)
        found, cost = np.zeros(result.shape[:2], bool), np.zeros(result.shape[:2])
        mean = np.full(len(alternatives), np.nan)  # of the cost; NaN: none is tracked
        pasts: list[Float | None] = [None] * len(alternatives)  # (D,) their poses in the frame before the last
        for begin in range(0, len(order) - 1, AT_ONCE):
            frames = order[begin + 1 : begin + 1 + AT_ONCE]
            lasts, seen = order[begin : begin + len(frames)], cache(lambda i: self._pyramid(i, LEVEL + 1))
            # most alternatives become the present pose at once: those that begin are settled together
            starts = np.stack([self._starts(one, lasts, frames, step) for one in alternatives])
            begun = self._settled(alternatives, starts, frames, seen)
            self._advance(2 * len(frames))
            for n, (last, i) in enumerate(zip(lasts.tolist(), frames.tolist(), strict=True)):
                known, mean = mean, np.full(len(alternatives), np.nan)
                if i != last + step:
                    continue
                present, poses = self.poses[i], begun[:, n]
                if tracked := np.flatnonzero(np.isfinite(known)).tolist():
                    some = [alternatives[k] for k in tracked]
                    starts = np.repeat(present[None, None], len(some), axis=0)
                    for start, k, one in zip(starts[:, 0], tracked, some, strict=True):
                        start[one.dofs] = _predicted(result[k, last], pasts[k])[one.dofs]
                    poses[tracked] = self._settled(some, starts, frames[n : n + 1], seen)[:, 0]
                were_tracked = np.isfinite(known).tolist()
                pasts = [self._past(*one, last) for one in zip(alternatives, result, were_tracked, strict=True)]
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

    def _starts(self, one: Alternative, lasts: NDArray[np.int64], frames: NDArray[np.int64], step: int) -> Float:
        """Return the poses (N, D) from which an alternative begins in N frames; the present one where it does not."""
        poses, follows = self.poses[frames], frames == lasts + step
        if one.begins is not None:
            angles = one.begins[frames][:, one.dofs]
            known = np.flatnonzero(np.isfinite(angles).all(axis=1))
            poses[np.ix_(known, one.dofs)] = angles[known]
        else:
            for n in np.flatnonzero(follows).tolist():
                past = self.poses[lasts[n] - step] if lasts[n] - step in self._seen else None
                poses[n, one.dofs] = _predicted(self.poses[lasts[n]], past)[one.dofs]
        return poses

    def _past(self, one: Alternative, poses: Float, tracked: bool, frame: int) -> Float | None:
        """Return the pose (D,) in a frame of an alternative with poses (F, D), which was tracked there or begins in the
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

    def _advance(self, frames: int) -> None:
        """Report the share that is done: every frame is settled once, tracked in both directions, which takes as long
        as four rounds, and smoothed in all rounds."""
        self._done += frames
        self._report(min(self._done / ((5 + ROUNDS) * len(self.tracked)), 1.0))

    def _together(self, frames: NDArray[np.int64]) -> Pyramid:
        """Return the finest scale of some frames."""
        return Pyramid.of_all([self._pyramid(i) for i in frames], 0)

    def _pyramid(self, i: int, scales: int = 1) -> Pyramid:
        """Return the scales of the masks of frame i, and what was measured in it, by the cameras that are used."""
        shown, used = self._masks[int(i)], np.isfinite(self.residual[i, :, 0])
        if not used.all():
            shown = np.where(used[:, None, None], shown, np.uint8(0))
        return self.tracker.views.pyramid(shown, scales, False, in_frames(self._measured, i, used))


def _predicted(pose: Float, past: Float | None) -> Float:
    """Return the pose (D,) after a pose (D,) and the one before it; no motion if that is unknown."""
    return pose if past is None else np.asarray(pose + VELOCITY * (pose - past))


def _surprises(joints: Float, frames: NDArray[np.int64]) -> Float:
    """Return (F, 2, 2, 2) how far a joint is from its prediction, metres, the joint for which this is most: in each of
    two states, last axis, predicted from each state of two frames before and of the frame before.

    Args:
        joints: (2, F, J, 3) in the two states.
        frames: (F,) their numbers. Anything may happen in lost frames; after them the velocity is not known.
    """
    result = np.zeros((joints.shape[1], 2, 2, 2))
    steps = joints[None, :, 1:] - joints[:, None, :-1]
    result[1:] = np.linalg.norm(steps, axis=-1).max(axis=-1).transpose(2, 0, 1)[:, None]
    away = steps[None, :, :, 1:] - VELOCITY * steps[:, :, None, :-1]
    follows = np.diff(frames) == 1
    known = np.flatnonzero(follows[1:] & follows[:-1])
    result[2 + known] = np.linalg.norm(away[..., known, :, :], axis=-1).max(axis=-1).transpose(3, 0, 1, 2)
    result[1:][~follows] = 0.0
    return result


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


def _steps(joints: Float) -> Float:
    """Return (F,) how far the fastest of the joints (F, J, 3) moves in a frame, mean of the steps before and after."""
    steps = np.sqrt((np.diff(joints, axis=0) ** 2).sum(axis=-1)).max(axis=-1)
    beside = np.concatenate([steps[:1], steps, steps[-1:]]) if len(steps) else np.zeros(2)
    return np.asarray((beside[:-1] + beside[1:]) / 2.0)


def _chunks(frames: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return frames in pieces of at most :data:`AT_ONCE`."""
    return [frames[k : k + AT_ONCE] for k in range(0, len(frames), AT_ONCE)]


def _lowest(frames: NDArray[np.int64], error: Float, count: int) -> NDArray[np.int64]:
    """Return the frame of the lowest E_S (N,) in each of ``count`` stretches of the frames (N,)."""
    edges = np.linspace(0, len(frames), min(count, len(frames)) + 1).round().astype(int)
    return np.array([frames[a + int(np.argmin(error[a:b]))] for a, b in pairwise(edges)])
