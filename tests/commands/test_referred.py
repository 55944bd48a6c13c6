"""The commands on a capture whose videos stay where they are."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import tomllib

from tests.conftest import FRAMES, Tk
from tests.io.conftest import write_toml
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_result


@pytest.fixture
def elsewhere(copy: Path) -> Path:
    """The rendered capture with its videos in another folder, and clocks that begin at other times, all at 10 s."""
    raw = copy.parent / "raw"
    shutil.move(copy / "videos", raw)
    document = tomllib.loads((copy / "capture.toml").read_text())
    names = sorted(path.name for path in raw.iterdir())
    document["videos"] = {Path(name).stem: {"path": f"../raw/{name}", "offset": 10.0, "rate": 1.0} for name in names}
    write_toml(copy / "capture.toml", document)
    return copy


def test_tracking_rendering_and_reports_equal_those_of_videos_in_the_folder_and_other_times_are_not_resumed(
    tk: Tk, causal: Path, elsewhere: Path, quick: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "moved.h5"
    run = ("track", elsewhere, "-o", moved, "--config", quick, "--causal")
    ran = tk(*run, "--frames", "0:3")
    assert ran.code == 0, ran.err
    apart = read_result(causal).joints[:3] - read_result(moved).joints
    assert np.abs(apart).max() < 0.01
    assert tk("render", moved, elsewhere, "-o", tmp_path / "o.mp4").code == 0
    assert tk("report", moved, elsewhere, "-o", tmp_path / "r.html").code == 0
    raw = elsewhere.parent / "raw" / "cam1.mp4"
    tk("render", moved, elsewhere, "-o", raw, "--force").complaint("raw/cam1.mp4: is an input of this command")
    assert tk(*run, "--resume", "--frames", "0:3").code == 0
    text = (elsewhere / "capture.toml").read_text()
    (elsewhere / "capture.toml").write_text("from = 10.1\n" + text)
    tk(*run, "--resume", "--frames", "0:5").complaint("videos and times of the frames")


def test_inspect_reports_the_clock_and_masks_are_of_frames(tk: Tk, elsewhere: Path, tmp_path: Path) -> None:
    ran = tk("inspect", elsewhere)
    assert ran.code == 0 and "from 10.000 s to 10.867 s of the common time" in ran.out + ran.err
    assert open_capture(elsewhere).frame_count == FRAMES
