"""Where masks come from: given, the empty scene, a segmenter, or nowhere; and what a segmenter's masks show."""

from __future__ import annotations

import importlib.util
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.conftest import QUICK, Silent, Tk
from tests.people import HEIGHT, WIDTH, install, truth, write_people
from tests.run.scarlet import Scarlet
from tk.errors import CaptureError, ConfigError
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.model.body.body_points import LANDMARKS
from tk.run.mask_folder import write_masks
from tk.run.prefetch import Ahead, open_observations
from tk.run.segmentation import landmark_asker, make_labeller, mask_source, sees_landmarks
from tk.run.task import Task
from tk.segmenters import load, names
from tk.segmenters.people_masks import PeopleMasks
from tk.settings import Settings

FRAMES = 20


def walking(k: int) -> tuple[float, float]:
    """Once around in 20 frames."""
    return 0.85 * np.cos(0.1 * np.pi * k), 0.85 * np.sin(0.1 * np.pi * k)


def standing(k: int) -> tuple[float, float]:
    return 0.1, 0.02 * np.sin(k)


def bystander(k: int) -> tuple[float, float]:
    """Beyond the volume."""
    return 1.55, 1.7


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One who walks, and one who looks on. Not to be changed."""
    return write_people(tmp_path_factory.mktemp("people") / "walk", [walking, bystander], FRAMES)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is installed here: no segmenter is."""
    monkeypatch.setattr("tk.segmenters.names", lambda: ())
    monkeypatch.setattr("tk.run.segmentation.names", lambda: ())
    monkeypatch.setattr("tk.run.mask_folder.names", lambda: ())


def wrong(masks: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(C,) E_S."""
    return np.asarray((masks > 0) ^ true).sum(axis=(1, 2)) / true.sum(axis=(1, 2))


# --------------------------------------------------------------------------------------------------------- the order


def test_source_of_masks_depends_on_the_capture(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path / "site", monkeypatch, red="Red")
    assert names()[0] == "red"
    assert mask_source(open_capture(copy)) == "given"
    assert mask_source(open_capture(copy, masks="none")) == "none"
    assert mask_source(open_capture(copy, masks="median")) == "median"
    shutil.rmtree(copy / "background")
    assert mask_source(open_capture(copy)) == "given"
    assert mask_source(open_capture(copy, masks="none")) == "segmenter red"
    shutil.rmtree(copy / "masks")
    assert mask_source(open_capture(copy)) == "segmenter red"


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("command", ["track", "reconstruct"])
def test_a_capture_without_any_source_of_masks_is_refused(tk: Tk, walk: Path, tmp_path: Path, command: str) -> None:
    ran = tk(command, walk, "-o", tmp_path / "r.h5")
    ran.complaint(str(walk), "give a folder of masks", "background/", "pip install tk-mocap[segmenter]")
    assert not (tmp_path / "r.h5").exists()


def test_a_missing_segmenter_is_reported(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path / "site", monkeypatch, red="Red", lost="Missing", wrong="Wrong")
    with pytest.raises(ConfigError, match=r"segmenter blue: is not installed; installed: .*red"):
        load("blue")
    with pytest.raises(ConfigError, match="segmenter lost: redsegmenter:Missing cannot be loaded"):
        load("lost")
    with pytest.raises(ConfigError, match="segmenter wrong: returned values outside 0 to 1"):
        write_masks(open_capture(walk), tmp_path / "masks", Silent(), "wrong")


# ------------------------------------------------------------------------------------------------------- the median


def test_median_background_of_a_moving_person(walk: Path) -> None:
    notes: list[str] = []
    capture = open_capture(walk, masks="median")
    label = make_labeller(Task.of(capture, Settings()), notes.append)
    assert notes == [f"{walk}: the median of 20 frames is taken for the empty scene"]
    with capture.frames(10, 11) as frames:
        found = wrong(label(next(frames)).masks, truth(walk, 10))
    assert np.sort(found)[-2] < 0.1, "one camera sees the bystander behind, who is of the same colour"


@pytest.mark.parametrize("masks", ["median", "none"])
@pytest.mark.usefixtures("alone")
def test_median_background_of_a_still_person_is_refused(tmp_path: Path, masks: str) -> None:
    folder = write_people(tmp_path / "still", [standing], 12)
    with pytest.raises(CaptureError, match="hardly moves" if masks == "median" else "no segmenter") as caught:
        make_labeller(Task.of(open_capture(folder, masks=masks), Settings()), lambda _: None)
    assert "give a folder of masks" in str(caught.value) and "\n" not in str(caught.value)


def test_median_background_with_parts_of_the_person_is_reported(tmp_path: Path) -> None:
    folder = write_people(tmp_path / "slow", [lambda k: (-0.75, 0.0) if k < 9 else (-0.75 + 0.13 * (k - 8), 0.0)], 20)
    notes: list[str] = []
    make_labeller(Task.of(open_capture(folder, masks="median"), Settings()), notes.append)
    assert len(notes) == 2 and "the median shows parts" in notes[1] and "c1, c2" in notes[1]


# ---------------------------------------------------------------------------------------------------- the segmenter


@pytest.mark.parametrize("segmenter", ["Red", "Finding"])
def test_masks_show_everybody(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, segmenter: str) -> None:
    """Also the bystander beside the volume, in every camera."""
    install(tmp_path / "site", monkeypatch, red=segmenter)
    capture = open_capture(walk)
    notes: list[str] = []
    label = make_labeller(Task.of(capture, Settings()), notes.append)
    assert "the segmenter red makes the masks" in notes[0] and "every frame" in notes[1] and len(notes) == 2
    with capture.frames() as frames:
        for frame in islice(frames, 0, None, 6):
            assert wrong(label(frame).masks, truth(walk, frame.index, everybody=True)).max() < 0.1, frame.index


def test_a_process_ahead_makes_the_same_masks(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From another frame on, too: nothing is carried over."""
    install(tmp_path / "site", monkeypatch, red="Finding")
    capture = open_capture(walk)
    label = make_labeller(Task.of(capture, Settings()), lambda _: None)
    with capture.frames(3, 6) as frames:
        here = {frame.index: label(frame).masks for frame in frames}
    config = settings_file.from_toml(QUICK.replace("ahead = 0", "ahead = 2"))
    with Ahead(Task.of(capture, config), lambda _: None) as source:
        for observation, _ in source.frames(4, 6):
            np.testing.assert_array_equal(observation.masks, here[observation.index], strict=True)


def test_masks_without_a_person_are_empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path / "site", monkeypatch, red="Finding")
    folder = write_people(tmp_path / "left", [lambda k: None], 2)
    capture = open_capture(folder)
    with capture.frames() as frames:
        assert not make_labeller(Task.of(capture, Settings()), lambda _: None)(next(frames)).masks.any()


