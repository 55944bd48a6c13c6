"""The camera monitor: cameras that are wrong in some frames, a person who is absent, impossible poses."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.conftest import FITTED, FRAMES
from tests.model.landmarks import landmarks_of
from tests.trackers.walker import BODY, walk
from tk.errors import CaptureError
from tk.io import settings_file
from tk.io.captures.capture import Capture, open_capture
from tk.io.results.codec import decode, encode
from tk.io.results.reader import read_joints
from tk.io.results.status import Status
from tk.model.body.joint_sigma import CHANGING_M
from tk.model.cameras.camera import Rig
from tk.model.cameras.common_view import LEAST_INFORMATION, depth_information
from tk.model.masks.mask_agreement import Agreement
from tk.model.setup import Subject
from tk.trackers.camera_monitor import CameraMonitor, MonitorState, opening_agreement
from tk.trackers.judgement import FAULTS, STATES
from tk.trackers.protocol import Estimate, Frame
from tk.trackers.reason import Reason, report_frames
from tk.trackers.region import RegionTracker
from tk.trackers.volumetric import VolumetricTracker

CONFIG = settings_file.from_toml(FITTED)
Spoil = Callable[[Frame], Frame]


class Scene:
    """The tiny capture's frames, and a tracker that was started on them once."""

    def __init__(self, folder: Path) -> None:
        self.capture: Capture = open_capture(folder)
        self.setup = self.capture.setup()
        with self.capture.frames() as frames:
            self.frames = [Frame(f.index, f.images.copy(), np.array(f.masks)) for f in frames]
        self.truth = read_joints(folder / "truth.h5").positions
        tracker = self._tracker()
        tracker.start(self.frames[: tracker.opening_frames], Subject(self.capture.subject_height_m))
        self.model, self.state = tracker.model(), tracker.state

    def _tracker(self) -> RegionTracker:
        return RegionTracker(self.capture.rig, self.capture.up, CONFIG.silhouette, CONFIG.region)

    def monitor(self) -> CameraMonitor:
        tracker = self._tracker()
        tracker.take_model(self.model)
        tracker.state = self.state
        return CameraMonitor(tracker, self.setup, self.setup.subjects[0])

    def follow(self, spoil: Spoil, count: int = FRAMES) -> tuple[CameraMonitor, list[Estimate], list[np.ndarray]]:
        """The first frames, spoilt; the estimates, and which cameras were used in each."""
        monitor = self.monitor()
        steps = [monitor.step(spoil(frame)) for frame in self.frames[:count]]
        return monitor, [e for e, _ in steps], [used.masks.any(axis=(1, 2)) for _, used in steps]

    def lines(self, estimates: list[Estimate]) -> list[str]:
        """What the user reads about frames."""
        lines: list[str] = []
        report_frames(range(len(estimates)), [e.reason for e in estimates], lines.append)
        return lines

    def error(self, estimates: list[Estimate], first: int = 0) -> float:
        """The largest mean error of a frame from the first one on, m."""
        found = np.array([estimate.joints for estimate in estimates])[first:]
        return float(np.linalg.norm(found - self.truth[first : len(estimates)], axis=2).mean(axis=1).max())


@pytest.fixture(scope="module")
def scene(tiny: Path) -> Scene:
    return Scene(tiny)


@pytest.mark.parametrize("times", [0.95, 1.2])
def test_a_height_that_the_silhouettes_contradict_is_refused(scene: Scene, times: float) -> None:
    assert scene.capture.subject_height_m is not None
    tracker, subject = scene._tracker(), Subject(times * scene.capture.subject_height_m)
    monitor = CameraMonitor(tracker, scene.setup, subject)
    tracker.start(monitor.start(scene.frames[: tracker.opening_frames]), subject)
    contradicted = times > 1.1
    with pytest.raises(CaptureError, match="silhouettes fit a person of") if contradicted else nullcontext():
        monitor.check_body()


def moved(camera: int, frames: range, by: int = 30) -> Spoil:
    """The camera's masks show the person elsewhere in these frames."""

    def spoil(frame: Frame) -> Frame:
        if frame.index not in frames:
            return frame
        masks = frame.masks.copy()
        masks[camera] = np.roll(masks[camera], by, axis=1)
        return replace(frame, masks=masks)

    return spoil


def blind(cameras: list[int], frames: range) -> Spoil:
    """The cameras' masks are empty in these frames."""

    def spoil(frame: Frame) -> Frame:
        if frame.index not in frames:
            return frame
        masks = frame.masks.copy()
        masks[cameras] = 0
        return replace(frame, masks=masks)

    return spoil


