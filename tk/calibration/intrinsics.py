"""Intrinsics of one camera from its views of the board, and the choice of its lens model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.calibration.bundle import Lens, State, View, adjust
from tk.calibration.lens import FOCAL_SIGMA, Model, undistort
from tk.calibration.poses import IDENTITY, Pose, planar_poses

Float = NDArray[np.float64]

#: focal lengths to begin with, as shares of the image's width: 115° to 16° of view
_FOCALS = np.geomspace(0.32, 3.5, 15)
#: views for a fit of one camera; more change little
_MOST_VIEWS = 36
#: parts of the views, each held out once
_FOLDS = 3
#: another model than the first must lower the error in held-out views by this share
_BETTER = 0.04
#: intrinsics are determined if the farthest board is this many times as far as the nearest one
LEAST_RANGE = 2.0
#: fewest views of a camera that determine its intrinsics
FEWEST_VIEWS = 6


@dataclass(frozen=True)
class Fitted:
    """Intrinsics of one camera.

    Attributes:
        lens: the intrinsics.
        poses: of the board in the camera, by instant.
        held_out_px: error in held-out views, by model; empty if there was no choice.
        near_m, far_m: distance of the nearest and the farthest board.
        how: "given", "free" or "held": whether the intrinsics come from a file, are all estimated, or in part.
    """

    lens: Lens
    poses: dict[int, Pose]
    held_out_px: dict[str, float]
    near_m: float
    far_m: float
    how: str


def fit_lens(views: Sequence[View], size: tuple[int, int], models: Sequence[Model], given: Lens | None) -> Fitted:
    """Estimate the intrinsics of a camera.

    Args:
        views: of this camera.
        size: width and height of its images, pixels.
        models: lens models to choose from; a later one must fit held-out views better.
        given: intrinsics that are known.
    """
    if given is not None:
        poses = board_poses(given, views)
        near, far = _range(poses, views)
        return Fitted(given, poses, {}, near, far, "given")
    if len(views) > _MOST_VIEWS:
        views = [views[int(k)] for k in np.linspace(0, len(views) - 1, _MOST_VIEWS)]
    fits = {model.name: _fit(_first(model, views, size), views) for model in models}
    errors: dict[str, float] = {}
    best = models[0]
    if len(models) > 1 and len(views) >= 3 * _FOLDS:
        for model in models:
            errors[model.name] = _held_out(fits[model.name][0], views)
            if errors[model.name] < (1 - _BETTER) * errors[best.name]:
                best = model
    lens, poses = fits[best.name]
    near, far = _range(poses, views)
    if far < LEAST_RANGE * near or len(views) < FEWEST_VIEWS:
        # what a few similar views determine: one focal length and the first two terms of the distortion
        held = np.ones(best.size, bool)
        held[[0, 1, 4, 5]] = False
        lens, poses = _fit(replace(lens, values=lens.start, held=held), views)
        near, far = _range(poses, views)
        return Fitted(lens, poses, errors, near, far, "held")
    return Fitted(lens, poses, errors, near, far, "free")


def _first(model: Model, views: Sequence[View], size: tuple[int, int]) -> Lens:
    """Return a lens without distortion whose focal length fits best, of :data:`_FOCALS`."""
    width, height = size
    middle = [(width - 1) / 2, (height - 1) / 2]
    candidates = []
    for share in _FOCALS:
        values = np.array([share * width] * 2 + middle + [0.0] * (model.size - 4))
        errors = []
        for view in views:
            found = planar_poses(view.points, undistort(model, values, view.pixels), refine=False)
            errors.append(found[0][0] * values[0] if found else 1e3)
        candidates.append((float(np.median(errors)), values))
    _, values = min(candidates, key=lambda pair: pair[0])
    return Lens(model, values, values, width, FOCAL_SIGMA, np.zeros(model.size, bool))


def board_poses(lens: Lens, views: Sequence[View]) -> dict[int, Pose]:
    """Return the board's pose in the camera, by instant; views without one are missing."""
    found = {}
    for view in views:
        poses = planar_poses(view.points, undistort(lens.model, lens.values, view.pixels))
        if poses:
            found[view.instant] = poses[0][1]
    return found


def _fit(lens: Lens, views: Sequence[View]) -> tuple[Lens, dict[int, Pose]]:
    poses = board_poses(lens, views)
    own = [replace(view, camera=0) for view in views if view.instant in poses]
    if not own:
        return lens, {}
    state = State((lens,), (IDENTITY,), poses)
    solved = adjust(state, own)
    # poses near a distorted border may have begun in the wrong of two solutions
    lens = solved.state.lenses[0]
    again = board_poses(lens, own)
    better = {
        view.instant: again[view.instant]
        for view in own
        if view.instant in again and _rms(State((lens,), (IDENTITY,), again), view) < 0.8 * _rms(solved.state, view)
    }
    if better:
        solved = adjust(State((lens,), (IDENTITY,), {**solved.state.boards, **better}), own, solved.noise_px)
    return solved.state.lenses[0], dict(solved.state.boards)


def _rms(state: State, view: View) -> float:
    return float(np.sqrt((state.errors(view) ** 2).sum(axis=1).mean()))


def _held_out(start: Lens, views: Sequence[View]) -> float:
    """Return the mean error in views that a fit has not used, pixels, the worst tenth left out; a fit begins at
    ``start``."""
    errors = []
    for fold in range(_FOLDS):
        lens, _ = _fit(start, [view for k, view in enumerate(views) if k % _FOLDS != fold])
        for view in views[fold::_FOLDS]:
            own = replace(view, camera=0)
            poses = board_poses(lens, [own])
            errors.append(_rms(State((lens,), (IDENTITY,), poses), own) if poses else 10.0)
    return float(np.mean(np.sort(errors)[: max(1, round(0.9 * len(errors)))]))


def _range(poses: dict[int, Pose], views: Sequence[View]) -> tuple[float, float]:
    """Return the distances of the nearest and the farthest board, metres."""
    far = [
        float(np.linalg.norm(poses[view.instant].apply(view.points).mean(axis=0)))
        for view in views
        if view.instant in poses
    ]
    return (min(far), max(far)) if far else (np.nan, np.nan)
