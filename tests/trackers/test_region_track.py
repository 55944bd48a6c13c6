"""``tk track`` by default: the region tracker, its second pass, bodies from files, resumed runs; and by silhouettes."""

from __future__ import annotations

import json
import logging
import shutil
import signal
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import tomli_w

from tests.conftest import FITTED, FRAMES, QUICK, Silent, Tk, as_if_killed, track, without_first_pose
from tests.io.conftest import write_picture
from tests.run.test_session import send
from tk.commands.track import EXIT_LOST, _expected_error, end
from tk.errors import ResultError
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.data import Result
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.model.body.anthropometry import AVERAGE_BODY, BodyDimensions
from tk.model.setup import Subject
from tk.run.offline import REFINED
from tk.run.plan import recording_task
from tk.run.session import Summary, estimates
from tk.run.task import RecordingOptions, Task
from tk.trackers.bodies import body_and_poses, read_body
from tk.trackers.headings import turned_pose
from tk.trackers.protocol import Estimate, Frame
from tk.trackers.reason import Reason
from tk.trackers.region import RegionTracker

CONFIG = settings_file.from_toml(QUICK)
COLUMNS = ("frames", "time", "pose", "joints", "sigma", "residual", "status", "objective")


def run(capture: Path, output: Path, reporter: Silent | None = None, **options: Any) -> Summary:
    return track(open_capture(capture), output, CONFIG, reporter, **options)


def task(capture: Path, frames: tuple[int, int]) -> Task:
    return recording_task(open_capture(capture), RecordingOptions(CONFIG, frames=frames))


def assert_same(path: Path, expected: Path, frames: slice = slice(None)) -> None:
    """Bit for bit, times apart, whatever process made them."""
    a, b = read_result(path), read_result(expected)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name)[frames], err_msg=name)
    for name in ("parts/shape", "parts/T_body_part"):
        np.testing.assert_array_equal(a.model[name], b.model[name], err_msg=name)


def mean_error(result: Result, tiny: Path) -> float:
    truth = read_joints(tiny / "truth.h5").positions[result.frames]
    return float(np.linalg.norm(result.joints - truth, axis=2).mean())


