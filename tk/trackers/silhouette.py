"""The silhouette tracker: cone body, occluding contours, damped Gauss-Newton (the paper on silhouettes and twists).

It uses neither voxels nor colours, so two or three cameras and their masks are enough. One frame:

    masks → cleaned, scales → {contours → edgels along their normals → normal equations → step} × iterations × scales

Beyond the paper, a limb search runs at intervals (:mod:`tk.trackers.proposals.limbs`): a silhouette hides an arm in
front of or behind the trunk, and when the arm reappears, no contour may be near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import SearchSettings
from tk.model.cameras.camera import Rig
from tk.model.setup import Setup, Subject
from tk.optim.gauss_newton import GaussNewtonSettings
from tk.settings import Settings, SilhouetteSettings
from tk.trackers.contour_finder import LINE_SEARCH, SOLVER, blind
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.judgement import RECOVER_EVERY, Match
from tk.trackers.protocol import Estimate, Frame, Stopwatch
from tk.trackers.reason import is_lost

Float = NDArray[np.float64]


@dataclass(frozen=True)
class SilhouetteState:
    """(D,) poses of the last frame and of the one before; consecutive frames in which the person was lost; whether no
    frame has been tracked yet."""

    pose: Float
    previous: Float
    lost_for: int
    fresh: bool


class SilhouetteTracker(ContourTracker[SilhouetteState]):
    """Tracks one person. :meth:`start` once, then :meth:`step` for every frame, the first included."""

    State = SilhouetteState
    method = "silhouette"
    timing_stages: tuple[str, ...] = ("masks_clean", "optimise", "check")

    @classmethod
    def of(cls, setup: Setup, settings: Settings) -> SilhouetteTracker:
        """Return a new tracker with the settings of this method."""
        return cls(setup.rig, setup.up, settings.silhouette, fps=setup.fps, seed=settings.seed)

    def __init__(
        self,
        rig: Rig,
        up: str,
        settings: SilhouetteSettings | None = None,
        line_search: SearchSettings = LINE_SEARCH,
        solver: GaussNewtonSettings = SOLVER,
        fps: float = 15.0,
        seed: int = 0,
    ) -> None:
        super().__init__(rig, up, settings or SilhouetteSettings(), fps, line_search, solver, seed)
        self.stages = tuple(f"scale_{i}" for i in reversed(range(solver.scales)))
        self._pose = self._previous = np.zeros(len(self.pose_names))
        self._lost_for = 0
        self._fresh = True

    def start(self, frames: Sequence[Frame], subject: Subject) -> None:
        self._pose = self._previous = self.find([blind(f) for f in frames], subject)
        self._lost_for = 0
        self._fresh = True

    def step(self, frame: Frame) -> Estimate:
        watch = Stopwatch()
        settings = self.settings
        seen = self.see(blind(frame))
        pyramid = seen.pyramid
        watch.lap("masks_clean")
        start = self._pose + settings.prediction * (self._pose - self._previous)
        settled = self.settle(pyramid, start[None])
        pose = settled.states[0]
        watch.lap("optimise")
        if self.search_frames and frame.index % self.search_frames == 0:
            pose = self.improved(seen, pose)
        error = float(self.mean_residual(pyramid, pose[None], frame.uncertain)[0])
        # after a loss a pose near the last one may fit by chance
        due = self._lost_for > 0 if error <= settings.lost_error else self._lost_for % RECOVER_EVERY == 0
        if due and np.isfinite(error):
            pose = self.best(seen, pose, self.anywhere(seen, pose))
            error = float(self.mean_residual(pyramid, pose[None], frame.uncertain)[0])
        found, origin = Match(error, settings.lost_error).reason, self._origin()
        # nobody is visible: the last pose is kept
        pose = pose if np.isfinite(error) else self._pose
        # after a loss the displacement is no motion
        self._previous, self._pose = pose if self._lost_for else self._pose, pose
        self._lost_for = self._lost_for + 1 if is_lost(found) else 0
        self._fresh = False
        watch.lap("check")
        return Estimate(
            **self.pose_fields(pose),
            origin=origin,
            found=found,
            objective=error,
            iterations=settled.iterations,
            timing=watch.laps,
        )

    def last_poses(self) -> tuple[Float, Float]:
        return self._pose, self._previous
