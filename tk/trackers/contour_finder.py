"""Finds a person's pose by contours: initialisation, body fit, Gauss-Newton, limb search. All trackers use it.

masks → cleaned, scales → {contours → edgels along their normals → normal equations → step} × iterations × scales
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from itertools import zip_longest
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.kernels.line_search import SearchSettings
from tk.kernels.silhouette import descend, normal_equations
from tk.model.body.anthropometry import AVERAGE_BODY, BodyDimensions
from tk.model.body.body_fit import INFORMATIVE_FRAMES, STATURE_DEVIATION, FittedBody, fit_body
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.initial_pose import rough_pose
from tk.model.body.limb_candidates import Limb, limbs_of
from tk.model.body.skeleton import JOINTS, build_skeleton, convert_poses
from tk.model.body.stored_body import body_values
from tk.model.cameras.camera import Rig
from tk.model.cameras.landmark_agreement import consensus
from tk.model.cameras.tracker_frame import TrackerFrame
from tk.model.cues import landmarks
from tk.model.cues.cue import CONTOUR_INFORMATION, Cue
from tk.model.cues.part_colors import PartColors, RenderedBody, color_bins
from tk.model.cues.ray_costs import Evidence, RayGrid, unpacked
from tk.model.masks.silhouettes import Pyramid, Views
from tk.model.setup import Subject
from tk.optim import gauss_newton
from tk.optim.gauss_newton import BatchSolution, GaussNewtonSettings
from tk.optim.quadratic import Quadratic
from tk.settings import SilhouetteSettings
from tk.trackers.hypotheses import PROPOSED, SAME_POSE_M, TrajectoryHypothesis, turning
from tk.trackers.initialisation import MOST_STATURE_RATIO, FoundPoses, find_in, find_person, stature_of, weighed
from tk.trackers.proposals import exchanged, limbs
from tk.trackers.proposals.anywhere import centroid
from tk.trackers.protocol import Frame

Float = NDArray[np.float64]

# Standard deviation of the logarithm of a stature that was estimated: areas of silhouettes err by 6 %, landmarks by 2 %
# about a mean that is 2 % too small; of somebody who bends they show up to 12 % less.
ESTIMATED_STATURE_DEVIATION = 0.05
# Rows of the grid of rays: to screen many candidates of a limb, and to choose among few poses.
COARSE_ROWS, FINE_ROWS = 54, 96
LINE_SEARCH = SearchSettings()
# Half this tolerance, or none, leaves the mean joint error on eight captures unchanged to 0.02 cm; twice as much makes
# fast arms worse by 0.1 cm.
SOLVER = GaussNewtonSettings(scales=3, relaxation=1.6, tolerance=0.012)
#: the cues by their names, in the order in which their terms are added
CUES: Mapping[str, Callable[[Rig, ConeBody, Float], Cue]] = {landmarks.NAME: landmarks.LandmarkCue}


@dataclass(frozen=True)
class Seen:
    """What a frame shows of one person.

    Attributes:
        frame: the frame.
        pyramid: its silhouettes, and what was measured of the person.
        evidence: its costs on the grid :attr:`ContourFinder.coarse_grid`.
        images: as in :meth:`ContourFinder.settle`.
    """

    frame: Frame
    pyramid: Pyramid
    evidence: Evidence
    images: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class _Begun:
    """A search in the first frame of an opening.

    Attributes:
        masks: of the frame.
        subject: what was known of the person.
        rough: (D,) the known rough pose on the average body, if any.
        found: what the frame shows.
    """

    masks: NDArray[np.uint8]
    subject: Subject
    rough: Float | None
    found: FoundPoses

    def serves(self, frame: Frame, subject: Subject) -> bool:
        """Return whether the same search in a frame would find the same."""
        own = self.subject
        same = own.init is subject.init and own.body is subject.body
        return same and self.masks is frame.masks and (own.height_m, own.hull_m) == (subject.height_m, subject.hull_m)


class ContourFinder:
    """Finds the pose of one person's body in a frame. It knows the body, but no earlier frame.

    It has its own world frame, derived from the cameras; :attr:`body` and all poses are in it.

    Args:
        rig: the cameras.
        up: the upward direction of their world, see :func:`tk.model.cameras.up.up_vector`.
        settings: see :class:`~tk.settings.SilhouetteSettings`.
        fps: frames per second.
        line_search: how edges are searched along the contours' normals.
        solver: scales and iterations of Gauss-Newton.
        seed: seed of the random candidate poses of the limb search.
    """

    def __init__(
        self,
        rig: Rig,
        up: str,
        settings: SilhouetteSettings,
        fps: float = 15.0,
        line_search: SearchSettings = LINE_SEARCH,
        solver: GaussNewtonSettings = SOLVER,
        seed: int = 0,
    ) -> None:
        self.settings, self.line_search, self.solver = settings, line_search, solver
        self.rig, self.up, self.fps, self.seed = rig, up, fps, seed
        self.world = TrackerFrame.of(rig, up)
        self.views = Views(self.world.rig)
        self.coarse_grid, self.fine_grid = (RayGrid(self.world.rig, rows) for rows in (COARSE_ROWS, FINE_ROWS))
        skeleton = build_skeleton(AVERAGE_BODY)
        self.pose_names, self.pose_units = skeleton.names, skeleton.units
        self._body: ConeBody | None = None
        self._begun: _Begun | None = None  # what :meth:`anticipate` has found
        self._cues: tuple[tuple[object, ...], list[Cue]] = ((None,), [])  # the last ones, and what they are of
        self._marked: tuple[Float, float | None] = np.empty(0), None  # landmarks, and the stature that they show
        self.colors: PartColors
        self.limbs: tuple[Limb, ...]

    @property
    def search_frames(self) -> int:
        """Frames between two routine limb searches; 0: none."""
        seconds = self.settings.search_every
        return max(int(seconds * self.fps), 1) if seconds else 0

    @property
    def search_level(self) -> int:
        """The scale at which proposed limbs settle."""
        return min(1, self.solver.scales - 1)

    @property
    def opening_frames(self) -> int:
        """Number of frames used by the initialisation."""
        return self.settings.init_frames

    @property
    def body(self) -> ConeBody:
        """The body; known after :meth:`find` or :meth:`take_body`."""
        if self._body is None:
            raise RuntimeError("no body yet: call find() or take_body() first")
        return self._body

    def take_body(self, body: ConeBody) -> None:
        """Use this body from now on; the learned colours are kept."""
        known = self.colors.state if self._body is not None else None
        self._body = body = body.standing("z")
        self.colors = PartColors(body)
        if known is not None:
            self.colors.state = known
        self.limbs = limbs_of(body)

    def prepare(self, with_landmarks: bool) -> None:
        """See :class:`~tk.trackers.protocol.Tracker`; otherwise each is compiled when it is first called."""
        body = build_cone_body(AVERAGE_BODY)
        empty = np.zeros((len(self.views.rig), *self.views.rig.frame_shape), np.uint8)
        seen = self.views.pyramid(empty, 1, False)
        pose = np.zeros((1, len(body.skeleton.names)))
        normal_equations(body.arrays, self.views.at(seen, 0), pose, self.line_search)
        Evidence.of(self.coarse_grid, empty).mismatch(body, pose)
        if with_landmarks:
            unknown = np.full((len(empty), len(landmarks.LANDMARKS), 4), np.nan)
            landmarks.LandmarkCue(self.views.rig, body, unknown).cost(pose)

    # --- initialisation (silhouette paper, section 4.6) ---------------------------------------------------------

    def anticipate(self, frame: Frame, subject: Subject) -> None:
        """Search for the person in a frame before those after it are there; :meth:`find` takes what is found, if it
        begins with this frame."""
        with suppress(CaptureError):  # find() raises it
            self._begun = self._begin(frame, self.pyramid(frame), subject)

    def find(self, frames: Sequence[Frame], subject: Subject) -> Float:
        """Return the pose (D,) in the first of the frames; the body is fitted to all of them.

        Args:
            frames: consecutive observations, at least one; a whole stride is better.
            subject: what is known of the person. A body that is known is not fitted. Without a rough pose, walking
                phases, standing and the Da Vinci pose are tried.

        Raises:
            CaptureError: fewer than two cameras see anybody in the first frame, or the silhouettes contradict the
                height.
        """
        pyramids, init = [self.pyramid(frame) for frame in frames], subject.init
        stature = (init and init.height_m) or subject.height_m
        if init is None:
            centroid(self.views.rig, pyramids[0], frames[0].index)  # raises if nobody is there, before a body is taken
            if stature:
                apparent = stature_of(self, pyramids[::6])  # a check needs fewer frames
                if not 1 / MOST_STATURE_RATIO < apparent / stature < MOST_STATURE_RATIO:
                    raise CaptureError(
                        f"the height of {stature:.2f} m contradicts the silhouettes, which show a person of about "
                        f"{apparent:.2f} m: correct the height in capture.toml, or omit it; if it is right, "
                        "calibration.toml has another unit or scale, or the masks are too large or too small"
                    )
        begun, self._begun = self._begun, None
        if len(frames) == 1 or begun is None or not begun.serves(frames[0], subject):
            begun = self._begin(frames[0], pyramids[0], subject, len(frames) == 1)
        seen = [self.see(blind(f), pyramid=shown) for f, shown in zip(frames, pyramids, strict=True)]
        hypotheses = find_person(self, seen, begun.rough, begun.found)
        # where the silhouettes of the opening leave the pose open, which way the person faces for example
        if len(hypotheses) > 1 and (asked := self.asked(frames[0], pyramids[0], hypotheses[0].poses[0])):
            hypotheses = weighed(self, hypotheses, seen[0], self.see(blind(frames[0]), pyramid=asked))
            pyramids[0] = asked
        if not self.settings.adapt or subject.body is not None:
            return np.asarray(hypotheses[0].poses[0])
        expected = BodyDimensions.from_stature(stature or stature_of(self, pyramids, subject.hull_m))
        return self._adapt(frames, pyramids, hypotheses, expected.barefoot, stature is not None)

    def _begin(self, frame: Frame, pyramid: Pyramid, subject: Subject, alone: bool = False) -> _Begun:
        """Take an average body, or the one that is known, and search for the person in the first frame of an opening.

        The body's size is that of this frame, because the others may not be there yet. ``alone``: there are none.
        """
        init, rough = subject.init, None
        if init is None:
            centroid(self.views.rig, pyramid, frame.index)  # raises if nobody is there
            stature = subject.height_m or stature_of(self, [pyramid], subject.hull_m)
            average = BodyDimensions.from_stature(stature)
        else:
            height_m = init.height_m or subject.height_m or stature_of(self, [pyramid])
            average, given, angles = rough_pose(init.joints, init.angles, height_m, self.world)
        self.take_body(subject.body or build_cone_body(average))
        if init is not None:
            rough = self.settle(pyramid, convert_poses(angles, given, self.body.skeleton)[None]).states[0]
        found = find_in(self, self.see(blind(frame), pyramid=pyramid), rough, alone)
        return _Begun(frame.masks, subject, rough, found)

    def _adapt(
        self,
        frames: Sequence[Frame],
        pyramids: Sequence[Pyramid],
        hypotheses: Sequence[TrajectoryHypothesis],
        stature: float,
        known: bool,
    ) -> Float:
        """Fit the body to the opening and return the pose (D,) in its first frame.

        Of several hypotheses the one is chosen that has the lowest sum of two costs: that with the average body and
        that with the body fitted to it, in the frames of the fit, because a fitted body compensates a part of a wrong
        trajectory.

        Args:
            frames, pyramids: the F frames of the opening, and their silhouettes.
            hypotheses: trajectories over these frames.
            stature, known: stature, metres, and whether it was given rather than estimated.
        """
        count = min(INFORMATIVE_FRAMES, len(pyramids))
        chosen = np.unique(np.linspace(0, len(pyramids) - 1, count).round().astype(int))
        deviation = STATURE_DEVIATION if known else ESTIMATED_STATURE_DEVIATION
        found: list[tuple[float, ConeBody, Float]] = []
        for hypothesis in hypotheses:
            body, fitted, _ = self.fit(pyramids, hypothesis.poses, chosen, stature, deviation)
            cost = hypothesis.cost
            if len(hypotheses) > 1:
                self.take_body(body)
                costs = np.array([self._converged_cost(frames[i], pyramids[i], hypothesis.poses[i]) for i in chosen])
                cost += float(costs[np.isfinite(costs)].mean())  # infinite in frames without a person
            found.append((cost, body, fitted[0]))
        _, body, pose = min(found, key=lambda one: one[0])
        self.take_body(body)
        return np.asarray(pose)

    def _converged_cost(self, frame: Frame, pyramid: Pyramid, pose: Float) -> float:
        """Return the cost of the pose that a pose (D,) converges to, nats; uncertain pixels count half."""
        return float(self.cost(pyramid, self.settle(pyramid, pose[None]).states, frame.uncertain)[0])

    def fit(
        self,
        pyramids: Sequence[Pyramid],
        poses: Float,
        chosen: NDArray[np.int64],
        stature: float,
        stature_deviation: float = STATURE_DEVIATION,
        body: ConeBody | None = None,
    ) -> FittedBody:
        """Fit the body to the chosen ones of several frames, arguments as for
        :func:`~tk.model.body.body_fit.fit_body`."""
        seen = [pyramids[i] for i in chosen]
        return fit_body(self.views, seen, poses[chosen], self.line_search, stature, stature_deviation, body)

    # --- one frame ----------------------------------------------------------------------------------------------

    def pyramid(self, frame: Frame) -> Pyramid:
        """Return the frame's silhouettes, cleaned, at all scales, and what was measured of the person."""
        pyramid = self.views.pyramid(frame.masks, self.solver.scales, True)
        marked = landmarks.of_person(frame.landmarks, pyramid.masks[0])
        return pyramid if marked is None else replace(pyramid, measured={landmarks.NAME: marked})

    def asked(self, frame: Frame, pyramid: Pyramid, pose: Float) -> Pyramid | None:
        """Return a frame's silhouettes with a network's landmarks of the person, who is expected at a pose (D,); None
        if there is no network, the frame has its landmarks, or they show somebody else."""
        if frame.ask is None or frame.landmarks is not None:
            return None
        found = frame.ask(self.world.points_out(landmarks.points(self.body, pose)))
        marked = landmarks.of_person(None if found is None else found[None], pyramid.masks[0])
        return None if marked is None else replace(pyramid, measured={**pyramid.measured, landmarks.NAME: marked})

    def marked_stature(self, seen: Float) -> float | None:
        """Return the stature that landmarks (V, L, 4) show, see :func:`~tk.model.cues.landmarks.stature`; a start asks
        for that of one frame several times."""
        if not np.array_equal(self._marked[0], seen, equal_nan=True):
            self._marked = seen, landmarks.stature(self.views.rig, seen)
        return self._marked[1]

    def sighted(self, seen: Float) -> RenderedBody | None:
        """Return the average body on the grid :attr:`fine_grid`, at the pose that a person's landmarks (V, L, 4) show;
        None if no two images agree on them."""
        points = consensus(self.views.rig, seen).points
        if not np.isfinite(points).any():
            return None
        body = build_cone_body(AVERAGE_BODY)
        poses = landmarks.propose(self.views.rig, body, seen, np.nanmean(points, axis=0))
        met = self.fine_grid.render(body, poses[:1])
        return RenderedBody(met.label[0], met.depth[0])

    def cues(self, pyramid: Pyramid) -> list[Cue]:
        """Return what a frame, or each of B frames, shows beside silhouettes; a frame's are asked for ten times."""
        of_these = self.views.rig, self.body, pyramid.measured
        if any(new is not old for new, old in zip_longest(of_these, self._cues[0])):
            rig, body, measured = of_these
            self._cues = of_these, [of(rig, body, measured[name]) for name, of in CUES.items() if name in measured]
        return self._cues[1]

    def cue_variance(self, pyramid: Pyramid, poses: Float) -> Float:
        """Return (B, J) variance of the joints' positions, metres², by which the cues contradict poses (B, D)."""
        return sum((cue.variance(poses) for cue in self.cues(pyramid)), np.zeros((len(poses), len(JOINTS))))

    def settle(
        self,
        pyramid: Pyramid,
        poses: Float,
        levels: Sequence[int] | None = None,
        images: NDArray[np.uint8] | None = None,
        prior: Quadratic | None = None,
        limb: Limb | None = None,
    ) -> BatchSolution:
        """Minimise by Gauss-Newton from poses (B, D), all in one frame or each in its own.

        Args:
            pyramid: silhouettes of one frame, or of B.
            poses: (B, D).
            levels: scales, 0 the finest; None: all.
            images: with images, colour differences attract contours inside the silhouette, too.
            prior: of the poses, in the unit of the contours' equations, see :mod:`tk.model.cues.cue`.
            limb: only this limb moves.
        """
        body = self.body
        arrays, free = (limb.arrays, limb.dofs) if limb else (body.arrays, None)
        regions = None if images is None else self.colors.regions(images, self.views.rig.frame_shape)
        return gauss_newton.minimise(
            lambda states, scale, steps: descend(
                arrays, self.views.at(pyramid, scale), states, self.line_search, steps, regions
            ),
            poses,
            free,
            body.skeleton.lower,
            body.skeleton.upper,
            self.solver,
            self.terms(pyramid, prior),
            levels,
        )

    def terms(
        self, pyramid: Pyramid, prior: Quadratic | None = None, displaced: bool = False
    ) -> Callable[[Float], Quadratic] | None:
        """Return the terms of the cost beside the contours, about poses (B, D); None if there are none.

        ``displaced``: the contours' equations have the displacements of segments as unknowns, so they count no edgel
        too much, and cues need no weight.
        """
        cues = self.cues(pyramid)
        if not cues and prior is None:
            return None

        def all_of(poses: Float) -> Quadratic:
            terms = [cue.normal(poses).scaled((1.0 if displaced else cue.weight) / CONTOUR_INFORMATION) for cue in cues]
            return reduce(add, terms if prior is None else [*terms, prior])

        return all_of

    def evidence(self, grid: RayGrid, frame: Frame, pyramid: Pyramid) -> Evidence:
        """Return the costs of a frame on a grid of rays, and by its cues."""
        cues = self.cues(pyramid)
        if not frame.images.size:
            return Evidence.of(grid, pyramid.masks[0], frame.uncertain, cues=cues)
        bins = color_bins(grid.sample(frame.images))
        doubt = None if frame.doubt is None else grid.nearest(self.fine_grid, frame.doubt)
        return Evidence.of(grid, pyramid.masks[0], frame.uncertain, bins, self.colors, cues, doubt)

    def kept_evidence(self, pyramid: Pyramid, colors: NDArray[np.uint16] | None) -> Evidence:
        """Return the costs of a frame on :attr:`coarse_grid` by its silhouettes, its cues, and the colours that were
        kept of it, as in :class:`~tk.trackers.protocol.Estimate`."""
        bins, doubt = unpacked(colors)
        cues = self.cues(pyramid)
        return Evidence.of(self.coarse_grid, pyramid.masks[0], None, bins, self.colors, cues, doubt)

    def see(self, frame: Frame, images: NDArray[np.uint8] | None = None, pyramid: Pyramid | None = None) -> Seen:
        """Return what a frame shows; ``images`` as in :meth:`settle`, ``pyramid`` that of the frame, if known."""
        pyramid = pyramid or self.pyramid(frame)
        return Seen(frame, pyramid, self.evidence(self.coarse_grid, frame, pyramid), images)

    def cost(self, pyramid: Pyramid, poses: Float, uncertain: NDArray[np.bool_] | None = None) -> Float:
        """Return (B,) the negative logarithm of the likelihood of a frame without colours, nats."""
        evidence = Evidence.of(self.coarse_grid, pyramid.masks[0], uncertain, cues=self.cues(pyramid))
        return evidence.cost(self.body, poses)

    def mean_residual(self, pyramid: Pyramid, poses: Float, uncertain: NDArray[np.bool_] | None = None) -> Float:
        """Return (B,) E_S, mean over the views that see anybody, inf if none does. A body on ``uncertain`` pixels
        counts half."""
        evidence = Evidence.of(self.coarse_grid, pyramid.masks[0], uncertain)
        return evidence.mismatch(self.body, poses)

    def compared(self, seen: Seen, pose: Float, *proposed: Float) -> tuple[Float, Float]:
        """Settle proposed poses (B, D), unless they cost too much for it. Return a pose (D,) and those of them that
        differ from it, (1 + B', D), and the negative logarithms of their posteriors, nats, up to a constant of the
        frame."""
        skeleton, found = self.body.skeleton, np.concatenate(proposed)
        if len(found):
            cost = seen.evidence.cost(self.body, np.concatenate([pose[None], found]))
            found = found[cost[1:] + turning(skeleton, found, pose) <= cost[0] + PROPOSED]
        if len(found):
            found = self.settle(seen.pyramid, found, (0,), seen.images).states
        found = np.concatenate([pose[None], found[skeleton.apart(found, skeleton.joints(pose)) > SAME_POSE_M]])
        cost = self.evidence(self.fine_grid, seen.frame, seen.pyramid).cost(self.body, found)
        return found, cost + turning(skeleton, found, pose)

    def best(self, seen: Seen, pose: Float, *proposed: Float) -> Float:
        """Return the most probable (D,) of a pose and proposed ones."""
        poses, cost = self.compared(seen, pose, *proposed)
        return np.asarray(poses[int(np.argmin(cost))])

    def proposed(self, seen: Seen, pose: Float, misplaced: Sequence[Limb] = ()) -> tuple[Float, Float]:
        """Return what a search for the limbs proposes beside a pose (D,), poses (B, D) and (2, D)."""
        found = limbs.modes(self, seen, pose, misplaced)
        return limbs.propose(self, seen, pose, found), exchanged.propose(self, seen, pose)

    def improved(self, seen: Seen, pose: Float) -> Float:
        """Return the most probable (D,) of a pose and what a search for its limbs proposes."""
        return self.best(seen, pose, *self.proposed(seen, pose))

    def model(self) -> Mapping[str, Any]:
        """Return the body as stored in `/model`."""
        return body_values(self.body)


def blind(frame: Frame) -> Frame:
    """Return the frame without images, for what does not use colours, and without a network to ask."""
    return replace(frame, images=frame.images[:0], ask=None)
