"""The body fit: rows against finite differences, and a known body recovered from its rendered silhouettes."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tests.model.figures import BODY as AVERAGE
from tests.model.figures import draw_silhouettes, scaled, surface_points
from tests.model.landmarks import body_points, landmarks_of
from tests.model.ring import ring_of_cameras
from tk.kernels.cones import CONE
from tk.kernels.line_search import SearchSettings
from tk.kernels.silhouette import Edgels
from tk.model.body import body_fit
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_fit import fit_body
from tk.model.body.body_parameters import BodyFamily, shape_rows
from tk.model.body.body_points import LANDMARKS
from tk.model.body.cone_body import SHAPE_NUMBERS, build_cone_body
from tk.model.body.gait_poses import standing_pose, walking_pose
from tk.model.body.skeleton import JOINTS, SEGMENTS
from tk.model.cues.landmarks import NAME
from tk.model.cues.ray_costs import Evidence, RayGrid
from tk.model.masks.silhouettes import Views

STATURE = 1.75
VIEWS = Views(ring_of_cameras(3, width=240, height=300))
SEARCH = SearchSettings()
DIMENSIONS = [field.name for field in fields(BodyDimensions)]


def walk(body, count):
    """(count, D) a stride with arms out and bent elbows, so that every joint is visible."""
    skeleton = body.skeleton
    poses = np.array([walking_pose(skeleton, 0.05 + i / count) for i in range(count)])
    poses[:, 2] = 0.93
    for side in "lr":
        poses[:, skeleton.index(f"elbow_{side}_flexion")] = np.linspace(0.3, 1.6, count)
        poses[:, skeleton.index(f"shoulder_{side}_roll")] = np.linspace(-0.4, 0.4, count)
        poses[:, skeleton.index(f"hip_{side}_pitch")] -= 0.5
        poses[:, skeleton.index(f"knee_{side}_flexion")] += 0.6
    return poses


def pyramids_of(body, poses):
    return [VIEWS.pyramid(masks, 1, False) for masks in draw_silhouettes(body, VIEWS.rig, poses)]


def edgels_all_over(body, count=400):
    """Edgels at random places of all parts with random rows: derivatives hold for any surface point."""
    rng = np.random.default_rng(8)
    part = rng.integers(len(body.parts), size=count)
    angle, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, count)
    cone = np.array([p.kind == CONE for p in body.parts])[part]
    radius = np.where(cone, 1.0, np.sqrt(1 - z**2))
    unscaled = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.where(cone, np.abs(z), z)])
    row = rng.normal(size=(count, 3))
    nothing = np.zeros(count)
    first = nothing.astype(np.int32)
    return Edgels(first, first, part, unscaled, nothing, nothing, row, np.zeros((count, 2)), np.zeros((count, 2)))


EDGELS = edgels_all_over(AVERAGE)
FAMILY = BodyFamily(AVERAGE.dimensions, 0.01)
POSE = walk(AVERAGE, 3)[1] + np.random.default_rng(1).normal(0, 0.1, len(AVERAGE.skeleton.names))


def along_rows(body, pose):
    """(N,) positions of the edgels along their rows, pixels."""
    return np.einsum("na,na->n", EDGELS.row, surface_points(body, pose, EDGELS.part, EDGELS.unscaled))


def dense(rows_of, columns, edgels=EDGELS):
    """(N, columns) the rows of each part's edgels by all unknowns."""
    result = np.zeros((len(edgels.part), columns))
    for part in range(len(AVERAGE.parts)):
        own = np.flatnonzero(edgels.part == part)
        unknowns, rows = rows_of(part, edgels.of(own))
        result[own[:, None], unknowns] = rows
    return result


def test_pose_rows_equal_finite_differences():
    linear = FAMILY.linearised(FAMILY.mean, POSE[None])
    expected = surface_points(AVERAGE, POSE, EDGELS.part, EDGELS.unscaled)
    np.testing.assert_allclose(linear.points(EDGELS), expected)
    rows = dense(lambda part, edgels: linear.pose_rows(part, edgels, linear.points(edgels)), len(POSE))
    for k, step in enumerate(1e-6 * np.eye(len(POSE))):
        expected = (along_rows(AVERAGE, POSE + step) - along_rows(AVERAGE, POSE - step)) / 2e-6
        if AVERAGE.skeleton.is_by_landmarks[k]:
            assert not rows[:, k].any() and np.abs(expected).max() > 0.1, "contours do not move it"
            continue
        np.testing.assert_allclose(rows[:, k], expected, atol=1e-7, err_msg=AVERAGE.skeleton.names[k])


