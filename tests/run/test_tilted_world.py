"""A world that nobody has laid along the floor, like the frame of a camera: `up` is a direction, not an axis."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation

from tests.conftest import QUICK, track
from tk.io import settings_file
from tk.io.captures.calibration import camera_table
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints, read_result
from tk.model.cameras.tracker_frame import seen_from
from tk.model.cameras.up import up_text
from tk.model.cameras.volume import Volume

TURN = Rotation.from_euler("xyz", [-1.2, 0.3, 0.5]).as_matrix()


@pytest.fixture(scope="module")
def tilted(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny capture with its world turned by :data:`TURN`."""
    folder = tmp_path_factory.mktemp("tilted") / "capture"
    shutil.copytree(tiny, folder)
    original = open_capture(tiny)
    tables: dict[str, object] = {}
    for camera in original.rig:
        turned = replace(camera, rotation=camera.rotation @ TURN.T)
        tables[camera.name] = camera_table(turned)
    (folder / "calibration.toml").write_text(tomli_w.dumps(tables))
    side = 1.15 * max(original.volume.size)
    settings = {
        "up": (3 * TURN[:, 2]).tolist(),
        "volume": {"center": (TURN @ original.volume.center).tolist(), "size": [side] * 3},
    }
    (folder / "capture.toml").write_text(tomli_w.dumps(settings))
    return folder


def test_the_person_is_tracked_in_a_tilted_world(tiny: Path, tilted: Path, tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    track(open_capture(tilted), path, settings_file.from_toml(QUICK), method="volumetric", frames=(0, 3))
    with h5py.File(path) as file:
        up = file.attrs["up"]
    np.testing.assert_allclose(open_capture(tilted).up_axis, TURN[:, 2], atol=1e-12)
    assert up == open_capture(tilted).up  # the very text
    truth = read_joints(tiny / "truth.h5").positions[:3] @ TURN.T
    found = read_result(path).joints
    assert np.linalg.norm(found - truth, axis=-1).mean() < 0.10


def test_results_do_not_depend_on_the_worlds_rotation(unposed: Path, tmp_path: Path) -> None:
    """Not even to rounding, which would decide between poses that explain the pictures alike."""
    capture, shift = open_capture(unposed), np.array([3.0, -2.0, 0.7])
    side = 1.15 * max(capture.volume.size)
    center = TURN @ capture.volume.center + shift
    turned = replace(
        capture,
        rig=seen_from(capture.rig, TURN.T, -TURN.T @ shift),
        volume=Volume((center[0], center[1], center[2]), (side, side, side)),
        up=up_text(TURN @ capture.up_axis),
    )
    results = []
    for name, one in (("as it is.h5", capture), ("turned.h5", turned)):
        track(one, tmp_path / name, settings_file.from_toml(QUICK), frames=(0, 2))
        results.append(read_result(tmp_path / name))
    expected, found = results
    assert found.smoothed is not None and expected.smoothed is not None
    for a, b in (
        (found.joints, expected.joints),
        (found.feet, expected.feet),
        (found.smoothed["joints/position"], expected.smoothed["joints/position"]),
    ):
        assert a is not None and b is not None
        np.testing.assert_allclose(a, b @ TURN.T + shift, atol=1e-9)
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.objective, expected.objective)
    np.testing.assert_array_equal(found.model["parts/shape"], expected.model["parts/shape"])
    for joint, angles in expected.angles.items():
        if joint != "pelvis":  # its heading is counted from an axis of the capture's world
            np.testing.assert_allclose(found.angles[joint], angles, atol=1e-6)
