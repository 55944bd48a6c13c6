from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import refused
from tests.io.conftest import write_toml
from tk.errors import CaptureError
from tk.io.captures.init_pose import LEAST_JOINTS, read_init_pose
from tk.model.body.skeleton import JOINTS

NAMES = ("torso_x", "torso_y", "torso_z", "torso_yaw", "elbow_l_pitch")
PLACES = {name: [0.1 * k, 0.2 * (k % 2), 1.0] for k, name in enumerate(JOINTS)}
PLACE = {"torso_x": 0.1, "torso_y": -0.2, "torso_z": 1.0}


def test_joints_are_read(tmp_path: Path) -> None:
    file = tmp_path / "pose.toml"
    some = dict(list(PLACES.items())[:LEAST_JOINTS])
    write_toml(file, {"frame": 12, "joints": some, "subject": {"height": 1.8}})
    pose = read_init_pose(file, NAMES)
    assert (pose.frame, pose.height_m, pose.angles) == (12, 1.8, {})
    assert set(pose.joints) == set(some)
    for name, position in some.items():
        np.testing.assert_array_equal(pose.joints[name], position)
    np.testing.assert_allclose(pose.center, np.mean(list(some.values()), axis=0))


def test_angles_are_read_in_degrees_and_positions_in_metres(tmp_path: Path) -> None:
    file = tmp_path / "pose.toml"
    write_toml(file, {"angles": {**PLACE, "torso_yaw": 90, "elbow_l_pitch": -30.0}})
    pose = read_init_pose(str(file), NAMES)
    assert pose.angles == pytest.approx({**PLACE, "torso_yaw": math.pi / 2, "elbow_l_pitch": -math.pi / 6})
    assert (pose.frame, pose.height_m, pose.joints) == (None, None, {})
    np.testing.assert_array_equal(pose.center, list(PLACE.values()))


@pytest.mark.parametrize(
    ("document", "parts"),
    [
        ({}, ["either a [joints] or an [angles] table"]),
        ({"joints": PLACES, "angles": PLACE}, ["either a [joints] or an [angles] table"]),
        ({"joints": {**PLACES, "nose": [0, 0, 0]}}, ["unknown joint nose", "pelvis"]),
        ({"joints": {"pelvis": [0, 0, 1]}}, ["1 joints are too few", str(LEAST_JOINTS)]),
        ({"joints": {**PLACES, "neck": [0, 1]}}, ["neck", "3 numbers"]),
        ({"joints": {**PLACES, "neck": [0, 1, math.nan]}}, ["neck", "nan"]),
        ({"joints": {**PLACES, "neck": "here"}}, ["neck", "3 numbers"]),
        ({"joints": 3}, ["joints", "table"]),
        ({"joints": {name: [0, 0, 1] for name in JOINTS}}, ["[joints] lie on a line"]),
        ({"joints": {name: [0, 0.01 * k, 0.1 * k] for k, name in enumerate(JOINTS)}}, ["[joints] lie on a line"]),
        ({"angles": {**PLACE, "tail": 3.0}}, ["unknown angle tail", "torso_yaw"]),
        ({"angles": {"torso_yaw": 3.0}}, ["torso_x, torso_y and torso_z", "metres"]),
        ({"angles": {**PLACE, "torso_yaw": math.inf}}, ["torso_yaw", "finite"]),
        ({"angles": {**PLACE, "torso_yaw": "north"}}, ["torso_yaw", "number"]),
        ({"angles": PLACE, "frame": -1}, ["frame = -1"]),
        ({"angles": PLACE, "frame": 1.5}, ["frame", "whole"]),
        ({"angles": PLACE, "subject": {"height": 180}}, ["height = 180", "metres"]),
        ({"angles": PLACE, "subject": {"height": -1.8}}, ["height = -1.8"]),
        ({"angles": PLACE, "subject": 3}, ["subject", "table"]),
    ],
)
def test_mistakes_are_reported_in_one_line(tmp_path: Path, document: dict[str, Any], parts: list[str]) -> None:
    file = tmp_path / "pose.toml"
    write_toml(file, document)
    with refused(CaptureError, *parts) as caught:
        read_init_pose(file, NAMES)
    assert str(caught.value).startswith(str(file))


def test_unreadable_files_are_reported(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"nowhere\.toml: no such file"):
        read_init_pose(tmp_path / "nowhere.toml", NAMES)
    with pytest.raises(CaptureError, match="no such file"):
        read_init_pose(tmp_path, NAMES)
    (tmp_path / "bad.toml").write_text("[joints\n")
    with pytest.raises(CaptureError, match=r"bad\.toml: invalid TOML"):
        read_init_pose(tmp_path / "bad.toml", NAMES)