def test_shape_rows_equal_finite_differences():
    groups = AVERAGE.shape_groups
    T = AVERAGE.part_transforms(AVERAGE.skeleton.segment_transforms(POSE))

    def of_part(part, edgels):
        first = SHAPE_NUMBERS * AVERAGE.group[part]
        at = np.broadcast_to(T[part], (len(edgels.part), 4, 4))
        return first + np.arange(SHAPE_NUMBERS), shape_rows(AVERAGE, part, at, edgels)

    rows = dense(of_part, SHAPE_NUMBERS * len(groups))
    for k in range(len(groups) * SHAPE_NUMBERS):
        step = np.zeros(len(groups) * SHAPE_NUMBERS)
        step[k] = 1e-6
        pair = [AVERAGE.reshaped(change.reshape(-1, SHAPE_NUMBERS)) for change in (step, -step)]
        expected = (along_rows(pair[0], POSE) - along_rows(pair[1], POSE)) / 2e-6
        name = f"{groups[k // SHAPE_NUMBERS]} {k % SHAPE_NUMBERS}"
        np.testing.assert_allclose(rows[:, k], expected, atol=1e-6, err_msg=name)
        if k % SHAPE_NUMBERS < 2:
            assert np.abs(expected).max() > 0.01, f"{name}: no edgel moves"


def test_part_without_edgels_has_no_rows():
    unknowns, rows = FAMILY.linearised(FAMILY.mean, POSE[None]).parameter_rows(0, EDGELS.of(slice(0, 0)))
    assert rows.shape == (0, len(unknowns))


def test_dimension_rows_equal_finite_differences():
    mean = FAMILY.mean
    shared = mean + np.random.default_rng(2).normal(0, 0.02, len(mean)) * (FAMILY.deviation > 1e-5)
    rows = dense(FAMILY.linearised(shared, POSE[None]).parameter_rows, len(mean))
    change = shared[len(DIMENSIONS) :].reshape(-1, SHAPE_NUMBERS)
    for k, name in enumerate(DIMENSIONS):
        pair = []
        for sign in (1, -1):
            values = np.exp(shared[: len(DIMENSIONS)] + sign * 1e-5 * np.eye(len(DIMENSIONS))[k])
            body = build_cone_body(BodyDimensions(*values)).reshaped(change)
            pair.append(along_rows(body, POSE))
        np.testing.assert_allclose(rows[:, k], (pair[0] - pair[1]) / 2e-5, atol=1e-6, err_msg=name)


def test_landmark_rows_equal_finite_differences():
    mean = FAMILY.mean
    shared = mean + np.random.default_rng(3).normal(0, 0.02, len(mean)) * (FAMILY.deviation > 1e-5)
    rows = FAMILY.landmark_rows(shared, POSE[None])[0]
    assert rows.shape == (len(LANDMARKS), 3, len(mean))
    for k, step in enumerate(1e-5 * np.eye(len(mean))):
        pair = [body_points(FAMILY.build(shared + sign * step), POSE) for sign in (1, -1)]
        np.testing.assert_allclose(rows[..., k], (pair[0] - pair[1]) / 2e-5, atol=1e-5)
    assert (np.abs(rows).max(axis=(0, 1)) > 0.01)[[DIMENSIONS.index("upper_arm"), DIMENSIONS.index("calf")]].all()


def test_rows_use_the_pose_of_their_frame():
    poses = walk(AVERAGE, 2)
    linear = FAMILY.linearised(FAMILY.mean, poses)
    K = len(FAMILY.mean)
    both = [dense(linear.parameter_rows, K, EDGELS._replace(pose=EDGELS.pose + i)) for i in range(2)]
    for pose, rows in zip(poses, both, strict=True):
        alone = FAMILY.linearised(FAMILY.mean, pose[None])
        np.testing.assert_allclose(rows, dense(alone.parameter_rows, K), atol=1e-9)
    assert np.abs(both[0] - both[1]).max() > 0.01


@pytest.mark.parametrize("up", ["z", "x"])
def test_part_transforms_of_many_poses_follow_the_skeleton(up):
    body = build_cone_body(AVERAGE.dimensions, up)
    poses = np.random.default_rng(0).uniform(-1, 1, (4, len(body.skeleton.names)))
    T = body.skeleton.segment_transforms(poses)
    for pose, found in zip(poses, T, strict=True):
        np.testing.assert_allclose(found, body.skeleton.segment_transforms(pose), atol=1e-12)
    for p, part in enumerate(body.parts):
        expected = T[:, SEGMENTS.index(part.segment)] @ body.skeleton.in_world(part.T_body_part)
        np.testing.assert_allclose(body.part_transforms(T)[:, p], expected, atol=1e-12)


def test_lengths_of_a_known_body_are_recovered():
    """The average body's lengths are off by 5 %."""
    # the wrist hardly shows, so forearm and hand keep their lengths
    true = scaled(AVERAGE.dimensions, thigh=0.95, calf=1.05, upper_arm=1.05, thigh_radius=1.1)
    body = build_cone_body(true)
    poses = walk(body, 8)
    start = poses + np.random.default_rng(0).normal(0, 0.01, poses.shape)
    found, fitted, _ = fit_body(VIEWS, pyramids_of(body, poses), start, SEARCH, true.stature)
    for name in ("thigh", "calf", "upper_arm", "forearm"):
        assert getattr(found.dimensions, name) == pytest.approx(getattr(true, name), rel=0.03), name
    off = [
        np.linalg.norm(found.skeleton.joints(a) - body.skeleton.joints(b), axis=1).mean()
        for a, b in zip(fitted, poses, strict=True)
    ]
    assert np.mean(off) < 0.012
    assert found.dimensions.stature == pytest.approx(true.stature, rel=0.01)