def torn(camera: int, frames: range, part: tuple[float, float], uncertain_part: bool = False) -> Spoil:
    """A part of the person, as shares of the height in the image, is missing from the camera's masks in these frames:
    background or uncertain."""

    def spoil(frame: Frame) -> Frame:
        if frame.index not in frames:
            return frame
        masks = frame.masks.copy()
        rows = np.flatnonzero(masks[camera].any(axis=1))
        first, last = rows[0], rows[-1] + 1
        low, high = (round(first + share * (last - first)) for share in part)
        uncertain = np.zeros(masks.shape, np.bool_)
        uncertain[camera, low:high] = uncertain_part & (masks[camera, low:high] > 0)
        masks[camera, low:high] = 0
        return replace(frame, masks=masks, uncertain=uncertain)

    return spoil


def test_good_recording_excludes_no_camera(scene: Scene) -> None:
    monitor, estimates, used = scene.follow(lambda frame: frame)
    assert monitor.report() == [] and np.all(used)
    assert not any(e.status == "lost" for e in estimates)
    alone = scene.monitor().tracker
    for frame, estimate in zip(scene.frames, estimates, strict=True):
        np.testing.assert_allclose(alone.step(frame).joints, estimate.joints, rtol=0, atol=1e-7)


def test_turned_camera_is_excluded_and_included_again(scene: Scene) -> None:
    monitor, estimates, used = scene.follow(moved(1, range(5, 10)), 12)
    assert [bool(u[1]) for u in used] == [True] * 5 + [False] * 5 + [False, True]
    assert all(u[[0, 2, 3]].all() for u in used)
    assert scene.error(estimates) < 0.08
    (line,) = monitor.report()
    assert "camera cam2 disagrees with the others" in line and "frames 5 to 10" in line
    # the residual of an excluded camera is unknown
    assert estimates[6].residual is not None and np.isnan(estimates[6].residual[1]).all()


@pytest.mark.parametrize(
    ("seen", "wrong"), [("none", True), ("right", False), ("turned", True), ("in two images", False), ("alone", True)]
)
def test_landmarks_confirm_a_camera_whose_masks_contradict_the_others(scene: Scene, seen: str, wrong: bool) -> None:
    """The masks of a camera are displaced; its landmarks are right, displaced with the masks, or unknown."""
    frames = []
    for frame in map(moved(1, range(FRAMES)), scene.frames[:3]):
        landmarks = landmarks_of(scene.setup.rig, BODY, walk(1)[0], 0.02, seed=frame.index)[None]
        if seen == "turned":
            landmarks[:, 1, :, 0] += 40.0
        if seen in ("in two images", "alone"):
            landmarks[:, 2:] = np.nan
        if seen == "alone":
            landmarks[:, 0] = np.nan
        frames.append(replace(frame, landmarks=None if seen == "none" else landmarks))
    assert (1 in opening_agreement(scene.setup, frames, np.zeros((3, 4), np.bool_)).wrong) == wrong


@pytest.mark.parametrize(("by", "refused"), [(0.0, False), (3.0, True)])
def test_landmarks_of_two_cameras_do_not_deny_that_one_is_turned(scene: Scene, by: float, refused: bool) -> None:
    """Their lines of sight nearly meet however a camera is turned about its upright axis; the sizes differ by 2 %."""
    first, second = tuple(scene.setup.rig)[:2]
    turn = np.asarray(cv2.Rodrigues(np.radians([0.0, by, 0.0]))[0])
    turned = replace(second, rotation=turn @ second.rotation, translation=turn @ second.translation)
    setup = replace(scene.setup, rig=Rig((first, turned)))
    frames = [
        replace(frame, masks=frame.masks[:2], landmarks=landmarks_of(scene.setup.rig, BODY, walk(1)[0], 0.02)[None, :2])
        for frame in scene.frames[:3]
    ]
    found = opening_agreement(setup, frames, np.zeros((3, 2), np.bool_))
    assert bool(found.refusal) == refused


def test_two_cameras_that_face_each_other_contradict_no_third(scene: Scene) -> None:
    centers = scene.setup.rig.centers - scene.truth[0].mean(axis=0)
    rays = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    assert depth_information(rays[[0, 2]]) < LEAST_INFORMATION < depth_information(rays[[0, 3]])
    for unseen, excluded in ((3, False), (2, True)):
        monitor = scene.monitor()
        for frame in scene.frames[:8]:
            _, used = monitor.step(moved(1, range(5, 10))(blind([unseen], range(FRAMES))(frame)))
        assert bool(used.masks[1].any()) is not excluded


