"""A small tree in the MoBo database's layout, made of the tiny capture."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts.paper.mobo import camera_from_tsai, rotation_zyx, write_capture
from tests.conftest import refused
from tk.errors import CalibrationError, CaptureError
from tk.io.captures.capture import open_capture
from tk.model.cameras.camera import Camera

NAMES = ("vr03_7", "vr05_7", "vr07_7", "vr13_7")
FRAMES = 6
PIXEL_MM = 0.01  # of the sensor


def tsai_of(camera: Camera) -> list[float]:
    """The numbers of an undistorted camera."""
    K, R = camera.matrix, camera.rotation
    ry = np.arcsin(-R[2, 0])
    rx, rz = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    f = K[1, 1] * PIXEL_MM
    head = [camera.width, camera.width, PIXEL_MM, PIXEL_MM, PIXEL_MM, PIXEL_MM, K[0, 2], K[1, 2], K[0, 0] / K[1, 1]]
    return [*head, f, 0.0, *(1000 * camera.translation), rx, ry, rz]


@pytest.fixture(scope="module")
def walk(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("mobo")
    source = open_capture(tiny)
    pictures, masks = (root / tree / "04002" / "slowWalk" for tree in ("moboJpg", "moboBgSub"))
    (root / "calibration").mkdir()
    for name, camera in zip(NAMES, source.rig, strict=True):
        (pictures / name).mkdir(parents=True)
        (masks / name).mkdir(parents=True)
        numbers = tsai_of(camera)
        (root / "calibration" / f"{name}.cal").write_text("\n".join(map(str, numbers)) + "\n", encoding="utf-8")
    with source.frames(0, FRAMES) as frames:
        for frame in frames:
            assert frame.masks is not None
            for name, image, mask in zip(NAMES, frame.images, frame.masks, strict=True):
                cv2.imwrite(str(pictures / name / f"{name}_{frame.index:05d}.jpg"), image)
                cv2.imwrite(str(masks / name / f"{name}_{frame.index:05d}.bmp"), mask)
    return pictures


def test_a_walk_becomes_a_capture(tiny: Path, walk: Path, tmp_path: Path) -> None:
    write_capture(walk, tmp_path / "capture")
    source, found = open_capture(tiny), open_capture(tmp_path / "capture")
    assert found.rig.names == NAMES and found.frame_count == FRAMES
    assert (found.fps, found.init_pose, found.has_masks) == (30.0, "any", True)
    p = np.random.default_rng(0).uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 1.8], (50, 3))
    for a, b in zip(source.rig, found.rig, strict=True):
        flat = Camera(a.name, a.width, a.height, a.matrix, np.zeros(5), a.rotation, a.translation)
        np.testing.assert_allclose(b.project(p)[0], flat.project(p)[0], atol=1e-6)
    with source.frames(0, 1) as first, found.frames(0, 1) as second:
        np.testing.assert_array_equal(next(first).masks, next(second).masks)


def test_tsais_lens_distortion_is_inverted() -> None:
    f, kappa = 6.0, 2e-3
    tsai = dict.fromkeys(["dx", "dy", "dpx", "dpy"], 0.01) | {"Ncx": 640, "Nfx": 640, "Cx": 320, "Cy": 240, "sx": 1.0}
    tsai |= {"f": f, "kappa1": kappa, "Tx": 100.0, "Ty": -50.0, "Tz": 3000.0, "Rx": 0.1, "Ry": -0.2, "Rz": 0.3}
    camera = camera_from_tsai("vr03_7", tsai, (640, 480), Path("vr03_7.cal"))
    for p in np.random.default_rng(1).uniform([-0.8, -0.6, -0.5], [0.8, 0.6, 0.5], (20, 3)):
        x, y, z = rotation_zyx(0.1, -0.2, 0.3) @ p + [0.1, -0.05, 3.0]
        pixel = camera.project(p[None])[0][0]
        d = (pixel - [320, 240]) * 0.01  # on the sensor, millimetres
        np.testing.assert_allclose(d * (1 + kappa * d @ d), [f * x / z, f * y / z], atol=2e-4)


def test_bad_camera_files_are_refused_in_one_line(walk: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(walk.parents[2], tmp_path / "mobo"))
    sequence, capture = copy / "moboJpg" / "04002" / "slowWalk", tmp_path / "capture"
    file = copy / "calibration" / "vr05_7.cal"
    for text, reason in (("1 2 3", "holds 3 numbers"), ("one", "cannot be read as numbers")):
        file.write_text(text, encoding="utf-8")
        with refused(CalibrationError, "vr05_7.cal", reason):
            write_capture(sequence, capture)
    shutil.rmtree(copy / "calibration")
    with refused(CalibrationError, "slowWalk", "camera file"):
        write_capture(sequence, capture)
    with refused(CaptureError, "no MoBo walk"):
        write_capture(tmp_path, capture)
    assert not capture.exists()