# --------------------------------------------------------------------------------------------------------- tk masks


def test_track_uses_given_masks(tk: Tk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path / "site", monkeypatch, red="Finding")
    walk, frames = write_people(tmp_path / "walk", [walking, bystander], 6), 6
    out = tmp_path / "made"
    ran = tk("masks", walk, "-o", out, "--frames", ":4")
    assert ran.code == 0 and "masks of 4 frames" in ran.err
    first = (out / "c1" / "000002.png").read_bytes()
    (out / "c2" / "000003.png").unlink()
    (out / "c1" / "000002.png").write_bytes(b"kept")
    ran = tk("masks", walk, "-o", out, "--segmenter", "red")
    assert ran.code == 0 and f"masks of {frames} frames" in ran.err and "3 of them new" in ran.err
    assert (out / "c1" / "000002.png").read_bytes() == b"kept"
    (out / "c1" / "000002.png").write_bytes(first)
    capture = open_capture(walk, masks=str(out))
    assert capture.frame_count == frames
    with capture.frames() as frames:
        for frame in frames:
            assert frame.masks is not None
            file = cv2.imread(str(out / "c0" / f"{frame.index:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert file.dtype == np.uint8 and set(np.unique(file)) == {0, 255}
            np.testing.assert_array_equal(frame.masks[0], file)
    assert not [path for path in out.rglob("*") if path.name.endswith(".part")]


def test_masks_of_the_masks_command_are_used(
    tk: Tk, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "site", monkeypatch, red="Finding", plain="Red")
    command = ("masks", walk, "-o", tmp_path / "made", "--frames", "1:2", "--segmenter")
    ran = tk(*command, "red")
    assert ran.code == 0 and "frames before 1 are missing" in ran.err
    with pytest.raises(CaptureError, match=r"starts with 000001.png, so frame 0 has no mask; .* tk masks"):
        open_capture(walk, masks=str(tmp_path / "made"))
    tk(*command, "plain").complaint("masks.toml", "segmenter: red, not plain")
    tk(*command, "red", "--cameras", "c0,c1").complaint("cameras")
    tk("masks", walk, "-o", walk).complaint(str(walk), "choose another folder")
    tk(*command, "green").complaint("segmenter green", "is not installed")


@pytest.mark.usefixtures("alone")
def test_a_segmenter_may_be_an_object(walk: Path) -> None:
    capture = replace(open_capture(walk), segmenter=Scarlet())
    assert mask_source(capture) == "segmenter Scarlet"
    with open_observations(Task.of(capture, Settings()), lambda _: None) as observations:
        (observation, _), *_ = observations.frames(0, 2)
    assert observation.masks.any(axis=(1, 2)).all() and (observation.masks == 0).mean() > 0.5


class Pose(Scarlet):
    """A segmenter that also sees landmarks: all of them on a line in the middle of its image."""

    landmarks = LANDMARKS

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        height, width = image.shape[:2]
        y = np.linspace(0.45, 0.55, len(LANDMARKS)) * height
        return self.segment(image), np.column_stack([np.full_like(y, width / 2), y, np.full_like(y, 0.9)])


@pytest.mark.usefixtures("alone")
def test_a_tracker_asks_for_landmarks_about_the_place_where_it_expects_the_person(walk: Path) -> None:
    capture = replace(open_capture(walk), segmenter=Pose())
    task, images = Task.of(capture, Settings()), np.zeros((len(capture.rig), HEIGHT // 2, WIDTH // 2, 3), np.uint8)
    ask, points = landmark_asker(task), np.tile([0.2, 0.1, 1.0], (len(LANDMARKS), 1))
    points[[LANDMARKS.index(f"shoulder_{side}") for side in "lr"], 2] = 1.4
    assert ask is not None and sees_landmarks(task)
    found = ask(images, points)
    assert found is not None and found.shape == (len(capture.rig), len(LANDMARKS), 4)
    middle = [camera.project(np.array([[0.2, 0.1, 1.0]]))[0][0] for camera in capture.rig]
    assert np.linalg.norm(found[..., :2].mean(axis=1) - middle, axis=1).max() < 2.0
    assert ask(images, np.full_like(points, np.nan)) is None


@pytest.mark.usefixtures("alone")
def test_who_is_asked_for_landmarks(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody without a network that sees them, or if the user says so, or if every frame has them."""
    capture = open_capture(walk, masks="median")
    assert landmark_asker(Task.of(capture, Settings())) is None
    assert landmark_asker(Task.of(replace(capture, segmenter=Scarlet()), Settings())) is None
    with_pose = replace(capture, segmenter=Pose())
    for setting, asked in (("auto", True), ("never", False), ("always", False)):
        assert (landmark_asker(Task.of(with_pose, Settings(landmarks=setting))) is not None) == asked
    monkeypatch.setattr("tk.segmenters.names", lambda: ("mediapipe",))
    for there in (True, False):  # nothing is downloaded for it
        monkeypatch.setattr("tk.segmenters.weights.at_hand", lambda there=there: there)
        assert (landmark_asker(Task.of(capture, Settings())) is not None) == there


@pytest.mark.usefixtures("alone")
def test_no_segmenter_for_masks(tk: Tk, walk: Path, tmp_path: Path) -> None:
    tk("masks", walk, "-o", tmp_path / "made").complaint("no segmenter is installed", "pip install tk-mocap[segmenter]")
    assert not (tmp_path / "made").exists()


# ------------------------------------------------------------------------------------------------ the built-in network

HAS_LITERT = importlib.util.find_spec("ai_edge_litert") is not None


@pytest.mark.skipif(not HAS_LITERT, reason="the extra segmenter is not installed")
def test_the_built_in_network_segments_a_rendered_person(tiny: Path) -> None:
    from tk.segmenters.weights import FILES, default_cache_dir

    if not all((default_cache_dir() / "segmenter" / name).is_file() for name in FILES):
        pytest.skip("the network's weights were never fetched on this machine")
    capture = open_capture(tiny, masks="none")
    made = PeopleMasks(load("mediapipe"), "mediapipe", capture.rig, capture.volume)
    with open_capture(tiny).frames(0, 1) as frames:
        frame = next(frames)
    assert frame.masks is not None
    level = wrong(made.segment(frame.images), frame.masks > 0)[:3]  # the last camera looks from above
    assert level.max() < 0.3