@pytest.fixture(scope="module")
def fitted(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a first pass with a fitted body. Not to be changed."""
    path = tmp_path_factory.mktemp("region") / "fitted.h5"
    track(open_capture(tiny), path, settings_file.from_toml(FITTED), frames=(0, 3), causal=True)
    return path


# --- the passes -------------------------------------------------------------------------------------------------------


def test_the_second_pass_replaces_poses(tiny: Path, causal: Path, refined: Path) -> None:
    first, second = read_result(causal), read_result(refined)
    assert first.meta.method == second.meta.method == "region"
    assert REFINED not in first.model and second.model[REFINED] == 1
    for name in ("frames", "time", "status"):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name), err_msg=name)
    assert first.residual is not None and second.residual is not None
    # poses that the motion couples may explain single masks less well, but are nearer to the truth
    assert second.residual.mean() < 1.05 * first.residual.mean()
    assert mean_error(second, tiny) < mean_error(first, tiny)
    assert np.abs(second.pose - first.pose).max() > 1e-3
    # the settings are without a body fit
    np.testing.assert_array_equal(second.model["parts/shape"], first.model["parts/shape"])
    # pictures 160 pixels wide and a hasty fit: the person is found, and no limb is elsewhere
    for result in (first, second):
        assert mean_error(result, tiny) < 0.08
        found = body_and_poses(result)
        assert found is not None
        body, poses = found
        np.testing.assert_allclose([body.skeleton.joints(p) for p in poses], result.joints, atol=1e-9)


def test_a_height_that_only_the_whole_recording_contradicts_makes_all_frames_suspect(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[float, float]] = []

    def contradiction(fitted_m: float, height_m: float) -> str:
        asked.append((fitted_m, height_m))
        return "another height"

    monkeypatch.setattr("tk.run.offline.height_contradiction", contradiction)
    reporter = Silent()
    track(open_capture(tiny), tmp_path / "r.h5", settings_file.from_toml(FITTED), reporter)
    (fitted_m, height_m), result = asked[0], read_result(tmp_path / "r.h5")
    body = body_and_poses(result)
    assert body is not None and fitted_m == pytest.approx(body[0].dimensions.barefoot)
    assert height_m == 1.75
    assert (result.status == Status.SUSPECT).all()
    assert "another height: all frames are suspect" in reporter.notes


def test_the_body_is_fitted_again_although_the_recording_begins_in_the_initialisation_pose(
    tiny: Path, fitted: Path, tmp_path: Path
) -> None:
    result = as_if_killed(fitted, tmp_path / "r.h5")
    track(open_capture(tiny), result, settings_file.from_toml(FITTED), frames=(0, 3), resume=True)
    models = [read_result(path).model for path in (fitted, tmp_path / "r.h5")]
    assert np.abs(models[0]["parts/shape"] - models[1]["parts/shape"]).max() > 1e-4


def pretend(monkeypatch: pytest.MonkeyPatch, *frames: int, **values: Any) -> None:
    """Let the tracker return these values in these frames."""
    step = RegionTracker.step

    def changed(tracker: RegionTracker, frame: Frame) -> Estimate:
        estimate = step(tracker, frame)
        return replace(estimate, **values) if frame.index in frames else estimate

    monkeypatch.setattr(RegionTracker, "step", changed)


def test_result_that_contradicts_its_masks_is_suspect_and_ends_with_exit_code_3(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    returned: list[Estimate] = []

    class Watching(Silent):
        def advance(self, frame: int, estimate: Any) -> None:
            returned.append(estimate)

    pretend(monkeypatch, 0, 1, 2, 3, residual=np.full((4, 2), 0.3))
    reporter = Watching()
    summary = run(tiny, tmp_path / "r.h5", reporter, frames=(0, 4), causal=True)
    assert (summary.frames, summary.suspect, summary.lost) == (4, 4, 0)
    assert [estimate.status for estimate in returned] == ["suspect"] * 4
    result = read_result(tmp_path / "r.h5")
    assert (result.status == Status.SUSPECT).all() and result.has_pose.all()
    assert result.sigma is not None and np.isnan(result.sigma).all()
    assert any("suspect, frames 0 to 3" in note for note in reporter.notes)
    with pytest.raises(SystemExit) as ended:
        end(tmp_path / "r.h5", summary, False, False)
    assert ended.value.code == EXIT_LOST
    assert "4 of 4 frames are lost or suspect" in capsys.readouterr().err.splitlines()[-1]


def test_returned_estimates_are_those_of_the_first_pass_and_keep_no_images(tiny: Path, causal: Path) -> None:
    """Bit for bit. Whoever collects them holds some kilobytes a frame."""
    found = list(estimates(task(tiny, (0, 4))))
    expected = read_result(causal)
    assert [e.frame for e in found] == [0, 1, 2, 3]
    assert [e.status for e in found] == ["initialised"] + 3 * ["tracked"]
    np.testing.assert_array_equal([e.joints for e in found], expected.joints[:4])
    np.testing.assert_array_equal([e.sigma for e in found], np.asarray(expected.sigma)[:4])
    for estimate in found:
        arrays = [value for value in vars(estimate).values() if isinstance(value, np.ndarray)]
        assert len(arrays) >= 5 and sum(map(memory_behind, arrays)) < 10_000


def memory_behind(array: np.ndarray) -> int:
    """Bytes of what an array is a view of, or its own."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array.nbytes if array.base is None else len(memoryview(array.base))


# --- stopped and taken up again ---------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs POSIX signals")
def test_a_killed_causal_run_is_resumed_and_equals_an_uninterrupted_one(
    tk: Tk, quick: Path, tiny: Path, causal: Path, tmp_path: Path
) -> None:
    result = tmp_path / "r.h5"
    frames = 8
    command = ["track", tiny, "-o", result, "--config", quick, "--causal", "--frames", f":{frames}"]
    killed = send(signal.SIGKILL, 3, *command, clock=10.0)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert killed.stdout == ""
    done = len(read_result(result).frames)  # frames that are written together may be more than those reported
    assert 4 <= done < frames
    assert_same(result, causal, slice(0, done))
    ran = tk(*command, "--resume")
    assert ran.code == 0, ran.err
    assert ran.messages[0] == f"note: {done} of {frames} frames are finished already"
    assert ran.err.splitlines()[-1].startswith(f"{frames} frames in {result}, 0 lost")
    assert_same(result, causal, slice(0, frames))
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]  # the killed run's scraps are gone
    again = tk(*command, "--resume")  # nothing is left to do
    assert again.code == 0 and f"{frames} of {frames} frames are finished already" in again.err
    assert_same(result, causal, slice(0, frames))


