"""The commands: output, exit codes, and messages about bad input."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.conftest import FRAMES, QUICK, Tk, without_first_pose
from tests.io.conftest import write_picture
from tk import __version__
from tk.io import settings_file
from tk.io.results.reader import read_result
from tk.model.body.skeleton import JOINTS

SIZE = (160, 120)


# --- the main job -----------------------------------------------------------------------------------------------------


def test_track_writes_a_complete_result(tk: Tk, unposed: Path, tmp_path: Path) -> None:
    """The person is searched for. Options override the settings file; stages are printed before the first frame."""
    folder = tmp_path / "results"
    folder.mkdir()
    result, settings = folder / "result.h5", tmp_path / "settings.toml"
    settings.write_text(f"seed = 3\n{QUICK}prediction = 0\n".replace("32", "40"), encoding="utf-8")
    ran = tk("track", unposed, "-o", result, "--config", settings, "--frames", "2:6", "--seed", "5", "--voxels", "32")
    assert ran.code == 0, ran.err
    assert ran.out == ""  # progress is no result
    lines = ran.err.splitlines()
    stages = [re.sub(r"^\[ *[\d.]+ s\] ", "", line) for line in lines]
    assert stages[:2] == ["loading", f"opening {unposed}"]
    begun = next(i for i, line in enumerate(lines) if line.startswith("frame 2: "))
    assert any("finding the person in frame 0" in line for line in stages[:begun])
    assert all(line.isprintable() for line in lines)  # plain lines, no bar, because stderr is not a terminal
    done = next(i for i, line in enumerate(lines) if line.startswith("frame 5: 4/4, "))
    assert "second pass" in lines[done + 1] and ran.messages == lines[-1:]
    assert lines[-1].startswith(f"4 frames in {result}, 0 lost, ")
    assert {path.name for path in folder.iterdir()} == {"result.h5"}  # --no-report
    found = read_result(result)
    assert (found.meta.capture, found.meta.method, found.meta.seed, found.meta.fps) == ("demo", "region", 5, 15.0)
    assert found.pose.shape == (4, 32) and found.meta.joint_names == JOINTS and len(found.meta.residual_cameras) == 4
    np.testing.assert_array_equal(found.frames, np.arange(2, 6))
    np.testing.assert_allclose(found.time, np.arange(2, 6) / 15.0)
    for name in ("pose", "joints", "sigma", "residual", "objective"):
        assert np.isfinite(getattr(found, name)).all(), name
    assert set(found.status) == {0}  # the initial frame was left out
    parts = sum(seconds for stage, seconds in found.timing.items() if stage not in ("decode", "masks", "total"))
    assert (found.timing["total"] >= parts - 1e-9).all()  # writing is in it, too
    dimensions = [float(value) for name, value in found.model.items() if name.startswith("dimensions/")]
    assert dimensions and all(abs(value) < 2.5 for value in dimensions)
    assert found.model["parts/shape"].shape[1] == 4 and found.hull is None
    config = settings_file.from_toml(found.meta.config_toml)
    assert (config.voxels, config.seed, config.silhouette.prediction) == (32, 5, 0.0) and __version__ in found.software


def test_track_without_output_takes_the_name_of_the_folder(
    tk: Tk, quick: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder that `.` or a link stands for; the first line has the path."""
    command = ["track", ".", "--config", quick, "--frames", ":1", "--causal"]
    link = copy.parent / "link"
    link.symlink_to(copy)
    monkeypatch.chdir(copy)
    ran = tk(*command)
    expected = copy / f"{copy.name}.h5"
    assert ran.code == 0 and ran.err.splitlines()[0] == f"note: the result is {expected}" and expected.is_file()
    ran = tk("track", link, *command[2:])
    ran.complaint(expected.name, "exists", "--force")


def test_masks_from_a_folder_and_chosen_cameras_are_used(
    tk: Tk, quick: Path, copy: Path, causal: Path, tmp_path: Path
) -> None:
    shutil.move(copy / "masks", tmp_path / "mine")
    shutil.rmtree(copy / "background")  # masks could not be made from the videos
    command = ["track", copy, "--config", quick, "--frames", ":3", "--causal", "--masks", tmp_path / "mine"]
    assert tk(*command, "-o", tmp_path / "r.h5", "--cameras", "cam1, cam2,cam4").code == 0
    with h5py.File(causal, "r") as a, h5py.File(tmp_path / "r.h5", "r") as b:
        assert np.abs(a["joints/position"][:3] - b["joints/position"][()]).max() > 1e-6
        assert (b["status"][()] < 3).all()


