"""A world that nobody has laid along the floor, like the frame of a camera: `up` is a direction, not an axis."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation

from tests.conftest import QUICK, Silent
from tests.test_silhouette_track import QUICK as QUICK_SILHOUETTE
from tk.config import Config
from tk.io.capture import open_capture
from tk.io.result import read_joints, read_result
from tk.session import track

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
        tables[camera.name] = {
            "size": [camera.width, camera.height],
            "matrix": camera.matrix.tolist(),
            "distortions": camera.distortions.tolist(),
            "rotation": cv2.Rodrigues(turned.rotation)[0].ravel().tolist(),
            "translation": camera.translation.tolist(),
        }
    (folder / "calibration.toml").write_text(tomli_w.dumps(tables))
    side = 1.15 * max(original.volume.size)
    settings = {
        "up": (3 * TURN[:, 2]).tolist(),
        "volume": {"center": (TURN @ original.volume.center).tolist(), "size": [side] * 3},
    }
    (folder / "capture.toml").write_text(tomli_w.dumps(settings))
    return folder


@pytest.mark.parametrize(
    ("method", "quick"), [("volumetric", QUICK), ("silhouette", QUICK_SILHOUETTE)], ids=["volumetric", "silhouette"]
)
def test_the_person_is_tracked(tiny: Path, tilted: Path, tmp_path: Path, method: str, quick: str) -> None:
    path = tmp_path / "r.h5"
    track(open_capture(tilted), path, Config.from_toml(quick), Silent(), method, (0, 6))
    with h5py.File(path) as file:
        up = file.attrs["up"]
    np.testing.assert_allclose(open_capture(tilted).up_axis, TURN[:, 2], atol=1e-12)
    assert up == open_capture(tilted).up  # the very text
    truth = read_joints(tiny / "truth.h5").positions[:6] @ TURN.T
    found = read_result(path).joints
    assert np.linalg.norm(found - truth, axis=-1).mean() < 0.10
