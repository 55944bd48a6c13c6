"""Each example runs with short settings, on the demo or a smaller capture, and gives the output that it promises."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import cv2
import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
#: options that make the examples short
OPTIONS = {
    "01_track_and_plot": ["--frames", "2", "--out", "out"],
    "02_compare_methods_and_cameras": ["--frames", "1"],
    "03_hulls_to_open3d": ["--frames", "1", "--voxels", "32", "--out", "out"],
}


@pytest.mark.filterwarnings("default")  # warnings of other packages do not fail the test
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(
    example: Path,
    quick: Path,
    tiny: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = ["--config", str(quick)] if "--config" in example.read_text(encoding="utf-8") else []
    capture = [str(tiny)] if example.stem.startswith(("01", "02")) else []
    monkeypatch.setattr(sys, "argv", [example.name, *OPTIONS[example.stem], *settings, *capture])
    runpy.run_path(str(example), run_name="__main__")
    said = capfd.readouterr().out
    if example.stem.startswith("01"):
        assert "2 frames, 0 lost" in said
        assert cv2.imread(str(tmp_path / "out" / "motion.png")).std() > 5  # the image is not blank
    elif example.stem.startswith("02"):
        means = [float(line[28:].split()[0]) for line in said.splitlines()[1:]]
        assert len(means) == 4 and all(0 < mean < 15 for mean in means)
    else:
        assert (tmp_path / "out" / "000000.ply").stat().st_size > 1000
        height = float(said.split(" m high")[0].split()[-1])
        assert 1.5 < height < 2.1


def test_examples_have_at_most_65_lines_and_are_all_tested() -> None:
    assert [path.stem for path in EXAMPLES] == sorted(OPTIONS)
    for path in EXAMPLES:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 65, path.name
