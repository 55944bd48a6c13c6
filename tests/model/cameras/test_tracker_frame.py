"""The tracker's frame in worlds with any orientation and origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.model.figures import BODY
from tests.model.ring import ring_of_cameras
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.tracker_frame import TrackerFrame, seen_from
from tk.model.cameras.up import UP_AXES, up_text, up_vector

seeds = st.integers(0, 2**32 - 1)


def random_rig(rng: np.random.Generator) -> Rig:
    """One to six cameras within some metres, with any orientation."""
    cameras = []
    for i in range(rng.integers(1, 7)):
        rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        cameras.append(Camera(f"c{i}", 160, 120, np.eye(3), np.zeros(5), rotation, rng.uniform(-4, 4, 3)))
    return Rig(tuple(cameras))


def random_up(rng: np.random.Generator) -> str:
    """An axis or any direction."""
    axes = rng.random() < 0.3
    return str(rng.choice(UP_AXES)) if axes else up_text(rng.normal(size=3))


def random_world(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A turn (3, 3) and a move (3,) of some metres."""
    return Rotation.random(random_state=int(rng.integers(2**31))).as_matrix(), rng.uniform(-5, 5, 3)


def bits(rig: Rig) -> list[bytes]:
    return [values.tobytes() for camera in rig for values in (camera.rotation, camera.translation, camera.matrix)]


@given(seeds)
def test_points_poses_and_cameras_survive_a_round_trip(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, up = random_rig(rng), random_up(rng)
    world = TrackerFrame.of(rig, up)
    points, poses = rng.uniform(-3, 3, (2, 5, 3)), rng.uniform(-2, 2, (5, len(BODY.skeleton.names)))
    np.testing.assert_allclose(world.points_out(world.points_in(points)), points, atol=1e-12)
    np.testing.assert_allclose(world.poses_out(world.poses_in(poses)), poses, atol=1e-12)
    np.testing.assert_array_equal(world.poses_in(poses)[:, 4:], poses[:, 4:])
    np.testing.assert_allclose(world.poses_in(poses[0]), world.poses_in(poses)[0], atol=1e-12)
    # cameras but for their rounding
    for found, expected in zip(world.rig_out(world.rig), rig, strict=True):
        np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-7)
        np.testing.assert_allclose(found.translation, expected.translation, atol=1e-6)


@given(seeds)
def test_z_is_up_and_a_pose_places_the_same_body_in_both_worlds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, up = random_rig(rng), random_up(rng)
    world = TrackerFrame.of(rig, up)
    np.testing.assert_allclose(world.rotation.T @ up_vector(up), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(world.rig.centers.mean(axis=0), 0.0, atol=1e-6)
    poses = rng.uniform(-1, 1, (4, len(BODY.skeleton.names)))
    outside = BODY.standing(up).skeleton.joints(world.poses_out(poses))
    np.testing.assert_allclose(outside, world.points_out(BODY.skeleton.joints(poses)), atol=1e-12)
    # the cameras see the joints at the same places
    for own, camera in zip(world.rig, rig, strict=True):
        np.testing.assert_allclose(own.to_camera(world.points_in(outside[0])), camera.to_camera(outside[0]), atol=1e-6)


@given(seeds)
def test_cameras_are_bit_identical_in_any_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, up = random_rig(rng), random_up(rng)
    expected = bits(TrackerFrame.of(rig, up).rig)
    for _ in range(5):
        turn, shift = random_world(rng)
        other = TrackerFrame.of(seen_from(rig, turn.T, -turn.T @ shift), up_text(turn @ up_vector(up)))
        assert bits(other.rig) == expected


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, -90.0, 180.0])
@pytest.mark.parametrize("pitch_deg", [0.0, 30.0, 90.0])
def test_cameras_mounted_at_right_angles_are_bit_identical_in_any_world(roll_deg: float, pitch_deg: float) -> None:
    """Level, on their side, upside down, on the ceiling: turns by exactly 90° and 180° round alike, too."""
    ring = ring_of_cameras(4, width=160, height=200)
    mounted = Rotation.from_euler("xz", [pitch_deg, roll_deg], degrees=True).as_matrix()
    rig = Rig(tuple(replace(c, rotation=mounted @ c.rotation, translation=mounted @ c.translation) for c in ring))
    expected = bits(TrackerFrame.of(rig, "z").rig)
    rng = np.random.default_rng(0)
    for _ in range(20):
        turn, shift = random_world(rng)
        assert bits(TrackerFrame.of(seen_from(rig, turn.T, -turn.T @ shift), up_text(turn[:, 2])).rig) == expected


def test_x_is_the_first_cameras_rightward_direction() -> None:
    rig = ring_of_cameras(3, width=160, height=200)
    np.testing.assert_allclose(TrackerFrame.of(rig, "z").rig[0].rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-7)
    # of a camera on its side: the viewing direction
    on_side = replace(rig[0], rotation=Rotation.from_euler("z", 90, degrees=True).as_matrix() @ rig[0].rotation)
    np.testing.assert_allclose(TrackerFrame.of(Rig((on_side,)), "z").rig[0].rotation[2], [1, 0, 0], atol=1e-7)
