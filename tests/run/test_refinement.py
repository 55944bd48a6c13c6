"""`tk calibrate --refine` and what `tk track` does by itself: cameras that are off, a video that is late."""

from __future__ import annotations

import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from tests.conftest import FITTED, QUICK, Silent, Tk, as_if_killed, track
from tests.inspection.test_checks import turn_camera
from tests.model.figures import BODY, draw_silhouettes
from tests.model.ring import ring_of_cameras
from tests.walkers import RIG, stroll
from tk.io import settings_file
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.mask_store import MaskStore
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.kernels.mask_values import OTHERS
from tk.model.cameras.bundle import TrackedPerson
from tk.model.cameras.camera import Rig
from tk.model.cameras.refinement import turn_between
from tk.run import offline as finish
from tk.run.delays import retimed, retimed_measured, whole_delays
from tk.run.draft import Draft
from tk.run.refined_calibration import refine_capture
from tk.run.refinement import BetterCameras
from tk.settings import Settings
from tk.trackers.camera_monitor import CameraMonitor
from tk.trackers.protocol import Estimate, Frame
from tk.trackers.reason import Reason

TURNED = 1.0  # degrees, of cam2; a camera with a larger error is excluded


@pytest.fixture(scope="module")
def turned(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny capture, its second camera turned by :data:`TURNED` degrees about its vertical."""
    return with_turned_camera(tiny, tmp_path_factory.mktemp("turned"), TURNED)


@pytest.fixture(scope="module")
def turned_more(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, turned so far that the camera is excluded."""
    return with_turned_camera(tiny, tmp_path_factory.mktemp("turned"), 1.5 * TURNED)


def with_turned_camera(tiny: Path, parent: Path, degrees: float) -> Path:
    folder = Path(shutil.copytree(tiny, parent / "capture"))
    turn_camera(folder, 1, degrees)
    return folder


@pytest.fixture(scope="module")
def run(turned: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Silent]:
    """A result, and what was said."""
    path, reporter = tmp_path_factory.mktemp("results") / "result.h5", Silent()
    assert track(open_capture(turned), path, settings_file.from_toml(QUICK), reporter, frames=(0, 11)).lost == 0
    return path, reporter


def turns(one: Rig, other: Rig) -> np.ndarray:
    """(C,) degrees between the cameras of two rigs."""
    return np.array([turn_between(a, b) for a, b in zip(one, other, strict=True)])


def test_tracking_refines_cameras_that_disagree(run: tuple[Path, Silent], turned: Path, tiny: Path) -> None:
    path, reporter = run
    said = [note for note in reporter.notes if "the cameras disagreed" in note]
    assert len(said) == 1 and "px off" in said[0]
    used = read_result(path).cameras
    assert used is not None
    true, given = open_capture(tiny).rig, open_capture(turned).rig
    assert turns(used.rig, true).max() < 0.75 * turns(given, true).max()


def test_refine_writes_a_calibration(
    run: tuple[Path, Silent], turned: Path, tiny: Path, tk: Tk, tmp_path: Path
) -> None:
    path, _ = run
    output = tmp_path / "refined.toml"
    ran = tk("calibrate", turned, "--refine", path, "-o", output, "--trust", "4")
    assert ran.code == 0 and "cam2" in ran.out and "±" in ran.out, ran.err
    true, given = open_capture(tiny).rig, open_capture(turned).rig
    refined = read_calibration(output)
    assert turns(refined.rig, true).max() < 0.75 * turns(given, true).max()
    assert len(refined.time_offset_s) == len(given)
    tk("calibrate", turned, "--refine", path, "-o", output).complaint(str(output), "--force")


def test_reduced_images_refine_the_recorded_cameras(run: tuple[Path, Silent], turned: Path, tmp_path: Path) -> None:
    capture = open_capture(turned)
    config = replace(Settings(), ahead=0, person_pixels=int(capture.setup().person_pixels().min() / 2))
    refine_capture(capture, run[0], tmp_path / "refined.toml", config, lambda _: None)
    for refined, given in zip(read_calibration(tmp_path / "refined.toml").rig, capture.rig, strict=True):
        assert (refined.width, refined.height) == (given.width, given.height)
        np.testing.assert_allclose(refined.matrix, given.matrix, rtol=0.02)


def test_cameras_that_were_moved_are_not_compared(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[np.ndarray] = []

    def compare(people: list[TrackedPerson], *_: Any) -> None:
        (person,) = people
        seen.append(np.array([person.masks(frame).any(axis=(1, 2)) for frame in person.frames.tolist()]))

    monkeypatch.setattr(finish, "compare_cameras", compare)
    monkeypatch.setattr(CameraMonitor, "moved", np.array([False, True, False, False]))
    track(open_capture(tiny), tmp_path / "moved.h5", settings_file.from_toml(QUICK), Silent(), frames=(0, 2))
    assert (seen[0] == [True, False, True, True]).all()


@pytest.mark.parametrize("better", [[True], [False, True]])
def test_late_videos_are_tracked_again_unless_the_poses_follow(
    better: list[bool], tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With invented delays: which frames are tracked again, and that every frame keeps its row."""
    asked: list[np.ndarray] = []
    again = len(better) > 1

    def made_up(people: Any, rig: Rig, *_: Any) -> Any:
        return BetterCameras(rig, np.array([0.0, 0.0, 1.0, -1.0]), "refined")

    read = Capture.frames

    def remember(capture: Capture, *more: Any) -> Any:
        asked.append(np.array(capture.late_frames))
        return read(capture, *more)

    monkeypatch.setattr(finish, "refine_if_inconsistent", made_up)
    monkeypatch.setattr(finish, "explains_better", lambda *_: better.pop(0))
    monkeypatch.setattr(Capture, "frames", remember)
    path, reporter = tmp_path / "again.h5", Silent()
    assert track(open_capture(tiny), path, settings_file.from_toml(QUICK), reporter, frames=(2, 12)).lost == 0
    assert [late.tolist() for late in asked] == [[0, 0, 0, 0], [0, 0, 1, -1]][: 1 + again]
    assert any("tracking again" in note for note in reporter.notes) == again
    result = read_result(path)
    assert result.frames.tolist() == list(range(2, 12)) and (result.status != Status.LOST).all()
    assert result.cameras is not None
    np.testing.assert_allclose(result.cameras.time_offset_s * open_capture(tiny).fps, [0, 0, 1, -1])
    # a camera that is late or early has no mask at an end
    assert result.residual is not None
    assert np.isnan(result.residual[[0, -1], [2, 3]]).all() and np.isfinite(result.residual[1:-1, :2]).all()


def test_delays_that_explain_the_images_worse_are_not_used(
    tiny: Path, causal: Path, refined: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The videos are synchronous; a delay of three frames is invented."""

    def made_up(people: Any, rig: Rig, *_: Any) -> Any:
        return BetterCameras(rig, np.array([0.0, 0.0, 3.0, 0.0]), "refined")

    settings, path, reporter = settings_file.from_toml(QUICK), as_if_killed(causal, tmp_path / "again.h5"), Silent()
    monkeypatch.setattr(finish, "refine_if_inconsistent", made_up)
    assert track(open_capture(tiny), path, settings, reporter, resume=True).tracked_now == 0
    result = read_result(path)
    assert reporter.notes == [] and result.cameras is not None and not result.cameras.time_offset_s.any()
    np.testing.assert_array_equal(result.joints, read_result(refined).joints)


def test_excluded_camera_is_used_after_the_refinement(turned_more: Path, tiny: Path, tmp_path: Path) -> None:
    path, reporter = tmp_path / "r.h5", Silent()
    track(open_capture(turned_more), path, settings_file.from_toml(FITTED), reporter, frames=(0, 11))
    assert any("cam2" in note and "left out of frames 0 to 10" in note for note in reporter.notes)
    assert "tracked again: no camera is left out" in reporter.notes
    result, truth = read_result(path), read_joints(tiny / "truth.h5").positions[:11]
    assert result.residual is not None and np.isfinite(result.residual).all()
    assert np.linalg.norm(result.joints - truth, axis=-1).mean() < 0.05


def test_result_without_a_body_and_bad_options_are_refused(tiny: Path, tracked: Path, tk: Tk, tmp_path: Path) -> None:
    output = tmp_path / "refined.toml"
    bare = tmp_path / "bare.h5"
    shutil.copy(tracked, bare)
    with h5py.File(bare, "r+") as file:
        del file["people/0/model"]
    tk("calibrate", tiny, "--refine", bare, "-o", output).complaint(str(bare), "no body with contours")
    tk("calibrate", tiny, "--refine", tracked, "-o", output, "--trust", "0").complaint("trust = 0")
    assert not output.exists()


@pytest.mark.parametrize("away", [range(0), range(10, 14)])
@pytest.mark.parametrize("late", [[0, 0, 0, 0], [0, 2, 0, 0], [0, 0, -3, 0]])
def test_videos_that_are_late_by_more_than_edges_reach_are_found(late: list[int], away: range) -> None:
    frames = np.arange(24)
    poses = stroll(0.08 * frames - 1.0, 12)
    drawn = draw_silhouettes(BODY, RIG, poses)  # frame k of a late video shows frame k + late of the others
    drawn[:, 3, ::3] = 0  # this camera's masks are poor
    drawn[away] = 0
    seen = np.array([[drawn[min(max(k + n, 0), 23), c] for c, n in enumerate(late)] for k in frames])
    tracked = TrackedPerson(BODY, seen.__getitem__, frames, poses, seen.any(axis=(2, 3)).all(axis=1))
    assert whole_delays([tracked], RIG).tolist() == late


@pytest.mark.parametrize(("count", "found"), [(56, [0, 12, 0, 0]), (24, [0, 0, 0, 0])])
def test_delay_at_the_edge_of_the_range_is_searched_farther_and_never_taken(count: int, found: list[int]) -> None:
    """A video is twelve frames late. In 24 frames, no delay of that size can be tested."""
    frames = np.arange(count)
    poses = stroll(0.03 * frames - 0.8, 31)
    drawn = draw_silhouettes(BODY, RIG, poses)
    seen = np.array([[drawn[min(k + n, count - 1), c] for c, n in enumerate((0, 12, 0, 0))] for k in frames])
    tracked = TrackedPerson(BODY, seen.__getitem__, frames, poses, np.ones(count, np.bool_))
    assert whole_delays([tracked], RIG).tolist() == found


def test_an_excluded_camera_is_not_late() -> None:
    """From some frame on it shows the person in few pixels only, and the body covers many times as many others."""
    frames = np.arange(40)
    poses = stroll(0.03 * frames - 0.6, 12)
    seen = draw_silhouettes(BODY, RIG, poses)
    aside = np.roll(seen[24:, 1], 50, axis=2)  # the camera is turned
    seen[24:, 1] = np.where(aside > 0, OTHERS, 0)
    seen[24:, 1, 50:54, 70:74] = 255
    tracked = TrackedPerson(BODY, seen.__getitem__, frames, poses, np.ones(40, np.bool_))
    assert whole_delays([tracked], RIG).tolist() == [0, 0, 0, 0]


def test_masks_of_late_cameras_come_from_other_frames() -> None:
    store = MaskStore()
    for frame in range(4):
        store.put(frame, (np.arange(8) == frame).astype(np.uint8)[None, None] * np.full((3, 2, 1), 255, np.uint8))
    late = retimed(store, np.arange(4), np.array([0, 1, -2]))
    for frame in range(4):
        shown = [np.flatnonzero(mask[0]).tolist() for mask in late.get(frame)]
        assert shown == [[frame], [frame - 1] if frame >= 1 else [], [frame + 2] if frame < 2 else []]
    assert retimed(store, np.arange(4), np.zeros(3, np.int64)) is store


def test_landmarks_of_late_cameras_come_from_other_frames() -> None:
    frames = np.array([3, 4, 5, 7])  # frame 6 was not tracked
    landmarks = np.broadcast_to(frames[:, None, None, None], (4, 3, 2, 3)).astype(np.float64)
    late = retimed_measured(landmarks, frames, np.array([0, 1, -2]))
    assert late is not None and late.shape == landmarks.shape
    np.testing.assert_array_equal(late[:, 0, 0, 0], [3, 4, 5, 7])
    np.testing.assert_array_equal(late[:, 1, 1, 2], [np.nan, 3, 4, np.nan])
    np.testing.assert_array_equal(late[:, 2, 0, 1], [5, np.nan, 7, np.nan])
    assert retimed_measured(landmarks, frames, np.zeros(3, np.int64)) is landmarks


def judged(
    displacement: list[float], sigma: float = 0.01, blind: int = 0, first: Reason = Reason.NONE
) -> tuple[Any, list[str]]:
    """Return the draft, and the notes, of frames with displacements of body and mask in four cameras, of which the
    last ones saw nobody."""
    F, notes = len(displacement), list[str]()
    half = np.array(displacement)[:, None, None] / 2 * np.ones((F, 4, 2))
    half[:, 4 - blind :] = np.nan
    columns = {
        "residual": half,
        "evidence/sigma": np.full((F, 15), sigma),
        "joints/position": np.zeros((F, 15, 3)),
        "evidence/reason": np.full(F, first, np.uint8),
        "evidence/found": np.zeros(F, np.uint8),
        "evidence/origin": np.array([Status.RECOVERED, *(F - 1) * [Status.TRACKED]], np.uint8),
    }
    result: Any = SimpleNamespace(frames=np.arange(F), **dict.fromkeys(finish.COLUMNS.values()))
    nobody: Any = None
    draft = Draft(nobody, result, nobody, np.zeros(F, np.bool_), np.zeros(F, np.bool_), columns, refined=True)
    task: Any = SimpleNamespace(settings=Settings())
    finish._Finisher(task, True, notes.append, lambda _: None, RIG)._judge(draft)
    finish.report_frames(result.frames, draft.current("evidence/reason"), notes.append)
    return draft, notes


def test_frame_that_is_judged_again_has_the_sigma_of_the_first_pass() -> None:
    draft, notes = judged(20 * [0.05], sigma=0.2, first=Reason.CONTRADICTED)
    assert not draft.columns["evidence/reason"].any() and notes == []
    np.testing.assert_array_equal(draft.columns["joints/sigma"], 0.2)
    again, _ = judged(20 * [0.6], sigma=0.2)
    assert np.isnan(again.columns["joints/sigma"]).all() and (again.columns["evidence/sigma"] == 0.2).all()
    assert (again.columns["status"] == Status.SUSPECT).all()


def test_person_who_is_tracked_again_by_another_tracker_is_judged_as_in_the_first_pass() -> None:
    rig, zeros, masks = ring_of_cameras(4, 8, 6), np.zeros((4, 6, 8), np.uint8), MaskStore()
    for frame in range(6):
        masks.put(frame, zeros)

    class Recorded:
        def frames(self, begin: int, stop: int) -> Any:
            images = np.zeros((4, 6, 8, 3), np.uint8)
            return nullcontext(SimpleNamespace(index=i, halved=images, time=0.0) for i in range(begin, stop))

    class Jumping:
        tracks_among_others, image_step, has_second_pass = False, 1, True

        def step(self, frame: Frame) -> Estimate:
            at = np.full((15, 3), 9.0 if frame.index == 3 else 0.0)
            whole, none = np.full((4, 2), 0.02), np.zeros(1, np.int32)
            return Estimate(np.zeros(5), at, Status.TRACKED, 0.0, none, {}, deviation=np.full(15, 0.01), residual=whole)

    draft, _ = judged(6 * [0.05])
    given = {"pose": np.zeros((6, 5)), "objective": np.zeros(6), "evidence/camera": np.zeros((6, 4), np.uint8)}
    status = np.array([0, 0, 0, 0, 0, Status.ABSENT], np.uint8)
    result: Any = SimpleNamespace(**{**vars(draft.result), "status": status})
    tracker: Any = Jumping()
    draft = replace(draft, tracker=tracker, masks=masks, result=result, columns=draft.columns | given)
    task: Any = SimpleNamespace(settings=Settings(), source=Recorded(), setup=SimpleNamespace(rig=rig, fps=15.0))
    finisher = finish._Finisher(task, True, print, lambda _: None, rig)
    found = finisher._tracked_by(tracker, draft, np.zeros((6, 4), np.bool_))
    assert found.lost.tolist() == [False, False, False, True, False, False]
    assert found.columns["evidence/found"].tolist() == [0, 0, 0, Reason.JUMPS, 0, 0]
    assert (found.columns["joints/position"][3] == 9.0).all()


def test_cameras_from_opposite_sides_leave_sigma_unknown_and_are_named_as_the_cause() -> None:
    draft, (note,) = judged(20 * [0.05], blind=3)
    assert np.isnan(draft.columns["joints/sigma"]).all()
    assert draft.columns["status"].tolist() == [Status.RECOVERED, *19 * [Status.TRACKED]]
    assert (draft.columns["evidence/sigma"] == 0.01).all()
    assert "from opposite sides" in note and "frames 0 to 19" in note
    assert judged(20 * [0.05], blind=2)[1] == []