def test_sigma_is_unknown_while_the_cameras_left_face_each_other(scene: Scene) -> None:
    _, estimates, _ = scene.follow(blind([1, 3], range(5, 9)), 9)
    assert [bool(np.isnan(e.sigma).all()) for e in estimates] == 5 * [False] + 4 * [True]
    assert not any(e.status == "lost" for e in estimates)


def test_status_is_that_of_the_step_without_the_wrong_camera(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the wrong camera, the person seems to be elsewhere."""
    step = RegionTracker.step

    def elsewhere(tracker: RegionTracker, frame: Frame) -> Estimate:
        estimate = step(tracker, frame)
        wrong = frame.index == 5 and frame.masks[1].any()
        return replace(estimate, origin=Status.RECOVERED, found=Reason.CUT) if wrong else estimate

    monkeypatch.setattr(RegionTracker, "step", elsewhere)
    _, estimates, used = scene.follow(moved(1, range(5, 10)), 6)
    assert not used[5][1] and (estimates[5].status, estimates[5].reason) == ("tracked", Reason.NONE)


def test_frozen_and_black_cameras_are_excluded_and_reported(scene: Scene) -> None:
    def spoil(frame: Frame) -> Frame:
        images, masks = frame.images.copy(), frame.masks.copy()
        if frame.index >= 4:
            images[0], masks[0] = scene.frames[4].images[0], scene.frames[4].masks[0]
        if frame.index >= 8:
            images[3], masks[3] = 0, 255
        return replace(frame, images=images, masks=masks)

    monitor, estimates, used = scene.follow(spoil)
    assert not any(u[3] for u in used[8:]) and not used[-1][0]
    assert scene.error(estimates) < 0.10
    lines = " | ".join(monitor.report())
    assert "cam1 stands still" in lines and "cam4 shows nothing: left out of frames 8 to 13" in lines


@pytest.mark.parametrize("covered", [True, False], ids=["covered by a thing", "person out of view"])
def test_camera_that_shows_nothing_of_the_person_is_reported(scene: Scene, covered: bool) -> None:
    noise = np.random.default_rng(0)

    def spoil(frame: Frame) -> Frame:
        images, masks = frame.images.copy(), frame.masks.copy()
        if frame.index >= 5:
            masks[2] = 255 * covered
            if covered:  # all of it has colours that are not the person's, and is in motion
                images[2] = (0, 255, 0) + noise.integers(0, 2, (*images.shape[1:3], 1), np.uint8) * (255, -255, 0)
        return replace(frame, images=images, masks=masks)

    monitor, estimates, _ = scene.follow(spoil, 9)
    state, text = ("torn", FAULTS["torn"]) if covered else ("unseen", FAULTS["unseen"])
    for i, e in enumerate(estimates):
        assert e.residual is not None and e.cameras is not None
        assert np.isnan(e.residual[:, 0]).tolist() == [False, False, i >= 5, False]
        assert [STATES[camera] for camera in e.cameras] == ["used", "used", state if i >= 5 else "used", "used"]
    assert monitor.report() == [f"camera cam3 {text}: left out of frames 5 to 8"]
    assert monitor.doubted.tolist() == [False, False, covered, False]


@pytest.mark.parametrize("cameras", [[0, 1, 2, 3], [0, 1, 3]], ids=["no mask", "one mask"])
def test_absent_person_is_lost_and_recovered_on_return(scene: Scene, cameras: list[int]) -> None:
    monitor, estimates, _ = scene.follow(blind(cameras, range(5, 8)), 11)
    status = [e.status for e in estimates]
    assert status[5:8] == ["lost"] * 3 and "lost" not in status[:5] + status[9:]
    assert "recovered" in status[8:10]
    assert all(e.sigma is not None and np.isnan(e.sigma).all() for e in estimates[5:8])
    assert scene.error(estimates, status.index("recovered")) < 0.10
    assert scene.lines(estimates)[0] == "fewer than two cameras see anybody: no pose, frames 5 to 7"
    assert monitor.doubted.all()


def test_person_who_is_elsewhere_without_having_been_lost_is_reported(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = RegionTracker.step

    def jump(tracker: RegionTracker, frame: Frame) -> Estimate:
        estimate = step(tracker, frame)
        cut = frame.index == 7 and estimate.origin == Status.TRACKED
        return replace(estimate, origin=Status.RECOVERED, found=Reason.CUT) if cut else estimate

    monkeypatch.setattr(RegionTracker, "step", jump)
    expected = "elsewhere than in the frame before, as after a cut in the recording: searched for again, frame 7"
    assert [expected in line for line in scene.lines(scene.follow(lambda frame: frame, 9)[1])] == [True]
    after_a_loss = scene.lines(scene.follow(blind([0, 1, 2, 3], range(5, 7)), 10)[1])
    assert after_a_loss and not any("as after a cut" in line for line in after_a_loss)


@pytest.mark.parametrize("part", [(0.0, 0.5), (0.5, 1.0)], ids=["the head's half", "the feet's half"])
def test_torn_mask_misleads_in_no_frame(scene: Scene, part: tuple[float, float]) -> None:
    """It is left out if the others fit better without it, and used again when it is whole."""
    head = part[0] == 0.0
    monitor, estimates, used = scene.follow(torn(1, range(2, 5), part), 10)
    assert [bool(u[1]) for u in used[:5]] == [True] * 2 + [not head] * 3
    assert all(u.all() for u in used[8:])
    assert [line.split(":")[0] for line in monitor.report()] == head * ["camera cam2 disagrees with the others"]
    assert np.flatnonzero(monitor.doubted).tolist() == head * [1]
    assert not any(e.status == "lost" for e in estimates)
    assert scene.error(estimates) < 0.05


@pytest.mark.parametrize("camera", [1, 2])
def test_mask_with_surplus_area_is_left_out_if_the_others_fit_better_without_it(scene: Scene, camera: int) -> None:
    def too_wide(frame: Frame) -> Frame:
        masks = frame.masks.copy()
        if frame.index >= 4:
            masks[camera] = cv2.dilate(masks[camera], np.ones((9, 9), np.uint8))
        return replace(frame, masks=masks)

    monitor, estimates, used = scene.follow(too_wide, 10)
    if camera == 1:  # the rest gains hardly anything without one of the others: its mask may be used, and misleads none
        assert sum(not u[camera] for u in used[4:]) >= 5 and not used[-1][camera]
    assert all(u[[c for c in range(4) if c != camera]].all() for u in used)
    assert all(f"camera cam{camera + 1}" in line for line in monitor.report())
    assert scene.error(estimates) < 0.04


@pytest.mark.parametrize("part", [(0.0, 0.2), (0.7, 1.0)], ids=["the head", "the shanks"])
def test_camera_with_uncertain_pixels_is_not_excluded(scene: Scene, part: tuple[float, float]) -> None:
    monitor, estimates, used = scene.follow(torn(1, range(2, 8), part, uncertain_part=True), 9)
    assert np.all(used) and monitor.report() == []
    assert not any(e.status == "lost" for e in estimates)
    assert scene.error(estimates) < 0.05


def test_camera_with_half_of_its_mask_uncertain_is_excluded(scene: Scene) -> None:
    monitor, estimates, used = scene.follow(torn(1, range(2, 8), (0.0, 0.5), uncertain_part=True), 12)
    assert not any(u[1] for u in used[2:8]) and all(u[1] for u in used[:2])
    assert all(u[1] for u in used[10:])
    assert [line.split(":")[0] for line in monitor.report()] == ["camera cam2 disagrees with the others"]
    assert scene.error(estimates) < 0.05


def test_two_cameras_that_turn_slowly_are_excluded(scene: Scene) -> None:
    def sagging(frame: Frame) -> Frame:
        images, masks = frame.images.copy(), frame.masks.copy()
        for camera in (2, 3):  # the other two cannot know which pair is wrong
            images[camera] = np.roll(images[camera], frame.index // 2, axis=1)
            masks[camera] = np.roll(masks[camera], frame.index // 2, axis=1)
        return replace(frame, images=images, masks=masks)

    monitor, estimates, used = scene.follow(sagging)
    assert not any(u[[2, 3]].any() for u in used[8:])
    # between the discoveries three cameras are left, one of them shifted by 3 px: its frame alone does not show which
    assert sum(not u[[0, 1]].all() for u in used) <= 1
    assert [line.split(":")[0] for line in monitor.report() if "moved" in line] == [
        f"camera {name} has been moved or zoomed since the first frame" for name in ("cam3", "cam4")
    ]
    assert monitor.moved.tolist() == [False, False, True, True]
    assert scene.error(estimates) < 0.10


def test_inconsistent_camera_is_excluded_from_the_opening(scene: Scene) -> None:
    monitor = scene.monitor()
    spoil = moved(2, range(FRAMES))
    opening = monitor.start([spoil(frame) for frame in scene.frames[:3]])
    assert all(f.masks.any(axis=(1, 2)).tolist() == [True, True, False, True] for f in opening)
    for frame in scene.frames[:6]:
        estimate, used = monitor.step(spoil(frame))
        assert not used.masks[2].any() and estimate.status != "lost"
    (line,) = monitor.report()
    assert "camera cam3 disagrees" in line and "frames 0 to 5" in line
    assert isinstance(monitor.tracker, RegionTracker) and monitor.tracker.view_m == CHANGING_M


def test_camera_that_is_black_in_a_part_of_the_opening_stays_in_the_other_part(scene: Scene) -> None:
    monitor, opening = scene.monitor(), []
    for frame in scene.frames[:5]:
        images, masks = frame.images.copy(), frame.masks.copy()
        if frame.index > 1:
            images[2] = masks[2] = 0
        opening.append(replace(frame, images=images, masks=masks))
    shown = monitor.start(opening)
    assert [bool(f.masks[2].any()) for f in shown] == [True, True, False, False, False]
    assert all(f.masks[[0, 1, 3]].any(axis=(1, 2)).all() for f in shown)
    assert monitor.step(opening[0])[1].masks[2].any() and monitor.report() == []


def test_sigma_counts_what_the_test_of_the_opening_tolerates(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    sigma = []
    for undetected_m in (0.0, 0.04):
        monkeypatch.setattr(Agreement, "undetected_m", undetected_m)
        monitor = scene.monitor()
        monitor.start(scene.frames[:3])
        estimate, _ = monitor.step(blind([2, 3], range(FRAMES))(scene.frames[0]))
        assert estimate.sigma is not None
        sigma.append(np.median(estimate.sigma))
    assert np.sqrt(sigma[1] ** 2 - sigma[0] ** 2) > 0.02  # half of it: each joint is seen by two segments and views


def test_person_whose_size_contradicts_the_given_height_is_refused(scene: Scene) -> None:
    monitor = CameraMonitor(scene.monitor().tracker, scene.setup, Subject(height_m=0.95))
    with pytest.raises(CaptureError, match=r"measures 1\.\d+ m in the images, but .* says 0.95 m"):
        monitor.start(scene.frames[:3])


def test_the_volumetric_tracker_goes_without_a_camera_that_shows_nothing(scene: Scene) -> None:
    capture, body = scene.capture, scene.monitor().tracker.body
    tracker = VolumetricTracker(capture.rig, capture.volume, capture.up, replace(CONFIG, voxels=48))
    tracker.start(scene.frames[:1], Subject(capture.subject_height_m, body=body))
    monitor = CameraMonitor(tracker, scene.setup, scene.setup.subjects[0])
    images, masks = scene.frames[1].images.copy(), scene.frames[1].masks.copy()
    images[3], masks[3] = 0, 255
    monitor.step(scene.frames[0])
    estimate, used = monitor.step(replace(scene.frames[1], images=images, masks=masks))
    assert estimate.cameras is not None and np.flatnonzero(estimate.cameras).tolist() == [3]
    assert not used.masks[3].any() and estimate.status == "tracked"


class Jumping:
    """A tracker whose estimate jumps in one frame."""

    tracks_among_others = has_second_pass = False

    def __init__(self, joints: np.ndarray, when: int) -> None:
        self.joints, self.when = joints, when

    def step(self, frame: Frame) -> Estimate:
        at = self.joints + (np.array([4.0, 0.0, 0.0]) if frame.index == self.when else 0.0)
        none = np.zeros(0, np.int32)
        return Estimate(np.zeros(24), at, Status.TRACKED, 0.0, none, {}, deviation=np.full(15, 0.01))


def test_impossible_pose_is_lost(scene: Scene) -> None:
    tracker: Any = Jumping(scene.truth[0], 3)
    monitor = CameraMonitor(tracker, scene.setup, scene.setup.subjects[0])
    estimates = [monitor.step(frame)[0] for frame in scene.frames[:6]]
    assert [e.status for e in estimates] == ["tracked"] * 3 + ["lost"] + ["tracked"] * 2
    assert estimates[3].sigma is not None and np.isnan(estimates[3].sigma).all()
    assert scene.lines(estimates) == ["the pose found cannot be true: it jumps: lost, frame 3"]
    assert monitor.doubted.all()


def test_resumed_run_is_the_same(scene: Scene) -> None:
    spoil = moved(1, range(4, 9))
    whole, expected, _ = scene.follow(spoil, 11)
    first = scene.monitor()
    for frame in scene.frames[:6]:
        first.step(spoil(frame))
    state = first.tracker.state
    again = scene.monitor()
    again.tracker.take_model(scene.model)
    again.tracker.state = state
    again.state = decode(MonitorState, encode(first.state))  # as after --resume
    for frame, estimate in zip(scene.frames[6:11], expected[6:], strict=True):
        np.testing.assert_allclose(again.step(spoil(frame))[0].joints, estimate.joints, rtol=0, atol=1e-9)
    assert again.report() == whole.report()
