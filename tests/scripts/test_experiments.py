"""The paper's experiments at a small size: what their tables and figures are of, not how large the numbers are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scripts.experiments import EXPERIMENTS, main
from scripts.paper import common, cues, sampling, views
from scripts.paper.common import Options, Track, spread, table
from scripts.paper.levenberg_marquardt import instead_of_smd
from scripts.paper.motion import turned_deg
from tests.conftest import QUICK
from tk.io import settings_file
from tk.model.body.skeleton import JOINTS
from tk.settings import Settings
from tk.trackers.volumetric import VolumetricTracker

DEMO = Path(__file__).resolve().parents[2] / "tk" / "data" / "demo"


def made_up(error: float = 2.0, frames: int = 6) -> Track:
    pose = np.zeros((frames, 3))
    pose[:, 2] = np.radians(7.0) * np.arange(frames)
    return Track(
        np.full((frames, 15), error),
        pose,
        ("m", "rad", "rad"),
        np.full((frames, 6), 5),
        np.full(frames, 20.0),
        np.zeros(frames, bool),
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Tracking replaced by numbers made up; what was asked for."""
    calls: list[tuple[Any, ...]] = []

    def track(
        capture: Path, config: Settings, frames: int | None, method: str = "volumetric", cameras: Any = None
    ) -> Track:
        calls.append((config, frames, VolumetricTracker.optimise, cameras))
        return made_up()

    monkeypatch.setattr(common, "track", track)
    return calls


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "sampling"])
def test_every_experiment_writes_a_figure_and_a_table(
    name: str, asked: list[tuple[Any, ...]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([name, str(DEMO), "--frames", "6", "--seeds", "2", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert EXPERIMENTS[name].paper in printed and "2 seeds" in printed
    assert printed.count("|\n") >= 3 and "2.00" in printed
    assert 0 < (tmp_path / f"{name}.png").stat().st_size < 200_000
    assert all(frames == 6 for _, frames, _, _ in asked)
    assert {config.seed for config, *_ in asked} == {0, 1}


def test_optimisers_differ_only_in_the_optimiser_and_the_number_of_points(
    asked: list[tuple[Any, ...]], tmp_path: Path
) -> None:
    main(["optimisers", str(DEMO), "--seeds", "1", "--out", str(tmp_path)])
    smd = VolumetricTracker.optimise
    assert [(optimise is smd, config.effort) for config, _, optimise, _ in asked] == [
        (True, 1), (True, 5), (False, 1), (False, 5),
    ]  # fmt: skip
    same = {replace(config, effort=1.0) for config, *_ in asked}
    assert same == {Settings()}


def test_cues_are_what_their_names_say() -> None:
    found = cues.variants()
    for name, config in found.items():
        assert (config.volumetric.edge_weight > 0) == ("edges" in name)
        assert (config.volumetric.coverage_weight > 0) == ("coverage" in name)
    assert len(set(found.values())) == len(found)


def test_view_selection_has_the_named_number_of_views(asked: list[tuple[Any, ...]], tmp_path: Path) -> None:
    views.run(Options(DEMO, 6, 1, tmp_path / "views.png"))
    assert [len(set(cameras)) for *_, cameras in asked] == [4, 5, 5], "the demo has five cameras"


def test_turns_are_the_greatest_of_a_frame_and_lengths_do_not_count() -> None:
    track = made_up()
    track.pose[3, 0] += 5.0
    np.testing.assert_allclose(turned_deg(track), 7.0)
    track.pose[:, 1] = np.pi * np.array([0.99, -0.99, 0.99, -0.99, 0.99, -0.99])
    np.testing.assert_allclose(turned_deg(track), 7.0, err_msg="3.6° through ±180°")


def test_a_table_is_markdown() -> None:
    assert table([{"a": "1", "b": "2"}, {"a": "3", "b": "4"}]).splitlines() == [
        "| a | b |", "| --- | --- |", "| 1 | 2 |", "| 3 | 4 |",
    ]  # fmt: skip
    assert spread([1.0]) == "1.00" and spread([1.0, 3.0], 1) == "2.0 (1.0-3.0)"


SHORT = replace(settings_file.from_toml(QUICK), voxels=48)


@pytest.fixture(scope="module")
def short(tiny: Path) -> Track:
    return common.track(tiny, SHORT, 3)


def test_a_capture_is_tracked_by_levenberg_marquardt(tiny: Path, short: Track) -> None:
    with instead_of_smd():
        track = common.track(tiny, SHORT, 3)
    assert 0.5 < track.mean_cm < 15 and track.mean_cm != short.mean_cm
    assert (track.iterations > 0).all() and track.iterations.shape == short.iterations.shape


def test_tracking_result_matches_the_capture(short: Track) -> None:
    assert short.error_cm.shape == (3, len(JOINTS)) and short.pose.shape[0] == 3
    assert 0.5 < short.mean_cm < 15 and short.lost_frames <= 3
    assert (short.optimise_ms > 0).all() and (short.iterations > 0).all()


@pytest.fixture(scope="module")
def scene(tiny: Path) -> sampling.Scene:
    """The second frame, tracked to."""
    return sampling.look(Options(tiny, 2, 1, Path("none.png")), settings_file.preset("kehl2006"))


def test_recovery_of_a_displaced_arm_is_judged(
    scene: sampling.Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sampling, "look", lambda options, paper: scene)
    text = sampling.run(Options(DEMO, 2, 2, tmp_path / "sampling.png"), step_deg=24.0)  # a coarse picture
    assert "of 8" in text and "stochastic" in text and "deterministic" in text
    assert (tmp_path / "sampling.png").stat().st_size < 200_000


def test_deterministic_points_stay_and_stochastic_ones_do_not(scene: sampling.Scene) -> None:
    start = sampling.moved(scene, np.array([[10.0, 5.0]]))
    values = [sampling.landscape(scene, 3, start)[0] for _ in range(2)]
    assert values[0] == values[1] != sampling.landscape(scene, 4, start)[0]
    ends = [sampling.descend(scene, start[0], 3, False)[0][-1] for _ in range(2)]
    np.testing.assert_array_equal(ends[0], ends[1])
    held = np.setdiff1d(np.arange(len(scene.pose)), scene.two)
    np.testing.assert_array_equal(start[0, held], scene.pose[held])


def test_a_folder_that_is_no_capture_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="nowhere"):
        main(["views", str(tmp_path / "nowhere"), "--out", str(tmp_path)])
