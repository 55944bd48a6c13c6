"""The region tracker, the default: contours place the limbs, a search over all of their places finds them again.

A frame's way, top to bottom:

    masks → contours from the prediction: silhouette edges, and inside the silhouette borders between colours
          → does the body explain every ray?  ── yes ─► pose, σ
          → no: places of all limbs, screened in one batch each, the best descended from
          → the few best live on for some frames; the one that explains them best is the pose
          → colours of the parts learned

Contours and equations are the silhouette paper's (sections 4.1 to 4.3); borders between colours are those of
region-based tracking (Stoiber et al., *SRT3D*, IJCV 2022). The search takes the place of the first paper's Stochastic
Meta Descent and of its visual hull: a limb lies in the hull and fills it where it lies in all silhouettes and leaves no
ray of theirs without a part. Casting rays tells that directly, at the pictures' resolution and not the voxels'.
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
from tk.model.body.joint_sigma import contour_variance, directions, posture_variance
from tk.model.body.limb_candidates import Limb
from tk.model.body.skeleton import JOINTS, Skeleton
from tk.model.cameras.camera import Rig
from tk.model.cues.part_colors import color_bins
from tk.model.cues.ray_costs import Evidence, mean_of_views
from tk.model.masks.silhouettes import Pyramid
from tk.model.setup import InitPose, Setup
from tk.optim.gauss_newton import Prior
from tk.settings import BodyFitSettings, RegionSettings, Settings, SilhouetteSettings
from tk.trackers.contour_tracker import GAIN, RECOVER_EVERY, SAME_POSE_M, ContourTracker
from tk.trackers.protocol import Estimate, Observation, Stopwatch, drift

Float = NDArray[np.float64]

# Information of one pixel of contour, 1/px²: edgels err by 2 px, and together along 10 px.
INFORMATION = 1.0 / (2.0**2 * 10.0)
# A frame is gone through at this many scales at least: at the finest alone a descent does not come all the way.
FEWEST = 2
# Standard deviations of the priors: waist and ankles about straight ones, the others about their prediction.
WAIST_DEG, ANKLE_DEG, ANGLE_DEG, TRANSLATION_M = 12.0, 20.0, 40.0, 0.3
# How long a hypothesis may live beside the best one, in frames, and how much of its running cost a frame replaces.
PATIENCE, RENEWAL = 6, 0.4
# Hypotheses that cost this much more than the best one, as a share of the person's pixels, are dropped.
MARGIN = 0.02
# A limb that is lost shows in most views, a torn mask in one: no view adds more than this to what a frame is explained
# worse than usual.
MOST_A_VIEW = 0.15
# Who stays worse explained for so many frames has been looked for twice in vain: where the joints are is not known.
UNKNOWN_AFTER = 2 * RECOVER_EVERY
# Colours are learned only in frames that are explained about as well as is usual, and what is worse than that counts as
# this much worse: a wrong pose that lasts does not become usual.
LEARN_RATIO = 1.15
# Masks are searched for what is carried where this share of their pixels has colours that are not the person's; smaller
# things than this many pixels across stay.
FOREIGN_SHARE = 0.01
_THING = np.ones((5, 5), np.uint8)
# A limb is not where it is told to be if a ray that meets it costs more than this on an average. In the development
# captures no limb that lay within 15 cm of the truth had 0.25, and of those farther off most had 0.3 to 0.4.
MISPLACED = 0.25
# The second pass: what the body is fitted to, and how near a frame stays to its pose of the first pass.
SECOND_FIT = BodyFitSettings(frames=24, rounds=4)
SECOND_ANGLE_DEG = 15.0
# One standard deviation of the logarithm of the stature about that of the first fit, where no height was given.
SECOND_STATURE_DEVIATION = 0.03
# Frames that the second pass settles in one launch.
AT_ONCE = 8
# A step of a joint that is longer than its neighbours by this is a jump, metres: twice what makes two poses of one.
JUMP_M = 2 * SAME_POSE_M
# Over so many frames the usual posture of the first pass is a plain mean, then one that forgets.
USUAL_FRAMES = 200


@dataclass(frozen=True)
class Hypothesis:
    """A pose that is followed.

    Attributes:
        pose, previous: (D,) now and a frame before.
        cost: running mean of what it leaves unexplained.
        age: frames since it was proposed.
        jumped: a search has just found it: ``previous`` is that of the pose which it replaces, so that it may be moving
            fast, or that pose had lost it.
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
        self._usual: Float = np.full(len(rig), np.inf)
        self._usual_posture: Float = np.zeros((len(JOINTS), 3))
        self._postures = 0
        self._lost_for = 0
        self._stranded = 0
        self._in_vain = False
        self._fresh = True

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
        self._usual = np.full(len(self._usual), np.inf)
        self._usual_posture, self._postures = np.zeros((len(JOINTS), 3)), 0
        self._lost_for = 0
        self._stranded = 0
        self._in_vain = False
        self._fresh = True

    def step(self, frame: Observation) -> Estimate:
        """The pose in the next frame."""
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
        misplaced = self.misplaced(evidence, label)
        searched = self._needs_search(frame, self._worse(error), misplaced)
        if searched:
            # where no limb alone was better in the frame before, one may be where the other one of its pair should be
            in_pairs, settled = self._in_vain, self._best.pose
            self._propose(frame, pyramid, evidence, images, misplaced, in_pairs)
            if self._best.pose is not settled:
                label, curvature, residual = self._look(evidence, pyramid, images)
                error = residual.sum(axis=1)
                misplaced = self.misplaced(evidence, label)
            self._in_vain = not in_pairs and self._worse(error)
        else:
            self._in_vain = False
        watch.lap("search")
        followed = self._best.pose
        lost = self._follow(pyramid, error)
        if self._best.pose is not followed:
            label, curvature, residual = self._look(evidence, pyramid, images)
            error = residual.sum(axis=1)
        self._learn(evidence, label, error, lost)
        status = "lost" if lost else "initialised" if self._fresh else "recovered" if self._lost_for else "tracked"
        self._lost_for = self._lost_for + 1 if lost else 0
        self._fresh = False
        pose = self._best.pose
        sigma = self._sigma(pose, curvature)
        for limb in self.misplaced(evidence, label):  # no search has found it
            sigma[list(limb.joints)] = np.nan
        if self._stranded >= UNKNOWN_AFTER and self._worse(error):
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
        """The frame, where it shows things of colours that are not the person's without those in its masks: what is
        carried. They stay in doubt, for parts may be before or behind them."""
        if not (self.config.colors and self.colors.known and frame.images.size):
            return frame
        foreign, grid = self.colors.foreign, self.screen
        person = grid.sample(frame.masks) >= 128
        strange = foreign[color_bins(grid.sample(frame.images)[person])]
        view = np.nonzero(person)[0]
        seen, odd = (np.bincount(of, minlength=len(person)) for of in (view, view[strange]))
        if odd.sum() < FOREIGN_SHARE * seen.sum():
            return frame
        masks = frame.masks.copy()
        uncertain = np.zeros(masks.shape, np.bool_) if frame.uncertain is None else frame.uncertain.copy()
        for c in np.flatnonzero(odd >= FOREIGN_SHARE * np.maximum(seen, 1)):
            x, y, w, h = cv2.boundingRect(masks[c])
            box = slice(y, y + h), slice(x, x + w)
            shown = np.flatnonzero(masks[c][box] >= 128)
            colors = frame.images[c][box].reshape(-1, 3).take(shown, axis=0)
            odd_ones = np.zeros((h, w), np.uint8)
            odd_ones.ravel()[shown] = foreign[color_bins(colors)]
            thing = cv2.morphologyEx(odd_ones, cv2.MORPH_OPEN, _THING).view(np.bool_)
            masks[c][box][thing] = 0
            uncertain[c][box][thing] = True
        return replace(frame, masks=masks, uncertain=uncertain)

    @property
    def _best(self) -> Hypothesis:
        return self._alive[0]

    def _levels(self) -> list[int]:
        """The scales to go through. A coarse one sees far, and so other limbs' edges: the first is the one that sees as
        far as the prediction leaves to go of what a joint went in the frame before; the coarsest, after a jump and for
        who is lost or stranded."""
        contours, skeleton = self.contours, self.body.skeleton
        first = self.solver.scales - 1
        if not (self._lost_for or self._stranded or any(h.jumped for h in self._alive)):
            went_m = max(skeleton.apart(h.pose, skeleton.joints(h.previous)) for h in self._alive)
            left_m = abs(1 - contours.prediction) * went_m
            left_px = left_m * self.views.rig.pixels_per_metre(skeleton.joints(self._best.pose)[0])
            while first > FEWEST - 1 and self.line_search.window_px * 2 ** (first - 1) >= left_px:
                first -= 1
        return list(range(first, -1, -1))

    def _prior(self, mean: Float, angle_deg: float = ANGLE_DEG) -> Prior:
        """Waist and ankles are about straight, all else is about where it was expected."""
        skeleton = self.body.skeleton
        deviation = np.where(skeleton.prismatic, TRANSLATION_M, np.radians(angle_deg))
        deviation[skeleton.is_waist] = np.radians(WAIST_DEG)
        deviation[skeleton.is_ankle] = np.radians(ANKLE_DEG)
        straight = skeleton.is_waist | skeleton.is_ankle
        return Prior(np.where(straight, 0.0, mean), deviation**-2 / INFORMATION)

    def _rank(self) -> None:
        """The hypothesis that explains the last frames best comes first; those far behind, or equal, are dropped."""
        if len(self._alive) == 1:
            self._alive = [replace(self._alive[0], age=1)]
            return
        skeleton = self.body.skeleton
        kept: list[Hypothesis] = []
        places: list[Float] = []
        for h in sorted(self._alive, key=lambda h: h.cost):
            if kept and (h.cost > kept[0].cost + MARGIN or h.age > PATIENCE):
                continue
            if all(skeleton.apart(h.pose, other) > SAME_POSE_M for other in places):
                kept.append(h)
                places.append(skeleton.joints(h.pose))
        self._alive = [replace(kept[0], age=1), *kept[1 : self.config.hypotheses]]

    def misplaced(self, evidence: Evidence, label: NDArray[np.uint8]) -> tuple[Limb, ...]:
        """The limbs that lie outside the person, or on colours that are not theirs, for a good part of them."""
        cost, count = evidence.cost_of_parts(self.colors.group, label)
        return tuple(
            limb for limb in self.limbs if cost[limb.parts].sum() > MISPLACED * max(count[limb.parts].sum(), 1)
        )

    def _needs_search(self, frame: Observation, worse: bool, misplaced: Sequence[Limb]) -> bool:
        """Whether a limb is where it cannot be, this frame is explained worse than is usual, or it is time to look
        around."""
        every = self.contours.search_every
        due = every > 0 and frame.index % every == 0
        return self.contours.body != "walker" and (due or worse or bool(misplaced))

    def _worse(self, error: Float) -> bool:
        """Whether a frame is explained worse than is usual for this person, by views (C,): by as much as a limb leaves
        that is lost."""
        excess = np.minimum(error - self._usual, MOST_A_VIEW)
        return bool(np.nanmean(excess) > self.config.search_excess)

    def _propose(
        self,
        frame: Observation,
        pyramid: Pyramid,
        evidence: Evidence,
        images: NDArray[np.uint8] | None,
        misplaced: Sequence[Limb],
        in_pairs: bool,
    ) -> None:
        """Other places of the limbs join the hypotheses, with what they cost above the best one's running mean."""
        best = self._best
        poses, cost = self.search(frame, pyramid, evidence, best.pose, images, misplaced, in_pairs)
        gain = cost[0] - cost
        # a jump must pay more than noise makes of two casts; less must show in the frames that follow
        self._alive += [
            Hypothesis(pose, best.previous, best.cost - RENEWAL * float(g if g > GAIN else min(g, 0.0)), jumped=True)
            for pose, g in zip(poses[1:], gain[1:], strict=True)
            if g > -MARGIN / 2
        ]
        self._rank()

    def _follow(self, pyramid: Pyramid, by_view: Float) -> bool:
        """Whether the person is lost; who is, or stays badly explained, is looked for as at the start; if that is in
        vain, again after twice as long."""
        error, limit = float(np.nanmean(by_view)), self.contours.lost_error
        self._stranded = self._stranded + 1 if self._worse(by_view) else 0
        due = self._lost_for > 0 if error <= limit else self._lost_for % RECOVER_EVERY == 0
        waits, rest = divmod(self._stranded, RECOVER_EVERY)
        stranded = not due and rest == 0 and waits.bit_count() == 1
        if not (due or stranded):
            return error > limit
        pose, found = self.recover(pyramid, self._best.pose, error)
        if found < (error - self.config.search_excess if stranded else error):
            self._alive = [Hypothesis(pose, pose, self._best.cost)]
        return found > limit

    def _learn(self, evidence: Evidence, label: NDArray[np.uint8], by_view: Float, lost: bool) -> None:
        if lost:
            return
        seen = np.isfinite(by_view)
        error, usual = by_view[seen], self._usual[seen]
        if self.config.colors and evidence.bins is not None and error.sum() <= LEARN_RATIO * usual.sum():
            self.colors.learn(evidence.bins[evidence.person], label[evidence.person])
        self._usual[seen] = drift(usual, np.minimum(error, LEARN_RATIO * usual))

    def _look(
        self, evidence: Evidence, pyramid: Pyramid, images: NDArray[np.uint8] | None
    ) -> tuple[NDArray[np.uint8], Float, Float]:
        """The best pose's labels on the screen (V, h, w), JᵀWJ (D, D), and residual (V, 2)."""
        best = self._best.pose[None]
        _, met = evidence.cast(self.body, self.colors.group, best, export=True)
        assert met is not None
        regions = None if images is None else self.colors.regions(images)
        here = self.views.equations(self.body.arrays, pyramid, best, 0, self.line_search, regions)
        return met.label[0], here.hessian[0], evidence.residual(met.label[0])

    def _sigma(self, pose: Float, curvature: Float) -> Float:
        """(15,) one standard deviation of each joint's position along an axis, metres: of the contours' noise, the
        posture beside the usual one until now, and the spread of the hypotheses that live."""
        skeleton = self.body.skeleton
        precision = INFORMATION * (curvature + np.diag(self._prior(pose).precision))
        variance = contour_variance(skeleton, pose, precision, self.body.free)
        self._postures = min(self._postures + 1, USUAL_FRAMES)
        self._usual_posture += (directions(skeleton, pose) - self._usual_posture) / self._postures
        variance += posture_variance(skeleton, pose, self._usual_posture)
        if len(self._alive) > 1:
            poses, cost = (np.array(column) for column in zip(*((h.pose, h.cost) for h in self._alive), strict=True))
            variance += _disagreement(skeleton, poses, cost)
        return np.asarray(np.sqrt(variance))

    def second_pass(
        self,
        masks: Sequence[NDArray[np.uint8]],
        poses: Float,
        lost: NDArray[np.bool_],
        residual: Float,
        height_m: float | None,
        keep_body: bool = False,
    ) -> tuple[Float, Float, Float]:
        """Fit the body to frames of the whole recording, and settle every frame anew with it.

        Frames of differing poses show what an opening without the initialisation pose may not: where a knee or an elbow
        is, only a bent one tells. Each frame stays near the pose that the first pass found, so that what colours told
        of a limb inside the silhouette is not lost. Where a limb jumps, for a search has found it elsewhere, the pose
        behind that is followed backwards beside those of the frames before: what explains them better stands, and σ
        has the spread of the two.

        Args:
            masks: (C, H, W) of F frames, as :meth:`step` told them: cleaned.
            poses: (F, D) of the first pass, in the capture's world.
            lost: (F,) bool; such frames neither teach nor change.
            residual: (F, C, 2) of the first pass; a camera whose residual is NaN in a frame is not used in it.
            height_m: the subject's height, if known.
            keep_body: leave the body as it is.

        Returns:
            Poses (F, D) in the capture's world, residuals (F, C, 2), and one standard deviation (F, 15) of the joints'
            positions along an axis, metres, 0 in lost frames. The tracker has the new body.
        """
        given, poses = poses, self.world.poses_in(poses)
        tracked = np.flatnonzero(~lost)
        variance = np.zeros((len(poses), len(JOINTS)))
        if not len(tracked):
            return given, residual, variance

        def believed(i: int) -> NDArray[np.uint8]:
            shown, out = masks[i], np.isnan(residual[i, :, 0])
            return np.where(out[:, None, None], np.uint8(0), shown) if out.any() else shown

        if not keep_body and self.contours.adapt:
            opening = tracked[: self.contours.init_frames : 3]
            spread = _spread(
                tracked, np.nanmean(residual[tracked].sum(axis=2), axis=1), SECOND_FIT.frames - len(opening)
            )
            chosen = np.union1d(opening, spread)
            seen = [self.views.pyramid(believed(int(i)), 1, False) for i in chosen]
            stature = height_m or self.body.dimensions.stature
            deviation = STATURE_DEVIATION if height_m else SECOND_STATURE_DEVIATION
            body, _ = self.fit(seen, poses[chosen], np.arange(len(chosen)), stature, SECOND_FIT, deviation)
            self.take_body(body)
        result, residuals = poses.copy(), np.array(residual)
        body = self.body
        for chunk in np.array_split(tracked, -(-len(tracked) // AT_ONCE)):
            seen = [self.views.pyramid(believed(int(i)), 1, False) for i in chunk]
            prior = self._prior(poses[chunk], SECOND_ANGLE_DEG)
            settled = self.settle(Pyramid.of_all(seen), poses[chunk], (0,), prior=prior)
            result[chunk] = settled.states
            precision = INFORMATION * (settled.hessian + np.diag(prior.precision))
            variance[chunk] = contour_variance(body.skeleton, result[chunk], precision, body.free)
            for i, pyramid in zip(chunk, seen, strict=True):
                residuals[i] = self._costs(pyramid, result[i][None])[1][0]
        jumps = _jumps(body.skeleton, poses)
        later: Hypothesis | None = None
        for i in tracked[::-1]:
            if i + 1 == len(poses) or lost[i + 1]:
                later = None
            elif later is None and jumps[i + 1]:
                later = Hypothesis(result[i + 1], result[i + 1], 0.0)
            if later is None:
                continue
            pyramid = self.views.pyramid(believed(int(i)), 1, False)
            prior = self._prior(later.pose[None], SECOND_ANGLE_DEG)
            settled = self.settle(pyramid, later.pose[None], (0,), prior=prior)
            both = np.stack([result[i], settled.states[0]])
            costs, of_both = self._costs(pyramid, both)
            later = self._backwards(later, both, costs)
            if later is None:
                continue
            if later.cost < -GAIN:
                result[i], residuals[i] = both[1], of_both[1]
                precision = INFORMATION * (settled.hessian[0] + np.diag(prior.precision))
                variance[i] = contour_variance(body.skeleton, result[i], precision, body.free)
            variance[i] += _disagreement(body.skeleton, both, np.array([0.0, later.cost]))
        usual = np.median(directions(self.body.skeleton, result[tracked]), axis=0)
        variance[tracked] += posture_variance(self.body.skeleton, result[tracked], usual)
        return np.where(lost[:, None], given, self.world.poses_out(result)), residuals, np.sqrt(variance)

    def _costs(self, pyramid: Pyramid, poses: Float) -> tuple[Float, Float]:
        """Return the costs (B,) of poses (B, D) by masks alone, mean over the views, and their residuals (B, V, 2)."""
        evidence = Evidence.of(self.screen, pyramid.masks[0])
        by_view, met = evidence.cast(self.body, self.colors.group, poses, export=True)
        assert met is not None
        return mean_of_views(by_view), np.array([evidence.residual(label) for label in met.label])

    def _backwards(self, later: Hypothesis, poses: Float, cost: Float) -> Hypothesis | None:
        """The hypothesis that comes from the frame after, by what it costs more than that frame's own pose; both are at
        ``poses`` (2, D), the own one first. None where they are the same, or it explains too little."""
        more = float(cost[1] - cost[0])
        if later.age:
            more = later.cost + RENEWAL * (more - later.cost)
        skeleton = self.body.skeleton
        if more > MARGIN or skeleton.apart(poses[1], skeleton.joints(poses[0])) <= SAME_POSE_M:
            return None
        return Hypothesis(poses[1], later.pose, more, later.age + 1)

    def _nobody(self, frame: Observation, watch: Stopwatch) -> Estimate:
        """Nobody is in sight: the last pose stands, as lost."""
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
        """What :meth:`restore` needs beside the model to go on from the last frame."""
        return {
            **super().state(),
            "poses": np.array([h.pose for h in self._alive]),
            "previous": np.array([h.previous for h in self._alive]),
            "costs": np.array([h.cost for h in self._alive]),
            "ages": np.array([h.age for h in self._alive]),
            "jumped": np.array([h.jumped for h in self._alive]),
            "usual": self._usual.copy(),
            "usual_posture": self._usual_posture.copy(),
            "postures": self._postures,
            "lost_for": self._lost_for,
            "stranded": self._stranded,
            "in_vain": self._in_vain,
            **self.colors.state(),
        }

    def rewind(self, state: Mapping[str, Any]) -> None:
        """Go back to a state."""
        rows = zip(*(np.array(state[name]) for name in ("poses", "previous", "costs", "ages", "jumped")), strict=True)
        self._alive = [Hypothesis(p, q, float(c), int(a), bool(j)) for p, q, c, a, j in rows]
        self._usual = np.full(len(self.views.rig), state["usual"], np.float64)
        self._usual_posture = np.array(state["usual_posture"], np.float64)
        self._postures = int(state["postures"])
        self._lost_for = int(state["lost_for"])
        self._stranded = int(state["stranded"])
        self._in_vain = bool(state["in_vain"])
        self.colors.restore(state)
        self._fresh = False

    def with_cameras(self, rig: Rig) -> RegionTracker:
        """Return a tracker of the same body and colours with other cameras."""
        fresh = RegionTracker(rig, self.up, self.contours, self.config)
        fresh.take_body(self.body)
        fresh.colors.restore(self.colors.state())
        return fresh

    def start_at(self, pose: Float) -> None:
        """Continue at a pose (D,) of the setup's world, with no memory of the frames before it."""
        start = self.world.poses_in(pose[None])
        once = {"poses": start, "previous": start, "costs": np.zeros(1), "ages": np.ones(1, int)}
        nothing = {"usual": np.inf, "lost_for": 0, "stranded": 0, "in_vain": False}
        self.rewind({**self.state(), **once, **nothing, "jumped": np.zeros(1, bool)})


def _disagreement(skeleton: Skeleton, poses: Float, cost: Float) -> Float:
    """(J,) variance of the joints' places along an axis over poses (H, D) that cost so much (H,), metres²."""
    weight = np.exp((cost.min() - cost) / GAIN)
    weight /= weight.sum()
    places = skeleton.joints(poses)
    mean = np.einsum("h,hja->ja", weight, places)
    return np.asarray(np.einsum("h,hja->j", weight, (places - mean) ** 2) / 3)


def _jumps(skeleton: Skeleton, poses: Float) -> NDArray[np.bool_]:
    """(F,) whether a joint comes to the pose of a frame, of (F, D), by a step longer than those before and behind it,
    by :data:`JUMP_M`."""
    steps = np.pad(np.linalg.norm(np.diff(skeleton.joints(poses), axis=0), axis=2), ((1, 1), (0, 0)))
    beside = np.maximum(steps[:-2], steps[2:])
    return np.concatenate([[False], (steps[1:-1] > beside + JUMP_M).any(axis=1)])


def _spread(frames: NDArray[np.int64], error: Float, count: int) -> NDArray[np.int64]:
    """Of each of ``count`` stretches of the frames (N,) the one that is explained best, error (N,)."""
    edges = np.linspace(0, len(frames), min(count, len(frames)) + 1).round().astype(int)
    return np.array([frames[a + int(np.argmin(error[a:b]))] for a, b in pairwise(edges)])