def test_a_fit_with_other_frames_begins_at_the_body(monkeypatch):
    monkeypatch.setattr(body_fit, "ROUNDS_AGAIN", 0)
    body, poses = build_cone_body(scaled(AVERAGE.dimensions, thigh=0.9, thigh_radius=1.3)), walk(AVERAGE, 1)
    change = np.random.default_rng(0).normal(0.0, 0.01, (len(body.shape_groups), 8))
    body = body.reshaped(change)
    found, _, _ = fit_body(VIEWS, pyramids_of(body, poses), poses, SEARCH, STATURE, body=body)
    np.testing.assert_allclose(found.dimensions.values, body.dimensions.values)
    np.testing.assert_allclose(found.shape, body.shape, atol=1e-4)


@pytest.mark.parametrize("wrong", [0.96, 1.04])
def test_silhouettes_outweigh_a_wrong_height(wrong: float) -> None:
    poses = walk(AVERAGE, 4)
    true = AVERAGE.dimensions.barefoot
    found, _, _ = fit_body(VIEWS, pyramids_of(AVERAGE, poses), poses, SEARCH, true * wrong)
    assert abs(found.dimensions.barefoot / true - 1) < 0.6 * abs(wrong - 1)


def test_landmarks_show_joints_that_silhouettes_of_straight_limbs_do_not():
    """Upper arms are longer and forearms shorter than average; the arms hang straight."""
    body = build_cone_body(scaled(AVERAGE.dimensions, upper_arm=1.12, forearm=0.88))
    pose = standing_pose(body.skeleton)
    pose[:3] = walk(body, 1)[0, :3]
    (silhouettes,) = pyramids_of(body, pose[None])
    ratio = []
    for measured in ({}, {NAME: landmarks_of(VIEWS.rig, body, pose)}):
        found, _, _ = fit_body(VIEWS, [replace(silhouettes, measured=measured)], pose[None], SEARCH, STATURE)
        ratio.append(found.dimensions.upper_arm / found.dimensions.forearm)
    true = body.dimensions.upper_arm / body.dimensions.forearm
    # a little, because the landmarks' offsets of some centimetres are unknown
    assert abs(ratio[1] - true) < 0.95 * abs(ratio[0] - true)


def test_shapes_are_recovered_as_mirror_images():
    """Longer feet that point in another direction: no dimension explains both."""
    groups = AVERAGE.shape_groups
    change = np.zeros((len(groups), SHAPE_NUMBERS))
    change[groups.index("foot_"), [3, 6]] = [0.15, 0.03]
    change[groups.index("thigh_"), 0] = 0.2
    true = AVERAGE.reshaped(change)
    poses = walk(true, 3)
    seen = pyramids_of(true, poses)
    found, fitted, _ = fit_body(VIEWS, seen, poses, SEARCH, STATURE)
    grid = RayGrid(VIEWS.rig, 150)

    def error(body, poses):
        return np.mean(
            [Evidence.of(grid, p.masks[0]).mismatch(body, q[None]) for p, q in zip(seen, poses, strict=True)]
        )

    assert error(found, fitted) < 0.6 * error(AVERAGE, poses)
    parts = {part.name: part for part in found.parts}
    for part in found.parts:
        if part.name.endswith("_l"):
            assert parts[part.name[:-2] + "_r"].shape == pytest.approx(part.shape)
    start = {part.name: part for part in AVERAGE.parts}
    assert parts["thigh_l"].shape[0] > 1.08 * start["thigh_l"].shape[0]


def test_ends_of_a_part_move_separately_and_mirrored():
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
    assert np.linalg.norm(end - end_before) < 2e-3  # a limb keeps its length, so its far end moves a little
    chin, crown = (np.subtract(a, b) for a, b in zip(ends(body, "head"), ends(AVERAGE, "head"), strict=True))
    assert np.linalg.norm(chin) == pytest.approx(0.03, rel=0.1) and np.linalg.norm(crown) < 3e-3
    same = AVERAGE.reshaped(np.zeros_like(change))
    for a, b in zip(same.parts, AVERAGE.parts, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a.T_body_part, b.T_body_part, atol=1e-12)


def test_variance_by_the_body_falls_with_the_frames_and_knows_depth() -> None:
    """A body that one frame shows is less certain than one that six different frames show."""
    poses = walk(AVERAGE, 6)
    seen = pyramids_of(AVERAGE, poses)
    one, six = (fit_body(VIEWS, seen[:n], poses[:n], SEARCH, STATURE).variance() for n in (1, 6))
    assert one.shape == (len(JOINTS),) and (six < one).all()
    assert 0.003 < np.sqrt(one.mean()) < 0.02