def test_a_run_killed_in_its_second_pass_repeats_it_on_resume(
    tiny: Path, causal: Path, refined: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """All frames are there, and what follows from all of them is not."""
    result = as_if_killed(causal, tmp_path / "r.h5")
    caplog.set_level(logging.INFO, "tk")
    summary = run(tiny, result, resume=True)
    assert (summary.frames, summary.tracked_now) == (FRAMES, 0) and "second pass" in caplog.text
    assert_same(result, refined)
    assert read_result(result).smoothed is not None
    caplog.clear()
    assert run(tiny, result, resume=True).tracked_now == 0
    assert "second pass" not in caplog.text
    assert_same(result, refined)


def test_a_causal_result_can_be_extended(tiny: Path, fitted: Path, tmp_path: Path) -> None:
    """The body is fitted to the same frames however few are asked for."""
    capture, config, part = open_capture(tiny), settings_file.from_toml(FITTED), tmp_path / "part.h5"
    track(capture, part, config, frames=(0, 1), causal=True)
    assert_same(part, fitted, slice(0, 1))
    track(capture, part, config, frames=(0, 3), resume=True, causal=True)
    assert_same(part, fitted)


def test_a_result_of_the_silhouette_tracker_follows_the_contract_and_can_be_extended(
    tiny: Path, tmp_path: Path
) -> None:
    whole, parts = tmp_path / "whole.h5", tmp_path / "parts.h5"
    summary = run(tiny, whole, method="silhouette", frames=(0, 5))
    assert (summary.frames, summary.lost) == (5, 0)
    run(tiny, parts, method="silhouette", frames=(0, 4))
    assert run(tiny, parts, method="silhouette", frames=(0, 5), resume=True).tracked_now == 1
    result = read_result(whole)
    np.testing.assert_array_equal(read_result(parts).pose, result.pose)
    assert result.meta.method == "silhouette" and mean_error(result, tiny) < 0.08
    assert result.status.tolist() == [Status.INITIALISED] + [Status.TRACKED] * 4
    assert (result.pose.shape, result.iterations.shape) == ((5, 32), (5, 3))
    assert {"decode", "masks", "masks_clean", "optimise", "check", "total"} <= set(result.timing)
    assert np.shape(result.model["parts/shape"]) == (24, 4)


def test_frames_without_anybody_are_counted_apart_and_not_changed_by_the_second_pass(
    tk: Tk, quick: Path, copy: Path, tmp_path: Path
) -> None:
    for camera in (copy / "masks").iterdir():
        for index in (2, 3):
            write_picture(camera / f"{index:06d}.png", np.zeros((120, 160), np.uint8))
    ran = tk("track", copy, "-o", tmp_path / "r.h5", "--config", quick, "--json", "--frames", ":6")
    assert ran.code == 0 and "0 lost, 2 absent" in ran.messages[-1], ran.err
    found = json.loads(ran.out)
    assert (found["frames"], found["lost"], found["absent"]) == (6, 0, 2)
    result = read_result(tmp_path / "r.h5")
    assert result.status.tolist() == [1, 0, Status.ABSENT, Status.ABSENT, Status.RECOVERED, 0]
    assert result.sigma is not None and result.residual is not None
    np.testing.assert_array_equal(np.isnan(result.sigma).all(axis=1), ~result.has_pose)
    np.testing.assert_array_equal(np.isnan(result.residual).all(axis=(1, 2)), ~result.has_pose)
    np.testing.assert_array_equal(np.isfinite(result.joints).all(axis=(1, 2)), result.has_pose)
    assert "fewer than two cameras see anybody: no pose, frames 2 to 3" in result.notes


@pytest.mark.parametrize("causal", [False, True])
def test_frames_without_known_joints_are_reported(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, causal: bool
) -> None:
    pretend(monkeypatch, 2, 3, found=Reason.HIGH)
    reporter = Silent()
    options = {"frames": (0, 6 if causal else 10), "causal": causal}
    assert run(tiny, tmp_path / "r.h5", reporter, **options).lost == 0
    result = read_result(tmp_path / "r.h5")
    assert result.sigma is not None
    first = 2 if causal else 0  # the second pass knows that the residual was high before
    assert np.flatnonzero(np.isnan(result.sigma).all(axis=1)).tolist() == list(range(first, 4))
    (line,) = (note for note in result.notes if "σ is unknown" in note)
    assert line.endswith(f"σ is unknown, frames {first} to 3") and line in reporter.notes
    (text,) = _expected_error(tmp_path / "r.h5")
    assert text.endswith(f" cm (constant offsets included), unknown in {4 - first} frames")
    if causal:  # returned estimates are those of the first pass
        notes: list[str] = []
        assert len(list(estimates(task(tiny, (0, 4)), notes.append))) == 4
        assert any(note.endswith("σ is unknown, frames 2 to 3") for note in notes)


def test_a_person_who_was_tracked_back_to_front_is_tracked_again(
    tiny: Path, unposed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = RegionTracker.start

    def start_turned(tracker: RegionTracker, frames: Sequence[Frame], subject: Subject) -> None:
        start(tracker, frames, subject)
        pose = tracker.world.poses_out(tracker.last_poses()[0][None])[0]
        tracker.start_at(turned_pose(tracker, pose))

    monkeypatch.setattr(RegionTracker, "start", start_turned)
    run(unposed, tmp_path / "proposed.h5", causal=True, frames=(0, 2))
    assert mean_error(read_result(tmp_path / "proposed.h5"), tiny) < 0.08, "the first pass finds the heading by itself"
    monkeypatch.setattr(
        "tk.trackers.region.of_heading", SimpleNamespace(propose=lambda _, __, pose: np.empty((0, len(pose))))
    )
    first, reporters = tmp_path / "first.h5", [Silent(), Silent()]
    run(unposed, first, reporters[0], causal=True, frames=(0, 3))
    second = as_if_killed(first, tmp_path / "second.h5")
    run(unposed, second, reporters[1], frames=(0, 3), resume=True)
    errors = [mean_error(read_result(path), tiny) for path in (first, second)]
    said = [any("faces the other way" in note for note in reporter.notes) for reporter in reporters]
    assert said == [False, True]
    assert errors[0] > 0.2 and errors[1] < 0.08


# --- bodies from files ------------------------------------------------------------------------------------------------


def test_the_body_of_an_earlier_result_is_used_unchanged_and_a_second_pass_ends_a_result(
    tk: Tk, quick: Path, tiny: Path, refined: Path, tmp_path: Path
) -> None:
    result = tmp_path / "r.h5"
    run(tiny, result, body=refined, frames=(0, 2))
    found, expected = read_result(result), read_result(refined)
    np.testing.assert_array_equal(found.model["parts/shape"], expected.model["parts/shape"])
    np.testing.assert_allclose(found.model["dimensions/thigh"], expected.model["dimensions/thigh"])
    assert found.model[REFINED] == 1, "the second pass settles the frames, and leaves the body"
    assert mean_error(found, tiny) < 0.08
    before = result.read_bytes()
    with pytest.raises(ResultError, match=r"a second pass has gone over .* only a causal result"):
        run(tiny, result, body=refined, frames=(0, 4), resume=True)
    assert result.read_bytes() == before
    # nothing to be done is no mistake, and changes nothing
    given = ["--config", quick, "--body", refined]
    ran = tk("track", tiny, "-o", result, *given, "--frames", ":2", "--resume")
    assert ran.code == 0 and "2 of 2 frames are finished already" in ran.err
    assert result.read_bytes() == before


def test_a_body_given_by_dimensions_is_used(tk: Tk, quick: Path, tiny: Path, tmp_path: Path) -> None:
    file = tmp_path / "body.toml"
    file.write_text(tomli_w.dumps({"stature": 1.8, "dimensions": {"thigh": 0.45}}), encoding="utf-8")
    ran = tk("track", tiny, "-o", tmp_path / "r.h5", "--config", quick, "--frames", ":2", "--causal", "--body", file)
    assert ran.code == 0, ran.err
    model = read_result(tmp_path / "r.h5").model
    average = BodyDimensions.from_stature(1.8)
    assert (model["dimensions/thigh"], model["dimensions/calf"]) == pytest.approx((0.45, average.calf))
    body = read_body(file, "-y")
    assert body.dimensions.thigh == 0.45 and body.skeleton.T_world_body[1, 2] == -1
    file.write_text("[dimensions]\nthigh = 0.45\n", encoding="utf-8")
    assert read_body(file, "z").dimensions == replace(AVERAGE_BODY, thigh=0.45)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[dimensions]\nlegs = 1.0\n", ["unknown dimension legs", "thigh"]),
        ("[dimensions]\nthigh = 'long'\n", ["thigh = long", "between 0 and 3"]),
        ("[dimensions]\nthigh = 45\n", ["thigh = 45", "metres"]),
        ("stature = true\n", ["stature = True"]),
        ("dimensions = 3\n", ["dimensions"]),
        ("stature = \n", ["body.toml"]),
    ],
)
def test_unusable_bodies_are_reported_in_one_line(
    tk: Tk, quick: Path, tiny: Path, tmp_path: Path, text: str, parts: list[str]
) -> None:
    file = tmp_path / "body.toml"
    file.write_text(text, encoding="utf-8")
    tk("track", tiny, "-o", tmp_path / "r.h5", "--config", quick, "--body", file).complaint(str(file), *parts)


