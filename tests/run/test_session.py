"""The loop: same seed, same file; runs that are stopped, prolonged or taken up again; where a run starts.

By the volumetric tracker; tests/trackers/test_region_track.py has what is the default's own, and kills a run.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tomli_w

from tests import conftest
from tests.conftest import EVERY_FRAME, FRAMES, QUICK, Silent, StopAt, Tk, run_clock, without_first_pose
from tests.io.conftest import write_picture
from tk.errors import ConfigError, ResultError
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.model.body.skeleton import JOINTS
from tk.run.plan import choose_frames
from tk.run.session import Summary
from tk.trackers.registry import tracker_class

ROOT = Path(__file__).parents[2]
CONFIG = settings_file.from_toml(QUICK)
track = partial(conftest.track, method="volumetric")

# `tk` that sends itself a signal once a frame is finished
VICTIM = """
import os, signal, sys, time
from tk.commands import console
from tk import cli

clock, speed = time.perf_counter, float(os.environ["TEST_CLOCK"])
time.perf_counter = lambda: speed * clock()
tell = console.ConsoleReporter.advance

def advance(self, frame, estimate):
    tell(self, frame, estimate)
    if frame == int(os.environ["TEST_FRAME"]):
        os.kill(os.getpid(), int(os.environ["TEST_SIGNAL"]))

