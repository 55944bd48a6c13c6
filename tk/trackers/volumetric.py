"""The volumetric tracker: visual hull, colour, superellipsoid body, Stochastic Meta Descent (Kehl & Van Gool 2006).

The steps of a frame in :meth:`VolumetricTracker.step`, with their sections; figure 8 of the paper starts at (1).

    masks → visual hull, coloured surface      4.1
    (1) colour segmentation                    6.1.3
    (2) all degrees of freedom at ε₁           6.1, 6.2
    (3) five chains at ε₂, the torso held      6.4
    (4) colour models updated                  eq. 16

docs/method.md lists the departures from the paper.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.results.status import Status
from tk.kernels.nearest import SurfaceIndex
from tk.model.body.anthropometry import AVERAGE_BODY
from tk.model.body.cone_body import ConeBody
from tk.model.body.joints import CHAIN_OF_SEGMENT, CHAINS, JOINTS
from tk.model.body.skeleton import build_skeleton, convert_poses
from tk.model.body.stored_body import restore_body
from tk.model.body.superellipsoid_body import SuperellipsoidBody, build_superellipsoid_body
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume, VoxelGrid
from tk.model.cues.appearance import Appearance
from tk.model.cues.edge_term import ContourTerm
from tk.model.cues.objective import NEAR_M, BodyObjective, Fit, FrameObjective
from tk.model.hull.hull import HullSurface, VisualHull
from tk.model.setup import Setup, Subject
from tk.model.stateful import Stateful
from tk.optim import schedule
from tk.optim.smd import MAX_ITERATIONS
from tk.settings import Settings
from tk.trackers.contour_finder import ContourFinder, blind
from tk.trackers.judgement import Match
from tk.trackers.protocol import Estimate, Frame, Stopwatch
from tk.trackers.reason import Reason, is_lost

Float = NDArray[np.float64]

# Edge of a cell of the nearest-neighbour search, voxels: about twenty surface voxels a cell. Affects speed only.
CELL_VOXELS = 4.0
# Minimum number of surface voxels of a person: a person has about 1,300 in a grid of 64³. Smaller hulls are noise.
LEAST_VOXELS = 60
# Status "lost": more than this share of the samples of a limb, the head or the torso has no voxel within σ.
LOST_SHARE = 0.6
# Shares of the last frame's motion that are tried as predictions for the next one. The paper does not say how it
# predicts; at 15 Hz an arm turns by up to 31° between frames (its section 7.4).
PREDICTIONS = (1.0, 0.5, 0.0)


def points_and_iterations(effort: float) -> tuple[int, int]:
    """Return the factor of the paper's numbers of points, and the iterations of a pass.

    An effort above 1 multiplies the points, one below 1 the iterations, see :class:`tk.settings.Settings`.
    """
    return max(round(effort), 1), max(round(min(effort, 1.0) * MAX_ITERATIONS), 1)


@dataclass(frozen=True)
class VolumetricState:
    """(D,) poses of the last frame and of the one before; consecutive frames in which the person was lost; whether no
    frame has been tracked yet; colours."""

    pose: Float
    previous: Float
    lost_for: int
    fresh: bool
    appearance: Appearance


class VolumetricTracker(Stateful[VolumetricState]):
    """Tracks one person. :meth:`start` once, then :meth:`step` for every frame, the first included.

    Args:
        rig: the cameras.
        volume: the working volume.
        up: the world axis that points up.
        settings: all settings.

    Raises:
        VolumeError: no two cameras see the volume.
    """

    State = VolumetricState
    method = "volumetric"
    stages: tuple[str, ...] = ("all", *CHAINS)
    timing_stages: tuple[str, ...] = ("hull", "surface", "colour", "optimise", "update")
    objective_kind = "robust distance of surface points"
    image_step = 1
    reports_sigma = False
    has_segments = False
    has_second_pass = False
    tracks_among_others = False

    @classmethod
    def of(cls, setup: Setup, settings: Settings) -> VolumetricTracker:
        """Return a new tracker with the settings of this method."""
        return cls(setup.rig, setup.volume, setup.up, settings, fps=setup.fps)

    def __init__(self, rig: Rig, volume: Volume, up: str, settings: Settings, fps: float = 15.0) -> None:
        self.settings = settings
        self.scale, self.iterations = points_and_iterations(settings.effort)
        self.up = up
        self.rig = rig
        self.hull = VisualHull(rig, VoxelGrid.cover(volume, settings.voxels))
        self._finder = ContourFinder(rig, up, settings.silhouette, fps, seed=settings.seed)
        skeleton = build_skeleton(AVERAGE_BODY, up, paper=True)
        self.pose_names, self.pose_units = skeleton.names, skeleton.units
        self.skin: SuperellipsoidBody
        self._objective: BodyObjective
        self._appearance: Appearance
        self._pose = self._previous = np.zeros(0)
        self._lost_for = 0
        self._fresh = True

    # --- initialisation (section 6.3) ---------------------------------------------------------------------------

    def prepare(self, with_landmarks: bool) -> None:
        """See :class:`~tk.trackers.protocol.Tracker`."""
        self._finder.prepare(with_landmarks)

    def anticipate(self, frame: Frame, subject: Subject) -> None:
        """See :class:`~tk.trackers.protocol.Tracker`."""
        self._finder.anticipate(frame, subject)

    def start(self, frames: Sequence[Frame], subject: Subject) -> None:
        """Find the subject in the first frame and fit the body to all frames, see :meth:`ContourFinder.find`.

        Raises:
            CaptureError: the volume is empty.
        """
        pose = self._finder.find(frames, subject)
        first = frames[0]
        self.hull.update(first.masks)
        surface = self.hull.surface(first.images)
        if len(surface) < LEAST_VOXELS:
            raise CaptureError(
                f"initialisation: only {len(surface)} surface voxels in frame {first.index}: check the masks, "
                "the calibration and the working volume ([volume] of capture.toml)"
            )
        self._build()
        self._pose = self._previous = self._from_contours(pose)
        index = self._index(surface, np.full(len(surface), -1, np.int64))
        problem = FrameObjective(self._objective, index, np.random.default_rng(0), first.images, self.hull.used)
        fit = problem.fit(self._pose)
        patch, colors = self._correspondences(surface, index, fit)
        self._appearance = Appearance.learn(len(self.skin.patch_names), patch, colors)
        self.hull.reset()

    def _build(self) -> None:
        self.skin = build_superellipsoid_body(self.body, self.up)
        terms, scale = self.settings.volumetric, self.scale
        edges = ContourTerm(self.skin, self.rig, terms.edge_weight, scale) if terms.edge_weight > 0 else None
        self._objective = BodyObjective(self.skin, terms.coverage_weight, edges, scale)

    # --- tracking (section 6.4) ---------------------------------------------------------------------------------

    def step(self, frame: Frame) -> Estimate:
        """Track the next frame."""
        watch = Stopwatch()
        settings = self.settings
        # the visual hull and its coloured surface (section 4.1)
        self.hull.update(frame.masks)
        watch.lap("hull")
        surface = self.hull.surface(frame.images)
        watch.lap("surface")
        if len(surface) < LEAST_VOXELS:
            return self._nothing_seen(frame, surface, watch)
        # (1) colour segmentation (section 6.1.3)
        fits = np.full(len(surface), -1, np.int64)
        if settings.volumetric.colors:
            fits = self._appearance.segment(surface.colors, surface.seen)
        index = self._index(surface, fits)
        watch.lap("colour")
        # one generator per frame: a resumed run draws the same samples as an uninterrupted run
        rng = np.random.default_rng([settings.seed, frame.index])
        problem = FrameObjective(self._objective, index, rng, frame.images, self.hull.used)
        # (2) all degrees of freedom at ε₁, (3) five chains at ε₂ (section 6.4)
        result = self.optimise(problem, self._starts(surface))
        every = self._finder.search_frames
        if every and frame.index % every == 0:
            result = self._search_limbs(frame, problem, result)
        fit = problem.fit(result.pose)
        watch.lap("optimise")
        found = Match(self._outside(fit), LOST_SHARE).reason
        lost = is_lost(found)
        origin = Status.INITIALISED if self._fresh else Status.RECOVERED if self._lost_for else Status.TRACKED
        if not lost:
            # (4) the colour models follow (eq. 16)
            patch, colors = self._correspondences(surface, index, fit)
            self._appearance = self._appearance.updated(patch, colors)
        self._previous = result.pose if lost or self._lost_for else self._pose
        self._pose = result.pose
        self._lost_for = self._lost_for + 1 if lost else 0
        self._fresh = False
        watch.lap("update")
        return Estimate(
            pose=result.pose,
            joints=self.skin.skeleton.joints(result.pose),
            origin=origin,
            found=found,
            objective=fit.value,
            iterations=result.iterations,
            timing=watch.laps,
            surface=surface,
        )

    def optimise(self, problem: FrameObjective, starts: Float) -> schedule.ScheduleResult:
        """Minimise a frame's objective, beginning at the best of the starts (S, D)."""
        return schedule.optimise(problem, starts, self.iterations)

    def _search_limbs(
        self, frame: Frame, problem: FrameObjective, found: schedule.ScheduleResult
    ) -> schedule.ScheduleResult:
        """Search other poses of the limbs by contours; return the result from there if its objective is lower.

        Not in the paper: a limb that was left behind finds other voxels near it and stays.
        """
        finder = self._finder
        seen = finder.see(blind(frame))  # colours inside the silhouettes are a cue of the region tracker only
        converged = finder.settle(seen.pyramid, self._to_contours(found.pose)[None]).states[0]
        candidates, _ = finder.compared(seen, converged, *finder.proposed(seen, converged))
        starts = problem.constrain(np.array([self._from_contours(candidate) for candidate in candidates]))
        values = problem.values(starts)
        best, here = int(np.argmin(values)), problem.value(found.pose)
        if values[best] >= here:
            return found
        again = self.optimise(problem, starts[best : best + 1])
        return again if problem.value(again.pose) < here else found

    def _from_contours(self, pose: Float) -> Float:
        """Convert a pose of the cone body, tracker coordinates, to the superellipsoid body, which has rigid feet."""
        return convert_poses(self._finder.world.poses_out(pose), self.body.skeleton, self.skin.skeleton)

    def _to_contours(self, pose: Float) -> Float:
        """Convert a pose of the superellipsoid body to the cone body, tracker coordinates."""
        return self._finder.world.poses_in(convert_poses(pose, self.skin.skeleton, self.body.skeleton))

    @property
    def opening_frames(self) -> int:
        """Number of frames that the body is fitted to."""
        return self._finder.opening_frames

    @property
    def body(self) -> ConeBody:
        """The fitted body; only after :meth:`start`, or with a state of an earlier run."""
        return self._finder.body.standing(self.up)

    def _starts(self, surface: HullSurface) -> Float:
        """Return the poses (S, D) from which the optimisation may start."""
        skeleton = self.skin.skeleton
        # a limb moves on, stops or turns: the objective decides
        motion = self._pose - self._previous
        starts = [self._pose + share * motion for share in PREDICTIONS]
        if self._lost_for:
            # the last pose, moved to the centre of the hull
            moved = self._pose.copy()
            moved[:3] += surface.positions.mean(axis=0) - skeleton.joints(self._pose)[list(JOINTS).index("pelvis")]
            turned = [moved.copy() for _ in range(4)]
            for i, pose in enumerate(turned):
                pose[skeleton.index("torso_yaw")] += i * np.pi / 2
            starts += turned
        elif not motion.any():
            starts = starts[:1]
        return np.array(starts)

    def _outside(self, fit: Fit) -> float:
        """Return which share of the body, or of one of its limbs, has left the hull, the largest."""
        chain = 1 + CHAIN_OF_SEGMENT[self.skin.segment[fit.frame.even[0]]]
        return float((np.bincount(chain, fit.unmatched) / np.maximum(np.bincount(chain), 1)).max())

    def _nothing_seen(self, frame: Frame, surface: HullSurface, watch: Stopwatch) -> Estimate:
        """Return the last pose with status "lost": the volume is empty, because fewer than two cameras see anybody, or
        because their masks exclude each other."""
        self._previous = self._pose
        self._lost_for += 1
        for stage in ("colour", "optimise", "update"):
            watch.lap(stage)
        return Estimate(
            pose=self._pose,
            joints=self.skin.skeleton.joints(self._pose),
            origin=Status.TRACKED,
            found=Reason.NOBODY if np.count_nonzero(self.hull.used) < 2 else Reason.UNEXPLAINED,
            objective=1.0 + self.settings.volumetric.coverage_weight,
            iterations=np.zeros(len(self.stages), np.int32),
            timing=watch.laps,
            surface=surface,
        )

    def _index(self, surface: HullSurface, fits: NDArray[np.int64]) -> SurfaceIndex:
        return SurfaceIndex.build(surface.positions, fits, CELL_VOXELS * self.hull.grid.voxel_m)

    def _correspondences(
        self, surface: HullSurface, index: SurfaceIndex, fit: Fit
    ) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
        """Return patches (N,) and colours (N, 3) of the samples that lie on a voxel which a camera sees."""
        samples = fit.frame.even[0]
        partner, residual = fit.linear.partner[: len(samples)], fit.linear.residual[: len(samples)]
        voxel = index.order[partner]
        sure = (partner >= 0) & (np.linalg.norm(residual, axis=1) < NEAR_M) & (surface.seen[voxel] > 0)
        return self.skin.patch[samples[sure]], surface.colors[voxel[sure]]

    # --- stored in the result file -------------------------------------------------------------------------------

    def model(self) -> Mapping[str, Any]:
        """Return the fitted body for `/model`."""
        return {
            **self._finder.model(),
            "patches/names": json.dumps(self.skin.patch_names),
            "patches/mean_yuv": self._appearance.mean,
            "patches/deviation_yuv": self._appearance.deviation,
            "patches/known": self._appearance.known.astype(np.uint8),
        }

    def take_model(self, model: Mapping[str, Any]) -> None:
        """Take the body of a run."""
        self._finder.take_body(restore_body(model))
        self._build()
