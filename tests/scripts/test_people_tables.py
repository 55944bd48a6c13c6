"""The tables of scenes with several people: one from tracked captures, one from invented results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from scripts import people_scenes
from scripts.people_scenes import Run, compare_together, embraces, main, outside
from tests.conftest import FITTED
from tk.io.results.data import JointTrack
from tk.io.results.reader import read_people
from tk.model.body.joints import JOINTS

FRAMES = np.arange(6)


def person(x: float, path: Path = Path("truth.h5")) -> JointTrack:
    """Return somebody whose joints lie on a line along z, and who walks along y."""
    positions = np.zeros((len(FRAMES), len(JOINTS), 3))
    positions[..., 0], positions[..., 1], positions[..., 2] = x, 0.1 * FRAMES[:, None], np.linspace(0, 1.7, len(JOINTS))
    return JointTrack(path, FRAMES, positions)


def moved(track: JointTrack, metres: float) -> JointTrack:
    """Return a result with an error along x in the second half of the frames."""
    positions = track.positions.copy()
    positions[3:, :, 0] += metres
    return replace(track, positions=positions, status=np.zeros(len(FRAMES), np.uint8))


@pytest.mark.slow
def test_bystander_scene_is_tracked_and_compared(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both captures are the same one, which is tracked once."""
    track, runs = people_scenes.track, list[Run]()

    def track_once(capture: Path, *rest: Any) -> Run:
        runs.append(runs[0] if runs else track(capture, *rest))
        return runs[-1]

    monkeypatch.setattr(people_scenes, "track", track_once)
    scene = tmp_path / "scenes" / "still"
    scene.mkdir(parents=True)
    for name in ("with", "without"):
        (scene / name).symlink_to(tiny)
    config = tmp_path / "fitted.toml"
    config.write_text(FITTED, encoding="utf-8")
    options = ["--config", str(config), "--frames", "0:2", "--causal", "--no-report"]
    main([str(tmp_path / "scenes"), "--work", str(tmp_path / "work"), *options])
    name, limbs, without, difference, *_, missed, missed_without = capsys.readouterr().out.splitlines()[-1].split()
    assert name == "still"
    assert 0 < float(limbs) < 10
    assert float(without) == float(limbs) and float(difference) == 0 and len(runs) == 2
    assert missed == missed_without == "0"


def test_embraces_are_frames_with_pelvises_close_together() -> None:
    apart = person(2.0)
    apart.positions[2:4, :, 0] = 0.4
    truth = [person(0.0), apart]
    assert embraces(truth).tolist() == [2, 3]
    assert [track.frames.tolist() for track in outside(truth, embraces(truth))] == [[0, 1, 4, 5]] * 2
    assert embraces([person(0.0)]).tolist() == []


def test_table_has_errors_relative_to_the_person_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = [person(0.0), person(1.5)]
    # together: person 0 is 4 cm off in half of the frames, person 1 is missed in half of them; alone: 2 and 0 cm
    results = {
        "both": Run((moved(truth[0], 0.04), moved(truth[1], 5.0)), 6.0, 300.0),
        "alone-0": Run((moved(truth[0], 0.02),), 2.0, 200.0),
        "alone-1": Run((moved(truth[1], 0.0),), 4.0, 200.0),
    }
    for name, tracks in (("both", truth), ("alone-0", truth[:1]), ("alone-1", truth[1:])):
        (tmp_path / "scene" / name).mkdir(parents=True)
        with h5py.File(tmp_path / "scene" / name / "truth.h5", "w") as file:
            for k, one in enumerate(tracks):
                for group in [file.create_group(f"people/{k}")] if len(tracks) > 1 else [file]:
                    group["frames"], group["time"] = one.frames, one.frames / 15
                    group["joints/position"] = one.positions
                    group["joints/position"].attrs.create("names", list(JOINTS), dtype=h5py.string_dtype())
    assert len(read_people(tmp_path / "scene" / "both" / "truth.h5")) == 2

    def track(capture: Path, *_: Any) -> Run:
        return results[capture.name]

    monkeypatch.setattr(people_scenes, "track", track)
    first, second = (line.split() for line in compare_together(tmp_path / "scene", tmp_path, []))
    assert first[:2] == ["scene", "0"]
    assert first[5:7] == ["2.00", "1.00"]  # raw, alone
    assert first[7:] == ["0", "0", "0", "0", "2.00", "1.50"]  # missed in three ways, switches, time, memory
    assert second[7:] == ["3", "0", "0", "0"]
    results["alone-1"] = Run((), 4.0, 200.0)  # refused
    first, second = (line.split() for line in compare_together(tmp_path / "scene", tmp_path, []))
    assert first[-2:] == ["3.00", "1.50"]  # compared with the other person only
    assert second[3:5] == ["-", "-"] and second[6] == "-"
