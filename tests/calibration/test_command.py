"""`tk calibrate` on rendered pictures and a video, and what the old commands answer."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts.synthetic.boards import Recipe, make_rig, render_boards
from tests.calibration.rigs import BOARD
from tests.conftest import Tk
from tk.calibration.footage import read_footage
from tk.io.captures.calibration import read_calibration
from tk.io.toml import load_toml

RECIPE = Recipe(((30, 2.6, 1.4, "phone"), (80, 2.6, 1.9, "webcam")), size=(480, 360), shared=7, close=4, seed=8)


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras' pictures of a board, PNG and JPEG."""
    folder = tmp_path_factory.mktemp("boards")
    render_boards(folder, RECIPE, BOARD, room=False)
    for file in (folder / "cam2").iterdir():
        cv2.imwrite(str(file.with_suffix(".JPG")), cv2.imread(str(file)), [cv2.IMWRITE_JPEG_QUALITY, 95])
        file.unlink()
    return folder


def test_pictures_become_a_calibration_and_a_page(tk: Tk, boards: Path, tmp_path: Path) -> None:
    output = tmp_path / "calibration.toml"
    ran = tk("calibrate", boards, "--square", "0.11", "-o", output, "--model", "pinhole5")
    assert ran.code == 0, ran.err
    assert "cam1" in ran.out and "at the person" in ran.out and "Check the scale with a tape" in ran.out
    assert len(read_calibration(output).rig) == 2
    metadata = load_toml(output)["metadata"]
    assert metadata["units"] == "m" and metadata["verdict"] in ("good", "usable")
    page = output.with_suffix(".html").read_text(encoding="utf-8")
    text = re.sub(r"base64,[^\"']*", "", page).replace("instan", "")
    assert page.count("<svg") >= 6 and "nan" not in text.lower()
    tk("calibrate", boards, "--square", "0.11", "-o", output).complaint("calibration.toml", "exists", "--force")


def test_videos_of_the_board_are_read_like_pictures(tk: Tk, boards: Path, tmp_path: Path) -> None:
    """The board is held for two frames at each place: the frame in which it leaves is not used."""
    folder, output = tmp_path / "videos", tmp_path / "calibration.toml"
    folder.mkdir()
    pictures = {own.name: {int(file.stem): file for file in own.iterdir()} for own in boards.iterdir()}
    instants = sorted(set().union(*pictures.values()))
    for name, files in pictures.items():
        writer = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, RECIPE.size)
        for instant in instants:
            image = cv2.imread(str(files[instant])) if instant in files else np.full((360, 480, 3), 80, np.uint8)
            for _ in range(2):
                writer.write(image)
        writer.release()
    ran = tk("calibrate", folder, "--square", "0.11", "-o", output, "--model", "pinhole5", "--json")
    assert ran.code == 0, ran.err
    cameras = {one["name"]: one for one in json.loads(ran.out)["cameras"]}
    for camera in make_rig(RECIPE):
        assert abs(cameras[camera.name]["focal_px"] / camera.matrix[0, 0] - 1) < 0.02
        assert 6 <= cameras[camera.name]["views"] <= len(instants)
    footages, _ = read_footage(folder, BOARD, ["cam1"], lambda _: None)
    moving = [instant for instant, seen in footages[0].seen.items() if seen.motion_px > 8]
    assert len(moving) >= 5 and all(instant % 2 for instant in moving)
    # a capture that refers to the videos: cam1 has begun ten frames before cam2
    (tmp_path / "cap").mkdir()
    tables = "\n".join(
        f'[videos.cam{k}]\npath = "../videos/cam{k}.avi"\noffset = {offset}' for k, offset in ((1, 4.0), (2, 4 + 1 / 3))
    )
    (tmp_path / "cap" / "capture.toml").write_text(tables)
    notes: list[str] = []
    (first, second), _ = read_footage(tmp_path / "cap", BOARD, None, lambda _: None, notes.append)
    assert any("from 4.333 s to" in line for line in notes)
    assert [instant + 10 for instant in first.seen] == [instant for instant in footages[0].seen if instant >= 10]
    assert len(second.instants) == len(first.instants) == len(footages[0].instants) - 10


def test_bad_recordings_are_refused_in_one_line(tk: Tk, boards: Path, tmp_path: Path) -> None:
    output, copy = tmp_path / "c.toml", tmp_path / "copy"
    tk("calibrate", boards, "-o", output).complaint("--square")
    tk("calibrate", boards, "-o", output, "--square", "110").complaint("a square of 110 m", "--square 0.11")
    tk("calibrate", tmp_path / "none", "--square", "0.11").complaint("none", "is not a folder")
    shutil.copytree(boards, copy)
    for file in (copy / "cam2").iterdir():
        cv2.imwrite(str(file), np.full((360, 480), 70, np.uint8))
    tk("calibrate", copy, "--square", "0.11", "-o", output).complaint("camera cam2: no board", "one colour")
    cv2.imwrite(str(copy / "cam1" / "0003.png"), np.zeros((100, 100), np.uint8))
    tk("calibrate", copy, "--square", "0.11", "-o", output).complaint("cam1/0003.png", "100×100")
    (copy / "cam1" / "first.png").write_bytes((copy / "cam1" / "0001.png").read_bytes())
    tk("calibrate", copy, "--square", "0.11", "-o", output).complaint("first.png", "no number")
    assert not output.exists()


def test_options_of_another_way_are_refused(tk: Tk, tmp_path: Path) -> None:
    tk("calibrate", "x", "--level", "--square", "0.1").complaint("--square: has no meaning with --level", "a board")
    tk("calibrate", "x", "--refine", "r.h5", "--level").complaint("--refine and --level: give one")
    tk("calibrate", "x", "--refine", "r.h5").complaint("give -o")
    tk("calibrate", "x", "--square", "0.1", "--focal").complaint("--focal", "only with --refine")
    tk("calibrate").complaint("give the folder BOARDS")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (("refine", "CAPTURE", "r.h5", "-o", "x.toml", "--trust", "4"), "tk calibrate CAPTURE --refine RESULT.h5"),
        (("level", "CAPTURE", "--help"), "tk calibrate CAPTURE --level"),
    ],
)
def test_old_commands_answer_with_the_new_one(tk: Tk, old: tuple[str, ...], new: str) -> None:
    tk(*old).complaint(f"tk {old[0]} is now: {new}")


def test_old_script_answers_with_the_new_command() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "scripts.calibrate_cameras", "boards"], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 2 and "tk calibrate BOARDS" in ran.stderr and ran.stderr.count("\n") == 1


@pytest.mark.slow
def test_faults_are_refused_or_named(tmp_path: Path) -> None:
    """All faults of the table in docs/calibrate.md."""
    from scripts import board_faults

    clean = tmp_path / "clean"
    render_boards(clean, board_faults.RECIPE, BOARD, room=False)
    for fault in board_faults.FAULTS:
        folder = tmp_path / "boards"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(clean, folder)
        fault.spoil(folder)
        code, text = board_faults.answer(folder, tmp_path / "c.toml", [*fault.options, "--force"])
        assert all(part in text for part in fault.parts), (fault.name, code, text)


@pytest.mark.slow
def test_rendered_rig_is_calibrated_to_millimetres(tmp_path: Path) -> None:
    from scripts import board_rigs

    recipe = replace(board_rigs.DEVELOPMENT["dev4"], shared=20)
    errors, verdict, _ = board_rigs.run(recipe, BOARD, tmp_path / "dev4")
    assert errors.place_mm < 3 and errors.turn_deg < 0.05 and errors.focal_percent < 0.3 and verdict.level == 0
