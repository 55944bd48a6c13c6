"""Damaged calibrations are read, or refused with one line."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import refused
from tests.io.conftest import write_toml
from tests.io.importers.conftest import make_rig, projection_matrix, renamed, tables
from tests.io.importers.test_calibration_formats import (
    in_first,
    write_calibio,
    write_colmap,
    write_mcal,
    write_multical,
    write_opencv,
    write_stereo,
)
from tests.io.importers.test_other_formats import write_easymocap, write_panoptic
from tests.io.importers.test_xml_formats import write_qca, write_xcp
from tk.errors import CalibrationError, CaptureError
from tk.io.importers import read_project
from tk.model.cameras.mounting import infer_up

NAMES = ["26578", "26579", "26580", "26581"]
RIG = renamed(make_rig(), *NAMES)
DAMAGES = 20


def write_projections(folder: Path) -> None:
    for camera in RIG:
        np.savetxt(folder / f"{camera.name}.txt", projection_matrix(camera))


FORMATS: dict[str, Callable[[Path], object]] = {
    "toml": lambda folder: write_toml(folder / "camera_array.toml", {"cameras": tables(RIG)}),
    "easymocap": lambda folder: write_easymocap(folder, RIG),
    "panoptic": lambda folder: write_panoptic(folder, RIG, NAMES),
    "qualisys": lambda folder: write_qca(folder / "x.qca.txt", RIG),
    "vicon": lambda folder: write_xcp(folder / "x.xcp", RIG, (1e-8, 0.0)),
    "projections": write_projections,
    "multical": lambda folder: write_multical(folder, in_first(RIG)),
    "calib.io": lambda folder: write_calibio(folder, in_first(RIG)),
    "opencv yaml": lambda folder: write_opencv(folder, RIG),
    "opencv json": lambda folder: write_opencv(folder, RIG, ".json"),
    "stereo": lambda folder: write_stereo(folder, RIG),
    "colmap": lambda folder: write_colmap(folder, RIG),
    "optitrack": lambda folder: write_mcal(folder, RIG),
}


@pytest.mark.parametrize(
    ("format_name", "file", "old", "new", "complaint"),
    [
        ("toml", "camera_array.toml", "matrix = [", "matrix = [ [1.0], ", "camera '26578': matrix must be 3×3 numbers"),
        (
            "toml",
            "camera_array.toml",
            "rotation = [",
            "rotation = [ nan, ",
            "camera '26578': rotation must be 3",
        ),
        ("toml", "camera_array.toml", "    320,", "    0,", "camera '26578': size = [0, 240]"),
        ("easymocap", "intri.yml", "K_26579:", "L_26579:", "has no K_26579"),
        ("easymocap", "intri.yml", "names:", "cams:", "has no list `names`"),
        ("easymocap", "intri.yml", "data: [", "data: [ x{", "K_26578 must be a matrix of 9 finite numbers"),
        ("easymocap", "intri.yml", '"26579"', '"26578"', "names must be distinct"),
        ("easymocap", "intri.yml", "W_26580: 320", "W_26580: wide", "W_26580 = 'wide' must be a number of pixels"),
        ("easymocap", "extri.yml", "data: [", "data: [ .Nan, ", "R_26578 must be a matrix of 3 finite numbers"),
        ("easymocap", "extri.yml", ":", ";", "is not YAML as OpenCV writes it"),
        ("easymocap", "intri.yml", "", None, "cannot be read (No such file or directory)"),
        ("panoptic", "calibration_171204_pose1.json", '"distCoef"', '"distortion"', "distCoef is missing"),
        ("panoptic", "calibration_171204_pose1.json", '"cameras"', '"kameras"', "has no list of `cameras`"),
        ("panoptic", "calibration_171204_pose1.json", "{", "{{", "invalid JSON"),
        ("panoptic", "calibration_171204_pose1.json", '"K": [[', '"K": [["a", ', "K must be 3×3 numbers"),
        ("panoptic", "calibration_171204_pose1.json", '"K": [[', '"K": [[-', "positive focal lengths"),
        ("qualisys", "x.qca.txt", "<cameras>", "<cameras", "invalid XML"),
        ("qualisys", "x.qca.txt", "<calibration", "<!DOCTYPE x [<!ENTITY a 'b'>]><calibration", "a document type"),
        ("qualisys", "x.qca.txt", "<transform ", "<transformed ", "camera '26578': has no <transform>"),
        ("qualisys", "x.qca.txt", "focalLengthU=", "U=", "camera '26578': <intrinsic>: focalLengthU is missing"),
        ("qualisys", "x.qca.txt", 'r11="', 'r11="nan', "camera '26578': <transform>: r11 = 'nan"),
        ("qualisys", "x.qca.txt", 'r11="', 'r11="7" r="', "camera '26578': rotation is no rotation matrix"),
        ("qualisys", "x.qca.txt", 'active="1"', 'active="0"', "0 calibrated camera, and a capture needs at least 2"),
        ("multical", "calibration.json", '"R": [[', '"R": [["x", ', "[camera_poses]: [26578]: R must be 3×3 numbers"),
        ("multical", "calibration.json", "_to_26578", "_to_99", "must be the name of a camera, or two names with _to_"),
        ("multical", "calibration.json", '"K": [[', '"K": [[-', "positive focal lengths"),
        ("calib.io", "rig.json", '"cameras"', '"kameras"', "has no list of `cameras`"),
        ("calib.io", "rig.json", '"f": {"state": 0, "val": ', '"f": {"val": -', "positive focal lengths"),
        ("calib.io", "rig.json", "}]", "}", "invalid JSON"),
        ("opencv yaml", "26579.yml", "data: [", "data: [ x, ", "camera_matrix must be 3×3 numbers"),
        ("opencv yaml", "26579.yml", "data: [", "data: [[", "is not YAML as OpenCV writes it"),
        ("opencv json", "26579.json", '"rows": 3', '"rows": 2', "camera_matrix must be 3×3 numbers"),
        ("stereo", "extrinsics.yml", "T:", "Q:", "has no R and T, from the first camera to the second one"),
        ("colmap", "cameras.txt", " OPENCV ", " FOV ", "line 2: 'FOV' is no lens model that tk reads"),
        ("colmap", "cameras.txt", " OPENCV ", " RADIAL ", "line 2: RADIAL needs 5 parameters, f, cx, cy, k1, k2"),
        ("colmap", "images.txt", " 26578.jpg", "", "line 3: must be an image (ten values, the last one its name)"),
        ("colmap", "images.txt", " 2 26579.jpg", " 9 26579.jpg", "camera 9 is not in cameras.txt"),
        ("colmap", "images.txt", "10 ", "10 nan ", "must hold finite numbers"),
        ("vicon", "x.xcp", "ORIENTATION=", "O=", "camera '26578': <KeyFrame>: ORIENTATION is missing"),
        ("vicon", "x.xcp", 'POSITION="', 'POSITION="x ', "camera '26578': <KeyFrame>: POSITION must be 3 numbers"),
        ("vicon", "x.xcp", 'SIZE="320 240"', 'SIZE="320"', "camera '26578': SENSOR_SIZE must be 2 numbers"),
        ("vicon", "x.xcp", 'FOCAL_LENGTH="', 'FOCAL_LENGTH="-', "must be positive"),
        ("vicon", "x.xcp", "KeyFrames>", "Frames>", "0 calibrated camera, and a capture needs at least 2"),
        ("vicon", "x.xcp", "ViconRadial2 ", "ViconRadial2 0 0 -1 0 0 ", "the distortion is not monotonic"),
    ],
)
def test_error_of_a_damaged_calibration_names_file_and_place(
    folder: Path,
    capfd: pytest.CaptureFixture[str],
    format_name: str,
    file: str,
    old: str,
    new: str | None,
    complaint: str,
) -> None:
    FORMATS[format_name](folder)
    path = folder / file
    if new is None:
        path.unlink()
    else:
        path.write_text(path.read_text().replace(old, new))
    capfd.readouterr()
    with refused(CalibrationError, complaint, path):
        read_project(folder)
    assert capfd.readouterr() == ("", "")


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return the data truncated, with a part removed or repeated, or with some bytes changed."""
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    b = min(b, a + rng.choice([1, 8, 200]))
    kind = rng.randrange(5)
    if kind == 0:
        return data[:a]
    if kind == 1:
        return data[:a] + data[b:]
    if kind == 2:
        return data[:b] + data[a:]
    if kind == 3:
        return data[:a] + bytes(rng.choices(b"0123456789.-e[]{}<>\"'=,: \n\x00\xff", k=b - a)) + data[b:]
    return data[:a] + rng.choice([b"nan", b"9" * 400, b"-", b"null", b"true", b"[", b'"', b"1e999"]) + data[b:]


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_calibration_is_read_or_refused_in_one_line(
    name: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / "videos").mkdir()
    for camera in NAMES:
        (folder / "videos" / f"{camera}.mp4").write_bytes(b"")
    FORMATS[name](folder)
    files = sorted(path for path in folder.iterdir() if path.is_file())
    intact = {path: path.read_bytes() for path in files}
    rng = random.Random(3)
    refused = 0
    capfd.readouterr()
    for _ in range(DAMAGES):
        path = rng.choice(files)
        path.write_bytes(damaged(intact[path], rng))
        try:
            project = read_project(folder)
            infer_up(project.rig)
            if len(project.rig) < len(NAMES):  # a damaged matrix is no matrix; missing cameras are noted
                assert any("left out" in note for note in project.notes)
                refused += 1
        except CaptureError as reason:
            refused += 1
            assert "\n" not in str(reason) and str(folder) in str(reason)
        path.write_bytes(intact[path])
    assert refused > 0
    assert capfd.readouterr() == ("", "")
