"""`tk view` on a display in memory, and without a display."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from tests.conftest import Tk
from tk.io.results.reader import read_result
from tk.render.figure import figure_of
from tk.view import shapes

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def display(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Start an X server that draws into memory."""
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb (Debian: xvfb)")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1400x1000x24", "-nolisten", "tcp"],
        pass_fds=(write,),
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()
    yield f":{number}"
    server.terminate()
    server.wait()


def run(display: str | None, *arguments: object) -> subprocess.CompletedProcess[str]:
    env = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    env |= {
        "VK_ICD_FILENAMES": os.devnull,
        "VK_DRIVER_FILES": os.devnull,
    }  # without a graphics card, every machine draws the same
    return subprocess.run(
        [sys.executable, "-c", "from tk.cli import main; main(prog_name='tk')", "view", *map(str, arguments)],
        cwd=ROOT,
        env=env | ({"DISPLAY": display} if display else {}),
        capture_output=True,
        text=True,
        timeout=240,
    )


def test_screenshot_shows_body_and_floor(display: str, tracked: Path, tiny: Path, tmp_path: Path) -> None:
    picture = tmp_path / "shot.png"
    ran = run(display, tracked, tiny, "--frame", 5, "--screenshot", picture)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == "", "messages belong on stderr"
    assert "frame 5" in ran.stderr
    image = cv2.imread(str(picture))
    assert image is not None and image.shape[0] > 600 and image.shape[1] > 1000
    middle = image[image.shape[0] // 6 : -image.shape[0] // 6, image.shape[1] // 3 : -image.shape[1] // 3].astype(int)
    colorful = middle.max(axis=2) - middle.min(axis=2) > 40
    assert 0.005 < colorful.mean() < 0.6, "left limbs warm, right limbs cool, trunk green"
    assert (np.ptp(image[-1, :, :].astype(int), axis=0) > 0).any(), "the floor reaches to the lower edge"


@pytest.mark.skipif(sys.platform != "linux", reason="displays of X are Linux's")
def test_missing_display_is_reported_with_the_alternative(
    tk: Tk, tracked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    tk("view", tracked).complaint("DISPLAY is not set", "tk report RESULT.h5")
    monkeypatch.setenv("DISPLAY", ":4711")
    tk("view", tracked).complaint("the display :4711 cannot be opened", "tk report RESULT.h5")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frame", "99"], "--frame 99: the result has frames 0 to 13"),
        (["--screenshot", "a.jpg"], "an image must end in .png"),
        (["--screenshot", "nowhere/a.png"], "the folder nowhere does not exist"),
    ],
)
def test_bad_options(tk: Tk, tracked: Path, options: list[str], message: str) -> None:
    tk("view", tracked, *options).complaint(message)


def test_shapes_match_the_result(tracked: Path) -> None:
    result = read_result(tracked)
    figure = figure_of(result)
    body = shapes.body_mesh(figure, 3)
    np.testing.assert_allclose(np.asarray(body.vertices), figure.placed(3))
    _, counts, _ = body.cluster_connected_triangles()
    assert len(counts) == len(figure.solids), "each solid is one connected mesh"
    assert body.is_orientable() and body.has_vertex_colors()
    assert len(shapes.skeleton_lines(figure.joints[3]).lines) == 14
    joints = figure.joints[3].copy()
    joints[2] = np.nan  # the crown
    assert len(shapes.skeleton_lines(joints).lines) == 13
    one = len(shapes.joint_spheres(joints[:1], None).vertices)
    assert len(shapes.joint_spheres(joints, None).vertices) == 14 * one
    assert result.hull is not None
    cloud = shapes.hull_cloud(result.hull[3])
    with h5py.File(tracked, "r") as file:
        first, last = file["hull/offsets"][3:5]
        np.testing.assert_allclose(np.asarray(cloud.points), file["hull/positions"][first:last])
