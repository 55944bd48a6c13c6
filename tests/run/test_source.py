"""Sources without a folder: frame sets that are rendered in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import tk
from tests.conftest import EVERY_FRAME, QUICK, Silent, StopAt, refused, run_clock
from tests.model.figures import draw_silhouettes
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, NAMES, STATURE, walk
from tk.errors import CaptureError, ConfigError
from tk.io import settings_file
from tk.io.captures.frames import FrameSet
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.io.results.status import Status
from tk.kernels.mask_values import PERSON
from tk.model.body.angles import UNSEEN
from tk.model.cameras.volume import Volume
from tk.model.setup import InitPose, Setup, Subject
from tk.run import offline
from tk.run.draft import Draft
from tk.run.session import Summary, estimates, track_task
from tk.run.task import Choice, Task, TrackOptions
from tk.trackers.camera_monitor import CameraMonitor
from tk.trackers.protocol import Estimate, Frame
from tk.trackers.region import RegionTracker

SETTINGS = settings_file.from_toml(QUICK.replace("init_frames = 3", "init_frames = 1"))
ONE_POSE = replace(
    SETTINGS,
    region=replace(SETTINGS.region, hypotheses=1),
    silhouette=replace(SETTINGS.silhouette, search_every=0.0),
)
RIG = ring_of_cameras(3, width=160, height=200)
POSES = walk(5)
SETUP = Setup(RIG, Volume((0.0, 0.0, 1.0), (3.0, 3.0, 2.2)), "z", 15.0, (Subject(STATURE, body=BODY),))
LATENCY_S = 0.25


@dataclass(frozen=True)
class Rendered:
    """A source of unknown length, as a live camera is; its clock does not start at 0. Masks are (F, C, H, W)."""

    masks: np.ndarray
    name = where = "rendered"
    first_frame = 0
    frame_count = None
    has_masks = True
    masks_from = "rendered"
    segmenter = None

    @property
    def time_offset_s(self) -> tuple[float, ...]:
        return (0.0,) * self.masks.shape[1]

    def frames(self, start: int = 0, stop: int | None = None) -> AbstractContextManager[Iterator[FrameSet]]:
        scene = np.random.default_rng(0).integers(0, 200, (*self.masks.shape[1:], 3), np.uint8)
        sets = (
            FrameSet(i, LATENCY_S + i / SETUP.fps, np.maximum(scene, masks[..., None]), masks)
            for i, masks in enumerate(self.masks)
        )
        return nullcontext(islice(sets, start, stop))

    def background(self) -> None:
        return None

    def shifted(self, time_offset_s: Sequence[float]) -> None:
        return None

    def damaged(self, stop: int, cameras: NDArray[np.bool_]) -> tuple[()]:
        return ()


@contextmanager
def starting_at(poses: np.ndarray) -> Iterator[None]:
    """Start each tracker at the first pose of its person: of (P, F, D) the one that its masks show most of.

    The search for somebody whose pose is not known takes longer than all else in a short run, and has its own tests.
    """
    start = RegionTracker.start

    def start_there(tracker: RegionTracker, frames: Sequence[Frame], subject: Subject) -> None:
        own = frames[0].masks >= PERSON

        def shown(pose: np.ndarray) -> int:
            joints, (height, width) = BODY.skeleton.joints(pose), own.shape[1:]
            at = [camera.project(joints)[0].round().astype(int) for camera in tracker.rig]
            places = [(y.clip(0, height - 1), x.clip(0, width - 1)) for x, y in (pixels.T for pixels in at)]
            return sum(int(mask[place].sum()) for mask, place in zip(own, places, strict=True))

        start(tracker, frames, replace(subject, init=first_pose(max(poses[:, frames[0].index], key=shown))))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RegionTracker, "start", start_there)
        patch.setattr(RegionTracker, "anticipate", lambda *_: None)
        yield


def first_pose(pose: np.ndarray) -> InitPose:
    return InitPose({}, dict(zip(NAMES, pose, strict=True)), None, STATURE)


def task(setup: Setup, source: Rendered, **options: Any) -> Task:
    """Return the task of tracking a simulated source."""
    return Task(setup, source, TrackOptions(SETTINGS, **options))


ONE = Rendered(draw_silhouettes(BODY, RIG, POSES))


def test_the_public_interface_tracks_a_source_in_memory(tmp_path: Path) -> None:
    assert isinstance(ONE, tk.Source)
    found = list(tk.track(ONE, setup=SETUP, config=SETTINGS, frames=(1, 4)))
    assert [e.frame for e in found] == [1, 2, 3]
    assert [e.time for e in found] == [LATENCY_S + i / SETUP.fps for i in (1, 2, 3)]  # the source's clock
    for estimate, pose in zip(found, POSES[1:], strict=False):
        assert np.linalg.norm(estimate.joints - BODY.skeleton.joints(pose), axis=1).mean() < 0.03

    result = tk.track(ONE, tmp_path / "r.h5", setup=SETUP, config=SETTINGS, causal=True, frames=(1, 4))
    np.testing.assert_array_equal(result.joints, [e.joints for e in found])
    with refused(ConfigError, "rendered", "setup"):
        tk.track(ONE, config=SETTINGS)
    with refused(ConfigError, "body", "only with a capture"):
        tk.track(ONE, setup=SETUP, body="body.toml")


def test_a_source_of_unknown_length_is_written_until_it_ends_and_the_second_pass_needs_no_folder(
    tmp_path: Path,
) -> None:
    summary = track_task(task(SETUP, ONE), tmp_path / "r.h5", Silent())
    result = read_result(tmp_path / "r.h5")
    assert summary.frames == len(result.frames) == len(POSES) and summary.lost == 0
    assert result.meta.capture == "rendered" and result.smoothed is not None
    np.testing.assert_allclose(result.time, LATENCY_S + np.arange(len(POSES)) / SETUP.fps)

    expected = np.array([BODY.skeleton.joints(pose) for pose in POSES])
    assert np.linalg.norm(result.joints - expected, axis=2).mean() < 0.03
    # no network has seen the face
    assert not result.pose[:, result.meta.pose_names.index("neck_roll")].any()
    np.testing.assert_array_equal(np.isnan(result.angles["neck"]), [[False, False, True]] * len(result))
    assert [joint.unmeasured for joint in result.meta.angles if joint.unmeasured] == [f"rotation: {UNSEEN}"]


# --- nobody is there yet ----------------------------------------------------------------------------------------------

EMPTY = 3
LATE = Rendered(np.concatenate([0 * ONE.masks[:EMPTY], ONE.masks]))
LATE_POSES = np.concatenate([POSES[:EMPTY], POSES])[None]


def track_late(path: Path, reporter: Silent, setup: Setup = SETUP, resume: bool = False, **options: Any) -> Summary:
    with starting_at(LATE_POSES):
        return track_task(task(setup, LATE, **options), path, reporter, resume=resume)


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """A run that begins with the first frame with somebody."""
    path = tmp_path_factory.mktemp("begun") / "r.h5"
    any_pose = replace(SETUP, subjects=(replace(SETUP.subjects[0], in_init_pose=False),))
    track_late(path, Silent(), any_pose, frames=(EMPTY, None))
    return read_result(path)


@pytest.mark.parametrize("people", ["auto", (0,)])
def test_frames_before_the_first_person_are_absent_and_the_others_as_if_tracking_began_there(
    begun: Result, tmp_path: Path, people: Choice
) -> None:
    reporter, late = Silent(), tmp_path / "late.h5"
    summary = track_late(late, reporter, people=people)
    result = read_result(late)
    assert (result.status == Status.ABSENT).tolist() == EMPTY * [True] + len(POSES) * [False]
    assert summary.present == len(POSES) and reporter.frames == list(range(EMPTY + len(POSES)))
    assert reporter.notes == [f"frame {EMPTY}: the first person has entered"]
    for name in ("pose", "joints", "sigma", "status"):
        np.testing.assert_array_equal(getattr(result, name)[EMPTY:], getattr(begun, name), err_msg=name)
    assert np.isfinite(result.joints).any(axis=(1, 2)).tolist() == EMPTY * [False] + len(POSES) * [True]


@pytest.mark.parametrize("stop", [EMPTY - 2, EMPTY + 1])
def test_a_run_that_began_with_an_empty_volume_is_resumed(
    begun: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    run_clock(monkeypatch, EVERY_FRAME)
    part = tmp_path / "part.h5"
    stopped = track_late(part, StopAt(stop))
    # frames are in the file from the first person on; before, there is none
    assert (stopped.interrupted, stopped.frames) == (True, stop + 1 if stop >= EMPTY else 0)
    assert part.exists() == (stop >= EMPTY) and len(list(tmp_path.iterdir())) == (2 if part.exists() else 0)
    track_late(part, Silent(), resume=True)
    result = read_result(part)
    assert (result.status[:EMPTY] == Status.ABSENT).all()
    for name in ("pose", "status", "sigma"):
        np.testing.assert_array_equal(getattr(result, name)[EMPTY:], getattr(begun, name))


def test_a_run_that_fails_in_a_step_between_two_writes_is_resumed(
    begun: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, path = RegionTracker.step, tmp_path / "r.h5"

    def fail(tracker: RegionTracker, frame: Frame) -> Estimate:
        estimate = step(tracker, frame)
        if frame.index == EMPTY + 3:
            raise CaptureError("broken")
        return estimate

    run_clock(monkeypatch, 1e-9)  # only the first frame is written by itself
    any_pose = replace(SETUP, subjects=(replace(SETUP.subjects[0], in_init_pose=False),))
    with monkeypatch.context() as patched, refused(CaptureError, "broken"):
        patched.setattr(RegionTracker, "step", fail)
        track_late(path, Silent(), any_pose, frames=(EMPTY, None))
    assert len(read_result(path)) == 3
    track_late(path, Silent(), any_pose, resume=True, frames=(EMPTY, None))
    for name in ("frames", "pose", "status", "sigma"):
        np.testing.assert_array_equal(getattr(read_result(path), name), getattr(begun, name))


def test_nobody_in_any_frame_is_an_error_that_leaves_no_file(tmp_path: Path) -> None:
    with refused(CaptureError, "nobody could be tracked: the working volume is empty"):
        track_task(task(SETUP, LATE, frames=(0, EMPTY)), tmp_path / "r.h5", Silent())
    assert not list(tmp_path.iterdir())
    with refused(CaptureError, "the working volume is empty"):
        list(estimates(task(SETUP, LATE, frames=(0, EMPTY))))


def test_a_start_that_fails_after_somebody_has_entered_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    start, attempts, refused_in = RegionTracker.start, [], [EMPTY]

    def refuse(tracker: RegionTracker, frames: Sequence[Frame], subject: Subject) -> None:
        attempts.append(frames[0].index)
        if frames[0].index in refused_in:
            raise CaptureError("half a person")
        start(tracker, frames, subject)

    monkeypatch.setattr(RegionTracker, "start", refuse)
    slow = replace(SETUP, fps=4.0)  # attempts are half a second apart
    with starting_at(LATE_POSES):
        found = list(estimates(task(slow, LATE)))
    assert [e.status for e in found][:6] == EMPTY * ["absent"] + 2 * ["lost"] + ["initialised"]
    assert attempts == [EMPTY, EMPTY + 2]
    refused_in += range(len(found))
    with refused(CaptureError, "nobody could be tracked: half a person"):
        list(estimates(task(slow, LATE)))


# --- two people -------------------------------------------------------------------------------------------------------

COUNT = 4
# person 1 stands where some cameras see him behind person 0
BOTH = np.array([walk(COUNT), walk(COUNT, first=0.4)])
BOTH[:, :, :2] += [[[0.35, -0.05]], [[-0.35, 0.05]]]
JOINTS = np.array([[BODY.skeleton.joints(pose) for pose in poses] for poses in BOTH])
FOUR = ring_of_cameras(4, width=160, height=200)
MASKS = np.array([draw_silhouettes(BODY, FOUR, poses) for poses in BOTH])
PAIR = replace(SETUP, rig=FOUR, subjects=(Subject(STATURE, body=BODY, in_init_pose=False),) * 2)
# the same with their first poses, which saves the search for them
POSED = replace(PAIR, subjects=tuple(replace(PAIR.subjects[0], init=first_pose(poses[0])) for poses in BOTH))


def far_off(joints: np.ndarray, person: int) -> float:
    """Return the mean distance from a person's joints, metres."""
    return float(np.linalg.norm(joints - JOINTS[person][: len(joints)], axis=2).mean())


