"""Section 7.1: an arm is displaced; stochastic and deterministic points bring it back, or do not.

As in the paper two angles are moved, by its 18.3° and 5.7°, and optimised, the rest of the body being held: the right
shoulder's and the right elbow's. The paper shows one run of either; here there are as many as seeds, to each of four
sides. The place to come back to is the minimum near the tracked pose of the objective averaged over many draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from scripts.paper.common import Float, Options, plt, save, table
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.kernels.nearest import SurfaceIndex
from tk.model.cues.edge_term import ContourTerm
from tk.model.cues.objective import CHAIN_NAMES, BodyObjective, FrameObjective
from tk.model.setup import Subject
from tk.optim import schedule as s
from tk.optim import smd
from tk.run.segmentation import make_labeller
from tk.run.task import Task
from tk.settings import Settings
from tk.trackers.protocol import Frame
from tk.trackers.volumetric import CELL_VOXELS, VolumetricTracker

ANGLES = ("shoulder_r_pitch", "elbow_r_flexion")
MOVED_DEG = np.array([18.3, 5.7])
SIDES = ((1, 1), (1, -1), (-1, 1), (-1, -1))
BACK_DEG = 5.0
CHAIN = CHAIN_NAMES.index("arm_r")
AVERAGED = 40  # draws
# Points on the arm's surface; as many on each projected contour.
few_points = patch("tk.model.cues.objective.CHAIN_SAMPLES", 10)
WIDTH_DEG, STEP_DEG = 36.0, 2.0


@dataclass(frozen=True)
class Scene:
    """A tracked frame and the objective of one arm in it.

    Attributes:
        frame: a new frame objective for every seed comes from :meth:`fresh`.
        pose: (D,) the tracked pose; two: the positions of :data:`ANGLES` in it.
    """

    frame: FrameObjective
    pose: Float
    two: NDArray[np.intp]

    def fresh(self, seed: int) -> FrameObjective:
        """The same frame with draws of this seed."""
        f = self.frame
        return FrameObjective(f.objective, f.index, np.random.default_rng(seed), images=f.images)


def look(options: Options, paper: Settings) -> Scene:
    """Track to the last of the frames with the defaults, and set up ``paper``'s objective there."""
    capture = open_capture(options.capture)
    config = Settings()
    label = make_labeller(Task.of(capture, config), lambda _: None)
    tracker = VolumetricTracker(capture.rig, capture.volume, capture.up, config)
    opening = tracker.opening_frames
    with capture.frames(0, options.frames) as frames:
        seen = (Frame(f.index, f.images.copy(), label(f).masks.copy()) for f in frames)
        first = list(islice(seen, opening))
        tracker.start(first, Subject(capture.subject_height_m))
        for observation in (*first, *seen):
            estimate = tracker.step(observation)
    surface = estimate.surface
    assert surface is not None
    skin = tracker.skin
    # colours do not confine the neighbours here: the arm's own are what it could not mistake
    every = np.full(len(surface), -1, np.int64)
    index = SurfaceIndex.build(surface.positions, every, CELL_VOXELS * tracker.hull.grid.voxel_m)
    term = ContourTerm(skin, capture.rig, paper.volumetric.edge_weight)
    with few_points:
        objective = BodyObjective(skin, paper.volumetric.coverage_weight, term)
    frame = FrameObjective(objective, index, np.random.default_rng(0), images=observation.images)
    two = np.array([skin.skeleton.index(name) for name in ANGLES])
    return Scene(frame, estimate.pose, two)


@few_points
def landscape(scene: Scene, seed: int, poses: Float, iteration: int = 0) -> Float:
    """(B,) the arm's objective at poses (B, D) on one draw."""
    owner = np.full(len(poses), CHAIN)
    return scene.fresh(seed).chains(owner, scene.pose)(poses, np.zeros_like(poses), iteration).value


def moved(scene: Scene, offsets_deg: Float) -> Float:
    """(B, D) poses with the two angles turned by (B, 2) degrees, within the limits."""
    poses = np.repeat(scene.pose[None], len(offsets_deg), 0)
    poses[:, scene.two] += np.radians(offsets_deg)
    return scene.frame.constrain(poses)


