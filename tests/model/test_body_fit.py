"""Dimensions from drawn silhouettes; derivatives by dimensions against finite differences."""

from dataclasses import fields

import numpy as np
import pytest

from tests.model.ring import ring_of_cameras
from tk.errors import ConfigError
from tk.kernels.cones import CONE
from tk.kernels.silhouette import SearchSettings
from tk.model.anthropometry import BodyDimensions
from tk.model.cone_body import SHAPE_NUMBERS, build_cone_body
from tk.model.cone_fitting import (
    ConeFitConfig,
    dimension_neighbours,
    fit_dimensions,
    fit_shapes,
    neighbours,
    parameter_rows,
)
from tk.model.gait import walking_pose
from tk.model.silhouettes import Views, draw_silhouettes

STATURE = 1.75
VIEWS = Views(ring_of_cameras(3, width=240, height=300))
AVERAGE = build_cone_body(BodyDimensions.from_stature(STATURE))
SEARCH = SearchSettings()


def walk(body, count):
    poses = np.array([walking_pose(body.skeleton, 0.05 + i / count) for i in range(count)])
    poses[:, 2] = 0.93
    return poses


def pyramids_of(body, poses):
    return [VIEWS.pyramid(masks, 1, None) for masks in draw_silhouettes(body, VIEWS.rig, poses)]


def test_rows_by_dimensions_are_differences_of_the_surface():
    poses = walk(AVERAGE, 1)
    edgels = VIEWS.edgels(AVERAGE, pyramids_of(AVERAGE, poses)[0], poses[0], 0, SEARCH)
    rows = parameter_rows(dimension_neighbours(AVERAGE, "z"), poses[0], edgels)
    names = [field.name for field in fields(BodyDimensions)]
    assert rows.shape == (len(edgels.view), len(names))
    # a longer calf moves what hangs on it, and nothing above the knee
    calf = rows[:, names.index("calf")]
    parts = np.array([AVERAGE.parts[p].name[:-2] for p in edgels.part])
    below = np.isin(parts, ["calf", "shin", "foot", "instep"])
    assert not calf[~below].any() and np.abs(calf[parts == "foot"]).max() > 5
    # a thicker thigh pushes its outline outwards, by the radius in pixels
    thigh = rows[parts == "thigh", names.index("thigh_radius")]
    grown = build_cone_body(AVERAGE.dimensions.scaled(thigh_radius=1.1))
    moved = grown.place(poses[0], edgels.part, edgels.unscaled) - AVERAGE.place(poses[0], edgels.part, edgels.unscaled)
    expected = np.einsum("na,na->n", edgels.row, moved)[parts == "thigh"] / np.log(1.1)
    np.testing.assert_allclose(thigh, expected, rtol=0.06, atol=1e-6)
    assert (thigh > 0).all()


def test_lengths_and_girths_are_found_from_a_stride():
    true = AVERAGE.dimensions.scaled(thigh=0.95, calf=1.06, thigh_radius=1.15, chest_half_width=0.93, forearm=1.05)
    body = build_cone_body(true)
    poses = walk(body, 6)
    start = poses + np.random.default_rng(0).normal(0, 0.01, poses.shape)
    config = ConeFitConfig(rounds=8, edge_noise_px=0.5)
    found, fitted = fit_dimensions(AVERAGE, VIEWS, pyramids_of(body, poses), start, "z", SEARCH, None, config)
    for name, tolerance in (("thigh", 0.03), ("calf", 0.03), ("thigh_radius", 0.05), ("forearm", 0.05)):
        assert getattr(found.dimensions, name) == pytest.approx(getattr(true, name), rel=tolerance), name
    off = [
        np.linalg.norm(found.skeleton.joints(a) - body.skeleton.joints(b), axis=1).mean()
        for a, b in zip(fitted, poses, strict=True)
    ]
    assert np.mean(off) < 0.012


def test_without_rounds_nothing_changes():
    poses = walk(AVERAGE, 1)
    config = ConeFitConfig(rounds=0)
    found, fitted = fit_dimensions(AVERAGE, VIEWS, pyramids_of(AVERAGE, poses), poses, "z", SEARCH, None, config)
    np.testing.assert_array_equal(fitted, poses)
    for field in fields(BodyDimensions):
        expected = getattr(AVERAGE.dimensions, field.name)
        assert getattr(found.dimensions, field.name) == pytest.approx(expected, rel=1e-12)


def test_settings_out_of_range_are_told():
    with pytest.raises(ConfigError, match="frames = 0"):
        ConeFitConfig(frames=0)
    with pytest.raises(ConfigError, match="edge_noise_px = 0"):
        ConeFitConfig(edge_noise_px=0.0)


