"""The region tracker, the default: contours locate the limbs, and a search over all their poses finds lost ones again.

One frame:

    masks → contours from the prediction: silhouette edges, and colour differences inside the silhouette
          → are there landmarks? Their pose is a hypothesis
          → is the residual high, a limb misplaced, or a search due?  ── no ─► pose, σ
          → yes: candidates for all limbs, screened in one launch each, the best ones refined; exchanged limbs, and the
            opposite heading
          → the best few are tracked for some frames; the one with the lowest cost is the pose
          → the colours of the parts are learned

Contours and equations are the silhouette paper's (sections 4.1 to 4.3); the colour differences are those of
region-based tracking (Stoiber et al., *SRT3D*, IJCV 2022). The search replaces the first paper's Stochastic Meta
Descent and its visual hull, which a limb should lie in and fill. Rays measure the same in the images, at a finer
resolution: every part should lie in all silhouettes, and every ray of a silhouette should meet a part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.kernels.mask_values import PERSON
from tk.kernels.silhouette import normal_equations
from tk.model.body.joint_sigma import CHANGING_M, directions, pose_variance, posture_variance
from tk.model.body.limb_candidates import Limb
from tk.model.body.skeleton import JOINTS, distinct
from tk.model.cameras.camera import Rig
from tk.model.cues import landmarks
from tk.model.cues.cue import CONTOUR_INFORMATION, Measured
from tk.model.cues.part_colors import LearnedColors, color_bins
from tk.model.cues.ray_costs import Evidence
from tk.model.masks.mosaic import doubled
from tk.model.masks.regions import SQUARE3
from tk.model.masks.silhouettes import Pyramid
from tk.model.reduced_images import crop
from tk.model.setup import Setup, Subject
from tk.optim.quadratic import Quadratic
from tk.settings import RegionSettings, Settings, SilhouetteSettings
from tk.trackers.contour_finder import Seen
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.hypotheses import DROPPED, RENEWAL, SAME_POSE_M, Hypothesis, disagreement, renewed
from tk.trackers.judgement import RECOVER_EVERY, Match, depth_known
from tk.trackers.proposals import exchanged, limbs
from tk.trackers.proposals import landmarks as of_landmarks
from tk.trackers.proposals import opposite as of_heading
from tk.trackers.protocol import Estimate, Frame, Stopwatch
from tk.trackers.reason import Reason, is_lost
from tk.trackers.residual import BaselineState, ResidualBaseline, variance_factor
from tk.trackers.second_pass import SecondPass

Float = NDArray[np.float64]

# Standard deviations of the priors about the predicted pose (tk.model.body.joints has those about zero).
ANGLE_DEG, TRANSLATION_M = 40.0, 0.3
# A limb is misplaced if the mean mismatch of its rays is larger.
MISPLACED = 0.25
# Limbs are searched for in every second frame if this share of the body's rays meets pixels of other people: a hidden
# limb has no contour to follow, and appears elsewhere. Where the pose explains the frame as well as others, nothing can
# be found: the residual must be DOUBTFUL spreads above its mean.
HIDDEN, SEARCH_HIDDEN, DOUBTFUL = 0.02, 2, 0.5
_NEVER = -(2**31)  # the frame of the last limb search if there was none


class _Look(NamedTuple):
    """How the best pose explains a frame."""

    label: NDArray[np.uint8]  # (V, h, w) the parts that the grid's rays meet
    residual: Float  # (V, 2) missing and surplus area

    @property
    def error(self) -> Float:
        """(V,) E_S."""
        return np.asarray(self.residual.sum(axis=1))


@dataclass(frozen=True)
class RegionState:
    """What changes from frame to frame. Poses are in the tracker's own world.

    Attributes:
        alive: the hypotheses, best first.
        residuals, colors: what has been learned.
        mean_posture, postures: (J, 3) mean directions, of this number of frames.
        lost_for, refused, high_for: consecutive frames in which the person was lost, whose pose was refused
            (:class:`~tk.trackers.judgement.Match`), and with a high residual.
        view_m: see :class:`RegionTracker`.
        spread: (J,) variance of the joints' positions along an axis, metres², over the modes of the last limb search.
        searched: the frame of that search; :data:`_NEVER` before the first one, and where the person has been found
            anew.
        fresh: whether no frame has been tracked yet.
    """

    alive: list[Hypothesis]
    residuals: BaselineState
    colors: LearnedColors
    mean_posture: Float
    postures: int
    lost_for: int
    refused: int
    high_for: int
    view_m: float
    spread: Float
    searched: int
    fresh: bool


class RegionTracker(ContourTracker[RegionState]):
    """Tracks one person. :meth:`start` once, then :meth:`step` for every frame, the first included.

    Attributes:
        view_m: displacement of a segment's contours in one view, metres along an axis; larger if the calibration is
            doubtful.
    """

    State = RegionState
    method = "region"
    stages: tuple[str, ...] = ("contours", "search")
    timing_stages: tuple[str, ...] = ("masks_clean", "optimise", "check", "search")
    image_step = 2
    reports_sigma = True
    has_second_pass = True

    @classmethod
    def of(cls, setup: Setup, settings: Settings) -> RegionTracker:
        """Return a new tracker with the settings of this method."""
        return cls(setup.rig, setup.up, settings.silhouette, settings.region, setup.fps, settings.seed)

    def __init__(
        self,
        rig: Rig,
        up: str,
        settings: SilhouetteSettings | None = None,
        region_settings: RegionSettings | None = None,
        fps: float = 15.0,
        seed: int = 0,
    ) -> None:
        super().__init__(rig, up, settings or SilhouetteSettings(), fps, seed=seed)
        self.region_settings = region_settings or RegionSettings()
        self._alive: list[Hypothesis] = []
        self._mean_posture: Float = np.zeros((len(JOINTS), 3))
        self._postures = 0
        self._spread: Float = np.zeros(len(JOINTS))
        self._fresh = True
        self.view_m = CHANGING_M
        self._reset()

    def _reset(self) -> None:
        """Forget the residuals and everything that was decided from them."""
        self.residuals = ResidualBaseline(len(self.rig), self.region_settings.false_alarm)
        self._lost_for = self._refused = self._high_for = 0
        self._searched = _NEVER

    def start(self, frames: Sequence[Frame], subject: Subject) -> None:
        pose = self.find(frames, subject)
        self._alive = [Hypothesis(pose, pose, 0.0)]
        self._mean_posture, self._postures = np.zeros((len(JOINTS), 3)), 0
        self._fresh = True
        self._reset()

    def start_at(self, pose: Float) -> None:
        """Continue at a pose (D,) of the setup's world, with the same body and colours, but no memory of residuals."""
        pose = self.world.poses_in(pose[None])[0]
        self._alive = [Hypothesis(pose, pose, 0.0)]
        self._fresh = False
        self._reset()

    def step(self, frame: Frame) -> Estimate:
        watch = Stopwatch()
        settings, own = self.settings, self.region_settings
        frame = self.without_foreign(frame)
        seen = self.see(frame, frame.images if own.colors else None)
        pyramid, evidence = seen.pyramid, seen.evidence
        watch.lap("masks_clean")
        # predict, settle
        self._alive += [replace(h, previous=h.pose, jumped=False) for h in self._alive if h.jumped]
        # angles that only landmarks show change when these are seen, not by motion
        velocity = np.where(self.body.skeleton.is_by_landmarks, 0.0, settings.prediction)
        starts = np.array([h.pose + velocity * (h.pose - h.previous) for h in self._alive])
        prior = self.prior(starts)
        poses, iterations = self.settle(pyramid, starts, self._scales(), seen.images, prior)
        watch.lap("optimise")
        mismatch, met = evidence.cast(self.body, poses)
        if not np.isfinite(mismatch).all():
            return self._nobody(frame, watch)
        costs = evidence.cost_of(mismatch, poses)
        self._alive = renewed(self._alive, poses, costs)
        self._rank()
        i = int(np.argmin([np.abs(pose - self._best.pose).max() for pose in poses]))
        look = _Look(met.label[i], evidence.residual(met.label[i]))
        watch.lap("check")
        # propose, settle, choose: the person anywhere, then the limbs
        cut = not self._lost_for and self.residuals.jumped(look.residual)
        if (cut or self._is_due(look.error)) and self._choose(seen, self.anywhere(seen, self._best.pose), again=True):
            look, self._searched = self._look(seen), _NEVER
        misplaced = self.misplaced(evidence, look.label)
        searched = self._needs_search(frame, look, misplaced, evidence.hidden(look.label))
        best = self._best.pose
        if searched:
            self._searched = frame.index
            found = limbs.modes(self, seen, best, self.limbs if self._fresh else misplaced)
            if self._is_open(limbs.spread(self.body.skeleton, best, best, found)) and (asked := self._ask(seen, best)):
                seen, found = asked, limbs.weighed(self, asked, best, found)
        proposed = [of_landmarks.propose(self, seen, best)]
        if searched:
            proposed += [limbs.propose(self, seen, best, found), exchanged.propose(self, seen, best)]
            proposed.append(of_heading.propose(self, seen, best))
        if self._choose(seen, *proposed):
            look = self._look(seen)
        evidence, modes = seen.evidence, None
        if searched:
            self._spread = limbs.spread(self.body.skeleton, self._best.pose, best, found)
            modes = limbs.others(self._best.pose, best, found)
        watch.lap("search")
        pose, error = self._best.pose, float(np.nanmean(look.error))
        reason = Match(
            error,
            settings.lost_error,
            excess=self.residuals.mean_excess(look.error),
            cut=cut,
            lost_for=self._lost_for,
            refused=self._refused,
            high_for=self._high_for if self.residuals.high(look.error) else 0,
            depth=bool(depth_known(self.world.rig, self.body.skeleton.joints(pose), look.residual)),
            false_alarm=own.false_alarm,
        ).reason
        if reason != Reason.UNEXPLAINED:
            self._learn(evidence, look)
        origin = self._origin(cut)
        if not is_lost(reason):
            self._refused, self._postures = 0, self._postures + 1
            self._mean_posture += (directions(self.body.skeleton, pose) - self._mean_posture) / self._postures
        elif reason == Reason.STILL_HIGH:
            self._refused += 1
        self._lost_for = self._lost_for + 1 if is_lost(reason) else 0
        self._fresh = False
        deviation = self._sigma(pose, look, seen)
        watch.lap("check")
        return Estimate(
            **self.pose_fields(pose),
            origin=origin,
            found=reason,
            objective=error,
            iterations=np.array([iterations.sum(), int(searched)], np.int32),
            timing=watch.laps,
            deviation=deviation,
            modes=modes,
            residual=look.residual,
            masks=pyramid.masks[0],
            drawn=look.label > 0,
            colors=evidence.packed_colors(),
            landmarks=seen.pyramid.measured.get(landmarks.NAME),
        )

    def _is_open(self, variance: Float) -> bool:
        """Return whether a network locates a joint better than a frame whose modes have a variance (J,), metres²: the
        error of a landmark that is seen is smaller."""
        return bool((variance > landmarks.deviation(np.ones(1)) ** 2).any())

    def _ask(self, seen: Seen, pose: Float) -> Seen | None:
        """Return what a frame shows with a network's landmarks of the person, who is expected at a pose (D,); None as
        :meth:`asked`."""
        pyramid = self.asked(seen.frame, seen.pyramid, pose)
        return None if pyramid is None else self.see(seen.frame, seen.images, pyramid)

    def kept(self, frame: Frame) -> tuple[NDArray[np.uint8], NDArray[np.uint16] | None]:
        """Return what a second pass needs of a frame that was tracked: masks and colors as in
        :class:`~tk.trackers.protocol.Estimate`."""
        seen = self.see(self.without_foreign(frame))
        return seen.pyramid.masks[0], seen.evidence.packed_colors()

    def without_foreign(self, frame: Frame) -> Frame:
        """Return the frame with masks that exclude carried objects: large areas of colours that are not the person's.

        Their pixels become uncertain, because parts of the body may be in front of or behind them.
        """
        if not (self.region_settings.colors and self.colors.known and frame.images.size):
            return frame
        foreign, grid = self.colors.foreign, self.coarse_grid
        person = grid.sample(frame.masks) >= PERSON
        unknown = foreign[color_bins(grid.sample(frame.images)[person])]
        view = np.nonzero(person)[0]
        masks, uncertain = frame.masks, np.zeros(0, np.bool_)
        for c in np.unique(view[unknown]):
            # one ray more on each side: the mask ends between two rays
            rows, columns = (
                slice(max(rays[0] - 1, 0) * grid.step, (rays[-1] + 2) * grid.step)
                for rays in (np.flatnonzero(person[c].any(axis=axis)) for axis in (1, 0))
            )
            box = rows, columns
            # a quarter of the pixels shows objects that are wider than six pixels; narrower ones are ignored
            coarse = crop(frame.images[c], masks.shape[1:], rows, columns, step=2)
            odd_pixels = foreign.take(color_bins(coarse)) & (masks[c][box][::2, ::2] >= PERSON)
            opened = np.asarray(cv2.morphologyEx(odd_pixels.view(np.uint8), cv2.MORPH_OPEN, SQUARE3), np.uint8)
            if not opened.any():
                continue
            if masks is frame.masks:  # the frame's own stay as they are
                masks = masks.copy()
                uncertain = np.zeros(masks.shape, np.bool_) if frame.uncertain is None else frame.uncertain.copy()
            shown = masks[c][box] >= PERSON
            carried = doubled(opened)[: len(shown), : shown.shape[1]].view(np.bool_) & shown
            masks[c][box][carried] = 0
            uncertain[c][box][carried] = True
        return frame if masks is frame.masks else replace(frame, masks=masks, uncertain=uncertain)

    @property
    def _best(self) -> Hypothesis:
        return self._alive[0]

    def last_poses(self) -> tuple[Float, Float]:
        return self._best.pose, self._best.previous

    def _scales(self) -> list[int]:
        """Return the scales of the next frame, coarse to fine.

        A coarse scale reaches far, but also other limbs' edges. So the first is the finest that reaches as far as a
        joint may be from its prediction: its last step times the unpredicted share; from the finest of all alone
        Gauss-Newton does not converge. After a jump, a loss or a high residual it is the coarsest.
        """
        settings, skeleton, solver = self.settings, self.body.skeleton, self.solver
        first, window_px = solver.scales - 1, self.line_search.window_px
        if not (self._lost_for or self._high_for or any(h.jumped for h in self._alive)):
            step_m = max(skeleton.apart(h.pose, skeleton.joints(h.previous)) for h in self._alive)
            error_m = abs(1 - settings.prediction) * step_m
            error_px = error_m * self.views.rig.pixels_per_metre(skeleton.joints(self._best.pose)[0])
            while first > self.search_level and window_px * 2 ** (first - 1) >= error_px:
                first -= 1
        return list(range(first, -1, -1))

    def prior(self, mean: Float, angle_deg: float = ANGLE_DEG) -> Quadratic:
        """Return the prior: straight joints about zero, all other degrees of freedom about ``mean`` (..., D)."""
        skeleton = self.body.skeleton
        deviation = np.where(skeleton.prismatic, TRANSLATION_M, np.radians(angle_deg))
        straight = skeleton.is_straight
        deviation[straight] = skeleton.straight[straight]
        return Quadratic.about(np.where(straight, 0.0, mean), deviation**-2 / CONTOUR_INFORMATION)

    def _rank(self) -> None:
        """Sort the hypotheses by cost; drop those that are improbable beside the best, or equal."""
        if len(self._alive) == 1:
            return
        ranked = sorted(self._alive, key=lambda h: h.cost)
        ranked = [h for h in ranked if h.cost <= ranked[0].cost + DROPPED]
        kept = distinct(
            self.body.skeleton.joints(np.array([h.pose for h in ranked])), SAME_POSE_M, self.region_settings.hypotheses
        )
        self._alive = [ranked[i] for i in kept]

    def misplaced(self, evidence: Evidence, label: NDArray[np.uint8]) -> tuple[Limb, ...]:
        """Return the limbs of which a large part lies outside the mask, or on colours that are not theirs."""
        mismatch, count = evidence.mismatch_of_parts(self.body, label)
        return tuple(
            limb for limb in self.limbs if mismatch[limb.parts].sum() > MISPLACED * max(count[limb.parts].sum(), 1)
        )

    def _needs_search(self, frame: Frame, look: _Look, misplaced: Sequence[Limb], hidden: float) -> bool:
        """Return whether the limbs are searched for: at intervals, if the residual is high, a limb is misplaced, or the
        share ``hidden`` of the body meets pixels of other people and the frame shows what the pose does not explain.

        The poses that a search has proposed compete for :data:`RECOVER_EVERY` frames before a limb that is still
        misplaced is searched for again.
        """
        since, every = abs(frame.index - self._searched), self.search_frames  # also backwards
        if self.residuals.high(look.error) or (misplaced and since >= RECOVER_EVERY):
            return True
        doubtful = hidden > HIDDEN and self.residuals.mean_excess(look.error) > DOUBTFUL
        return every > 0 and (since >= every or (doubtful and since >= SEARCH_HIDDEN))

    def _choose(self, seen: Seen, *proposed: Float, again: bool = False) -> bool:
        """Add proposed poses (B, D) to the hypotheses, with their cost relative to the best one's running mean; return
        whether one of them is now the best. ``again``: the displacement from the last pose is no motion."""
        best = self._best
        if any(map(len, proposed)):
            poses, cost = self.compared(seen, best.pose, *proposed)
            self._alive += [
                Hypothesis(pose, pose if again else best.previous, best.cost + RENEWAL * float(more), jumped=not again)
                for pose, more in zip(poses[1:], cost[1:] - cost[0], strict=True)
                if more < DROPPED
            ]
            self._rank()
        return not np.array_equal(self._best.pose, best.pose)

    def _is_due(self, by_view: Float) -> bool:
        """Return whether the person is searched for as at the start, because the last frame was lost, or the residual
        (E_S, (V,)) is above the limit or stays high. Searches for the last reason become rarer: after 3, 6, 12 …
        frames. A lost person is searched for in every frame, but above the limit in every third one."""
        error, limit = float(np.nanmean(by_view)), self.settings.lost_error
        self._high_for = self._high_for + 1 if self.residuals.high(by_view) else 0
        waits, rest = divmod(self._high_for, RECOVER_EVERY)
        if rest == 0 and waits.bit_count() == 1:
            return True
        return self._lost_for > 0 if error <= limit else self._lost_for % RECOVER_EVERY == 0

    def _learn(self, evidence: Evidence, look: _Look) -> None:
        """Update the baseline of the residual; the colours, too, if E_S is not above the baseline. A pixel counts less,
        the more in doubt it is."""
        person, doubt = evidence.person, evidence.doubt
        if self.region_settings.colors and evidence.bins is not None and self.residuals.mean_excess(look.error) <= 0:
            self.colors.learn(evidence.bins[person], look.label[person], None if doubt is None else 1 - doubt[person])
        self.residuals.learn(look.residual)

    def _look(self, seen: Seen) -> _Look:
        """Return how the best pose explains the frame."""
        _, met = seen.evidence.cast(self.body, self._best.pose[None])
        return _Look(met.label[0], seen.evidence.residual(met.label[0]))

    def _sigma(self, pose: Float, look: _Look, seen: Seen) -> Float:
        """Return (J,) one standard deviation of each joint's position along an axis, metres: from the evidence of this
        frame, the difference to the mean posture until now, what its cues contradict, the modes of the limbs, and
        the spread of the hypotheses."""
        skeleton = self.body.skeleton
        prior = self.prior(pose[None])
        hessian, _ = self.equations(seen.pyramid, pose[None], prior, self.view_m, seen.images)
        variance = self.variance(pose, np.linalg.inv(hessian[0]), look.residual)
        variance += posture_variance(skeleton, pose, self._mean_posture) + self._spread
        variance += self.cue_variance(seen.pyramid, pose[None])[0]
        if len(self._alive) > 1:
            poses, cost = (np.array(column) for column in zip(*((h.pose, h.cost) for h in self._alive), strict=True))
            variance += disagreement(skeleton, poses, cost)
        return np.asarray(np.sqrt(variance))

    def equations(
        self,
        pyramid: Pyramid,
        poses: Float,
        prior: Quadratic,
        view_m: float = 0.0,
        images: NDArray[np.uint8] | None = None,
    ) -> tuple[Float, Float]:
        """Return the normal equations (B, D, D), (B, D) of B frames at poses (B, D), nats: contours at the finest
        scale, cues, prior and limits.

        Args:
            pyramid, images: as for :meth:`settle`; images of a single frame.
            poses: (B, D).
            prior: of the poses.
            view_m: standard deviation, metres along an axis, of the displacement of a segment's contours in one view,
                an unknown that is eliminated; 0: contours are not displaced.
        """
        skeleton, search = self.body.skeleton, self.line_search
        if view_m:
            # along itself a contour says nothing; a step is held back there all the same
            search = replace(search, displacement=1.0 / (view_m**2 * CONTOUR_INFORMATION), tangential=0.0)
        regions = None if images is None else self.colors.regions(images, self.views.rig.frame_shape)
        here = normal_equations(self.body.arrays, self.views.at(pyramid, 0), poses, search, regions)
        terms = self.terms(pyramid, prior, displaced=view_m > 0)
        assert terms is not None
        linear, matrix = terms(poses)
        diagonal = np.einsum("bdd->bd", here.hessian)
        # as in a step of one frame, tk.kernels.newton
        unit = diagonal.sum(axis=1) / np.maximum(np.count_nonzero(diagonal > 0, axis=1), 1)
        excess = skeleton.clip(poses) - poses
        pull = self.solver.limit_weight * unit[:, None] * (excess != 0)
        hessian = here.hessian + matrix + pull[:, :, None] * np.eye(poses.shape[1])
        gradient = here.gradient + linear - (matrix @ poses[..., None])[..., 0] + pull * excess
        return CONTOUR_INFORMATION * hessian, CONTOUR_INFORMATION * gradient

    def variance(self, pose: Float, covariance: Float, residual: Float) -> Float:
        """Return (..., J) variance of the joints' positions along an axis, metres², scaled by the residual.

        Args:
            pose: (..., D).
            covariance: (..., D, D) of the pose.
            residual: (..., V, 2); NaN for a view that was not used.
        """
        noise = pose_variance(self.body.skeleton, pose, covariance)
        return np.asarray(noise * variance_factor(residual)[..., None])

    def following(
        self,
        masks: Sequence[NDArray[np.uint8]],
        poses: Float,
        lost: NDArray[np.bool_],
        residual: Float,
        measured: Measured | None = None,
    ) -> tuple[Float, Float]:
        """Optimise every frame by itself, from poses that other cameras, or masks of other instants, have given.

        Arguments as for :meth:`second_pass`; return poses (F, D) and residuals (F, C, 2).
        """
        inside = self.world.poses_in(poses)
        again = SecondPass(self, masks, measured or {}, None, None, inside, lost, residual, lambda _: None)
        again.follow()
        return np.where(lost[:, None], poses, self.world.poses_out(again.poses)), again.residual

    def second_pass(
        self,
        masks: Sequence[NDArray[np.uint8]],
        poses: Float,
        lost: NDArray[np.bool_],
        residual: Float,
        height_m: float | None,
        measured: Measured | None = None,
        modes: Float | None = None,
        colors: Sequence[NDArray[np.uint16] | None] | None = None,
        keep_body: bool = False,
        report: Callable[[float], None] = lambda _: None,
    ) -> tuple[Float, Float, Float]:
        """Optimise frames again with what all of them show, and with a body fitted to all of them, see
        :mod:`tk.trackers.second_pass`.

        Args:
            masks: (C, H, W) of F frames, cleaned.
            poses: (F, D) of the first pass.
            lost: (F,) bool; such frames are not used and do not change.
            residual: (F, C, 2) of the first pass; NaN where a camera was excluded.
            height_m: the subject's height, if known.
            measured: of F frames, in the first pass; None: nothing.
            modes: (F, M, D) other poses of the limbs that the first pass left open, as in
                :class:`~tk.trackers.protocol.Estimate`.
            colors: (C, h, w) of F frames, likewise; None where they are not known.
            keep_body: leave the body as it is.
            report: receives the share of the work that is done.

        Returns:
            Poses (F, D), residuals (F, C, 2), and sigma (F, 15) in metres, 0 in lost frames.
        """
        if lost.all():
            return poses, residual, np.zeros((len(poses), len(JOINTS)))
        inside = self.world.poses_in(poses)
        again = SecondPass(self, masks, measured or {}, modes, colors, inside, lost, residual, report)
        if self.settings.adapt and not keep_body:
            again.fit_body(height_m)
        again.settle()
        again.decide()
        again.smooth()
        return np.where(lost[:, None], poses, self.world.poses_out(again.poses)), again.residual, again.sigma

    def _nobody(self, frame: Frame, watch: Stopwatch) -> Estimate:
        """Return the estimate of a frame without a person: the last pose, lost."""
        self._lost_for += 1
        pose = self._best.pose
        self._alive = [Hypothesis(pose, pose, self._best.cost)]
        for stage in self.timing_stages:
            watch.lap(stage)
        return Estimate(
            **self.pose_fields(pose),
            origin=Status.TRACKED,
            found=Reason.NOBODY,
            objective=np.inf,
            iterations=np.zeros(len(self.stages), np.int32),
            timing=watch.laps,
            deviation=np.full(len(JOINTS), np.nan),
            residual=np.full((len(frame.masks), 2), np.nan),
        )

    def with_cameras(self, rig: Rig) -> RegionTracker:
        """Return a tracker of the same body and colours with other cameras."""
        fresh = RegionTracker(rig, self.up, self.settings, self.region_settings, self.fps, self.seed)
        fresh.take_body(self.body)
        fresh.view_m = self.view_m
        fresh.colors.state = self.colors.state
        return fresh
