"""Accuracy on whole captures. Takes minutes; run by `make test-slow`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Tk, development_capture, track
from tk.evaluation.joints import Evaluation, evaluate_files
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_result
from tk.settings import Settings

pytestmark = pytest.mark.slow

DEMO = Path(__file__).parents[1] / "tk" / "data" / "demo"
FRAMES = {"walk": 80, "dance": 120, "punch": 150}
SEEDS = 5
MEAN_CM = 2.9  # Kehl & Van Gool 2006, section 7.3
DEMO_CM = 6.0  # larger, because the subject's proportions are not the average
MEMORY_MIB = 2048

# prints the peak memory of a command in a process of its own, without the memory of the test process
MEASURED = """
import resource, sys
from tk.cli import main
try:
    main(sys.argv[1:], prog_name="tk")
finally:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def assert_complete(found: Evaluation, frames: int) -> None:
    assert (found.judged, found.missing_outside, found.lost, found.nan_frames) == (frames, 0, 0, 0)


@pytest.mark.parametrize("name", FRAMES)
def test_mean_error_of_captures_segmented_from_their_videos(name: str, tmp_path: Path) -> None:
    """64³, five cameras, masks from the videos and the background clips; mean over the seeds."""
    folder = development_capture(name)
    means = []
    for seed in range(SEEDS):
        result = tmp_path / f"{seed}.h5"
        track(open_capture(folder, masks="none"), result, Settings(seed=seed))
        found = evaluate_files(result, folder / "truth.h5")
        assert_complete(found, FRAMES[name])
        means.append(found.raw.all.mean_cm)
    assert np.mean(means) <= MEAN_CM, means


@pytest.mark.parametrize("name", FRAMES)
def test_runs_with_the_same_seed_give_the_same_poses(name: str, tmp_path: Path) -> None:
    capture = open_capture(development_capture(name), masks="none")
    poses = []
    for run in ("a.h5", "b.h5"):
        track(capture, tmp_path / run, Settings(), frames=(0, 30))
        poses.append(read_result(tmp_path / run).pose)
    assert len(poses[0]) == 30
    np.testing.assert_array_equal(poses[0], poses[1])


@pytest.mark.skipif(sys.platform == "win32", reason="needs getrusage")
def test_tracking_needs_less_than_two_gibibytes(tmp_path: Path) -> None:
    command = [sys.executable, "-c", MEASURED, "track", str(development_capture("walk")), "-o", str(tmp_path / "r.h5")]
    ran = subprocess.run([*command, "--masks", "none"], capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert ran.returncode == 0, ran.stderr
    unit = 2**20 if sys.platform == "darwin" else 2**10
    assert int(ran.stdout) / unit < MEMORY_MIB


def test_demo_capture_is_tracked_and_its_error_printed(tk: Tk, tmp_path: Path) -> None:
    ran = tk("demo", "-o", tmp_path / "demo.h5")
    assert ran.code == 0, ran.err
    found = evaluate_files(tmp_path / "demo.h5", DEMO / "truth.h5")
    assert found.format_table() in ran.out
    assert_complete(found, found.judged)
    assert found.raw.all.mean_cm <= DEMO_CM, found.format_table()
    report = json.loads(tk("evaluate", tmp_path / "demo.h5", DEMO / "truth.h5", "--json").out)
    assert report["lost"] == 0