def diagonal_basis(hessian: Float, free: NDArray[np.bool_], damping: Float) -> tuple[Float, Float]:
    """In the place of :func:`tk.optim.schedule.descent_basis`: unit curvature along each parameter by itself."""
    scale = np.sqrt(np.diag(hessian) + damping)
    return np.diag(free / scale), np.diag(free * scale)


@few_points
def descend(scene: Scene, start: Float, seed: int, shuffle: bool) -> tuple[Float, int]:
    """Path (I + 1, 2) of the two angles in degrees, and the iterations."""
    frame = scene.fresh(seed)
    free = np.zeros(len(start), bool)
    free[scene.two] = True
    basis, inverse = diagonal_basis(frame.curvature(start), free, frame.damping(s.LEVER_M))
    tolerance = s.REFINE * np.where(frame.angular, np.radians(s.TOLERANCE_DEG), s.TOLERANCE_M)
    max_step = np.where(frame.angular, np.radians(s.MAX_STEP_DEG), s.MAX_STEP_M)
    objective = frame.chains(np.array([CHAIN]), scene.pose)
    found = smd.minimise(
        lambda poses, directions, i: objective(poses, directions, i if shuffle else 0),
        start[None],
        s.RATE,
        tolerance,
        frame.constrain,
        (basis[None], inverse[None]),
        max_step,
    )
    path = np.vstack([found.path[:, 0], found.pose])
    return np.degrees(path[:, scene.two]), int(found.iterations[0])


def run(options: Options, step_deg: float = STEP_DEG) -> str:
    """Write the figure, whose points lie ``step_deg`` apart, and give the table."""
    paper = settings_file.preset("kehl2006")
    scene = look(options, paper)
    axis = np.arange(-WIDTH_DEG, WIDTH_DEG + 0.1, step_deg)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    poses = moved(scene, grid)
    mean = np.mean([landscape(scene, seed, poses) for seed in range(AVERAGED)], axis=0)
    best = poses[mean.argmin()]
    goal = np.degrees(best[scene.two])
    rows, paths = [], {}
    for shuffle, name in ((True, "stochastic"), (False, "deterministic")):
        back, count, distance, made = 0, 0, [], []
        for side in SIDES:
            start = best.copy()
            start[scene.two] += np.radians(MOVED_DEG * side)
            start = scene.frame.constrain(start[None])[0]
            for seed in range(options.seeds):
                path, iterations = descend(scene, start, seed, shuffle)
                paths.setdefault(name, path)
                left = np.abs(path[-1] - goal)
                back += bool(left.max() <= BACK_DEG)
                count += 1
                distance.append(left)
                made.append(iterations)
        shoulder, elbow = np.mean(distance, axis=0)
        rows.append(
            {
                "points": name,
                "back within 5°": f"{back} of {count}",
                "left, shoulder and elbow [°]": f"{shoulder:.1f}, {elbow:.1f}",
                "iterations": f"{np.mean(made):.1f}",
            }
        )
    figure, panels = plt.subplots(1, 2, figsize=(10, 4.5), sharey=True)
    x, y = (np.degrees(scene.pose[k]) + axis for k in scene.two)
    fields = {"deterministic": landscape(scene, 0, poses), "stochastic": mean}
    for panel, (name, values) in zip(panels, fields.items(), strict=True):
        panel.contourf(x, y, values.reshape(len(axis), -1).T, 24)
        panel.plot(*paths[name].T, "w.-", linewidth=1, markersize=4)
        panel.plot(*goal, "ko", fillstyle="none")
        shown = "one draw" if name == "deterministic" else f"mean of {AVERAGED} draws"
        panel.set(title=f"{name}; objective of {shown}", xlabel=f"{ANGLES[0]} [°]")
    panels[0].set_ylabel(f"{ANGLES[1]} [°]")
    save(figure, options.figure)
    return table(rows)
