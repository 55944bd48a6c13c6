"""The second pass of the region tracker: what all frames together tell about each one.

Frames of different poses show what an opening hides, even one in the initialisation pose: only a bent knee or elbow
shows where it is. So the body is fitted to frames of the whole recording, and all frames are optimised again with it.
Each frame stays near its pose of the first pass, because that has used colours to locate limbs inside the silhouette.
This matters with the same body and cameras, too: without it, the limbs' mean error on the eight captures is 0.03 cm
larger, with two cameras 0.1 cm, and more limbs stay more than 10 cm off.

Poses that the first pass may have taken for others are compared with these (:mod:`tk.trackers.alternatives`).

Then one problem of all frames, coupled by the motion, gives the poses and their covariances
(:mod:`tk.optim.trajectory`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.body.body_fit import STATURE_DEVIATION
from tk.model.body.body_parameters import FITTED_STATURE_DEVIATION
from tk.model.body.joint_sigma import CONSTANT_M, directions, posture_variance
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.bundle import LONGEST_STEP, SEGMENT_M
from tk.model.cues import landmarks
from tk.model.cues.cue import Measured, in_frames
from tk.model.cues.ray_costs import Evidence, residual_of
from tk.model.masks.silhouettes import Pyramid, Views
from tk.model.motion.coupling import MotionTerm
from tk.optim.trajectory import Equations
from tk.trackers.alternatives import AT_ONCE, NEAR_DEG, SCALE, Choice, apart
from tk.trackers.residual import mean_error

if TYPE_CHECKING:
    from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]

# Frames of the body fit.
FIT_FRAMES = 24
# Iterations over all frames together; frames of which the equations are in memory at once, and frames before and after
# them that are solved with them: what a frame shows about others fades within some frames.
ROUNDS, WINDOW, OVERLAP = 2, 1000, 30
# Clothes, shadows and the shapes of the model err alike as long as the pose is the same. So what a frame shows, and its
# prior about the pose of the first pass, count by the share of CORRELATED_M, metres, that the fastest joint moves in
# it, and at least by its share of STILL_S, seconds: a person who stands still is seen once, not once a frame.
# CORRELATED_M was chosen on rendered people (docs/experiments.md, Sigma); STILL_S is assumed.
CORRELATED_M, STILL_S = 0.2, 1.0
# Bytes of the masks that stay unpacked: those of 244 frames of four VGA cameras. Each frame's are asked for up to
# twenty times, in the order of time, so those of a longer recording are unpacked each time.
_UNPACKED_BYTES = 300_000_000


class SecondPass:
    """The second pass over F frames. Poses are in the tracker's own world.

    Args:
        tracker: with the body and the cameras of this pass.
        masks: (C, H, W) of each frame, cleaned.
        measured: of F frames, see :mod:`tk.model.cues.cue`.
        modes: (F, M, D) other poses of the limbs that each frame leaves open; None if they are unknown.
        colors: (C, h, w) of each frame, as in :class:`~tk.trackers.protocol.Estimate`; None where they are unknown.
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
        colors: Sequence[NDArray[np.uint16] | None] | None,
        poses: Float,
        lost: NDArray[np.bool_],
        residual: Float,
        report: Callable[[float], None],
    ) -> None:
        self.tracker, self._report = tracker, report
        self._measured, self._modes, self._colors = measured, modes, colors
        frame = len(tracker.views.rig) * math.prod(tracker.views.rig.frame_shape)
        self._kept = max(_UNPACKED_BYTES // frame, AT_ONCE)  # frames
        self._pyramid = _unpacked(tracker.views, masks, measured, np.isfinite(residual[..., 0]), self._kept)
        self.tracked = np.flatnonzero(~lost)
        self._share = np.ones(len(poses))
        joints, seen = tracker.body.skeleton.joints(poses[self.tracked]), len(self.tracked)
        steps = _steps(joints, np.diff(self.tracked))
        self._share[self.tracked] = np.clip(steps / CORRELATED_M, 1.0 / min(tracker.fps * STILL_S, seen), 1.0)
        self.poses, self.residual = poses.copy(), np.array(residual)
        self._variance = np.zeros((2, len(poses), len(JOINTS)))  # of the pose, and of the choice
        # in a recording they are constant offsets, which sigma leaves out; few frames do not tell them from errors
        self._few = seen <= FIT_FRAMES
        self._constant = np.full(len(JOINTS), SEGMENT_M**2 if self._few else 0.0)
        self._view_m = float(np.hypot(tracker.view_m, CONSTANT_M)) if self._few else tracker.view_m
        self._done = 0.0

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
        opening = tracked[: min(tracker.opening_frames, FIT_FRAMES) : 3]
        error = np.nan_to_num(mean_error(self.residual[tracked]), nan=np.inf)
        chosen = np.union1d(opening, _lowest(tracked, error, FIT_FRAMES - len(opening)))
        stature = height_m or tracker.body.dimensions.barefoot
        deviation = STATURE_DEVIATION if height_m else FITTED_STATURE_DEVIATION
        seen = [self._pyramid(i, 1) for i in chosen]
        fitted = tracker.fit(seen, self.poses[chosen], np.arange(len(chosen)), stature, deviation, tracker.body)
        tracker.take_body(fitted.body)
        if self._few:
            self._constant += fitted.variance() / len(tracked)

    def settle(self) -> None:
        """Optimise every frame by itself, near its pose of the first pass."""
        for frames in _chunks(self.tracked):
            prior = self.tracker.prior(self.poses[frames], NEAR_DEG)
            settled = self.tracker.settle(self._together(frames), self.poses[frames], (0,), prior=prior)
            self.poses[frames] = settled.states
            self._advance(len(frames))

    def follow(self) -> None:
        """Optimise every frame by itself, at the scale :data:`SCALE`, from its pose of the first pass, which other
        cameras have given; give each its residual. :meth:`settle` optimises at the finest scale."""
        for frames in _chunks(self.tracked):
            coarse = Pyramid.of_all([self._pyramid(i, SCALE + 1) for i in frames], SCALE)
            self.poses[frames] = self.tracker.settle(coarse, self.poses[frames], (SCALE,)).states
            seen = self._together(frames)
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
                prior = self.tracker.prior(near[rows], NEAR_DEG)
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
        self._variance[0, frames] = variance + tracker.cue_variance(seen, poses)

    def _residual(self, seen: Pyramid, label: NDArray[np.uint8]) -> Float:
        """Return the residuals (N, C, 2) of bodies, labels (N, C, h, w), in N frames at the finest scale."""
        sampled = self.tracker.coarse_grid.sample(seen.masks[0]).reshape(label.shape)
        return residual_of(label > 0, sampled >= PERSON, sampled == OTHERS)

    def decide(self) -> None:
        """Replace poses where others, which are tracked beside them, are likelier; add what stays open to the variance.
        Frames between those of the comparison take part in the nearest one's change."""
        tracked, share = self.tracked, self._share[self.tracked]
        modes = None if self._modes is None else self._modes[tracked]
        needed = np.zeros(len(tracked), np.bool_) if modes is None else np.asarray(np.isfinite(modes).any(axis=(1, 2)))
        rows = apart(tracked, share, needed)
        frames, said = tracked[rows], np.add.reduceat(share, np.append(0, rows[:-1] + 1))
        choice = Choice(
            self.tracker,
            lambda k: self._pyramid(frames[k], SCALE + 1),
            lru_cache(self._kept)(lambda k: self._evidence(int(frames[k]))),
            frames,
            np.diff(rows) == np.diff(frames),
            self.poses[frames],
            np.minimum(said, 1.0),
            lambda part: self._advance(4 * len(tracked) * part / (1 + len(self.tracker.limbs))),
        )
        choice.decide(None if modes is None else modes[rows])
        change = choice.poses - self.poses[frames]
        place = np.interp(tracked, frames, np.arange(len(frames)))
        self.poses[tracked] += change[np.round(place).astype(int)]
        before, part = place.astype(int), (place % 1.0)[:, None]
        after = np.minimum(before + 1, len(frames) - 1)
        self._variance[1, tracked] = (1.0 - part) * choice.variance[before] + part * choice.variance[after]

    def _interpolate(self) -> None:
        """Set angles that only landmarks show between those of the frames in which two images or more have landmarks:
        neither joints nor contours depend on them."""
        if (marked := self._measured.get(landmarks.NAME)) is None:
            return
        images = np.isfinite(marked[self.tracked]).any(axis=(2, 3)).sum(axis=1)
        seen = self.tracked[images > 1]
        for k in np.flatnonzero(self.tracker.body.skeleton.is_by_landmarks) if len(seen) else ():
            self.poses[self.tracked, k] = np.interp(self.tracked, seen, self.poses[seen, k])

    def _advance(self, frames: float) -> None:
        """Report the share that is done: every frame is settled once, compared with others, which takes as long as four
        rounds, and smoothed in all rounds."""
        self._done += frames
        self._report(min(self._done / ((5 + ROUNDS) * len(self.tracked)), 1.0))

    def _together(self, frames: NDArray[np.int64]) -> Pyramid:
        """Return the finest scale of some frames."""
        return Pyramid.of_all([self._pyramid(i, 1) for i in frames], 0)

    def _evidence(self, i: int) -> Evidence:
        """Return the costs of frame i, with the colours that are known."""
        return self.tracker.kept_evidence(self._pyramid(i, 1), None if self._colors is None else self._colors[i])


def _unpacked(
    views: Views, masks: Sequence[NDArray[np.uint8]], measured: Measured, used: NDArray[np.bool_], kept: int
) -> Callable[[int, int], Pyramid]:
    """Return a function from a frame and a number of scales to the scales of the frame's masks, and what was measured
    in it, by the cameras that are used, (F, C). The masks of ``kept`` frames stay unpacked."""

    @lru_cache(kept)
    def shown(i: int) -> NDArray[np.uint8]:
        return masks[i] if used[i].all() else np.where(used[i][:, None, None], masks[i], np.uint8(0))

    @lru_cache(kept)
    def pyramid(i: int, scales: int) -> Pyramid:
        return views.pyramid(shown(int(i)), scales, False, in_frames(measured, i, used[i]))

    return pyramid


def _steps(joints: Float, apart: NDArray[np.int64]) -> Float:
    """Return (F,) how far the fastest of the joints (F, J, 3) moves in a frame, mean of the steps before and after;
    (F - 1,) frames that neighbours are ``apart``."""
    steps = np.sqrt((np.diff(joints, axis=0) ** 2).sum(axis=-1)).max(axis=-1) / apart
    beside = np.concatenate([steps[:1], steps, steps[-1:]]) if len(steps) else np.zeros(2)
    return np.asarray((beside[:-1] + beside[1:]) / 2.0)


def _chunks(frames: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return frames in pieces of at most :data:`AT_ONCE`."""
    return [frames[k : k + AT_ONCE] for k in range(0, len(frames), AT_ONCE)]


def _lowest(frames: NDArray[np.int64], error: Float, count: int) -> NDArray[np.int64]:
    """Return the frame of the lowest E_S (N,) in each of ``count`` stretches of the frames (N,)."""
    edges = np.linspace(0, len(frames), min(count, len(frames)) + 1).round().astype(int)
    return np.array([frames[a + int(np.argmin(error[a:b]))] for a, b in pairwise(edges)])