def test_version(tk: Tk) -> None:
    assert tk("--version").out.strip().endswith(__version__)


def test_demo_tracks_and_prints_the_accuracy(
    tk: Tk, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the last frames of a small capture instead of the one that ships, which has a slow test."""
    package, frames = tmp_path / "package", 4
    changes = ("frame = 0", f"frame = {FRAMES - frames}"), ("da-vinci", "any")
    without_first_pose(Path(shutil.copytree(tiny, package / "data" / "demo")), *changes)
    monkeypatch.setattr("importlib.resources.files", lambda name: package)
    monkeypatch.setattr("tk.commands.base.load_settings", lambda file, voxels: settings_file.from_toml(QUICK))
    ran = tk("demo", "-o", tmp_path / "demo.h5")
    assert ran.code == 0, ran.err
    assert f"{frames} frames judged: 0 lost" in ran.out
    assert ran.out.splitlines()[-1].startswith(f"The result is in {tmp_path / 'demo.h5'}")
    tk("demo", "-o", tmp_path / "demo.h5").complaint("demo.h5", "exists", "--force")


# --- bad usage --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["track"], ["CAPTURE", "tk track --help"]),
        (["batch", "x"], ["--output", "tk batch --help"]),
        (["track", "x", "-o", "r.h5", "--voxels", "many"], ["--voxels", "many"]),
        (["track", "x", "-o", "r.h5", "--frame", "3"], ["--frame"]),
        (["trak"], ["trak", "tk --help"]),
        (["--verbose"], ["--verbose", "tk --help"]),
        (["evaluate", "r.h5"], ["TRUTH"]),
        (["view", 300 * "x"], ["xxx", "name too long"]),
    ],
)
def test_bad_usage_is_one_line(tk: Tk, arguments: list[str], parts: list[str]) -> None:
    tk(*arguments).complaint(*parts)


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (["--frames", "5"], ["--frames 5", "A:B"]),
        (["--frames", "8:3"], ["--frames 8:3"]),
        (["--frames", "a:b"], ["--frames a:b"]),
        (["--frames", "-3:2"], ["--frames -3:2"]),
        (["--frames", "50:"], ["frames 50:", "0 to 13"]),
        (["--frames", "14:20"], ["frames 14:20", "0 to 13"]),
        (["--voxels", "4"], ["voxels = 4", "8 to 512"]),
        (["--seed", "-1"], ["seed = -1"]),
        (["--cameras", "cam1,left"], ["no camera", "'left'", "cam1, cam2, cam3, cam4"]),
        (["--cameras", "cam1"], ["cameras cam1", "at least 2"]),
        (["--cameras", ","], ["--cameras ','", "give names"]),
        (["--masks", "nowhere"], ["masks nowhere"]),
        (["--method", "magic"], ["--method", "magic", "volumetric"]),
        (["--config", "none.toml"], ["none.toml"]),
        (["--init-pose", "none.toml"], ["none.toml"]),
    ],
)
def test_bad_options_are_one_line(
    tk: Tk, quick: Path, tiny: Path, tmp_path: Path, options: list[str], parts: list[str]
) -> None:
    tk("track", tiny, "-o", tmp_path / "r.h5", "--config", quick, *options).complaint(*parts)
    assert list(tmp_path.iterdir()) == []


# --- bad captures -----------------------------------------------------------------------------------------------------


def _truncate(folder: Path) -> None:
    path = folder / "videos" / "cam2.mp4"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _nobody(folder: Path) -> None:
    _empty_masks(without_first_pose(folder))


def _empty_masks(folder: Path) -> None:
    for path in (folder / "masks").rglob("*.png"):
        write_picture(path, np.zeros(SIZE[::-1], np.uint8))


# one case of each file; the tests of the readers have the others
SPOILT: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "calibration is no TOML": (
        lambda folder: (folder / "calibration.toml").write_text("[cam1\n"), ["calibration.toml", "TOML"],
    ),
    "a volume out of sight": (
        lambda folder: (folder / "capture.toml").write_text("[volume]\ncenter = [0, 0, 90]\nsize = [1, 1, 1]\n"),
        ["capture.toml", "no two cameras"],
    ),
    "a truncated video": (_truncate, ["cam2.mp4", "cut off"]),
    "a text for a mask": (
        lambda folder: (folder / "masks/cam2/000000.png").write_text("white"), ["masks/cam2/000000.png"],
    ),
    "nobody there": (_nobody, ["capture", "nobody could be tracked: the working volume is empty", "unit"]),
    "nobody in the given pose": (_empty_masks, ["capture", "no mask of frame 0 shows anybody"]),
}  # fmt: skip


@pytest.mark.parametrize(
    ("method", "spoil"),
    [*(("region", name) for name in SPOILT), ("volumetric", "nobody there"), ("silhouette", "nobody there")],
)
def test_error_of_a_bad_capture_is_one_line_with_the_file(
    tk: Tk, quick: Path, copy: Path, tmp_path: Path, method: str, spoil: str
) -> None:
    change, parts = SPOILT[spoil]
    change(copy)
    ran = tk("track", copy, "-o", tmp_path / "r.h5", "--method", method, "--config", quick)
    ran.complaint(str(copy), *parts)
    assert list(tmp_path.iterdir()) == [copy]


@pytest.mark.parametrize("broken", [2, 6])
def test_finished_frames_are_kept_when_a_file_is_damaged(
    tk: Tk, quick: Path, copy: Path, tmp_path: Path, broken: int
) -> None:
    """Also at frame 2, one of the frames that the body is fitted to."""
    mask = copy / "masks" / "cam2" / f"{broken:06d}.png"
    good = mask.read_bytes()
    mask.write_bytes(good[: len(good) // 3])
    result = tmp_path / "r.h5"
    command = ["track", copy, "-o", result, "--config", quick, "--frames", ":7", "--causal"]
    tk(*command).complaint(str(mask))
    with h5py.File(result, "r") as file:
        np.testing.assert_array_equal(file["frames"], np.arange(broken))
    if broken > 4:
        mask.write_bytes(good)
        assert tk(*command, "--resume").code == 0
        with h5py.File(result, "r") as file:
            assert len(file["frames"]) == 7


# --- damaged results --------------------------------------------------------------------------------------------------


def spoil(path: Path, name: str, value: Any) -> None:
    """Replace a dataset or group of a result; None deletes it."""
    with h5py.File(path, "r+") as file:
        del file[name]
        if value is not None:
            file[name] = value


@pytest.mark.parametrize(
    ("method", "own"),
    [
        ("volumetric", [("resume", np.zeros(9, np.uint8)), ("resume", "text"), ("model/parts", None)]),
        ("region", [("resume", np.zeros(9, np.uint8)), ("model/parts", None)]),
    ],
)
def test_resume_refuses_a_damaged_state(
    tk: Tk, quick: Path, tiny: Path, first_frame: dict[str, Path], tmp_path: Path, method: str,
    own: list[tuple[str, Any]],
) -> None:  # fmt: skip
    result = tmp_path / "r.h5"
    command = ["track", tiny, "-o", result, "--config", quick, "--method", method, "--causal"]
    good = first_frame[method].read_bytes()
    for name, value in [*own, ("people/0/pose", np.zeros((2, 3))), ("pose", np.zeros((2, 3)))]:
        result.write_bytes(good)
        spoil(result, name, value)
        tk(*command, "--frames", ":2", "--resume").complaint("r.h5")


def test_evaluate_names_files_that_cannot_be_read(tk: Tk, tracked: Path, tiny: Path, tmp_path: Path) -> None:
    tk("evaluate", tmp_path / "r.h5", tiny / "truth.h5").complaint("r.h5", "no such file")
    tk("evaluate", tracked, tiny / "calibration.toml").complaint("calibration.toml", "not an HDF5 file")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["data"] = 1
    tk("evaluate", tracked, tmp_path / "other.h5").complaint("other.h5", "/frames")
