"""``tk track --method silhouette``, from the capture folder to the result file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.conftest import Silent, Tk
from tk.errors import ConfigError
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.model.body.skeleton import JOINTS
from tk.run.session import Summary, track
from tk.trackers.registry import METHODS

# no process ahead, and few frames to fit the body to
QUICK = """
ahead = 0
[silhouette]
init_frames = 3
"""


def run(capture: Path, output: Path, config: str = QUICK, masks: str = "auto", **options: Any) -> Summary:
    return track(
        open_capture(capture, masks=masks),
        output,
        settings_file.from_toml(config),
        Silent(),
        method="silhouette",
        **options,
    )


@pytest.fixture(scope="module")
def unbroken(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("silhouette") / "unbroken.h5"
    summary = run(tiny, path, frames=(0, 8))
    assert (summary.frames, summary.lost) == (8, 0)
    return path


def test_result_file_has_the_datasets_of_the_contract(tiny: Path, unbroken: Path) -> None:
    result = read_result(unbroken)
    assert result.meta.method == "silhouette" in METHODS
    assert result.status.tolist() == [Status.INITIALISED] + [Status.TRACKED] * 7
    with h5py.File(unbroken) as file:
        assert file["pose"].shape == (8, 31) and file["iterations"].shape == (8, 3)
        assert {"decode", "masks", "masks_clean", "optimise", "check", "total"} <= set(file["timing"])
        assert file["model/parts/shape"].shape == (22, 4)
        assert "silhouette" in file.attrs["config"]
    # pictures 160 pixels wide and a hasty fit: the person is found, and no limb is elsewhere
    truth = read_joints(tiny / "truth.h5").positions[:8]
    assert np.linalg.norm(result.joints - truth, axis=2).mean() < 0.08


def test_repeated_and_resumed_runs_give_the_same_result(tiny: Path, unbroken: Path, tmp_path: Path) -> None:
    output = tmp_path / "r.h5"
    run(tiny, output, frames=(0, 5))
    summary = run(tiny, output, frames=(0, 8), resume=True)
    assert (summary.frames, summary.tracked_now) == (8, 3)
    np.testing.assert_array_equal(read_result(output).pose, read_result(unbroken).pose)


def test_tracking_starts_from_any_pose_in_any_frame(copy: Path, tmp_path: Path) -> None:
    file = copy / "capture.toml"
    file.write_text(file.read_text(encoding="utf-8").replace("da-vinci", "any"), encoding="utf-8")
    run(copy, tmp_path / "r.h5", frames=(4, 7))
    found = read_result(tmp_path / "r.h5")
    assert found.frames.tolist() == [4, 5, 6] and found.status[0] == Status.INITIALISED


def test_videos_are_segmented_if_masks_are_none(tiny: Path, tmp_path: Path) -> None:
    run(tiny, tmp_path / "r.h5", masks="none", frames=(0, 3))
    truth = read_joints(tiny / "truth.h5").positions[:3]
    assert np.linalg.norm(read_joints(tmp_path / "r.h5").positions - truth, axis=2).mean() < 0.1


def test_tracking_starts_from_a_pose_file(tiny: Path, tmp_path: Path) -> None:
    truth = read_joints(tiny / "truth.h5").positions[0]
    lines = [f"{name} = {truth[i].round(2).tolist()}" for i, name in enumerate(JOINTS)]
    (tmp_path / "pose.toml").write_text("[joints]\n" + "\n".join(lines) + "\n", encoding="utf-8")
    run(tiny, tmp_path / "r.h5", frames=(0, 2), init_pose=tmp_path / "pose.toml")
    assert np.linalg.norm(read_joints(tmp_path / "r.h5").positions[0] - truth, axis=1).mean() < 0.08


def test_settings_out_of_range_are_refused(tiny: Path, tk: Tk, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="prediction"):
        settings_file.from_toml("[silhouette]\nprediction = 3.0\n")
    (tmp_path / "bad.toml").write_text("[silhouette]\nbodies = 3\n", encoding="utf-8")
    said = tk("track", tiny, "-o", tmp_path / "r.h5", "--method", "silhouette", "--config", tmp_path / "bad.toml")
    said.complaint("bad.toml", "silhouette.bodies")


def test_empty_masks_are_reported_in_one_line(copy: Path, quick: Path, tk: Tk, tmp_path: Path) -> None:
    import cv2

    for picture in (copy / "masks").rglob("*.png"):
        cv2.imwrite(str(picture), np.zeros_like(cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)))
    said = tk("track", copy, "-o", tmp_path / "r.h5", "--method", "silhouette", "--config", quick)
    said.complaint(str(copy), "0 of 4 masks of frame 0 show anybody")