def test_results_without_a_cone_body_are_refused(
    tk: Tk, quick: Path, tiny: Path, tracked: Path, causal: Path, tmp_path: Path
) -> None:
    command = ["track", tiny, "-o", tmp_path / "r.h5", "--config", quick]
    older = Path(shutil.copy(tracked, tmp_path / "older.h5"))
    with h5py.File(older, "r+") as file:
        del file["people/0/model/parts"]
    tk(*command, "--body", older).complaint("older.h5", "no body of contours", "the method region")
    tk(*command, "--body", tmp_path / "none.h5").complaint("none.h5")
    tk(*command, "--body", tmp_path / "none.toml").complaint("none.toml")
    damaged = Path(shutil.copy(causal, tmp_path / "damaged.h5"))
    with h5py.File(damaged, "r+") as file:
        del file["people/0/model/parts/name"]
    tk(*command, "--body", damaged).complaint("damaged.h5", "the body cannot be used")
    damaged.unlink()
    older.unlink()
    assert list(tmp_path.iterdir()) == []


def test_a_run_with_another_body_is_not_resumed(
    tiny: Path, refined: Path, first_frame: dict[str, Path], tmp_path: Path
) -> None:
    shutil.copy(first_frame["region"], tmp_path / "begun.h5")
    with pytest.raises(ResultError, match=r"given body \(its hash\): none, not "):
        run(tiny, tmp_path / "begun.h5", frames=(0, 4), causal=True, resume=True, body=refined)


