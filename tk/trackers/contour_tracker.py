"""What the trackers that follow contours share: finding the person, fitting the body, and a search for lost limbs.

masks → cleaned, scales → {contours → edgels along their normals → normal equations → step} × iterations × scales
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.captures.init_pose import InitPose
from tk.kernels.line_search import SearchSettings
from tk.kernels.raycast import Cast
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_fit import STATURE_DEVIATION, fit_body
from tk.model.body.cone_body import ConeBody, ConePart, build_cone_body
from tk.model.body.initial_pose import rough_pose
from tk.model.body.limb_candidates import Limb, distinct, limbs_of, pairs
from tk.model.body.skeleton import ANKLES, WAIST, build_skeleton, join_pose, split_pose
from tk.model.cameras.camera import Rig
from tk.model.cameras.tracker_frame import TrackerFrame
from tk.model.cues.part_colors import PartColors
from tk.model.cues.ray_costs import Evidence, RayGrid, mean_of_views
from tk.model.masks.silhouettes import Pyramid, Views
from tk.optim import gauss_newton
from tk.optim.gauss_newton import Descent, GaussNewtonSettings, Prior
from tk.settings import BodyFitSettings, SilhouetteSettings
from tk.trackers.initialisation import HEADINGS, PHASES, Way, centroid, find_person, stature_of
from tk.trackers.protocol import Observation

Float = NDArray[np.float64]

# Standard deviation of the logarithm of a stature that was measured in the pictures and not given.
MEASURED = 0.05
# A lost frame is searched for the person from the silhouettes' centroid; of several lost ones every so many.
RELOCATE_EVERY = 3
# One in so many places of a lost person goes on to the finer scales.
RELOCATED = 4
# No finer scale halves what a place leaves unexplained.
HALVED = 2.0
# The fall of the cost, as a share of the person's pixels, that makes another place of a limb the pose.
GAIN = 0.004
# Places of a limb that are descended from, more of one that is known to be misplaced, and random ones about its own
# place that are looked at beside the grid. With 3 and 8, half as many again of the limbs that are elsewhere stay there
# (scripts/search_recall.py).
PLACES, MORE_PLACES, NEARBY = 8, 16, 80
# Places of a limb are not looked at where that much of it is outside the silhouettes.
OUTSIDE = 0.4
# A limb's place is not descended from where the body costs more than now by this factor; and is given up if, once the
# limb alone has settled there, it costs more by this share of the person's pixels.
PROPOSED, PROMISING = 1.5, 0.01
# Poses that a search descends from with all limbs, beside the present one; and for each pair of limbs.
FINISHED, FINISHED_PAIRS = 2, 4
# Poses whose joints lie farther apart than this are different ones, metres.
APART_M = 0.05
# What a person who is found again may explain worse, as E_S, for facing as before and not the other way.
FACING = 0.04
# Rays a picture's height: to screen many places of a limb, and to choose among few poses.
SCREEN_ROWS, CHOICE_ROWS = 54, 96

LINE_SEARCH = SearchSettings()
# A tolerance of half as much, or of none, leaves the mean of the joints' errors as it is on eight captures, to 0.02 cm;
# twice as much makes fast arms worse by 0.1.
SOLVER = GaussNewtonSettings(scales=3, relaxation=1.6, tolerance=0.012)


class ContourTracker:
    """The person, the body and the descent; what a frame's way is, a subclass says.

    It counts in a world of its own: there stands :attr:`body`, and there are all poses but those that the protocol of
    :class:`~tk.trackers.protocol.Tracker` hands in and out, which are the capture's.

    Args:
        rig: the cameras.
        up: what points up in their world, see :func:`tk.model.cameras.up.up_vector`.
        config: see :class:`~tk.settings.SilhouetteSettings`.
        line_search: how edges are searched along the contours' normals.
        solver: scales and iterations of Gauss-Newton.
    """

    def __init__(
        self,
        rig: Rig,
        up: str,
        config: SilhouetteSettings,
        line_search: SearchSettings = LINE_SEARCH,
        solver: GaussNewtonSettings = SOLVER,
    ) -> None:
        self.contours, self.line_search, self.solver = config, line_search, solver
        self.rig, self.up = rig, up
        self.world = TrackerFrame.of(rig, up)
        self.views = Views(self.world.rig)
        self.screen, self.choice = (RayGrid(self.world.rig, rows) for rows in (SCREEN_ROWS, CHOICE_ROWS))
        full = config.body == "full"
        skeleton = build_skeleton(BodyDimensions.from_stature(1.7), waist=full, ankles=full)
        paper = np.flatnonzero(skeleton.is_paper)
        self.pose_names = tuple(skeleton.names[k] for k in paper)
        self.pose_units = tuple(skeleton.units[k] for k in paper)
        self.waist_names: tuple[str, ...] = WAIST if full else ()
        self.ankle_names: tuple[str, ...] = ANKLES if full else ()
        self._body: ConeBody | None = None
        self._lost_for = 0
        self.colors: PartColors
        self.limbs: tuple[Limb, ...]

    @property
    def opening_frames(self) -> int:
        """Frames that the person is found in."""
        return self.contours.init_frames

    @property
    def body(self) -> ConeBody:
        """The body, as it stands in the tracker's own world; only after :meth:`start` or :meth:`restore`."""
        if self._body is None:
            raise RuntimeError("the tracker has no body yet: call start() or restore() first")
        return self._body

    def take_body(self, body: ConeBody) -> None:
        """Track this body from now on, whichever world it stands in; the colours of its parts are kept where there are
        any."""
        known = self.colors.state() if self._body is not None else {}
        self._body = body = body.standing("z")
        self.colors = PartColors(body)
        self.colors.restore(known)
        self.limbs = limbs_of(body)

    def prepare(self) -> None:
        """Have the kernels compiled while there is nothing else to do. Without it that is done where one is needed."""
        body = build_cone_body(BodyDimensions.from_stature(1.7), preset=self.contours.body)
        empty = np.zeros((len(self.views.rig), *self.views.rig.frame_shape), np.uint8)
        seen = self.views.pyramid(empty, 1, False)
        for poses in (1, 2):  # one pose, and several at once
            pose = np.zeros((poses, len(body.skeleton.names)))
            self.views.equations(body.arrays, seen, pose, 0, self.line_search)
            Evidence.of(self.screen, empty).cast(body, np.zeros(len(body.parts), np.int32), pose)

    # --- initialisation (silhouette paper, section 4.6) ---------------------------------------------------------

    def find(
        self, frames: Sequence[Observation], height_m: float | None, init: InitPose | None, body: ConeBody | None = None
    ) -> Float:
        """(D,) the pose in the first of the frames; the body is fitted to all of them.

        Args:
            frames: consecutive observations from the initial one on, at least one; better a whole stride.
            height_m: the subject's height, if known.
            init: a rough pose given by a person, in the capture's world; None tries walking phases, standing and the Da
                Vinci pose.
            body: the body, if known; it is not fitted then.

        Raises:
            CaptureError: fewer than two cameras see anybody in the first frame.
        """
        pyramids = [self.pyramid(frame) for frame in frames]
        preset = self.contours.body
        rough: Float | None = None
        stature = (init and init.height_m) or height_m
        if init is None:
            centroid(self.views.rig, pyramids[0], frames[0].index)  # or nobody is there, and no body is taken
            average = BodyDimensions.from_stature(stature or stature_of(self, pyramids))
        else:
            average, angles = rough_pose(init.joints, init.angles, stature, self.world)
        self.take_body(body or build_cone_body(average, preset=preset))
        if init is not None:
            unknown = np.zeros(len(self.waist_names)), np.zeros(len(self.ankle_names))
            rough = self.settle(pyramids[0], join_pose(self.body.skeleton, angles, *unknown)[None]).states[0]
        ways = find_person(self, frames, pyramids, rough)
        if not self.contours.adapt or body is not None:
            return np.asarray(ways[0].poses[0])
        return self._adapt(frames, pyramids, ways, average.stature, stature is not None)

    def _adapt(
        self,
        frames: Sequence[Observation],
        pyramids: Sequence[Pyramid],
        ways: Sequence[Way],
        stature: float,
        known: bool,
    ) -> Float:
        """Fit the body to the opening, and (D,) the pose in its first frame; whether the stature is ``known``.

        Of several ways to explain the opening that is believed which both the average body, as its mean E_S
        tells, and its own explain best: a body that is fitted to a wrong way makes up for some of it.
        """
        count = min(self.contours.fit.frames, len(pyramids))
        chosen = np.unique(np.linspace(0, len(pyramids) - 1, count).round().astype(int))
        deviation = STATURE_DEVIATION if known else MEASURED
        found: list[tuple[float, ConeBody, Float]] = []
        for way in ways:
            body, fitted = self.fit(pyramids, way.poses, chosen, stature, self.contours.fit, deviation)
            error = way.error * way.handicap
            if len(ways) > 1:
                self.take_body(body)
                told = np.array(list(map(self._misfit, frames, pyramids, way.poses)))
                error *= float(told[np.isfinite(told)].mean())  # in the others nobody is in sight
            found.append((error, body, fitted[0]))
        _, body, pose = min(found, key=lambda one: one[0])
        self.take_body(body)
        return np.asarray(pose)

    def _misfit(self, frame: Observation, pyramid: Pyramid, pose: Float) -> float:
        """E_S where a pose (D,) settles, masks in doubt counted half."""
        return float(self.mean_residual(pyramid, self.settle(pyramid, pose[None]).states, frame.uncertain)[0])

    def fit(
        self,
        pyramids: Sequence[Pyramid],
        poses: Float,
        chosen: NDArray[np.int64],
        stature: float,
        config: BodyFitSettings,
        stature_deviation: float = STATURE_DEVIATION,
    ) -> tuple[ConeBody, Float]:
        """The body that suits the chosen ones of several frames, and their poses."""
        seen = [pyramids[i] for i in chosen]
        return fit_body(
            self.contours.body, self.views, seen, poses[chosen], self.line_search, stature, config, stature_deviation
        )

    def start(
        self,
        frames: Sequence[Observation],
        height_m: float | None,
        init: InitPose | None,
        body: ConeBody | None = None,
    ) -> None:
        """Find the subject in the first frame; what is kept of it, a subclass says."""
        self.find(frames, height_m, init, body)

    def state(self) -> Mapping[str, Any]:
        """What :meth:`restore` needs beside the model to go on from the last frame.

        Its poses are those of the tracker's own world, for turned out and in again they would not be the same bit for
        bit; ``world`` (3, 4) is the way from there to the capture's.
        """
        return {"world": np.column_stack([self.world.rotation, self.world.origin])}

    def rewind(self, state: Mapping[str, Any]) -> None:
        """Go back to a state; what of it there is, a subclass says."""

    def restore(self, model: Mapping[str, Any], state: Mapping[str, Any]) -> None:
        """Take up where a run with this model and state stopped."""
        self.take_body(restore_body(model))
        self.rewind(state)

    def poses_of(self, state: Mapping[str, Any], name: str) -> Float:
        """Poses that a state tells; results of before told those of the capture's world."""
        poses = np.asarray(state[name])
        return poses if "world" in state else self.world.poses_in(poses)

    def lose(self) -> None:
        """The last frame's pose is not believed: the person is looked for in the next one."""
        self._lost_for = max(self._lost_for, 1)

    # --- one frame ----------------------------------------------------------------------------------------------

    def pyramid(self, frame: Observation) -> Pyramid:
        """The frame's silhouettes, cleaned, at all scales."""
        return self.views.pyramid(frame.masks, self.solver.scales, True)

    def cleaned(self, masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Masks (V, H, W) as contours are looked for in them."""
        return self.views.pyramid(masks, 1, True).masks[0]

    def settle(
        self,
        pyramid: Pyramid,
        poses: Float,
        levels: Sequence[int] | None = None,
        images: NDArray[np.uint8] | None = None,
        prior: Prior | None = None,
        limb: Limb | None = None,
    ) -> Descent:
        """Gauss-Newton from poses (B, D), through all scales or those of ``levels``, 0 the finest; all in one frame, or
        each in its own of B.

        With ``images``, colours pull at contours inside the silhouette, too. With ``limb`` all else stays where it is.
        """
        body = self.body
        arrays, free = (limb.arrays, limb.free) if limb else (body.arrays, body.free)
        regions = None if images is None else self.colors.regions(images)
        return gauss_newton.minimise(
            lambda states, scale: self.views.equations(arrays, pyramid, states, scale, self.line_search, regions),
            poses,
            free,
            body.skeleton.lower,
            body.skeleton.upper,
            self.solver,
            prior,
            levels,
        )

    def evidence(self, grid: RayGrid, frame: Observation, pyramid: Pyramid) -> Evidence:
        """What the frame shows on a grid."""
        return Evidence.of(grid, pyramid.masks[0], frame.uncertain, frame.images, self.colors)

    def mean_residual(self, pyramid: Pyramid, poses: Float, uncertain: NDArray[np.bool_] | None = None) -> Float:
        """(B,) E_S averaged over the views that see anybody, inf where none does; what is met where the masks are
        ``uncertain`` counts half."""
        evidence = Evidence.of(self.screen, pyramid.masks[0], uncertain)
        return mean_of_views(evidence.cast(self.body, self.colors.group, poses)[0])

    def search(
        self,
        frame: Observation,
        pyramid: Pyramid,
        evidence: Evidence,
        pose: Float,
        images: NDArray[np.uint8] | None = None,
        misplaced: Sequence[Limb] = (),
        in_pairs: bool = False,
    ) -> tuple[Float, Float]:
        """Other places of the limbs: all of a limb's are screened in one launch, the best ones descended from, first by
        the limb alone, then, where that promises something, by the whole body.

        With ``in_pairs`` both arms, and both legs, are taken away at once: where one of them is in the other's place,
        neither finds its own while the other stays. ``evidence`` is the frame's on the screen's grid.

        Returns:
            Poses (B, D), that which was given first, and their costs (B,).
        """
        skeleton, group = self.body.skeleton, self.colors.group
        rng = np.random.default_rng([7, frame.index])
        by_view, met = evidence.cast(self.body, group, pose[None], export=True)
        assert met is not None
        own, unmet = mean_of_views(by_view)[0], evidence.unmet(met.label[0])
        joints = skeleton.joints(pose)
        level = (min(1, self.solver.scales - 1),)
        found: list[tuple[NDArray[np.int64], Float]] = []
        told_by, rays = evidence.cost_of_parts(group, met.label[0])
        for limbs in pairs(self.limbs) if in_pairs else [(limb,) for limb in self.limbs]:
            moved = np.concatenate([limb.parts for limb in limbs])
            if in_pairs and told_by[moved].sum() * rays.sum() <= told_by.sum() * rays[moved].sum():
                continue  # where they are they explain more than the rest of the body does
            others = np.setdiff1d(np.arange(len(group), dtype=np.int32), moved)
            without, rest = evidence.cast(self.body, group, pose[None], others, export=True)
            assert rest is not None
            if not in_pairs and limbs[0] not in misplaced and mean_of_views(without)[0] - own > unmet:
                continue  # it explains more where it is than there is to explain elsewhere
            before = Cast(rest.label[0].copy(), rest.depth[0].copy())
            settled = pose[None]
            for limb in limbs:
                tried = limb.candidates(pose, NEARBY, rng)
                cost, _ = evidence.cast(self.body, group, tried, limb.parts, before, most_outside=OUTSIDE)
                told = mean_of_views(cost)
                if not in_pairs:
                    told[told > PROPOSED * own] = np.inf
                count = MORE_PLACES if in_pairs or limb in misplaced else PLACES
                places = limb.distinct(skeleton, tried, told, count)
                if len(places):
                    places = self.settle(pyramid, places, level, images, limb=limb).states
                settled = limb.combined(settled, np.concatenate([pose[None], places]))
            cost, _ = evidence.cast(self.body, group, settled, moved, before)
            told = mean_of_views(cost)
            order = np.argsort(told, kind="stable")
            settled, told = settled[order], told[order]
            if in_pairs:  # the trunk has gone with the limbs as they are: only the whole body tells what a pair costs
                better = settled[distinct(skeleton.joints(settled), FINISHED_PAIRS, joints)]
            else:
                better = settled[(told < own + PROMISING) & (skeleton.apart(settled, joints) > APART_M)][:2]
            if len(better):
                found.append((np.concatenate([limb.dofs for limb in limbs]), better))
        if not found:
            return pose[None], np.array([own])
        # limbs elsewhere, and those of two groups
        poses = [place for _, places in found for place in places]
        for i, (_, places) in enumerate(found):
            for dofs, others in found[i + 1 :]:
                both = places[0].copy()
                both[dofs] = others[0][dofs]
                poses.append(both)
        cost = mean_of_views(evidence.cast(self.body, group, np.array(poses))[0])
        best = np.argsort(cost, kind="stable")[: None if in_pairs else FINISHED]
        chosen = np.array(poses)[best]
        settled = np.concatenate([pose[None], self.settle(pyramid, chosen, (0,), images).states])
        fine = self.evidence(self.choice, frame, pyramid)
        return settled, mean_of_views(fine.cast(self.body, group, settled)[0])

    def improved(self, frame: Observation, pyramid: Pyramid, pose: Float) -> Float:
        """(D,) the pose, or what a search finds that costs :data:`GAIN` less."""
        poses, cost = self.search(frame, pyramid, self.evidence(self.screen, frame, pyramid), pose)
        best = int(np.argmin(cost))
        return np.asarray(poses[best if cost[best] < cost[0] - GAIN else 0])

    def relocate(self, pyramid: Pyramid, pose: Float, error: float) -> tuple[Float, float]:
        """The pose or, if that explains the silhouettes better, one found as at the start; and its E_S.

        The pose as it was, moved to where the person is now, is tried, too. Seen from one instant a person may face
        either way: who faces as before is preferred by :data:`FACING`.
        """
        try:
            p_centroid = centroid(self.views.rig, pyramid, 0)
        except CaptureError:
            return pose, error
        skeleton = self.body.skeleton
        moved, yaw = pose.copy(), skeleton.index("torso_yaw")
        moved[skeleton.prismatic] = p_centroid
        levels = range(self.solver.scales - 1, -1, -1)
        starts = np.concatenate([moved[None], gait.hypotheses(skeleton, HEADINGS, PHASES, p_centroid, pose[yaw])])

        def turned(states: Float) -> Float:
            return np.asarray(FACING * (1 - np.cos(states[:, yaw] - pose[yaw])) / 2)

        coarse = self.settle(pyramid, starts, levels[:1]).states
        rough = self.mean_residual(pyramid, coarse)
        order = np.argsort(rough + turned(coarse), kind="stable")[: len(starts) // RELOCATED]
        order = order[rough[order] < HALVED * error]
        if not len(order):
            return pose, error
        settled = self.settle(pyramid, coarse[order], levels[1:]).states
        errors = self.mean_residual(pyramid, settled)
        i = int(np.argmin(errors + turned(settled)))
        return (settled[i], float(errors[i])) if errors[i] < error else (pose, error)

    def told(self, pose: Float) -> dict[str, Any]:
        """A pose (D,) as an :class:`~tk.trackers.protocol.Estimate` tells it, in the capture's world."""
        skeleton, world = self.body.skeleton, self.world
        paper, waist, ankles = split_pose(skeleton, world.poses_out(pose))
        return {"pose": paper, "waist": waist, "ankles": ankles, "joints": world.points_out(skeleton.joints(pose))}

    # --- what a result file keeps -------------------------------------------------------------------------------

    def model(self) -> Mapping[str, Any]:
        """The body for `/model`."""
        body = self.body
        return {
            **{f"dimensions/{name}": value for name, value in asdict(body.dimensions).items()},
            "body": body.preset,
            "parts/name": json.dumps([part.name for part in body.parts]),
            "parts/segment": json.dumps([part.segment for part in body.parts]),
            "parts/kind": np.array([part.kind for part in body.parts]),
            "parts/shape": np.array([part.shape for part in body.parts]),
            "parts/T_body_part": np.array([part.T_body_part for part in body.parts]),
        }


def restore_dimensions(model: Mapping[str, Any]) -> BodyDimensions:
    """The dimensions that :meth:`ContourTracker.model` wrote down."""
    prefix = "dimensions/"
    return BodyDimensions(**{k[len(prefix) :]: float(v) for k, v in model.items() if k.startswith(prefix)})


def restore_body(model: Mapping[str, Any], up: str = "z") -> ConeBody:
    """The body that :meth:`ContourTracker.model` wrote down."""
    body = build_cone_body(restore_dimensions(model), up, str(model["body"]))
    # parts as they were written down: other versions of this program may lay the body out in other ones
    ends = {part.name: part.ends for part in body.parts}
    parts = []
    for name, segment, kind, shape, T in zip(
        json.loads(str(model["parts/name"])),
        json.loads(str(model["parts/segment"])),
        model["parts/kind"],
        model["parts/shape"],
        model["parts/T_body_part"],
        strict=True,
    ):
        a, b, h, m = (float(value) for value in shape)
        parts.append(ConePart(name, segment, int(kind), (a, b, h, m), np.asarray(T), ends.get(name, (False, False))))
    return replace(body, parts=tuple(parts))