def test_silhouettes_of_the_pair_overlap() -> None:
    assert np.count_nonzero((MASKS[0] & MASKS[1]).any(axis=(0, 2, 3))) >= 2


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, ...]:
    """Both people, tracked in one go."""
    path = tmp_path_factory.mktemp("pair") / "r.h5"
    track_task(task(POSED, Rendered(MASKS.max(axis=0)), people="all"), path, Silent())
    return read_result(path).people


def test_two_people_are_tracked_and_kept_apart(pair: tuple[Result, ...]) -> None:
    assert len(pair) == 2
    assert sorted(person for r in pair for person in (0, 1) if far_off(r.joints, person) < 0.03) == [0, 1]
    assert not any((r.status == Status.LOST).any() for r in pair)


def test_a_run_stopped_among_the_frames_and_among_the_second_passes_is_finished(
    pair: tuple[Result, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop_at_person_1(finisher: Any, draft: Draft) -> Any:
        if draft.person.number == 1:
            raise KeyboardInterrupt
        return finish_one(finisher, draft)

    def track(reporter: Silent, resume: bool = True) -> tuple[Result, ...]:
        run = task(POSED, Rendered(MASKS.max(axis=0)), frames=(0, COUNT), people="all")
        track_task(run, tmp_path / "r.h5", reporter, resume=resume)
        return read_result(tmp_path / "r.h5").people

    run_clock(monkeypatch, EVERY_FRAME)
    finish_one = offline._Finisher.revision
    assert len(track(StopAt(2), resume=False)[0].frames) < COUNT
    with monkeypatch.context() as patch:
        patch.setattr(offline._Finisher, "revision", stop_at_person_1)
        stopped = track(Silent())
    assert stopped[0].smoothed is None and stopped[1].smoothed is None, "the file is rewritten once, at the end"
    for a, b in zip(track(Silent()), pair, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)
        np.testing.assert_array_equal(a.status, b.status)
        assert a.smoothed is not None


def test_a_bystander_is_no_part_of_the_subject() -> None:
    notes: list[str] = []
    found = list(estimates(task(POSED, Rendered(MASKS.max(axis=0)), frames=(0, 2), people=(0,)), notes.append))
    assert {e.person for e in found} == {0} and "lost" not in {e.status for e in found}
    joints = np.array([e.joints for e in found])
    assert min(far_off(joints, who) for who in (0, 1)) < 0.04
    assert not notes


def test_the_subject_position_chooses_the_person() -> None:
    for person in (0, 1):
        near = replace(PAIR.subjects[0], position=JOINTS[person][0, 0] + 0.1)
        notes: list[str] = []
        near_task = task(replace(PAIR, subjects=(near,)), Rendered(MASKS.max(axis=0)), frames=(0, 1))
        with starting_at(BOTH):
            (found,) = estimates(near_task, notes.append)
        assert any("2 people are in view" in note for note in notes)
        assert far_off(found.joints[None], person) < 0.1


def test_a_number_that_nobody_gets_is_an_error_or_a_note(tmp_path: Path) -> None:
    source = Rendered(MASKS.max(axis=0))
    with starting_at(BOTH), refused(CaptureError, "person 2 did not enter the working volume"):
        track_task(task(POSED, source, people=(2,), frames=(0, 1)), tmp_path / "r.h5", Silent())
    assert not list(tmp_path.iterdir())
    reporter = Silent()
    with starting_at(BOTH):
        track_task(task(POSED, source, people=(2, 1), causal=True, frames=(0, 1)), tmp_path / "r.h5", reporter)
    (found,) = read_result(tmp_path / "r.h5").people
    assert min(far_off(found.joints, who) for who in (0, 1)) < 0.04
    assert reporter.notes == [
        "person 2 is not in the working volume in frame 0, and is awaited",
        "person 2 did not enter the working volume",
    ]


ENTERING = 13  # frames; person 1 is there in frames 1 to 11
ENTER = np.array([walk(ENTERING), walk(ENTERING, first=0.4)])
ENTER[:, :, :2] += [[[0.55, -0.05]], [[-0.55, 0.05]]]  # apart: each frame takes half the time


def track_entering(
    path: Path, people: Choice = "all", stop: int | None = None, resume: bool = False, fps: float = 4.0
) -> tuple[Result, ...]:
    """Return the results of two people of whom one enters and leaves."""
    masks = np.array([draw_silhouettes(BODY, FOUR, own) for own in ENTER])
    masks[1, :1] = masks[1, 12:] = 0
    setup = replace(PAIR, fps=fps, subjects=PAIR.subjects[:1])
    options = TrackOptions(ONE_POSE, people=people, causal=True, frames=(0, stop))
    with starting_at(ENTER):
        track_task(Task(setup, Rendered(masks.max(axis=0)), options), path, Silent(), resume=resume)
    return read_result(path).people


@pytest.fixture(scope="module")
def everybody(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, ...]:
    """Both people."""
    return track_entering(tmp_path_factory.mktemp("entering") / "r.h5")


def test_somebody_who_enters_gets_a_number_and_who_leaves_is_absent(everybody: tuple[Result, ...]) -> None:
    first, second = everybody
    assert not (first.status >= Status.LOST).any()
    (here,) = np.nonzero(second.status != Status.ABSENT)
    np.testing.assert_array_equal(here, np.arange(here[0], 12))
    assert 1 < here[0] < 11 and not (second.status == Status.LOST).any()
    for own, result in zip(ENTER, (first, second), strict=True):
        np.testing.assert_array_equal(result.frames, np.arange(ENTERING))
        joints = np.array([BODY.skeleton.joints(pose) for pose in own])
        assert np.nanmedian(np.linalg.norm(result.joints - joints, axis=2)) < 0.1  # coarse settings


def test_cameras_that_were_moved_show_nobody_who_enters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their masks contain pieces of the scene, which make somebody of what one other camera shows."""
    monkeypatch.setattr(CameraMonitor, "unfit", np.array([False, True, True, True]))
    assert len(track_entering(tmp_path / "r.h5", stop=9)) == 1


def test_somebody_who_enters_later_can_be_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start, subjects = RegionTracker.start, list[Subject]()

    def watch(tracker: RegionTracker, frames: Sequence[Frame], subject: Subject) -> None:
        subjects.append(subject)
        start(tracker, frames, subject)

    monkeypatch.setattr(RegionTracker, "start", watch)
    (found,) = track_entering(tmp_path / "r.h5", (1,), stop=10)
    np.testing.assert_array_equal(found.frames, np.arange(10))
    (here,) = np.nonzero(found.status != Status.ABSENT)
    assert 1 < here[0] < 10 and not (found.status == Status.LOST).any()
    np.testing.assert_array_equal(np.isfinite(found.pose).all(axis=1), found.status != Status.ABSENT)
    np.testing.assert_array_equal(here, np.arange(here[0], 10))
    joints = np.array([BODY.skeleton.joints(pose) for pose in ENTER[1][here]])
    assert np.median(np.linalg.norm(found.joints[here] - joints, axis=2)) < 0.1  # coarse settings
    assert [subject.body for subject in subjects] == [None, BODY]  # the subject is the one who is chosen


def test_a_run_with_somebody_who_enters_later_is_resumed(everybody: tuple[Result, ...], tmp_path: Path) -> None:
    """Stopped before, and after the person enters; people are in the order in which they came."""
    path, people, end = tmp_path / "part.h5", (1, 0), 10
    for stop in (1, 9):
        track_entering(path, people, stop, resume=stop != 1)
    for one, other in zip(track_entering(path, people, end, resume=True), everybody, strict=True):
        assert (other.status[:end] != Status.ABSENT).any()
        np.testing.assert_array_equal(one.frames, other.frames[:end])
        np.testing.assert_array_equal(one.pose, other.pose[:end])
        np.testing.assert_array_equal(one.status, other.status[:end])
        # what was said before the stop, and after it
        assert [note for note in one.notes if "entered" in note or "awaited" in note] == [
            "person 1 is not in the working volume in frame 0, and is awaited",
            "frame 8: person 1 has entered",
        ]


def test_attempts_to_track_somebody_who_is_refused_are_twice_as_far_apart_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, attempts = RegionTracker.start, []

    def refuse_others(tracker: RegionTracker, frames: Sequence[Frame], subject: Subject) -> None:
        attempts.append(frames[0].index)
        if len(attempts) > 1:
            raise CaptureError("half a person")
        start(tracker, frames, subject)

    monkeypatch.setattr(RegionTracker, "start", refuse_others)
    found = track_entering(tmp_path / "r.h5", stop=11, fps=2.0)
    assert len(found) == 1 and attempts == [0, 7, 8, 10]  # from the eighth frame on
