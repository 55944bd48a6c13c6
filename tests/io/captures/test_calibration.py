from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.io.conftest import calibration_tables, write_toml
from tk.errors import CalibrationError, CaptureError
from tk.io.captures.calibration import match_camera, read_calibration, write_calibration
from tk.io.toml import load_toml
from tk.model.cameras.camera import Rig


def write(tmp_path: Path, document: dict[str, Any]) -> Path:
    path = tmp_path / "calibration.toml"
    write_toml(path, document)
    return path


def test_every_field_is_read(tmp_path: Path) -> None:
    tables = calibration_tables(3)
    tables["cam2"]["distortions"] = [0.1, -0.05, 0.001, 0.002]
    tables["metadata"] = {"adjusted": True, "error": 0.3}
    calibration = read_calibration(write(tmp_path, tables))
    rig = calibration.rig
    assert rig.names == calibration.keys == ("cam1", "cam2", "cam3")
    assert (rig[0].width, rig[0].height) == (64, 48)
    np.testing.assert_array_equal(rig[0].matrix, tables["cam1"]["matrix"])
    np.testing.assert_array_equal(rig[1].distortions, [0.1, -0.05, 0.001, 0.002])
    np.testing.assert_allclose(rig[0].center, [3.0, 0.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(rig[0].rotation @ rig[0].rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(("units", "unit_m"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
def test_units_scale_the_translation_only(tmp_path: Path, units: str, unit_m: float) -> None:
    tables = calibration_tables(2)
    expected = np.array(tables["cam1"]["translation"]) * unit_m
    camera = read_calibration(write(tmp_path, {**tables, "metadata": {"units": units}})).rig[0]
    np.testing.assert_allclose(camera.translation, expected, rtol=1e-15)
    np.testing.assert_array_equal(camera.matrix, tables["cam1"]["matrix"])


def test_variants_of_other_tools_are_read(tmp_path: Path) -> None:
    tables = calibration_tables(2)
    pose2sim = {f"cam_{k}": {**table, "size": [64.0, 48.0]} for k, table in enumerate(tables.values())}
    assert read_calibration(write(tmp_path, pose2sim)).rig[0].width == 64
    freemocap = {
        key: {**table, "world_position": [1.0, 2.0, 3.0], "world_orientation": np.eye(3).tolist()}
        for key, table in tables.items()
    }
    metadata = {"charuco_square_size": 54.0, "path_to_recording": "x", "units": "mm"}
    assert len(read_calibration(write(tmp_path, {**freemocap, "metadata": metadata})).rig) == 2
    caliscope = {
        str(k): {"cam_id": k, "rotation_count": 0, "error": 0.3, "grid_count": 20}
        | {key: value for key, value in table.items() if key != "name"}
        for k, table in enumerate(tables.values())
    }
    assert read_calibration(write(tmp_path, {"cameras": caliscope})).rig.names == ("0", "1")


def test_a_rotation_may_be_a_matrix(tmp_path: Path) -> None:
    tables = calibration_tables(3)
    expected = read_calibration(write(tmp_path, tables)).rig
    for table, camera in zip(tables.values(), expected, strict=True):
        table["rotation"] = camera.rotation.round(7).tolist()
    for camera, other in zip(expected, read_calibration(write(tmp_path, tables)).rig, strict=True):
        np.testing.assert_allclose(other.rotation, camera.rotation, atol=1e-6)
        np.testing.assert_allclose(other.rotation @ other.rotation.T, np.eye(3), atol=1e-14)


def test_a_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    path = write(tmp_path, calibration_tables(2))
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_calibration(path).rig) == 2


def test_fisheye_takes_four_numbers(tmp_path: Path) -> None:
    tables = calibration_tables(2)
    tables["cam1"] |= {"fisheye": True, "distortions": [0.01, 0.02, 0.0, 0.0, 0.0]}
    camera = read_calibration(write(tmp_path, tables)).rig[0]
    assert camera.fisheye
    np.testing.assert_array_equal(camera.distortions, [0.01, 0.02, 0.0, 0.0])
    tables["cam1"]["distortions"][4] = 0.1
    with pytest.raises(CalibrationError, match="fisheye lens has 4"):
        read_calibration(write(tmp_path, tables))


MATRIX = [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("matrix", np.zeros((3, 3)).tolist(), "matrix is singular"),
        ("matrix", [MATRIX[0], MATRIX[0], MATRIX[2]], "matrix is singular"),
        ("matrix", [[-60.0, 0.0, 31.5], *MATRIX[1:]], "positive focal lengths"),
        ("matrix", np.transpose(MATRIX).tolist(), "matrix must be"),
        ("matrix", [[float("nan"), 0.0, 31.5], *MATRIX[1:]], "matrix holds nan"),
        ("matrix", MATRIX[:2], "3×3 numbers, and is 2×3"),
        ("matrix", [MATRIX[0], MATRIX[1], [0.0, 1.0]], "is something else"),
        ("matrix", "1 0 0", "is something else"),
        ("distortions", [0.0] * 7, "4 or 5 or 8 or 12 or 14 numbers, and is 7"),
        ("distortions", [], "numbers, and is 0"),
        ("distortions", [0.0] * 8 + [1e-3] + [0.0] * 3, "12 numbers, of a thin prism"),
        ("matrix", [[60.0, 30.0, 31.5], *MATRIX[1:]], "a skew of 30 pixels"),
        ("matrix", [[0.9, 0.0, 0.5], [0.0, 1.2, 0.5], MATRIX[2]], "focal lengths of 0.9 and 1.2 in an image of 64"),
        ("matrix", [[9e4, 0.0, 0.5], [0.0, 9e4, 0.5], MATRIX[2]], "focal lengths of 9e+04 and 9e+04"),
        ("distortions", [0.0, float("inf"), 0.0, 0.0], "distortions holds inf"),
        ("rotation", np.eye(2).tolist(), "rotation must be 3 or 3×3 numbers, and is 2×2"),
        ("rotation", (2 * np.eye(3)).tolist(), "rotation is no rotation matrix: R Rᵀ is off the identity by 3"),
        ("rotation", np.diag([1.0, 1.0, -1.0]).tolist(), "rotation is no rotation matrix"),
        ("rotation", [0.0, float("nan"), 0.0], "rotation holds nan"),
        ("translation", 3.0, "translation must be 3 numbers, and is one number"),
        ("size", [0, 48], "two positive whole numbers"),
        ("size", [64, -48], "two positive whole numbers"),
        ("size", [64.5, 48.0], "two positive whole numbers"),
        ("fisheye", "no", "fisheye = 'no' must be true or false"),
        ("translation", [0.0, 1e308, 0.0], "translation holds 1e+308, which is too large"),
        ("rotation", [1e300, 0.0, 0.0], "rotation holds"),
        ("distortions", [1e12, 0.0, 0.0, 0.0], "distortions holds"),
        ("matrix", [[1e200, 0.0, 0.0], *MATRIX[1:]], "matrix holds"),
        ("size", [10**6, 48], "65536 pixels a side"),
    ],
)
def test_a_bad_value_is_one_line_with_file_and_camera(tmp_path: Path, key: str, value: Any, complaint: str) -> None:
    tables = calibration_tables(3)
    tables["cam2"][key] = value
    path = write(tmp_path, tables)
    with pytest.raises(CalibrationError, match=re.escape(complaint)) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(f"{path}: camera 'cam2': ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["size", "matrix", "distortions", "rotation", "translation"])
def test_a_missing_key_is_named(tmp_path: Path, key: str) -> None:
    tables = calibration_tables(2)
    del tables["cam1"][key]
    with pytest.raises(CalibrationError, match=f"camera 'cam1': {key} is missing"):
        read_calibration(write(tmp_path, tables))


def test_unreadable_files_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    with pytest.raises(CalibrationError, match="no such file"):
        read_calibration(path)
    path.write_text("[cam1\nname = ")
    with pytest.raises(CalibrationError, match="invalid TOML") as caught:
        read_calibration(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="not UTF-8"):
        read_calibration(path)
    path.write_text("[metadata]\nerror = 0.0\n")
    with pytest.raises(CalibrationError, match="has no cameras"):
        read_calibration(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_calibration(path)


def test_names_and_units_are_checked(tmp_path: Path) -> None:
    tables = calibration_tables(3)
    tables["cam3"]["name"] = "cam1"
    with pytest.raises(CalibrationError, match="two cameras have the name 'cam1'"):
        read_calibration(write(tmp_path, tables))
    with pytest.raises(CalibrationError, match=r"units = 'inch' must be one of m, cm, mm"):
        read_calibration(write(tmp_path, {**calibration_tables(2), "metadata": {"units": "inch"}}))


def test_select_keeps_the_named_cameras(tmp_path: Path) -> None:
    calibration = read_calibration(write(tmp_path, calibration_tables(4)))
    assert calibration.select(None).rig.names == ("cam1", "cam2", "cam3", "cam4")
    assert calibration.select(["cam4", " cam2"]).rig.names == ("cam2", "cam4")
    with pytest.raises(CaptureError, match=r"no camera 'cam9' in .*calibration.toml, which has cam1, cam2, cam3, cam4"):
        calibration.select(["cam1", "cam9"])
    with pytest.raises(CaptureError, match="at least 2"):
        calibration.select(["cam1", "cam1"])
    with pytest.raises(CaptureError, match=r"calibration\.toml: 1 camera"):
        read_calibration(write(tmp_path, calibration_tables(1))).select(None)


@pytest.mark.parametrize(
    ("name", "key", "stems", "expected"),
    [
        ("left", "cam_0", ["left", "cam_0"], "left"),  # the name first
        ("A", "cam_0", ["cam_0", "cam0"], "cam_0"),  # then the key, before anything looser
        ("cam_01", "cam_01", ["cam01", "cam02"], "cam01"),
        ("cam01", "x", ["cam-01"], "cam-01"),
        ("A", "cam_0", ["cam0"], "cam0"),  # the key, loosely
        ("cam1", "cam1", ["Cam 1", "cam11"], "Cam 1"),
        ("cam1", "cam1", ["cam-1", "Cam1"], "cam-1"),  # the same case first
        ("cam1", "cam1", ["cam11"], None),
        ("__", "_", ["--"], None),  # nothing left to compare
    ],
)
def test_match_camera(name: str, key: str, stems: list[str], expected: str | None) -> None:
    assert match_camera(name, key, stems) == expected


def test_match_camera_ignores_how_accents_are_written() -> None:
    composed, separated = "camara\u00e9", "camarae\u0301"
    assert match_camera(composed, "1", [separated]) == separated
    assert match_camera(separated, "1", [composed]) == composed


def test_match_camera_refuses_to_guess() -> None:
    with pytest.raises(CaptureError, match="could be any of cam-01, cam01"):
        match_camera("cam_01", "cam_01", ["cam01", "cam-01"])


def test_a_number_of_too_many_digits_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, calibration_tables(2))
    path.write_text(path.read_text().replace("60.0", "9" * 400, 1))
    with pytest.raises(CalibrationError, match=r"camera 'cam1': matrix holds 9+.*, which is too large"):
        read_calibration(path)


def test_a_written_calibration_differs_only_in_its_cameras(tmp_path: Path) -> None:
    tables = calibration_tables(3)
    tables["cam2"]["owner"] = "somebody"
    path = write(tmp_path, {"cameras": tables, "metadata": {"units": "mm"}})
    calibration = read_calibration(path).select(["cam1", "cam2"])
    moved = Rig(tuple(replace(c, translation=c.translation + 0.001, matrix=c.matrix * 1.0) for c in calibration.rig))
    write_calibration(tmp_path / "new.toml", calibration, moved, [0.0, -0.04])
    again = read_calibration(tmp_path / "new.toml")
    assert again.time_offset_s == (0.0, -0.04, 0.0)
    for one, other in zip(again.rig, (*moved, read_calibration(path).rig[2]), strict=True):
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-12)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
    document = load_toml(tmp_path / "new.toml")
    assert document["metadata"] == {"units": "mm"} and document["cameras"]["cam2"]["owner"] == "somebody"
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_calibration(tmp_path / "none" / "new.toml", calibration, moved, [0.0, 0.0])


def test_coefficients_that_are_zero_are_dropped(tmp_path: Path) -> None:
    """OpenCV returns 8, 12 or 14 numbers when models are switched on; and vectors as rows or columns."""
    tables = calibration_tables(5)
    expected = read_calibration(write(tmp_path, tables)).rig
    brown = [-0.1, 0.02, 1e-3, 2e-3, 0.01]
    rational = [*brown, 0.3, 0.02, 0.0]
    given = (brown, [*brown, 0.0, 0.0, 0.0], rational, [*rational, *[0.0] * 4], [rational])
    for table, values in zip(tables.values(), given, strict=True):
        table["distortions"] = values
        table["rotation"] = [[x] for x in table["rotation"]]
        table["translation"] = [table["translation"]]
    found = read_calibration(write(tmp_path, tables)).rig
    for camera, other, values in zip(found, expected, (brown, brown, rational, rational, rational), strict=True):
        np.testing.assert_array_equal(camera.distortions, values)
        np.testing.assert_array_equal(camera.rotation, other.rotation)
        np.testing.assert_array_equal(camera.translation, other.translation)


def test_skew_is_kept(tmp_path: Path) -> None:
    tables = calibration_tables(2)
    tables["cam1"]["matrix"][0][1] = 3.0
    assert read_calibration(write(tmp_path, tables)).rig[0].matrix[0, 1] == 3.0


@pytest.mark.parametrize(
    ("rotation", "translation", "cameras", "complaint"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 4, "all 4 cameras have the same rotation and translation (zero)"),
        ([0.1, 2.0, 0.3], [0.0, 1.0, 3.0], 4, "all 4 cameras have the same rotation and translation;"),
        (None, [0.0, 0.0, 0.0], 4, "all 4 cameras stand in the same place"),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 2, "the cameras cam1, cam2 have a rotation and translation of zero"),
    ],
)
def test_cameras_without_a_pose_are_refused(
    tmp_path: Path, rotation: list[float] | None, translation: list[float], cameras: int, complaint: str
) -> None:
    tables = calibration_tables(4)
    for k in range(cameras):
        tables[f"cam{k + 1}"]["translation"] = translation
        if rotation is not None:
            tables[f"cam{k + 1}"]["rotation"] = rotation
    path = write(tmp_path, tables)
    with pytest.raises(CalibrationError, match=re.escape(f"{path}: {complaint}")):
        read_calibration(path)


def test_one_camera_may_be_the_world(tmp_path: Path) -> None:
    tables = calibration_tables(3)
    tables["cam1"] |= {"rotation": [0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
    assert len(read_calibration(write(tmp_path, tables)).rig) == 3


def test_all_cameras_vote_for_up_also_those_that_are_not_selected(tmp_path: Path) -> None:
    tables = calibration_tables(5)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # a world with -y up
    for k, table in enumerate(tables.values()):
        roll = quarter if k < 2 else np.eye(3)
        table["rotation"] = (roll @ cv2.Rodrigues(np.array(table["rotation"]))[0] @ turn.T).tolist()
        table["translation"] = (roll @ table["translation"]).tolist()
    calibration = read_calibration(write(tmp_path, tables))
    assert calibration.mounting.up == calibration.select(["cam1", "cam2"]).mounting.up == "-y"
    for table in list(tables.values())[:2]:
        table["rotation_count"] = -1
    found = read_calibration(write(tmp_path, {k: tables[k] for k in ("cam1", "cam2")}))
    assert found.mounting.up == "-y" and found.turns == (3, 3)