# --- how it ends ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["region", "silhouette"])
def test_tracking_starts_from_any_pose_in_any_frame_with_any_seed(copy: Path, tmp_path: Path, method: str) -> None:
    without_first_pose(copy, ("da-vinci", "any"))
    config = settings_file.from_toml(f"seed = 5\n{QUICK}")
    track(open_capture(copy), tmp_path / "r.h5", config, frames=(4, 7), causal=True, method=method)
    found = read_result(tmp_path / "r.h5")
    assert mean_error(found, copy) < 0.08
    assert found.frames.tolist() == [4, 5, 6] and found.status[0] == Status.INITIALISED


def test_the_volumetric_tracker_accepts_and_stores_a_body(
    tiny: Path, causal: Path, tracked: Path, tmp_path: Path
) -> None:
    """One body serves both skins."""
    for method, given in (("volumetric", causal), ("region", tracked)):
        path = tmp_path / f"{method}.h5"
        track(open_capture(tiny), path, CONFIG, method=method, frames=(0, 3), body=given, causal=True)
        found, expected = read_result(path), read_result(given)
        assert not (found.status == Status.LOST).any()
        np.testing.assert_array_equal(found.model["parts/shape"], expected.model["parts/shape"])
        truth = read_joints(tiny / "truth.h5").positions[:3]
        assert np.median(np.linalg.norm(found.joints - truth, axis=2)) < 0.08
