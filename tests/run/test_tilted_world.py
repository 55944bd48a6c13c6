"""A world that nobody has laid along the floor, like the frame of a camera: `up` is a direction, not an axis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.conftest import QUICK, track
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_result
from tk.model.cameras.tracker_frame import seen_from
from tk.model.cameras.up import up_text
from tk.model.cameras.volume import Volume

TURN = Rotation.from_euler("xyz", [-1.2, 0.3, 0.5]).as_matrix()


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
