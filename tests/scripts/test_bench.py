"""The benchmark at a small size: that its figures are of what they say, not how large they are."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scripts import bench
from scripts.bench import Run, main


def here(*_: object, **__: object) -> Any:
    """Instead of a process of its own, which would compile the kernels again; another process could take the call."""

    def submit(function: Callable[..., object], *arguments: object) -> SimpleNamespace:
        call, given = pickle.loads(pickle.dumps((function, arguments)))
        result = call(*given)
        return SimpleNamespace(result=lambda: result)

    return nullcontext(SimpleNamespace(submit=submit))


@pytest.mark.slow
def test_benchmark_of_a_small_capture_runs(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "ProcessPoolExecutor", here)
    pytest.importorskip("open3d", exc_type=ImportError)
    file = tmp_path / "bench.json"
    main([str(tiny), "--voxels", "40", "--repeat", "1", "--frames", "4", "--json", str(file)])
    printed = capsys.readouterr().out
    report = json.loads(file.read_text(encoding="utf-8"))
    assert report["machine"]["cores"] >= 1 and report["growth"] == []
    (found,) = report["runs"]
    run = Run(**found["end_to_end"])
    assert run.frames == 4 and run.frames_per_second > 0 and run.peak_mib > 50
    assert 0 < run.first_frame_s < run.seconds
    assert run.launches["carve_kernel"] == 1, "one launch a frame for all cameras"
    assert run.launches["objective"] > 1
    stages = found["stages_ms"]
    assert {"decode", "masks", "hull", "colour", "optimise", "total"} <= stages.keys()
    assert all(ms > 0 for ms in stages.values())
    alone = {stage["name"]: stage for stage in found["alone"]}
    hull = alone["hull, from scratch"]
    for peer, ratio in hull["ratios"].items():
        assert ratio == pytest.approx(hull["peers"][peer] / hull["ms"])
    assert set(hull["peers"]) == {"Open3D carve_silhouette", "NumPy projection"}
    assert alone["neighbours: build and query"]["peers"].keys() == {"SciPy cKDTree"}
    contours = [name for name in alone if name.startswith(("contours:", "colour edges:", "objective "))]
    assert len(contours) == 7 and all(alone[name]["ms"] > 0 for name in contours)
    for text in ("kernel launches a frame", "peak memory", "Open3D carve_silhouette", "tiny at 40³"):
        assert text in printed


@pytest.mark.slow
def test_the_silhouette_tracker_has_stages_of_its_own(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "ProcessPoolExecutor", here)
    file = tmp_path / "bench.json"
    options = ["--method", "silhouette", "--cameras", "cam1,cam2,cam4", "--repeat", "1", "--frames", "4"]
    main([str(tiny), *options, "--json", str(file)])
    (found,) = json.loads(file.read_text(encoding="utf-8"))["runs"]
    assert found["method"] == "silhouette" and found["cameras"] == 3 and found["voxels"] is found["hull_ms"] is None
    run = Run(**found["end_to_end"])
    assert run.launches["silhouette_descent"] == 3, "one at each scale"
    assert {"masks_clean", "optimise", "check"} < found["stages_ms"].keys()
    alone = {stage["name"]: stage["ms"] for stage in found["alone"]}
    assert sum(name.startswith("contours, search, equations") for name in alone) == 3
    assert all(ms > 0 for name, ms in alone.items() if name != "masks")
    printed = capsys.readouterr().out
    assert "fitting alone: " in printed and "tiny, silhouettes" in printed


def test_a_capture_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="nowhere"):
        main([str(tmp_path / "nowhere"), "--repeat", "1"])


@pytest.mark.slow
def test_the_pieces_of_the_start_are_measured(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(tiny), "--start", "--masks", "auto"])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines[0].startswith("imports") and any(line.startswith("body fit") for line in lines)
    assert all(line.endswith(" ms") and float(line.split()[-2]) >= 0 for line in lines)
