"""The second pass of the region tracker: what all frames together tell about each one.

Frames of different poses show what an opening without the initialisation pose may hide: only a bent knee or elbow shows
where it is. So the body is fitted to frames of the whole recording, and every frame is optimised again with it. Each
frame stays near its pose of the first pass, because that has used colours to locate limbs inside the silhouette.
This matters with the same body and cameras, too: without it, the limbs' mean error on the eight captures is 0.03 cm
larger, with two cameras 0.1 cm, and more limbs stay more than 10 cm off.

Where a search has moved a limb, the new pose is also tracked backwards: it replaces earlier poses where its cost is
lower, and σ includes the spread of the two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS
from tk.model.body.body_fit import STATURE_DEVIATION
from tk.model.body.joint_sigma import directions, posture_variance
from tk.model.body.skeleton import JOINTS, Skeleton
from tk.model.cues.ray_costs import Evidence, residual_of
from tk.model.masks.silhouettes import Pyramid
from tk.trackers.contour_tracker import GAIN
from tk.trackers.hypotheses import MARGIN, RENEWAL, Hypothesis, disagreement
from tk.trackers.limb_search import SAME_POSE_M

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
# A step of a joint that is longer than those before and after it by this is a jump, metres.
JUMP_M = 2 * SAME_POSE_M


class SecondPass:
    """The second pass over F frames. Poses are in the tracker's own world.

    Args:
        tracker: with the body and the cameras of this pass.
        masks: (C, H, W) of each frame, cleaned.
        poses: (F, D) of the first pass.
        lost: (F,) bool; such frames are not used and do not change.
        residual: (F, C, 2) of the first pass; a camera whose residual is NaN in a frame is not used in it.
        report: receives the share of the work that is done.

    Attributes:
        poses, residual, variance: (F, D), (F, C, 2), (F, J) the result; the variance without that of the posture.
    """

    def __init__(
        self,
        tracker: RegionTracker,
        masks: Sequence[NDArray[np.uint8]],
        poses: Float,
        lost: NDArray[np.bool_],
        residual: Float,
        report: Callable[[float], None],
    ) -> None:
        self.tracker, self._masks, self._first, self._lost, self._report = tracker, masks, poses, lost, report
        self.tracked = np.flatnonzero(~lost)
        self.poses, self.residual = poses.copy(), np.array(residual)
        self.variance = np.zeros((len(poses), len(JOINTS)))

    @property
    def sigma(self) -> Float:
        """(F, J) metres, one standard deviation of the joints' positions along an axis; 0 in lost frames."""
        skeleton, tracked = self.tracker.body.skeleton, self.tracked
        variance = self.variance.copy()
        posture = np.median(directions(skeleton, self.poses[tracked]), axis=0)
        variance[tracked] += posture_variance(skeleton, self.poses[tracked], posture)
        return np.sqrt(variance)

    def fit_body(self, height_m: float | None) -> None:
        """Fit the tracker's body to frames of the opening and to the best frames of all stretches."""
        tracker, tracked = self.tracker, self.tracked
        opening = tracked[: tracker.contours.init_frames : 3]
        error = np.nanmean(self.residual[tracked].sum(axis=2), axis=1)
        chosen = np.union1d(opening, _lowest(tracked, error, FIT_FRAMES - len(opening)))
        stature = height_m or tracker.body.dimensions.stature
        deviation = STATURE_DEVIATION if height_m else STATURE
        seen = [self._pyramid(i) for i in chosen]
        body, _ = tracker.fit(seen, self.poses[chosen], np.arange(len(chosen)), stature, deviation)
        tracker.take_body(body)

    def optimise(self) -> None:
        """Optimise every frame near its pose of the first pass."""
        tracker, tracked, grid = self.tracker, self.tracked, self.tracker.screen
        done = 0
        for chunk in np.array_split(tracked, -(-len(tracked) // AT_ONCE)):
            seen = Pyramid.of_all([self._pyramid(i) for i in chunk])
            prior = tracker.prior(self._first[chunk], ANGLE_DEG)
            settled = tracker.settle(seen, self._first[chunk], (0,), prior=prior)
            self.poses[chunk] = settled.states
            label = grid.render(tracker.body, settled.states).label
            sampled = grid.sample(seen.masks[0]).reshape(label.shape)
            residual = residual_of(label > 0, sampled >= 128, sampled == OTHERS)
            self.residual[chunk] = residual
            self.variance[chunk] = tracker.variance(settled.states, settled.hessian, prior, label, residual)
            done += len(chunk)
            self._report(done / len(tracked))

    def track_backwards(self) -> None:
        """Track the poses behind the first pass's jumps backwards."""
        tracker, skeleton = self.tracker, self.tracker.body.skeleton
        jumps = _jumps(skeleton, self._first)
        later: Hypothesis | None = None
        for i in self.tracked[::-1]:
            if i + 1 == len(self.poses) or self._lost[i + 1]:
                later = None
            elif later is None and jumps[i + 1]:
                later = Hypothesis(self.poses[i + 1], self.poses[i + 1], 0.0)
            if later is None:
                continue
            pyramid = self._pyramid(i)
            prior = tracker.prior(later.pose[None], ANGLE_DEG)
            settled = tracker.settle(pyramid, later.pose[None], (0,), prior=prior)
            both = np.stack([self.poses[i], settled.states[0]])
            costs, of_both, labels = self._costs(pyramid, both)
            later = self._backwards(later, both, costs)
            if later is None:
                continue
            if later.cost < -GAIN:
                self.poses[i], self.residual[i] = both[1], of_both[1]
                self.variance[i] = tracker.variance(both[1], settled.hessian[0], prior, labels[1], of_both[1])
            self.variance[i] += disagreement(skeleton, both, np.array([0.0, later.cost]))

    def _pyramid(self, i: int) -> Pyramid:
        """Return the masks of frame i at full size, empty where a camera is not used."""
        shown, out = self._masks[int(i)], np.isnan(self.residual[i, :, 0])
        if out.any():
            shown = np.where(out[:, None, None], np.uint8(0), shown)
        return self.tracker.views.pyramid(shown, 1, False)

    def _costs(self, pyramid: Pyramid, poses: Float) -> tuple[Float, Float, NDArray[np.uint8]]:
        """Return the costs (B,) of poses (B, D) by masks alone, mean over the views, their residuals (B, V, 2), and the
        parts that the grid's rays meet (B, V, h, w)."""
        tracker = self.tracker
        evidence = Evidence.of(tracker.screen, pyramid.masks[0])
        cost, met = evidence.cast(tracker.body, poses)
        return cost, np.array([evidence.residual(label) for label in met.label]), met.label

    def _backwards(self, later: Hypothesis, poses: Float, cost: Float) -> Hypothesis | None:
        """Return the hypothesis from the next frame, tracked back by one, with its cost relative to this frame's pose;
        None if it has reached the same pose or costs too much.

        Args:
            later: the hypothesis in the next frame.
            poses, cost: (2, D), (2,) this frame's pose, then the hypothesis's.
        """
        more = float(cost[1] - cost[0])
        if later.age:
            more = later.cost + RENEWAL * (more - later.cost)
        skeleton = self.tracker.body.skeleton
        if more > MARGIN or skeleton.apart(poses[1], skeleton.joints(poses[0])) <= SAME_POSE_M:
            return None
        return Hypothesis(poses[1], later.pose, more, later.age + 1)


def _jumps(skeleton: Skeleton, poses: Float) -> NDArray[np.bool_]:
    """Return (F,) whether a joint's step to a frame, of poses (F, D), is longer than those before and after it by
    :data:`JUMP_M`."""
    steps = np.pad(np.linalg.norm(np.diff(skeleton.joints(poses), axis=0), axis=2), ((1, 1), (0, 0)))
    beside = np.maximum(steps[:-2], steps[2:])
    return np.concatenate([[False], (steps[1:-1] > beside + JUMP_M).any(axis=1)])


def _lowest(frames: NDArray[np.int64], error: Float, count: int) -> NDArray[np.int64]:
    """Return the frame of the lowest E_S (N,) in each of ``count`` stretches of the frames (N,)."""
    edges = np.linspace(0, len(frames), min(count, len(frames)) + 1).round().astype(int)
    return np.array([frames[a + int(np.argmin(error[a:b]))] for a, b in pairwise(edges)])
