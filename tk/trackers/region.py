"""The region tracker, the default: contours locate the limbs, and a search over all their poses finds lost ones again.

One frame:

    masks → contours from the prediction: silhouette edges, and colour differences inside the silhouette
          → is the residual high, or a limb misplaced?  ── no ─► pose, σ
          → yes: candidates for all limbs, screened in one launch each, the best ones refined
          → the best few are tracked for some frames; the one with the lowest cost is the pose
          → the colours of the parts are learned

Contours and equations are the silhouette paper's (sections 4.1 to 4.3); the colour differences are those of
region-based tracking (Stoiber et al., *SRT3D*, IJCV 2022). The search replaces the first paper's Stochastic Meta
Descent and its visual hull: a limb lies in the hull and fills it if it lies in all silhouettes and leaves no ray of
them without a part. Rays measure this directly, at the images' resolution instead of the voxels'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_fit import STATURE_DEVIATION
from tk.model.body.cone_body import ConeBody
from tk.model.body.joint_sigma import contour_variance, directions, posture_variance, view_variance
from tk.model.body.limb_candidates import Limb
from tk.model.body.skeleton import JOINTS, Skeleton
from tk.model.cameras.camera import Rig
from tk.model.cues.part_colors import color_bins
from tk.model.cues.ray_costs import Evidence, mean_of_views
from tk.model.cues.visible_contours import contour_shares
from tk.model.masks.silhouettes import Pyramid
from tk.model.setup import InitPose, Setup
from tk.optim.gauss_newton import Prior
from tk.settings import BodyFitSettings, RegionSettings, Settings, SilhouetteSettings
from tk.trackers.contour_tracker import GAIN, RECOVER_EVERY, SAME_POSE_M, ContourTracker
from tk.trackers.protocol import Estimate, Observation, Stopwatch
from tk.trackers.residual import ResidualBaseline, variance_factor

Float = NDArray[np.float64]

# Information of one pixel of contour, 1/px²: edgels err by 2 px, and together along 10 px.
INFORMATION = 1.0 / (2.0**2 * 10.0)
# Scales of a frame, at least: from the finest alone Gauss-Newton does not converge.
FEWEST = 2
# Standard deviations of the priors about the predicted pose (tk.model.body.joints has those about zero). Chosen on the
# development captures; sensitivity not measured.
ANGLE_DEG, TRANSLATION_M = 40.0, 0.3
# Frames during which a hypothesis is tracked beside the best one, and the share of its running cost that a frame
# replaces. A hypothesis that costs MARGIN more than the best one, as a share of the person's pixels, is dropped. Chosen
# on the development captures; sensitivity not measured.
PATIENCE, RENEWAL, MARGIN = 6, 0.4, 0.02
# After this many consecutive frames with a high residual, and two failed searches for the person, sigma is set to NaN.
UNKNOWN_AFTER = 2 * RECOVER_EVERY
# Masks are searched for carried objects if this share of their pixels has colours that are not the person's; objects
# narrower than the structuring element, pixels, are ignored.
FOREIGN_SHARE = 0.01
_OBJECT = np.ones((5, 5), np.uint8)
# A limb is misplaced if its rays cost more than this, on average. In the development captures no limb within 15 cm of
# the ground truth costs 0.25, and most others cost 0.3 to 0.4.
MISPLACED = 0.25
# Second pass: settings of the body fit, and how far a frame may move from its pose in the first pass.
SECOND_FIT = BodyFitSettings(frames=24, rounds=4)
SECOND_ANGLE_DEG = 15.0
# Standard deviation of the logarithm of the stature about that of the first fit, where no height was given.
SECOND_STATURE_DEVIATION = 0.03
# Frames of the second pass that are refined in one launch.
AT_ONCE = 8
# A step of a joint that is longer than those before and after it by this is a jump, metres.
JUMP_M = 2 * SAME_POSE_M
# Frames over which the mean posture of the first pass is a plain mean; then the oldest are forgotten.
POSTURE_FRAMES = 200


@dataclass(frozen=True)
class Hypothesis:
    """A pose that is tracked.

    Attributes:
        pose, previous: (D,) in this frame and the one before.
        cost: running mean of its cost.
        age: frames since it was proposed.
        jumped: whether a limb search has just found it. ``previous`` is then that of the pose it replaces, so that the
            two may differ by a fast motion or by a jump.
    """

    pose: Float
    previous: Float
    cost: float
    age: int = 0
    jumped: bool = False


class RegionTracker(ContourTracker):
    """Tracks one person. :meth:`start` once, then :meth:`step` for every frame, the first included."""

    method = "region"
    stages: tuple[str, ...] = ("contours", "search")
    timing_stages: tuple[str, ...] = ("masks_clean", "optimise", "check", "search")
    needs_images = True
    reports_sigma = True
    has_second_pass = True

    @classmethod
    def of(cls, setup: Setup, settings: Settings) -> RegionTracker:
        """Return a new tracker with the settings of this method."""
        return cls(setup.rig, setup.up, settings.silhouette, settings.region)

    def __init__(
        self, rig: Rig, up: str, contours: SilhouetteSettings | None = None, config: RegionSettings | None = None
    ) -> None:
        super().__init__(rig, up, contours or SilhouetteSettings())
        self.config = config or RegionSettings()
        self._alive: list[Hypothesis] = []
        self._mean_posture: Float = np.zeros((len(JOINTS), 3))
        self._postures = 0
        self._fresh = True
        self._reset()

    def _reset(self) -> None:
        """Forget the residuals and everything that was decided from them."""
        self.residuals = ResidualBaseline(len(self.rig), self.config.false_alarm)
        self._lost_for = self._high_for = 0
        self._search_failed = False

    def start(
        self,
        frames: Sequence[Observation],
        height_m: float | None,
        init: InitPose | None,
        body: ConeBody | None = None,
    ) -> None:
        """Find the subject in the first frame and fit the body to all of them, see :meth:`ContourTracker.find`."""
        pose = self.find(frames, height_m, init, body)
        self._alive = [Hypothesis(pose, pose, 0.0)]
        self._mean_posture, self._postures = np.zeros((len(JOINTS), 3)), 0
        self._fresh = True
        self._reset()

    def start_at(self, pose: Float) -> None:
        """Continue at a pose (D,) of the setup's world, with the same body and colours, but no memory of residuals."""
        pose = self.world.poses_in(pose[None])[0]
        self._alive = [Hypothesis(pose, pose, 0.0, 1)]
        self._fresh = False
        self._reset()

    def step(self, frame: Observation) -> Estimate:
        """Return the estimate for the next frame."""
        watch = Stopwatch()
        contours, config = self.contours, self.config
        frame = self.without_foreign(frame)
        pyramid = self.pyramid(frame)
        images = frame.images if config.colors else None
        watch.lap("masks_clean")
        self._alive += [replace(h, previous=h.pose, jumped=False) for h in self._alive if h.jumped]
        starts = np.array([h.pose + contours.prediction * (h.pose - h.previous) for h in self._alive])
        poses, hessian, iterations = self.settle(pyramid, starts, self._levels(), images, self._prior(starts))
        watch.lap("optimise")
        evidence = self.evidence(self.screen, frame, pyramid)
        by_view, met = evidence.cast(self.body, self.colors.group, poses, export=True)
        assert met is not None
        cost = mean_of_views(by_view)
        if not np.isfinite(cost).all():
            return self._nobody(frame, watch)
        self._alive = [
            Hypothesis(pose, h.pose, h.cost + RENEWAL * (c - h.cost) if h.age else float(c), h.age + 1)
            for h, pose, c in zip(self._alive, poses, cost, strict=True)
        ]
        self._rank()
        i = int(np.argmin([np.abs(pose - self._best.pose).max() for pose in poses]))
        label, curvature = met.label[i], hessian[i]
        residual = evidence.residual(label)
        error = residual.sum(axis=1)
        watch.lap("check")
        cut = not self._lost_for and self.residuals.jumped(residual)
        if cut and self._find_again(pyramid, error):
            label, curvature, residual = self._look(evidence, pyramid, images)
            error = residual.sum(axis=1)
        misplaced = self.misplaced(evidence, label)
        searched = self._needs_search(frame, self.residuals.high(error), misplaced)
        if searched:
            # after a search for single limbs that failed, one of a pair may have taken the other's place
            in_pairs, settled = self._search_failed, self._best.pose
            self._propose(frame, pyramid, evidence, images, misplaced, in_pairs)
            if self._best.pose is not settled:
                label, curvature, residual = self._look(evidence, pyramid, images)
                error = residual.sum(axis=1)
                misplaced = self.misplaced(evidence, label)
            self._search_failed = not in_pairs and self.residuals.high(error)
        else:
            self._search_failed = False
        watch.lap("search")
        followed = self._best.pose
        lost = self._recover(pyramid, error)
        if self._best.pose is not followed:
            label, curvature, residual = self._look(evidence, pyramid, images)
            error = residual.sum(axis=1)
        lost |= self._lost_for < UNKNOWN_AFTER and self.residuals.jumped(residual)
        self._learn(evidence, label, error, lost)
        again = cut or self._lost_for > 0
        status = "lost" if lost else "initialised" if self._fresh else "recovered" if again else "tracked"
        self._lost_for = self._lost_for + 1 if lost else 0
        self._fresh = False
        pose = self._best.pose
        sigma = self._sigma(pose, curvature, label, residual)
        for limb in self.misplaced(evidence, label):
            sigma[list(limb.joints)] = np.nan
        if self._high_for >= UNKNOWN_AFTER and self.residuals.high(error):
            sigma[:] = np.nan
        watch.lap("check")
        return Estimate(
            **self.pose_fields(pose),
            status=status,
            objective=float(self._best.cost),
            iterations=np.array([iterations.sum(), int(searched)], np.int32),
            timing=watch.laps,
            sigma=sigma,
            residual=residual,
            masks=pyramid.masks[0],
            drawn=label > 0,
        )

    def without_foreign(self, frame: Observation) -> Observation:
        """Return the frame with masks that exclude carried objects: large areas of colours that are not the person's.

        Their pixels become uncertain, because parts of the body may be in front of or behind them.
        """
        if not (self.config.colors and self.colors.known and frame.images.size):
            return frame
        foreign, grid = self.colors.foreign, self.screen
        person = grid.sample(frame.masks) >= 128
        unknown = foreign[color_bins(grid.sample(frame.images)[person])]
        view = np.nonzero(person)[0]
        seen, odd = (np.bincount(of, minlength=len(person)) for of in (view, view[unknown]))
        if odd.sum() < FOREIGN_SHARE * seen.sum():
            return frame
        masks = frame.masks.copy()
        uncertain = np.zeros(masks.shape, np.bool_) if frame.uncertain is None else frame.uncertain.copy()
        for c in np.flatnonzero(odd >= FOREIGN_SHARE * np.maximum(seen, 1)):
            x, y, w, h = cv2.boundingRect(masks[c])
            box = slice(y, y + h), slice(x, x + w)
            shown = np.flatnonzero(masks[c][box] >= 128)
            colors = frame.images[c][box].reshape(-1, 3).take(shown, axis=0)
            foreign_pixels = np.zeros((h, w), np.uint8)
            foreign_pixels.ravel()[shown] = foreign[color_bins(colors)]
            carried = cv2.morphologyEx(foreign_pixels, cv2.MORPH_OPEN, _OBJECT).view(np.bool_)
            masks[c][box][carried] = 0
            uncertain[c][box][carried] = True
        return replace(frame, masks=masks, uncertain=uncertain)

    @property
    def _best(self) -> Hypothesis:
        return self._alive[0]

    def last_poses(self) -> tuple[Float, Float]:
        """Return the poses (D,) of the last frame and of the frame before, in the tracker's frame."""
        return self._best.pose, self._best.previous

    def _levels(self) -> list[int]:
        """Return the scales of the next frame, coarse to fine.

        A coarse scale reaches far, but also other limbs' edges. So the first is the finest that reaches as far as a
        joint may be from its prediction: its last step times the unpredicted share. After a jump, a loss or a high
        residual it is the coarsest.
        """
        contours, skeleton = self.contours, self.body.skeleton
        first = self.solver.scales - 1
        if not (self._lost_for or self._high_for or any(h.jumped for h in self._alive)):
            step_m = max(skeleton.apart(h.pose, skeleton.joints(h.previous)) for h in self._alive)
            error_m = abs(1 - contours.prediction) * step_m
            error_px = error_m * self.views.rig.pixels_per_metre(skeleton.joints(self._best.pose)[0])
            while first > FEWEST - 1 and self.line_search.window_px * 2 ** (first - 1) >= error_px:
                first -= 1
        return list(range(first, -1, -1))

    def _prior(self, mean: Float, angle_deg: float = ANGLE_DEG) -> Prior:
        """Return the prior: straight joints about zero, all other degrees of freedom about ``mean`` (..., D)."""
        skeleton = self.body.skeleton
        deviation = np.where(skeleton.prismatic, TRANSLATION_M, np.radians(angle_deg))
        straight = skeleton.is_straight
        deviation[straight] = skeleton.straight[straight]
        return Prior(np.where(straight, 0.0, mean), deviation**-2 / INFORMATION)

    def _rank(self) -> None:
        """Sort the hypotheses by cost; drop those that cost :data:`MARGIN` more than the best, are too old or equal."""
        if len(self._alive) == 1:
            self._alive = [replace(self._alive[0], age=1)]
            return
        skeleton = self.body.skeleton
        kept: list[Hypothesis] = []
        joints: list[Float] = []
        for h in sorted(self._alive, key=lambda h: h.cost):
            if kept and (h.cost > kept[0].cost + MARGIN or h.age > PATIENCE):
                continue
            if all(skeleton.apart(h.pose, other) > SAME_POSE_M for other in joints):
                kept.append(h)
                joints.append(skeleton.joints(h.pose))
        self._alive = [replace(kept[0], age=1), *kept[1 : self.config.hypotheses]]

    def misplaced(self, evidence: Evidence, label: NDArray[np.uint8]) -> tuple[Limb, ...]:
        """Return the limbs of which a large part lies outside the mask, or on colours that are not theirs."""
        cost, count = evidence.cost_of_parts(self.colors.group, label)
        return tuple(
            limb for limb in self.limbs if cost[limb.parts].sum() > MISPLACED * max(count[limb.parts].sum(), 1)
        )

    def _needs_search(self, frame: Observation, high: bool, misplaced: Sequence[Limb]) -> bool:
        """Return whether the limbs are searched for: at intervals, if the residual is high or a limb is misplaced."""
        every = self.contours.search_every
        due = every > 0 and frame.index % every == 0
        return self.contours.body != "walker" and (due or high or bool(misplaced))

    def _propose(
        self,
        frame: Observation,
        pyramid: Pyramid,
        evidence: Evidence,
        images: NDArray[np.uint8] | None,
        misplaced: Sequence[Limb],
        in_pairs: bool,
    ) -> None:
        """Add the poses of a limb search to the hypotheses, with their cost relative to the best one's running mean."""
        best = self._best
        poses, cost = self.search(frame, pyramid, evidence, best.pose, images, misplaced, in_pairs)
        gain = cost[0] - cost
        # a gain within the noise of two casts counts only if it lasts over the next frames
        self._alive += [
            Hypothesis(pose, best.previous, best.cost - RENEWAL * float(g if g > GAIN else min(g, 0.0)), jumped=True)
            for pose, g in zip(poses[1:], gain[1:], strict=True)
            if g > -MARGIN / 2
        ]
        self._rank()

    def _recover(self, pyramid: Pyramid, by_view: Float) -> bool:
        """Return whether the person is lost; if so, or if the residual (E_S, (V,)) stays high, search for the person
        as at the start. Searches for the second reason become rarer: after 3, 6, 12 … frames."""
        error, limit = float(np.nanmean(by_view)), self.contours.lost_error
        self._high_for = self._high_for + 1 if self.residuals.high(by_view) else 0
        due = self._lost_for > 0 if error <= limit else self._lost_for % RECOVER_EVERY == 0
        waits, rest = divmod(self._high_for, RECOVER_EVERY)
        stays_high = not due and rest == 0 and waits.bit_count() == 1
        if not (due or stays_high):
            return error > limit
        pose, found = self.recover(pyramid, self._best.pose, error)
        if found < (error - self.residuals.margin if stays_high else error):
            self._alive = [Hypothesis(pose, pose, self._best.cost)]
        return found > limit

    def _find_again(self, pyramid: Pyramid, by_view: Float) -> bool:
        """Search for the person as at the start, because E_S (V,) has jumped in all views; return whether a better pose
        was found."""
        pose, _ = self.recover(pyramid, self._best.pose, float(np.nanmean(by_view)))
        if pose is self._best.pose:
            return False
        self._alive = [Hypothesis(pose, pose, self._best.cost)]
        return True

    def _learn(self, evidence: Evidence, label: NDArray[np.uint8], by_view: Float, lost: bool) -> None:
        """Update the baseline of the residual; the colours, too, if E_S (V,) is not above the baseline."""
        if lost:
            return
        if self.config.colors and evidence.bins is not None and self.residuals.mean_excess(by_view) <= 0:
            self.colors.learn(evidence.bins[evidence.person], label[evidence.person])
        self.residuals.learn(by_view)

    def _look(
        self, evidence: Evidence, pyramid: Pyramid, images: NDArray[np.uint8] | None
    ) -> tuple[NDArray[np.uint8], Float, Float]:
        """Return the best pose's labels on the grid (V, h, w), JᵀWJ (D, D), and residual (V, 2)."""
        best = self._best.pose[None]
        _, met = evidence.cast(self.body, self.colors.group, best, export=True)
        assert met is not None
        regions = None if images is None else self.colors.regions(images)
        here = self.views.equations(self.body.arrays, pyramid, best, 0, self.line_search, regions)
        return met.label[0], here.hessian[0], evidence.residual(met.label[0])

    def _sigma(self, pose: Float, curvature: Float, label: NDArray[np.uint8], residual: Float) -> Float:
        """Return (15,) one standard deviation of each joint's position along an axis, metres: from the evidence of this
        frame, the difference to the mean posture until now, and the spread of the hypotheses."""
        skeleton = self.body.skeleton
        variance = self._variance(pose, curvature, self._prior(pose), label, residual)
        self._postures = min(self._postures + 1, POSTURE_FRAMES)
        self._mean_posture += (directions(skeleton, pose) - self._mean_posture) / self._postures
        variance += posture_variance(skeleton, pose, self._mean_posture)
        if len(self._alive) > 1:
            poses, cost = (np.array(column) for column in zip(*((h.pose, h.cost) for h in self._alive), strict=True))
            variance += _disagreement(skeleton, poses, cost)
        return np.asarray(np.sqrt(variance))

    def _variance(
        self, pose: Float, curvature: Float, prior: Prior, label: NDArray[np.uint8], residual: Float
    ) -> Float:
        """Return (15,) variance of the joints' positions along an axis, metres², from the contours' noise and the
        directions of the views, scaled by the residual.

        Args:
            pose: (D,).
            curvature: (D, D) JᵀWJ.
            prior: of the pose.
            label: (V, h, w) the parts that the grid's rays meet.
            residual: (V, 2); NaN for a view that was not used.
        """
        body, used = self.body, np.isfinite(residual[:, 0])
        joints = body.skeleton.joints(pose)
        precision = INFORMATION * (curvature + np.diag(prior.precision))
        noise = contour_variance(body.skeleton, pose, precision, body.free)
        rays = joints - self.world.rig.centers[used, None]
        shares = contour_shares(body, self.screen, label, joints)[used]
        views = view_variance(rays / np.linalg.norm(rays, axis=-1, keepdims=True), shares)
        return np.asarray((noise + views) * variance_factor(residual))

    def second_pass(
        self,
        masks: Sequence[NDArray[np.uint8]],
        poses: Float,
        lost: NDArray[np.bool_],
        residual: Float,
        height_m: float | None,
        keep_body: bool = False,
    ) -> tuple[Float, Float, Float]:
        """Fit the body to frames of the whole recording, and refine every frame with it.

        Frames of different poses show what an opening without the initialisation pose may hide: only a bent knee or
        elbow shows where it is. Each frame stays near its pose of the first pass, because that has used colours to
        locate limbs inside the silhouette. Where a search has moved a limb, the new pose is also tracked backwards: it
        replaces earlier poses where its cost is lower, and σ includes the spread of the two.

        Args:
            masks: (C, H, W) of F frames, cleaned, as in the estimates.
            poses: (F, D) of the first pass, in the capture's world.
            lost: (F,) bool; such frames are not used and do not change.
            residual: (F, C, 2) of the first pass; a camera whose residual is NaN in a frame is not used in it.
            height_m: the subject's height, if known.
            keep_body: do not fit the body.

        Returns:
            Poses (F, D) in the capture's world, residuals (F, C, 2), and one standard deviation (F, 15) of the joints'
            positions along an axis, metres, 0 in lost frames. The tracker has the new body.
        """
        given, poses = poses, self.world.poses_in(poses)
        tracked = np.flatnonzero(~lost)
        variance = np.zeros((len(poses), len(JOINTS)))
        if not len(tracked):
            return given, residual, variance

        def used(i: int) -> NDArray[np.uint8]:
            shown, out = masks[i], np.isnan(residual[i, :, 0])
            return np.where(out[:, None, None], np.uint8(0), shown) if out.any() else shown

        if not keep_body and self.contours.adapt:
            opening = tracked[: self.contours.init_frames : 3]
            spread = _spread(
                tracked, np.nanmean(residual[tracked].sum(axis=2), axis=1), SECOND_FIT.frames - len(opening)
            )
            chosen = np.union1d(opening, spread)
            seen = [self.views.pyramid(used(int(i)), 1, False) for i in chosen]
            stature = height_m or self.body.dimensions.stature
            deviation = STATURE_DEVIATION if height_m else SECOND_STATURE_DEVIATION
            body, _ = self.fit(seen, poses[chosen], np.arange(len(chosen)), stature, SECOND_FIT, deviation)
            self.take_body(body)
        result, residuals = poses.copy(), np.array(residual)
        body = self.body
        for chunk in np.array_split(tracked, -(-len(tracked) // AT_ONCE)):
            seen = [self.views.pyramid(used(int(i)), 1, False) for i in chunk]
            prior = self._prior(poses[chunk], SECOND_ANGLE_DEG)
            settled = self.settle(Pyramid.of_all(seen), poses[chunk], (0,), prior=prior)
            result[chunk] = settled.states
            for i, pyramid, curvature in zip(chunk, seen, settled.hessian, strict=True):
                _, (residuals[i],), (label,) = self._costs(pyramid, result[i][None])
                variance[i] = self._variance(result[i], curvature, prior, label, residuals[i])
        jumps = _jumps(body.skeleton, poses)
        later: Hypothesis | None = None
        for i in tracked[::-1]:
            if i + 1 == len(poses) or lost[i + 1]:
                later = None
            elif later is None and jumps[i + 1]:
                later = Hypothesis(result[i + 1], result[i + 1], 0.0)
            if later is None:
                continue
            pyramid = self.views.pyramid(used(int(i)), 1, False)
            prior = self._prior(later.pose[None], SECOND_ANGLE_DEG)
            settled = self.settle(pyramid, later.pose[None], (0,), prior=prior)
            both = np.stack([result[i], settled.states[0]])
            costs, of_both, labels = self._costs(pyramid, both)
            later = self._backwards(later, both, costs)
            if later is None:
                continue
            if later.cost < -GAIN:
                result[i], residuals[i] = both[1], of_both[1]
                variance[i] = self._variance(result[i], settled.hessian[0], prior, labels[1], residuals[i])
            variance[i] += _disagreement(body.skeleton, both, np.array([0.0, later.cost]))
        posture = np.median(directions(self.body.skeleton, result[tracked]), axis=0)
        variance[tracked] += posture_variance(self.body.skeleton, result[tracked], posture)
        return np.where(lost[:, None], given, self.world.poses_out(result)), residuals, np.sqrt(variance)

    def _costs(self, pyramid: Pyramid, poses: Float) -> tuple[Float, Float, NDArray[np.uint8]]:
        """Return the costs (B,) of poses (B, D) by masks alone, mean over the views, their residuals (B, V, 2), and the
        parts that the grid's rays meet (B, V, h, w)."""
        evidence = Evidence.of(self.screen, pyramid.masks[0])
        by_view, met = evidence.cast(self.body, self.colors.group, poses, export=True)
        assert met is not None
        return mean_of_views(by_view), np.array([evidence.residual(label) for label in met.label]), met.label

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
        skeleton = self.body.skeleton
        if more > MARGIN or skeleton.apart(poses[1], skeleton.joints(poses[0])) <= SAME_POSE_M:
            return None
        return Hypothesis(poses[1], later.pose, more, later.age + 1)

    def _nobody(self, frame: Observation, watch: Stopwatch) -> Estimate:
        """Return the estimate of a frame without a person: the last pose, lost."""
        self._lost_for += 1
        pose = self._best.pose
        self._alive = [Hypothesis(pose, pose, self._best.cost)]
        for stage in self.timing_stages:
            watch.lap(stage)
        return Estimate(
            **self.pose_fields(pose),
            status="lost",
            objective=np.inf,
            iterations=np.zeros(len(self.stages), np.int32),
            timing=watch.laps,
            sigma=np.full(len(JOINTS), np.nan),
            residual=np.full((len(frame.masks), 2), np.nan),
        )

    def state(self) -> Mapping[str, Any]:
        """Return what :meth:`restore` needs, beside the model, to continue after the last frame."""
        return {
            **super().state(),
            "poses": np.array([h.pose for h in self._alive]),
            "previous": np.array([h.previous for h in self._alive]),
            "costs": np.array([h.cost for h in self._alive]),
            "ages": np.array([h.age for h in self._alive]),
            "jumped": np.array([h.jumped for h in self._alive]),
            **self.residuals.state(),
            "mean_posture": self._mean_posture.copy(),
            "postures": self._postures,
            "lost_for": self._lost_for,
            "high_for": self._high_for,
            "search_failed": self._search_failed,
            **self.colors.state(),
        }

    def rewind(self, state: Mapping[str, Any]) -> None:
        """Go back to a state."""
        rows = zip(*(np.array(state[name]) for name in ("poses", "previous", "costs", "ages", "jumped")), strict=True)
        self._alive = [Hypothesis(p, q, float(c), int(a), bool(j)) for p, q, c, a, j in rows]
        self.residuals.restore(state)
        self._mean_posture = np.array(state["mean_posture"], np.float64)
        self._postures = int(state["postures"])
        self._lost_for = int(state["lost_for"])
        self._high_for = int(state["high_for"])
        self._search_failed = bool(state["search_failed"])
        self.colors.restore(state)
        self._fresh = False

    def with_cameras(self, rig: Rig) -> RegionTracker:
        """Return a tracker of the same body and colours with other cameras."""
        fresh = RegionTracker(rig, self.up, self.contours, self.config)
        fresh.take_body(self.body)
        fresh.colors.restore(self.colors.state())
        return fresh


def _disagreement(skeleton: Skeleton, poses: Float, cost: Float) -> Float:
    """Return (J,) variance of the joints' positions along an axis, metres², over poses (H, D) with costs (H,)."""
    weight = np.exp((cost.min() - cost) / GAIN)
    weight /= weight.sum()
    joints = skeleton.joints(poses)
    mean = np.einsum("h,hja->ja", weight, joints)
    return np.asarray(np.einsum("h,hja->j", weight, (joints - mean) ** 2) / 3)


def _jumps(skeleton: Skeleton, poses: Float) -> NDArray[np.bool_]:
    """Return (F,) whether a joint's step to a frame, of poses (F, D), is longer than those before and after it by
    :data:`JUMP_M`."""
    steps = np.pad(np.linalg.norm(np.diff(skeleton.joints(poses), axis=0), axis=2), ((1, 1), (0, 0)))
    beside = np.maximum(steps[:-2], steps[2:])
    return np.concatenate([[False], (steps[1:-1] > beside + JUMP_M).any(axis=1)])


def _spread(frames: NDArray[np.int64], error: Float, count: int) -> NDArray[np.int64]:
    """Return the frame of the lowest E_S (N,) in each of ``count`` stretches of the frames (N,)."""
    edges = np.linspace(0, len(frames), min(count, len(frames)) + 1).round().astype(int)
    return np.array([frames[a + int(np.argmin(error[a:b]))] for a, b in pairwise(edges)])
