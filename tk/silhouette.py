"""The silhouette tracker: cone body, occluding contours, damped Gauss-Newton (the paper on silhouettes and twists).

No voxels and no colour: two or three cameras and their masks are enough. A frame's way, top to bottom:

    masks → cleaned, two scales → {contours → edgels along their normals → normal equations → step} × 3 × 2 → pose
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError
from tk.io.init_pose import InitPose
from tk.kernels.silhouette import SearchSettings
from tk.model import gait
from tk.model.anthropometry import BodyDimensions
from tk.model.camera import Rig
from tk.model.cone_body import PRESETS, ConeBody, ConePart, build_cone_body
from tk.model.cone_fitting import ConeFitConfig, fit_dimensions, fit_shapes
from tk.model.initialisation import rough_pose
from tk.model.silhouettes import CleaningConfig, Pyramid, Views
from tk.model.skeleton import build_skeleton, up_rotation
from tk.optim import gauss_newton
from tk.optim.gauss_newton import GaussNewtonConfig
from tk.tracker import Estimate, Observation, Stopwatch

Float = NDArray[np.float64]


@dataclass(frozen=True)
class SilhouetteConfig:
    """All settings of the silhouette tracker.

    Three scales and not the paper's two: at 15 frames a second hands leave the windows of two.

    Attributes:
        body: "full" (14 parts, 24 degrees of freedom), "limbs" (10 parts) or "walker" (the paper's 6 parts and 7
            degrees of freedom).
        prediction: share of the last frame's motion that the next is expected to repeat (the paper: 0, for it found
            none useful; half of it pays when arms and legs swing).
        headings, phases: how many headings and walking phases the initialisation tries.
        finalists: how many of them are followed through the first frames before one is chosen.
        adapt: whether the limbs' dimensions are adapted to the silhouettes.
        init_frames: frames that the initialisation looks at; a stride is about one second.
        second_thoughts: every how many frames other places are tried for the arms; 0: never. A silhouette hides an arm
            before or behind the trunk, and where it comes out again no contour may be near (beyond the paper, with the
            means of its section 4.6).
        gain: the fall of E_S that makes one of them the pose.
        lost_error: a frame whose E_S, averaged over the views, is above this is lost.
        relocate_every: a lost frame is searched for the person from the silhouettes' centroid, as the first frame is;
            of several lost ones every so many.
        ray_step: every how many pixels E_S is taken during tracking; 0: a 54th of the picture's height.
    """

    body: str = "full"
    prediction: float = 0.5
    headings: int = 8
    phases: int = 8
    finalists: int = 6
    adapt: bool = True
    init_frames: int = 40
    second_thoughts: int = 3
    gain: float = 0.002
    lost_error: float = 0.6
    relocate_every: int = 3
    ray_step: int = 0
    search: SearchSettings = field(default_factory=SearchSettings)
    solver: GaussNewtonConfig = field(default_factory=lambda: GaussNewtonConfig(scales=3))
    cleaning: CleaningConfig = field(default_factory=CleaningConfig)
    fit: ConeFitConfig = field(default_factory=ConeFitConfig)

    def __post_init__(self) -> None:
        if self.body not in PRESETS:
            raise ConfigError(f'silhouette: body = "{self.body}": choose one of {", ".join(PRESETS)}')
        for name in ("headings", "phases", "finalists", "init_frames", "relocate_every"):
            if getattr(self, name) < 1:
                raise ConfigError(f"silhouette: {name} = {getattr(self, name)} must be at least 1")
        if min(self.ray_step, self.second_thoughts) < 0:
            raise ConfigError("silhouette: ray_step and second_thoughts must not be negative")
        if not 0 <= self.prediction <= 1.5 or not self.lost_error > 0:
            raise ConfigError(
                f"silhouette: prediction = {self.prediction} must lie in [0, 1.5], lost_error = {self.lost_error} "
                "must be positive"
            )


class SilhouetteTracker:
    """Tracks one person. :meth:`start` once, then :meth:`step` for every frame, the first included.

    Args:
        rig: the cameras.
        up: the world axis that points up.
        config: all settings.
    """

    method = "silhouette"
    waist_names: tuple[str, ...] = ()
    timing_stages: tuple[str, ...] = ("masks_clean", "optimise", "check")

    def __init__(self, rig: Rig, up: str, config: SilhouetteConfig | None = None) -> None:
        self.config = config or SilhouetteConfig()
        self.up = up
        self.views = Views(rig, self.config.ray_step or max(1, round(rig.frame_shape[0] / 54)))
        self.stages = tuple(f"scale_{i}" for i in reversed(range(self.config.solver.scales)))
        skeleton = build_skeleton(BodyDimensions.from_stature(1.7), up)
        self.pose_names = skeleton.names
        self.pose_units = skeleton.units
        self._body: ConeBody | None = None
        self._pose = np.zeros(len(skeleton.names))
        self._previous = self._pose
        self._lost_for = 0
        self._fresh = True

    # --- initialisation (section 4.6) ---------------------------------------------------------------------------

    def start(self, frames: Sequence[Observation], height_m: float | None, init: InitPose | None) -> None:
        """Find the subject in the first frame and adapt the body to all of them.

        Args:
            frames: consecutive observations from the initial one on, at least one; better a whole stride.
            height_m: the subject's height, if known.
            init: a rough pose given by a person; None tries walking phases, standing and the Da Vinci pose.

        Raises:
            CaptureError: fewer than two cameras see anybody in the first frame.
        """
        pyramids = [self._pyramid(frame, self.config.solver.scales) for frame in frames]
        if init is None:
            p_centroid = self._centroid(pyramids[0], frames[0].index)
            stature = height_m or self._stature(pyramids[0], p_centroid)
            self._body = build_cone_body(BodyDimensions.from_stature(stature), self.up, self.config.body)
            start = self._choose(pyramids, p_centroid)
        else:
            stature_given = init.height_m or height_m
            dimensions, start = rough_pose(init.joints, init.angles, stature_given, self.up)
            self._body = build_cone_body(dimensions, self.up, self.config.body)
            start = self._settle(pyramids[0], start[None], self.config.solver.scales)[0]
        start, _ = self._reconsider(pyramids[0], start)
        if self.config.adapt:
            start = self._adapt(pyramids, start, height_m or (init.height_m if init else None))
        self._pose = self._previous = start
        self._lost_for = 0
        self._fresh = True

    def _choose(self, pyramids: Sequence[Pyramid], p_centroid: Float) -> Float:
        """Hypotheses settle on the first frame; the best are followed, and the one that keeps fitting is taken."""
        body = self.body
        poses = gait.hypotheses(body.skeleton, self.config.headings, self.config.phases, p_centroid)
        poses = self._settle(pyramids[0], poses, self.config.solver.scales)
        error = self._fit_error(pyramids[0], poses)
        firsts = poses[_distinct(poses, error, self.config.finalists)]
        error = self._fit_error(pyramids[0], firsts)
        now = firsts
        for pyramid in pyramids[1:]:
            now = self._settle(pyramid, now, self.config.solver.scales)
            error += self._fit_error(pyramid, now)
        return np.asarray(firsts[int(np.argmin(error))])

    def _adapt(self, pyramids: Sequence[Pyramid], start: Float, stature: float | None) -> Float:
        """Track all frames with the average body, then fit dimensions and poses together."""
        poses = [start]
        every = self.config.second_thoughts
        for i, pyramid in enumerate(pyramids[1:], 1):
            pose = self._settle(pyramid, poses[-1][None], self.config.solver.scales)[0]
            poses.append(self._reconsider(pyramid, pose)[0] if every and i % every == 0 else pose)
        count = min(self.config.fit.frames, len(pyramids))
        chosen = np.unique(np.linspace(0, len(pyramids) - 1, count).round().astype(int))
        seen = [pyramids[i] for i in chosen]
        search, fit = self.config.search, self.config.fit
        self._body, fitted = fit_dimensions(
            self.body, self.views, seen, np.array(poses)[chosen], self.up, search, stature, fit
        )
        if fit.shapes:
            self._body, fitted = fit_shapes(self._body, self.views, seen, fitted, search, fit)
        return np.asarray(fitted[0])

    def _centroid(self, pyramid: Pyramid, index: int) -> Float:
        """(3,) the point nearest to the rays through the silhouettes' centroids, metres."""
        A, y, count = np.zeros((3, 3)), np.zeros(3), 0
        for mask, camera in zip(pyramid.masks[0], self.views.rig, strict=True):
            ys, xs = np.nonzero(mask >= 128)
            if len(xs) == 0:
                continue
            ray = camera.rays([[xs.mean(), ys.mean()]])[0]
            across = np.eye(3) - np.outer(ray, ray)
            A += across
            y += across @ camera.center
            count += 1
        if count < 2:
            raise CaptureError(
                f"initialisation: {count} of {len(self.views.rig)} masks of frame {index} show anybody, two are "
                "needed: check the masks, or choose another first frame"
            )
        return np.asarray(np.linalg.solve(A, y), np.float64)

    def _stature(self, pyramid: Pyramid, p_centroid: Float) -> float:
        """Median over the views of the silhouette's height at the depth of its centroid, metres."""
        up = up_rotation(self.up)[:, 2]
        heights = []
        for mask, camera in zip(pyramid.masks[0], self.views.rig, strict=True):
            rows, columns = np.nonzero(mask >= 128)
            if len(rows) == 0:
                continue
            level = []
            for i in (rows.argmin(), rows.argmax()):
                ray = camera.rays([[columns[i], rows[i]]])[0]
                flat = ray - (ray @ up) * up
                away = (p_centroid - camera.center) - ((p_centroid - camera.center) @ up) * up
                level.append((camera.center + ray * (away @ flat) / (flat @ flat)) @ up)
            heights.append(abs(level[0] - level[1]))
        return float(np.clip(np.median(heights), 0.8, 2.4))

    # --- tracking (section 4) -----------------------------------------------------------------------------------

    def step(self, frame: Observation) -> Estimate:
        """The pose in the next frame."""
        watch = Stopwatch()
        config = self.config
        pyramid = self._pyramid(frame, config.solver.scales)
        watch.lap("masks_clean")
        start = self._pose + config.prediction * (self._pose - self._previous)
        pose = self._settle(pyramid, start[None], config.solver.scales)[0]
        watch.lap("optimise")
        every = config.second_thoughts
        if every and frame.index % every == 0:
            pose, error = self._reconsider(pyramid, pose)
        else:
            error = float(self._fit_error(pyramid, pose[None])[0])
        # after a loss the last pose is no evidence, however well the pose near it fits
        due = self._lost_for > 0 if error <= config.lost_error else self._lost_for % config.relocate_every == 0
        if due and np.isfinite(error):
            pose, error = self._relocate(pyramid, pose, error)
        lost = not error <= config.lost_error
        status = "lost" if lost else "initialised" if self._fresh else "recovered" if self._lost_for else "tracked"
        # nobody is in sight: the last pose stands
        pose = pose if np.isfinite(error) else self._pose
        # whoever was lost has jumped, not moved
        self._previous, self._pose = pose if self._lost_for else self._pose, pose
        self._lost_for = self._lost_for + 1 if lost else 0
        self._fresh = False
        watch.lap("check")
        return Estimate(
            pose=pose,
            joints=self.body.skeleton.joints(pose),
            status=status,
            objective=error,
            iterations=np.full(len(self.stages), config.solver.iterations, np.int32),
            timing=watch.laps,
        )

    def _reconsider(self, pyramid: Pyramid, pose: Float) -> tuple[Float, float]:
        """The pose or, if that explains the silhouettes better, one with an arm elsewhere; and its E_S."""
        error = float(self._fit_error(pyramid, pose[None])[0])
        if self.config.second_thoughts == 0 or self.config.body == "walker" or not np.isfinite(error):
            return pose, error
        variants = gait.arm_variants(self.body.skeleton, pose)
        best = variants[np.argsort(self._fit_error(pyramid, variants), kind="stable")[:2]]
        settled = self._settle(pyramid, best, 1)
        errors = self._fit_error(pyramid, settled)
        i = int(np.argmin(errors))
        return (settled[i], float(errors[i])) if errors[i] < error - self.config.gain else (pose, error)

    def _relocate(self, pyramid: Pyramid, pose: Float, error: float) -> tuple[Float, float]:
        """The pose or, if that explains the silhouettes better, one found as at the start; and its E_S."""
        try:
            p_centroid = self._centroid(pyramid, 0)
        except CaptureError:
            return pose, error
        starts = gait.hypotheses(self.body.skeleton, self.config.headings, self.config.phases, p_centroid)
        settled = self._settle(pyramid, starts, self.config.solver.scales)
        errors = self._fit_error(pyramid, settled)
        i = int(np.argmin(errors))
        return (settled[i], float(errors[i])) if errors[i] < error else (pose, error)

    @property
    def body(self) -> ConeBody:
        """The body; only after :meth:`start` or :meth:`restore`."""
        if self._body is None:
            raise RuntimeError("the tracker has no body yet: call start() or restore() first")
        return self._body

    def _pyramid(self, frame: Observation, scales: int) -> Pyramid:
        return self.views.pyramid(frame.masks, scales, self.config.cleaning)

    def _settle(self, pyramid: Pyramid, poses: Float, scales: int) -> Float:
        """Gauss-Newton from poses (B, D), from the scale ``scales - 1`` to the finest."""
        body = self.body
        solver = self.config.solver
        if scales != solver.scales:
            solver = replace(solver, scales=scales)
        return gauss_newton.minimise(
            lambda states, scale: self.views.equations(body, pyramid, states, scale, self.config.search),
            poses,
            body.free,
            body.skeleton.lower,
            body.skeleton.upper,
            solver,
        )

    def _fit_error(self, pyramid: Pyramid, poses: Float) -> Float:
        """(B,) E_S averaged over the views that see anybody; inf where none does."""
        error = self.views.fit_error(self.body, pyramid.masks[0], poses)
        seen = np.isfinite(error[0])
        return error[:, seen].mean(axis=1) if seen.any() else np.full(len(poses), np.inf)

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

    def state(self) -> Mapping[str, Any]:
        """What :meth:`restore` needs beside the model to go on from the last frame."""
        return {"pose": self._pose, "previous": self._previous, "lost_for": self._lost_for}

    def restore(self, model: Mapping[str, Any], state: Mapping[str, Any]) -> None:
        """Take up where a run with this model and state stopped."""
        self._body = restore_body(model, self.up)
        self._pose = np.asarray(state["pose"])
        self._previous = np.asarray(state["previous"])
        self._lost_for = int(state["lost_for"])
        self._fresh = False


def restore_body(model: Mapping[str, Any], up: str) -> ConeBody:
    """The body that :meth:`SilhouetteTracker.model` wrote down."""
    prefix = "dimensions/"
    dimensions = BodyDimensions(**{k[len(prefix) :]: float(v) for k, v in model.items() if k.startswith(prefix)})
    body = build_cone_body(dimensions, up, str(model["body"]))
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


def _distinct(poses: Float, error: Float, count: int) -> NDArray[np.int64]:
    """Indices of the best poses, at most ``count``, that differ from each other by more than 0.2 somewhere."""
    chosen: list[int] = []
    for i in np.argsort(error, kind="stable"):
        if all(np.abs(poses[i] - poses[j]).max() > 0.2 for j in chosen):
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return np.array(chosen)