console.ConsoleReporter.advance = advance
cli.main(prog_name="tk")
"""


def run(capture: Path, output: Path, **options: Any) -> Summary:
    return track(open_capture(capture), output, options.pop("config", CONFIG), **options)


def assert_same(path: Path, expected: Path, frames: slice = slice(None)) -> None:
    """Bit for bit, times apart."""
    with h5py.File(path, "r") as a, h5py.File(expected, "r") as b:
        for name in ("frames", "time", "pose", "joints/position", "status", "objective", "iterations"):
            np.testing.assert_array_equal(a[name][()], b[name][frames], err_msg=name)
        for name in b["model/patches"]:
            np.testing.assert_array_equal(a[f"model/patches/{name}"][()], b[f"model/patches/{name}"][()], err_msg=name)
        for name in b["model/dimensions"]:
            assert a[f"model/dimensions/{name}"][()] == b[f"model/dimensions/{name}"][()], name


def send(number: int, frame: int, *arguments: Any, clock: float = EVERY_FRAME) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", VICTIM, *map(str, arguments)],
        cwd=ROOT,
        env={
            **os.environ,
            "TEST_FRAME": str(frame),
            "TEST_SIGNAL": str(int(number)),
            "TEST_CLOCK": str(clock),
        },
        capture_output=True,
        text=True,
        timeout=600,
    )


# --- seeds ------------------------------------------------------------------------------------------------------------


def test_another_seed_gives_another_result(tiny: Path, tracked: Path, tmp_path: Path) -> None:
    run(tiny, tmp_path / "other.h5", config=settings_file.from_toml(f"seed = 1\n{QUICK}"), frames=(0, 2))
    assert np.abs(read_result(tmp_path / "other.h5").pose - read_result(tracked).pose[:2]).max() > 1e-6


# --- stopped and taken up again ---------------------------------------------------------------------------------------


def test_a_run_interrupted_twice_equals_an_uninterrupted_one(
    tiny: Path, tracked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_clock(monkeypatch, EVERY_FRAME)
    result, capture = tmp_path / "r.h5", open_capture(tiny)
    options: dict[str, Any] = {"frames": (0, 8), "store_hull": True, "resume": True}
    for frame in (0, 4):
        summary = track(capture, result, CONFIG, StopAt(frame), **options)
        assert summary.interrupted and summary.frames == frame + 1
    reporter = Silent()
    summary = track(capture, result, CONFIG, reporter, **options)
    assert (summary.interrupted, summary.frames, summary.tracked_now) == (False, 8, 3)
    assert (reporter.total, reporter.done, reporter.frames) == (8, 5, [5, 6, 7])
    assert_same(result, tracked, slice(0, 8))


def test_frames_are_reported_after_they_are_written(
    tiny: Path, tracked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_clock(monkeypatch, 1e-9)
    result, capture = tmp_path / "r.h5", open_capture(tiny)
    stopped = StopAt(3)
    summary = track(capture, result, CONFIG, stopped, frames=(0, 5), store_hull=True)
    assert summary.interrupted and stopped.frames == [0, 1, 2, 3]  # by then all of them were finished
    assert summary.frames == summary.tracked_now == 5
    assert_same(result, tracked, slice(0, 5))


def test_ctrl_c_before_the_first_frame_leaves_an_older_result(
    tiny: Path, first_frame: dict[str, Path], tmp_path: Path
) -> None:
    class Impatient(Silent):
        def begin(self, total: int, done: int) -> None:
            signal.raise_signal(signal.SIGINT)

    result = Path(shutil.copy(first_frame["volumetric"], tmp_path / "r.h5"))
    before = result.read_bytes()
    summary = track(open_capture(tiny), result, CONFIG, Impatient(), force=True)
    assert summary.interrupted and summary.frames == 0
    assert result.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        (["--frames", "1:"], "first frame: 0, not 1"),
        (["--cameras", "cam1,cam2,cam3"], "cameras: cam1, cam2, cam3, cam4, not cam1, cam2, cam3"),
        (["--masks", "none"], "masks: masks, not none"),
        (["--seed", "8"], "seed: 0, not 8"),
        (["--voxels", "40"], "config.voxels: 32, not 40"),
        (["--store-hull"], "stored hull: no, not yes"),
        (["--store-hull", "--frames", "0:1"], "stored hull: no, not yes"),  # nothing is left to do
    ],
)
def test_only_the_same_command_is_resumed(
    tk: Tk, quick: Path, tiny: Path, first_frame: dict[str, Path], tmp_path: Path, options: list[str], difference: str
) -> None:
    begun = Path(shutil.copy(first_frame["volumetric"], tmp_path))
    before = begun.read_bytes()
    ran = tk("track", tiny, "--method", "volumetric", "-o", begun, "--config", quick, "--resume", *options)
    ran.complaint(str(begun), difference, "start again")
    assert begun.read_bytes() == before


def test_large_images_are_reduced_and_the_result_has_the_recorded_cameras(
    copy: Path, causal: Path, tmp_path: Path
) -> None:
    """The run is resumed with images of the same size only."""
    capture, half = open_capture(copy), tmp_path / "half.h5"
    tall = capture.setup().person_pixels()
    config = replace(CONFIG, person_pixels=int(tall.min() / 2))
    reporter = Silent()
    conftest.track(capture, half, config, reporter, frames=(0, 2), causal=True)
    (line,) = [note for note in reporter.notes if "reduced size" in note]
    assert "all cameras at 1/2 (the person is about" in line
    found, full = read_result(half), read_result(causal).joints[:2]
    assert found.cameras is not None
    for camera, expected in zip(found.cameras.rig, capture.rig, strict=True):
        assert (camera.width, camera.height, camera.reduction) == (expected.width, expected.height, 1)
        np.testing.assert_allclose(camera.matrix, expected.matrix, rtol=1e-12)
    assert np.median(np.linalg.norm(found.joints - full, axis=2)) < 0.05
    assert np.abs(found.joints - full).max() > 0  # it is another computation
    settings = (copy / "capture.toml").read_text(encoding="utf-8").replace("height = 1.75", "height = 1.2")
    (copy / "capture.toml").write_text(settings, encoding="utf-8")
    with pytest.raises(ResultError, match="size of the images: 1/2, 1/2, 1/2, 1/2, not full, full, full, full"):
        conftest.track(open_capture(copy), half, config, resume=True, causal=True)


def test_lost_frames_of_all_runs_are_counted(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody is there in frames 3 to 5; the run is stopped in their midst, and after the last frame."""
    run_clock(monkeypatch, EVERY_FRAME)
    for camera in (copy / "masks").iterdir():
        for index in (3, 4, 5):
            write_picture(camera / f"{index:06d}.png", np.zeros((120, 160), np.uint8))
    result, capture = tmp_path / "r.h5", open_capture(copy)
    assert track(capture, result, CONFIG, StopAt(4), frames=(0, 9)).lost == 2
    assert track(capture, result, CONFIG, StopAt(8), resume=True, frames=(0, 9)).interrupted
    assert track(capture, result, CONFIG, resume=True, frames=(0, 9)).lost == 3
    assert read_result(result).notes == ("fewer than two cameras see anybody: no pose, frames 3 to 5",)
    status = read_result(result).status
    assert list(status[:3]) == [Status.INITIALISED, Status.TRACKED, Status.TRACKED]
    assert list(status[3:7]) == [Status.LOST, Status.LOST, Status.LOST, Status.RECOVERED]
    assert (status[7:] == Status.TRACKED).all()


# --- what is kept -----------------------------------------------------------------------------------------------------


def test_the_hull_is_stored_on_request(tracked: Path) -> None:
    result = read_result(tracked)
    assert result.hull is not None and len(result.hull.offsets) == FRAMES + 1
    assert result.hull.positions.dtype == np.float32 and result.hull.colors.dtype == np.uint8
    for row in range(FRAMES):
        points = result.hull[row]
        assert len(points.positions) == len(points.colors) > 60
        assert np.linalg.norm(points.positions.mean(axis=0) - result.joints[row].mean(axis=0)) < 0.3


# --- where a run starts -----------------------------------------------------------------------------------------------


def pose_file(path: Path, document: dict[str, Any]) -> Path:
    path.write_text(tomli_w.dumps(document), encoding="utf-8")
    return path