def test_shapes_are_found_and_the_skeleton_stays():
    groups = AVERAGE.shape_groups
    change = np.zeros((len(groups), SHAPE_NUMBERS))
    change[groups.index("thigh_")] = [0.2, 0.1, -0.1, 0.0, 0.01, 0.0, 0.01, 0.0]
    change[groups.index("calf_"), [5, 7]] = 0.01
    change[groups.index("foot_"), 3] = 0.1
    true = AVERAGE.reshaped(change)
    poses = walk(true, 4)
    masks = pyramids_of(true, poses)
    before = np.mean([VIEWS.fit_error(AVERAGE, m.masks[0], p[None]) for m, p in zip(masks, poses, strict=True)])
    config = ConeFitConfig(rounds=5, shape_noise_px=0.5)
    found, fitted = fit_shapes(AVERAGE, VIEWS, masks, poses, SEARCH, config)
    after = np.mean([VIEWS.fit_error(found, m.masks[0], p[None]) for m, p in zip(masks, fitted, strict=True)])
    assert after < 0.6 * before
    for name in ("thigh_l", "thigh_r"):
        a, b, h, m = next(part for part in found.parts if part.name == name).shape
        a_true, b_true, h_true, m_true = next(part for part in true.parts if part.name == name).shape
        assert h == pytest.approx(h_true, abs=1e-6) and [a, b, m] == pytest.approx([a_true, b_true, m_true], rel=0.06)
    np.testing.assert_array_equal(found.skeleton.anchor, AVERAGE.skeleton.anchor)


def test_rows_by_shapes_are_differences_of_the_whole_body():
    poses = walk(AVERAGE, 1)
    edgels = VIEWS.edgels(AVERAGE, pyramids_of(AVERAGE, poses)[0], poses[0], 0, SEARCH)
    step = np.zeros((len(AVERAGE.shape_groups), SHAPE_NUMBERS))
    step[AVERAGE.shape_groups.index("foot_"), 6] = 1e-4
    pair = AVERAGE.reshaped(step), AVERAGE.reshaped(-step)
    rows = parameter_rows([neighbours(*pair)], poses[0], edgels)[:, 0]
    larger, smaller = (body.place(poses[0], edgels.part, edgels.unscaled) for body in pair)
    np.testing.assert_allclose(rows, np.einsum("na,na->n", edgels.row, larger - smaller) / 2e-4, atol=1e-6)
    on_feet = np.char.startswith([AVERAGE.parts[p].name for p in edgels.part], "foot")
    assert np.abs(rows[on_feet]).max() > 10 and not rows[~on_feet].any()


def test_either_end_moves_alone_and_mirrored():
    change = np.zeros((len(AVERAGE.shape_groups), SHAPE_NUMBERS))
    change[AVERAGE.shape_groups.index("upper_arm_"), 4:] = [0.01, 0.02, 0.0, 0.0]
    change[AVERAGE.shape_groups.index("head"), 4:] = [0.03, 0.0, 0.0, 0.0]
    body = AVERAGE.reshaped(change)

    def ends(which, name):
        part = next(p for p in which.parts if p.name == name)
        low = 0.0 if part.kind == CONE else -part.shape[2]
        return [part.T_body_part[:3] @ [0.0, 0.0, z, 1.0] for z in (low, part.shape[2])]

    for near, far in zip(ends(body, "upper_arm_l"), ends(body, "upper_arm_r"), strict=True):
        np.testing.assert_allclose(near, far * [1, -1, 1], atol=1e-12)
    begin, end = ends(body, "upper_arm_l")
    begin_before, end_before = ends(AVERAGE, "upper_arm_l")
    assert np.linalg.norm(begin - begin_before) == pytest.approx(np.hypot(0.01, 0.02), abs=1e-9)
    assert np.linalg.norm(end - end_before) < 2e-3  # a limb keeps its length: its far end swings a little nearer
    chin, crown = (np.subtract(a, b) for a, b in zip(ends(body, "head"), ends(AVERAGE, "head"), strict=True))
    assert np.linalg.norm(chin) == pytest.approx(0.03, rel=0.1) and np.linalg.norm(crown) < 3e-3
    same = AVERAGE.reshaped(np.zeros_like(change))
    for a, b in zip(same.parts, AVERAGE.parts, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a.T_body_part, b.T_body_part, atol=1e-12)


def test_poses_stay_while_shapes_are_adapted():
    """A leaning head and a bent neck look alike: the shape has to take it."""
    groups = AVERAGE.shape_groups
    change = np.zeros((len(groups), SHAPE_NUMBERS))
    change[groups.index("foot_"), 6] = 0.03
    true = AVERAGE.reshaped(change)
    poses = walk(true, 4)
    config = ConeFitConfig(rounds=5, shape_noise_px=0.5, pose_deviation=0.001)
    _, fitted = fit_shapes(AVERAGE, VIEWS, pyramids_of(true, poses), poses, SEARCH, config)
    assert np.abs(fitted - poses).max() < 0.01
