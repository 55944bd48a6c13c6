from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.io.conftest import CENTER, look_at
from tests.io.importers.conftest import make_rig, points
from tk.io.importers.write import find_volume
from tk.model.cameras.camera import Rig
from tk.model.cameras.mounting import infer_up
from tk.model.cameras.up import UP_AXES, up_vector

seeds = st.integers(0, 2**32 - 1)


def rolled(rig: Rig, degrees: float, seed: int = 1) -> Rig:
    """Return the rig with each camera rotated about its optical axis by up to ``degrees``."""
    rng = np.random.default_rng(seed)
    cameras = []
    for camera in rig:
        roll = Rotation.from_euler("z", rng.uniform(-degrees, degrees), degrees=True).as_matrix()
        cameras.append(replace(camera, rotation=roll @ camera.rotation, translation=roll @ camera.translation))
    return Rig(tuple(cameras))


@pytest.mark.parametrize("name", UP_AXES)
def test_up_along_an_axis_is_found(name: str) -> None:
    turn = Rotation.align_vectors([up_vector(name)], [[0.0, 0.0, 1.0]])[0].as_matrix()
    assert infer_up(make_rig(world=turn)).up == name
    found = infer_up(rolled(make_rig(world=turn), 10.0))
    assert found.up == name and "the axis" in found.how


@given(seed=seeds)
@settings(max_examples=30)
def test_up_of_a_rotated_world_is_found(seed: int) -> None:
    turn = Rotation.random(random_state=seed).as_matrix()
    found = infer_up(make_rig(world=turn))
    off = np.degrees(np.arccos(np.clip(up_vector(found.up) @ turn[:, 2], -1, 1)))
    # exact, unless the true direction is close to an axis and taken for it
    assert off < 1e-3 or (found.up in UP_AXES and off <= 10.0)


def test_overhead_camera_does_not_change_up() -> None:
    """Its up and right directions are both horizontal."""
    turn = Rotation.from_euler("xyz", [0.5, -0.4, 0.2]).as_matrix()
    rig = make_rig(world=turn)
    down = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]]) @ turn.T
    overhead = replace(rig[0], name="top", rotation=down, translation=-down @ turn @ np.array([0.1, 0.0, 4.0]))
    found = infer_up(Rig((*rig.cameras, overhead)))
    np.testing.assert_allclose(up_vector(found.up), turn[:, 2], atol=1e-6)


def test_parallel_cameras_use_the_mean_direction() -> None:
    rig = make_rig()
    twins = Rig(tuple(replace(rig[0], name=str(k)) for k in range(3)))
    found = infer_up(twins)
    np.testing.assert_allclose(up_vector(found.up), -rig[0].rotation[1], atol=1e-12)
    assert "the mean" in found.how


def spun(rig: Rig, degrees: float, cameras: slice = slice(None)) -> Rig:
    """Return the rig with some cameras rotated about their optical axes, clockwise as seen from behind."""
    roll = Rotation.from_euler("z", -degrees, degrees=True).as_matrix()
    chosen = rig.cameras[cameras]
    return Rig(
        tuple(
            replace(c, rotation=roll @ c.rotation, translation=roll @ c.translation) if c in chosen else c for c in rig
        )
    )


def arc_rig(world: np.ndarray, half_deg: float, down_deg: float, count: int = 4) -> Rig:
    """Return upright cameras on one side of a room that look at a person, some more downwards than others."""
    cameras = []
    for index, heading in enumerate(np.linspace(-half_deg, half_deg, count)):
        down = down_deg + 4.0 * (index % 2)
        upright = Rotation.from_euler("ZX", [heading, -90.0 - down], degrees=True).as_matrix().T
        rotation = upright @ world.T
        cameras.append(replace(make_rig()[0], name=str(index), rotation=rotation, translation=np.array([0, 0, 3.0])))
    return Rig(tuple(cameras))


@pytest.mark.parametrize("half_deg", [20.0, 45.0, 80.0])
@pytest.mark.parametrize("down_deg", [0.0, 20.0, 40.0])
@pytest.mark.parametrize("spin", [90.0, -90.0])
def test_cameras_on_their_side_do_not_decide(half_deg: float, down_deg: float, spin: float) -> None:
    """In an arc they agree on a direction, but in a world with this direction they would be stacked."""
    upright = arc_rig(np.eye(3), half_deg, down_deg)
    assert infer_up(upright).up == "z" and infer_up(upright).sure
    found = infer_up(spun(upright, spin))
    assert found.up == "z" and not found.sure and "z is a guess" in found.how
    assert infer_up(spun(upright, spin), [int(spin / 90)] * 4) == infer_up(upright)


def test_cameras_on_their_side_all_around_do_not_decide() -> None:
    turn = Rotation.random(random_state=3).as_matrix()
    for count in range(2, 9):
        angles = 2 * np.pi * np.arange(count) / count
        rig = Rig(
            tuple(
                replace(make_rig()[0], name=str(k), rotation=look_at(c, CENTER)[0] @ turn.T)
                for k, c in enumerate(CENTER + 3 * np.stack([np.cos(angles), np.sin(angles), 0.2 + 0 * angles], 1))
            )
        )
        assert infer_up(rig).sure and not infer_up(spun(rig, 90)).sure


def test_majority_of_the_cameras_decides() -> None:
    turn = Rotation.from_euler("xyz", [0.5, -0.4, 0.2]).as_matrix()
    rig = Rig((*make_rig(world=turn), replace(make_rig(world=turn)[1], name="fifth")))
    for degrees in (90, 180, -90):
        found = infer_up(spun(rig, degrees, slice(2)))
        assert found.sure
        np.testing.assert_allclose(up_vector(found.up), turn[:, 2], atol=1e-6)
        assert not infer_up(spun(rig, degrees, slice(3))).sure or degrees == 180
    two = spun(Rig(rig.cameras[:4]), 180, slice(2))
    assert infer_up(two).how == "the cameras are mounted differently: z is a guess"
    # unless it is known how the images are turned
    np.testing.assert_allclose(up_vector(infer_up(two, [2, 2, 0, 0]).up), turn[:, 2], atol=1e-6)


def test_volume_ignores_one_camera_that_looks_elsewhere() -> None:
    rig = make_rig()
    turn = Rotation.from_euler("y", 75, degrees=True).as_matrix()
    other = replace(rig[3], name="other", rotation=turn @ rig[3].rotation, translation=turn @ rig[3].translation)
    volume, how = find_volume(Rig((*rig.cameras, other)))
    assert volume is not None and "4 of the 5 cameras see" in how
    assert (points().mean(axis=0) > volume.lower).all() and (points().mean(axis=0) < volume.upper).all()


def test_cameras_that_look_outwards_get_no_volume() -> None:
    outwards = [
        replace(c, rotation=c.rotation * [[-1], [1], [-1]], translation=c.translation * [-1, 1, -1]) for c in make_rig()
    ]
    volume, how = find_volume(Rig(tuple(outwards)))
    assert volume is None and "cam1, cam2, cam3, cam4 look away" in how