def test_starts_from_rough_joints_and_leaves_out_the_frames_before_them(copy: Path, tmp_path: Path) -> None:
    truth = read_joints(copy / "truth.h5")
    rough = truth.positions[4] + np.random.default_rng(0).normal(0, 0.04, (15, 3))
    joints = {name: rough[k].tolist() for k, name in enumerate(JOINTS) if not name.startswith("elbow")}
    file = pose_file(tmp_path / "pose.toml", {"frame": 4, "joints": joints, "subject": {"height": 1.75}})
    without_first_pose(copy, ("da-vinci", "any"))
    reporter = Silent()
    run(copy, tmp_path / "r.h5", init_pose=file, frames=(0, 9), reporter=reporter)
    assert reporter.frames == [4, 5, 6, 7, 8]
    assert any("frames before 4 are left out" in note for note in reporter.notes)
    with pytest.raises(ConfigError, match=r"frames 0:2: the subject is found in frame 4"):
        run(copy, tmp_path / "other.h5", init_pose=file, frames=(0, 2))
    found = read_result(tmp_path / "r.h5")
    np.testing.assert_array_equal(found.frames, np.arange(4, 9))
    assert found.status[0] == Status.INITIALISED and not (found.status == Status.LOST).any()
    assert np.median(np.linalg.norm(found.joints - truth.positions[4:9], axis=2)) < 0.12


def test_starts_from_angles(tiny: Path, tracked: Path, tmp_path: Path) -> None:
    known = read_result(tracked)
    names, pose = known.meta.pose_names, known.pose[5]
    angles = {
        n: float(v) if n in ("torso_x", "torso_y", "torso_z") else float(np.degrees(v))
        for n, v in zip(names, pose, strict=True)
    }
    angles = {name: round(value, 1) for name, value in angles.items()}
    run(tiny, tmp_path / "r.h5", init_pose=pose_file(tmp_path / "pose.toml", {"angles": angles}), frames=(5, 9))
    found = read_result(tmp_path / "r.h5")
    np.testing.assert_array_equal(found.frames, np.arange(5, 9))
    assert np.median(np.linalg.norm(found.joints - known.joints[5:9], axis=2)) < 0.06


@pytest.mark.parametrize(
    ("frame", "unit", "parts"), [(99, 1, ["99", "13"]), (0, 1000, ["outside the working volume", "metres"])]
)
def test_an_initial_pose_past_the_end_or_in_millimetres(
    tk: Tk, quick: Path, tiny: Path, tmp_path: Path, frame: int, unit: int, parts: list[str]
) -> None:
    joints = {name: [0.1 * unit * (k % 2), 0.05 * unit * k, 1.0 * unit] for k, name in enumerate(JOINTS)}
    file = pose_file(tmp_path / "pose.toml", {"frame": frame, "joints": joints})
    ran = tk("track", tiny, "--method", "volumetric", "-o", tmp_path / "r.h5", "--config", quick, "--init-pose", file)
    ran.complaint("pose.toml", *parts)


def test_masks_that_never_change_are_refused(tk: Tk, copy: Path, tmp_path: Path) -> None:
    for folder in (copy / "masks").iterdir():
        first, *others = sorted(folder.iterdir())
        for path in others:
            path.write_bytes(first.read_bytes())
    slow = tmp_path / "c.toml"  # the person stands still at first
    slow.write_text(QUICK.replace("init_frames = 3", f"init_frames = {FRAMES}"))
    tk("track", copy, "-o", tmp_path / "r.h5", "--config", slow).complaint(str(copy), "the masks never change")


def test_the_initial_frame_of_the_capture_must_be_tracked(copy: Path, tmp_path: Path) -> None:
    without_first_pose(copy, ("frame = 0", "frame = 3"))
    with pytest.raises(ConfigError, match=r"frames 0:2: the subject is found in frame 3"):
        run(copy, tmp_path / "r.h5", frames=(0, 2))


def test_requested_frames_are_tracked(tiny: Path) -> None:
    capture, notes = open_capture(tiny), list[str]()
    assert choose_frames(capture, (0, None), notes.append) == (0, FRAMES)
    assert choose_frames(capture, (3, 7), notes.append) == (3, 7)
    assert not notes
    assert choose_frames(capture, (3, 70), notes.append) == (3, FRAMES)
    assert "ends with frame 13" in notes[0]
    with pytest.raises(ConfigError, match=r"frames 14:: .* has only frames 0 to 13"):
        choose_frames(capture, (14, None), notes.append)
    late = replace(capture, time_offset_s=(5 / capture.fps, *(0.0 for _ in capture.rig.names[1:])))
    with pytest.raises(ConfigError, match=r"frames 0:5: the latest camera of .* begins in frame 5"):
        choose_frames(late, (0, 5), notes.append)
    assert choose_frames(late, (0, 6), notes.append) == (5, 6)


def test_masks_are_made_from_the_videos(tiny: Path, tmp_path: Path) -> None:
    path, capture = tmp_path / "r.h5", open_capture(tiny, masks="none")
    assert conftest.track(capture, path, CONFIG, frames=(0, 1), causal=True).lost == 0
    found, truth = read_result(path), read_joints(tiny / "truth.h5").positions[:1]
    assert np.linalg.norm(found.joints - truth, axis=2).mean() < 0.1 and (found.timing["masks"] > 0).all()


def test_unknown_method() -> None:
    with pytest.raises(ConfigError, match=r"method neural: choose one of .*volumetric"):
        tracker_class("neural")
