"""Killed runs and resumed results."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.io.result_files import append, assert_complete, assert_equal_values, resume, revise_result, write
from tests.io.result_victim import META, make_frame, make_run, make_state
from tk.errors import ResultError
from tk.io.results.layout import pack_state
from tk.io.results.reader import read_result
from tk.io.results.writer import ResultWriter

ROOT = Path(__file__).parents[3]


# --- kill -9 ----------------------------------------------------------------------------------------------------------


def kill_at_random(path: Path, frames: int, delay_s: float) -> int:
    """Run the victim, kill it some time after its first frame; returns the frames that it had reported."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.io.result_victim", str(path), str(frames)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    ) as victim:
        assert victim.stdout is not None
        reported = [victim.stdout.readline()]
        try:
            victim.wait(delay_s)
        except subprocess.TimeoutExpired:
            os.kill(victim.pid, signal.SIGKILL)
        reported += victim.stdout.read().splitlines()
    assert victim.returncode in (0, -signal.SIGKILL)
    return int([line for line in reported if line.strip()][-1])


def survive_kills(path: Path, kills: int, seed: int) -> None:
    generator = random.Random(seed)
    done = 0
    for _ in range(kills):
        reported = kill_at_random(path, done + 2000, generator.uniform(0.0, 0.05))
        assert reported > done  # the next run took up where the last one stopped
        done = assert_complete(path, reported)
        assert done <= reported + 1
        if done > 600:
            path.unlink()
            done = 0


@pytest.mark.usefixtures("system")
def test_killed_run_keeps_every_finished_frame_and_can_be_resumed(tmp_path: Path) -> None:
    survive_kills(tmp_path / "result.h5", kills=2, seed=1)


@pytest.mark.slow
def test_120_kills_lose_no_finished_frame(tmp_path: Path) -> None:
    survive_kills(tmp_path / "result.h5", kills=120, seed=2)


# --- resuming ---------------------------------------------------------------------------------------------------------


def test_resumed_run_knows_state_and_body_and_equals_an_uninterrupted_one(path: Path) -> None:
    model = {"height_m": 1.7, "torso/radii_m": np.arange(3.0), "names": '["torso"]'}
    with ResultWriter.create(path, META) as writer:
        writer.write_model(model)
        append(writer, *range(7))
    created = read_result(path).created
    writer, done = ResultWriter.resume(path, META)
    with writer:
        assert done == 7
        assert_equal_values(writer.state, make_state(6))
        assert_equal_values(writer.model, model)
        append(writer, *range(done, 12))
    assert assert_complete(path, 12) == 12
    assert read_result(path).created == created
    assert_equal_values(read_result(path).model, model)


def test_resume_without_a_file_starts_one(tmp_path: Path) -> None:
    writer, done = ResultWriter.resume(tmp_path / "result.h5", META)
    with writer:
        assert done == 0
        assert writer.state == {}


def test_frames_after_the_last_state_are_written_again(path: Path) -> None:
    with ResultWriter.create(path, META) as writer:
        append(writer, *range(6))
        append(writer, *range(6, 9), state=False)
    writer, done = ResultWriter.resume(path, META)
    with writer:
        assert done == 6
        assert_equal_values(writer.state, make_state(5))
        append(writer, *range(6, 10))
    assert assert_complete(path, 10) == 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"capture": "dance"}, "capture: walk, not dance"),
        ({"method": "silhouette"}, "method: volumetric, not silhouette"),
        ({"seed": 8}, "seed: 7, not 8"),
        ({"seed": 0}, "seed: 7, not 0"),
        ({"fps": 30.0}, "fps: 15.0, not 30.0"),
        ({"pose_names": ("x",), "pose_units": ("m",)}, "the pose has 24 entries, not 1"),
        ({"stages": ("all",)}, "stages: all, chains, not all"),
        ({"residual_cameras": ()}, "residual_cameras: cam1, .*, not none"),
        ({"sigma": False}, "sigma: True, not False"),
        ({"objective_kind": ""}, "objective_kind: negative log-likelihood, not none"),
        ({"angles": ()}, r"angles: knee_l \(flexion: .*, not none"),
        (
            {"angles": (replace(META.angles[0], convention="other"), META.angles[1])},
            "straight.*, not .*other",
        ),
        ({"config_toml": META.config_toml.replace("0.1", "0.2")}, r"config\.smd\.mu: 0\.1, not 0\.2"),
        ({"config_toml": META.config_toml + "[hull]\nvoxels = 64\n"}, r"config\.hull\.voxels: not set, not 64"),
    ],
)
def test_resuming_another_run_is_refused(path: Path, tmp_path: Path, change: dict[str, Any], message: str) -> None:
    write(path, 2)
    before = path.read_bytes()
    with pytest.raises(ResultError, match=rf"result\.h5: .*{message}.*cannot be resumed"):
        ResultWriter.resume(path, replace(META, **change))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]


def test_equal_settings_in_different_notation_can_be_resumed(path: Path) -> None:
    write(path, 1, replace(META, config_toml='# a comment\nmethod = "volumetric"\nsmd = { mu = 0.10 }\n'))
    assert resume(path, 1) == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda state: np.where(np.arange(len(state)) == len(state) // 2, state ^ 1, state),
        lambda state: state[:-1],
        lambda state: np.append(state, np.uint8(0)),
        lambda state: state[:0],
        lambda state: np.zeros(4, np.uint8),
        lambda state: pack_state(4, 2, {}),
    ],
)
def test_damaged_state_is_refused(path: Path, change: Callable[[np.ndarray], Any]) -> None:
    write(path, 4)
    with h5py.File(path, "r+") as file:
        state = file["resume"][()]
        del file["resume"]
        file["resume"] = change(state)
    before = path.read_bytes()
    with pytest.raises(ResultError, match=r"result\.h5: .*damaged"):
        ResultWriter.resume(path, META)
    assert path.read_bytes() == before


@pytest.mark.parametrize(("dataset", "value", "message"), [("pose", np.nan, "NaN"), ("frames", -5, "out of range")])
def test_damaged_frames_are_refused_before_the_run_goes_on(
    path: Path, dataset: str, value: float, message: str
) -> None:
    write(path, 6)
    with h5py.File(path, "r+") as file:
        file[dataset][2] = value
    with pytest.raises(ResultError, match=f"/{dataset}.*{message}"):
        resume(path, 9)


def test_state_is_intact_after_the_result_was_copied_and_revised(path: Path) -> None:
    state = {**make_state(3), "unknown": np.array([np.nan, -np.nan]), "none": "", "umlaut": "ä", "flag": True}
    with ResultWriter.create(path, META) as writer:
        writer.append(make_run(0), {0: make_frame(0)}, state)
    revise_result(path, notes=["a note"])
    writer, done = ResultWriter.resume(path, META)
    writer.close()
    assert done == 1
    assert_equal_values(writer.state, state)
