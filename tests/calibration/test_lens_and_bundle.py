"""Lens models and bundle adjustment: derivatives, recovery of known cameras, wrong points."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scripts.synthetic.boards import make_rig, place_boards
from tests.calibration.rigs import BOARD, POSES, RECIPE, RIG, see, visible
from tk.calibration.bundle import Lens, Solved, State, View, adjust, linearise
from tk.calibration.intrinsics import fit_lens
from tk.calibration.lens import FISHEYE, PINHOLE5, PINHOLE8, Model, project, undistort
from tk.calibration.poses import Pose, angle_deg, exp

Float = NDArray[np.float64]
DISTORTIONS = {
    PINHOLE5: [-0.2, 0.05, 0.001, -0.002, 0.01],
    PINHOLE8: [-0.2, 0.05, 0.001, -0.002, 0.01, 0.1, 0.02, 0.01],
    FISHEYE: [0.05, -0.01, 0.02, 0.003],
}
models = pytest.mark.parametrize("model", DISTORTIONS, ids=lambda model: model.name)


def lens_of(model: Model) -> Lens:
    values = np.array([700.0, 705.0, 320.0, 240.0, *DISTORTIONS[model]])
    return Lens(model, values, values, 640, 0.5, np.zeros(model.size, bool))


def points_before_camera() -> Float:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.8, 0.8, 20), rng.uniform(-0.6, 0.6, 20), rng.uniform(1.0, 3.0, 20)])


@models
def test_projection_is_that_of_opencv(model: Model) -> None:
    points, lens = points_before_camera(), lens_of(model).values
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    of = cv2.fisheye.projectPoints if model.fisheye else cv2.projectPoints
    if model.fisheye:
        expected, _ = of(points[:, None], np.zeros(3), np.zeros(3), matrix, lens[4:])
    else:
        expected, _ = of(points, np.zeros(3), np.zeros(3), matrix, lens[4:])
    pixels, _, _ = project(model, lens, points)
    np.testing.assert_allclose(pixels, np.asarray(expected).reshape(-1, 2), atol=1e-6)
    np.testing.assert_allclose(undistort(model, lens, pixels), points[:, :2] / points[:, 2:], atol=1e-8)


@models
def test_derivatives_match_finite_differences(model: Model) -> None:
    rng = np.random.default_rng(1)
    lens, n = lens_of(model), len(BOARD.points)
    camera = Pose(exp(0.2 * rng.normal(size=3)), np.array([0.0, 0, 2]))
    board = Pose(exp(rng.normal(size=3)), np.ones(3) / 9)

    def pixels(step: Float) -> Float:
        moved, other = board.moved(step[:6]), replace(lens, values=lens.values + step[12:])
        turns, moves = np.tile(moved.rotation, (n, 1, 1)), np.tile(moved.translation, (n, 1))
        return linearise(other, camera.moved(step[6:12]), turns, moves, BOARD.points, False)[0]

    turns, moves = np.tile(board.rotation, (n, 1, 1)), np.tile(board.translation, (n, 1))
    _, rows = linearise(lens, camera, turns, moves, BOARD.points)
    for k, step in enumerate(1e-6 * np.eye(12 + model.size)):
        expected = (pixels(step) - pixels(-step)) / 2e-6
        np.testing.assert_allclose(rows[:, :, k], expected, atol=1e-5 * max(1.0, np.abs(expected).max()))


def disturbed(noise_px: float, wrong: float = 0.0) -> tuple[State, list[View]]:
    """The true rig's views with noise and a share of wrong points, and an estimate near the truth."""
    rng = np.random.default_rng(3)
    views, lenses, cameras = [], [], []
    for c, camera in enumerate(RIG):
        for instant, pose in POSES.items():
            ids, pixels = visible(camera, pose, BOARD)
            if len(ids) >= 8:
                pixels = pixels + noise_px * rng.normal(size=pixels.shape)
                bad = rng.random(len(ids)) < wrong
                pixels[bad] += rng.uniform(-20, 20, (int(bad.sum()), 2))
                views.append(View(c, instant, BOARD.points[ids], pixels, ids))
        values = np.array([*camera.matrix.diagonal()[:2], *camera.matrix[:2, 2], *camera.distortions])
        off = values * np.array([1.02, 1.02, 1.01, 0.99, 0.7, 0.5, 0.0, 0.0, 0.0])
        start = np.array([off[0], off[0], 399.5, 299.5, 0, 0, 0, 0, 0])
        lenses.append(Lens(PINHOLE5, off, start, 800, 0.5, np.zeros(9, bool)))
        step = np.zeros(6) if c == 0 else np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 0.05, 3)])
        cameras.append(Pose(camera.rotation, camera.translation).moved(step))
    boards = {i: POSES[i].moved(rng.normal(0, 0.03, 6)) for i in {view.instant for view in views}}
    return State(tuple(lenses), tuple(cameras), boards), views


def errors_of(solved: Solved) -> tuple[float, float, float]:
    """Largest errors: metres, degrees, share of the focal length."""
    pairs = list(zip(solved.state.cameras, solved.state.lenses, RIG, strict=True))
    # the first camera is held at the truth
    place = max(float(np.linalg.norm(pose.inverse().translation - camera.center)) for pose, _, camera in pairs)
    turn = max(angle_deg(pose.rotation, camera.rotation) for pose, _, camera in pairs)
    return place, turn, max(abs(lens.values[0] / camera.matrix[0, 0] - 1) for _, lens, camera in pairs)


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_adjustment_recovers_the_rig(wrong: float) -> None:
    start, views = disturbed(0.1, wrong)
    solved = adjust(start, views)
    place, turn, focal = errors_of(solved)
    assert place < 0.01 and turn < 0.25 and focal < 0.003, (place, turn, focal)
    assert 0.07 < solved.noise_px < 0.14
    sigma = np.sqrt(np.diag(solved.covariance()))[solved.slices[1]]
    assert 1e-5 < sigma[6] / 700 < 0.003  # of a focal length


def test_held_out_views_choose_the_rational_model_where_it_is_right() -> None:
    recipe = replace(RECIPE, cameras=((30, 3.2, 1.4, "rational"), (85, 3.4, 2.0, "webcam")), shared=2, close=6)
    rig = make_rig(recipe)
    footage = see(rig[0], place_boards(recipe, rig, BOARD), 0, noise_px=0.1)
    views = [View(0, i, BOARD.points[s.detection.ids], s.detection.pixels, s.detection.ids) for i, s in
             footage.seen.items()]  # fmt: skip
    found = fit_lens(views, recipe.size, [PINHOLE5, PINHOLE8], None)
    assert found.lens.model is PINHOLE8
    assert found.held_out_px["pinhole8"] < 0.8 * found.held_out_px["pinhole5"]
    np.testing.assert_allclose(found.lens.values[:2], rig[0].matrix[[0, 1], [0, 1]], rtol=3e-3)
