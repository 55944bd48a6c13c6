"""Triangulation of joints with outliers, and the choice of one person."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.ring import ring_of_cameras
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.skeleton import build_skeleton
from tk.model.cameras.triangulation import same_person, triangulate_joints

RIG = ring_of_cameras(5, 640, 480)
SKELETON = build_skeleton(BodyDimensions.from_stature(1.75))
BOX = np.array([-1.2, -1.2, 0.0]), np.array([1.2, 1.2, 2.2])


def person(x: float = 0.0, y: float = 0.0, yaw: float = 0.4) -> np.ndarray:
    pose = neutral_pose(SKELETON)
    pose[:3] = [x, y, 0.95]
    pose[SKELETON.index("torso_yaw")] = yaw
    return SKELETON.joints(pose)


def seen(joints: np.ndarray) -> np.ndarray:
    """(C, 15, 3)."""
    return np.stack([np.column_stack([camera.project(joints)[0], np.full(15, 0.9)]) for camera in RIG])


@settings(max_examples=20)
@given(st.integers(0, 2**16))
def test_outliers_are_excluded(seed: int) -> None:
    """Two of five views of each joint are anywhere; the result agrees with the other three."""
    rng = np.random.default_rng(seed)
    joints, pixels = person(), seen(person())
    wrong = np.argsort(rng.random((5, 15)), axis=0)[:2]
    for j in range(15):
        for c in wrong[:, j]:
            # off by 40 px and more, the gate is 5 % of 350 px
            angle = rng.uniform(0, 2 * np.pi)
            pixels[c, j, :2] += rng.uniform(40, 200) * np.array([np.cos(angle), np.sin(angle)])
    found, agreeing = triangulate_joints(RIG, pixels)
    good = np.ones((5, 15), bool)
    np.put_along_axis(good, wrong, False, axis=0)
    np.testing.assert_allclose(found, joints, atol=1e-6)
    np.testing.assert_array_equal(agreeing, good)


def test_noise_is_averaged_with_confidence_as_weight() -> None:
    rng = np.random.default_rng(1)
    pixels = seen(person())
    pixels[:, :, :2] += rng.normal(0, 5, (5, 15, 2))
    found, _ = triangulate_joints(RIG, pixels)
    error = np.linalg.norm(found - person(), axis=1)
    assert error.mean() < 0.03 and error.max() < 0.06  # a pixel is 8 mm wide there
    exact = seen(person())
    pixels[:2] = exact[:2]
    pixels[2:, :, 2] = 0.35
    surer = np.linalg.norm(triangulate_joints(RIG, pixels)[0] - person(), axis=1)
    assert surer.mean() < 0.7 * error.mean()


def test_joints_without_two_views_are_nan() -> None:
    pixels = seen(person())
    pixels[1:, 3] = np.nan  # one view is left
    pixels[:, 5, 2] = 0.1  # too little confidence
    found, agreeing = triangulate_joints(RIG, pixels)
    assert np.isnan(found[[3, 5]]).all() and not agreeing[:, [3, 5]].any()
    assert np.isfinite(np.delete(found, [3, 5], axis=0)).all()


@pytest.mark.parametrize("order", [0, 1])
def test_person_inside_the_box_is_chosen_in_all_views(order: int) -> None:
    """Another person is visible as well, and the order of the people differs between views."""
    ours, other = seen(person()), seen(person(2.0, 1.0, 2.0))
    people = [np.stack([a, b] if (c + order) % 2 else [b, a]) for c, (a, b) in enumerate(zip(ours, other, strict=True))]
    people[3] = people[3][:0]  # a camera that finds nobody
    chosen = same_person(RIG, people, BOX)
    assert np.isnan(chosen[3]).all()
    np.testing.assert_array_equal(np.delete(chosen, 3, axis=0), np.delete(ours, 3, axis=0))


def test_without_people_in_two_views_the_result_is_nan() -> None:
    people = [np.zeros((0, 15, 3)) for _ in RIG]
    assert np.isnan(same_person(RIG, people, BOX)).all()
    alone = [seen(person())[:1], *people[1:]]
    assert np.isnan(triangulate_joints(RIG, same_person(RIG, alone, BOX))[0]).all()
