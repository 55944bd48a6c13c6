"""Masks of a recording without an empty scene: how often the segmenter is asked, and what the masks show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.people import truth, write_people
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.frames import FrameSet
from tk.model.cameras.camera import Rig
from tk.run.learned_masks import LEARNED, LEARNED_AND_SEGMENTER, SEGMENTER
from tk.run.segmentation import Labels, make_labeller
from tk.run.task import Task
from tk.settings import Settings

FRAMES = 60


def walking(k: int) -> tuple[float, float]:
    return 0.85 * np.cos(0.1 * np.pi * k), 0.85 * np.sin(0.1 * np.pi * k)


@dataclass
class Counting:
    """Segments what is red, and counts the images."""

    asked: list[int] = field(default_factory=lambda: [0])

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.asked[0] += 1
        blue, green, red = np.moveaxis(image.astype(int), 2, 0)
        return np.where((red > 150) & (green < 90) & (blue < 90), 0.9, 0.05).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_people(tmp_path_factory.mktemp("learned") / "walk", [walking], FRAMES)


def capture_of(folder: Path) -> tuple[Capture, Counting]:
    segmenter = Counting()
    return replace(open_capture(folder), segmenter=segmenter), segmenter


def labels_of(capture: Capture, start: int = 0) -> list[Labels]:
    label = make_labeller(Task.of(capture, Settings()), lambda _: None)
    with capture.frames(start) as frames:
        return [Labels(*(np.array(layer) for layer in label(frame))) for frame in frames]


@cache
def whole(folder: Path, fps: float) -> tuple[list[Labels], list[int]]:
    """Return the labels of all frames, and how many images the segmenter was asked for until each."""
    capture, segmenter = capture_of(folder)
    capture, labels, asked = replace(capture, fps=fps), list[Labels](), list[int]()
    label = make_labeller(Task.of(capture, Settings()), lambda _: None)
    with capture.frames() as frames:
        for frame in frames:
            labels.append(Labels(*(np.array(layer) for layer in label(frame))))
            asked.append(segmenter.asked[0])
    return labels, asked


def wrong(masks: NDArray[np.uint8], true: NDArray[np.bool_]) -> float:
    return float(np.count_nonzero((masks > 0) != true) / np.count_nonzero(true))


def test_few_frames_are_asked_for_and_all_masks_show_the_person(folder: Path) -> None:
    found, asked = whole(folder, 15.0)
    sources = np.array([labels.sources for labels in found])
    assert set(np.unique(sources)) == {LEARNED, LEARNED_AND_SEGMENTER}
    assert (sources != LEARNED).mean() <= 0.2
    assert asked[-1] <= 2 * (sources != LEARNED).sum()  # an image may be asked for twice
    assert max(wrong(labels.masks, truth(folder, k)) for k, labels in enumerate(found)) < 0.1


def test_a_note_says_why_the_segmenter_makes_all_masks(folder: Path) -> None:
    capture, _ = capture_of(folder)
    said: list[str] = []
    short = replace(capture, frame_count=40)
    make_labeller(Task.of(short, Settings()), said.append)
    assert "fewer than 50 frames are too few" in said[-1]
    said.clear()
    make_labeller(Task.of(capture, Settings()), said.append)
    assert not said
    large = Rig(tuple(replace(camera, width=5000, height=4000) for camera in capture.rig))
    make_labeller(Task.of(replace(capture, rig=large), Settings()), said.append)
    assert "images are too large" in said[-1]


# 8 samples, and 9: then the opening, of 24 frames, has its own scene
@pytest.mark.parametrize(("fps", "start"), [(15.0, 37), (10.0, 10)])
def test_masks_do_not_depend_on_the_first_frame(folder: Path, fps: float, start: int) -> None:
    capture = replace(capture_of(folder)[0], fps=fps)
    for a, b in zip(whole(folder, fps)[0][start:], labels_of(capture, start), strict=True):
        for one, other in zip(a, b, strict=True):
            np.testing.assert_array_equal(one, other)


def test_opening_waits_for_eight_samples_only(folder: Path) -> None:
    (_, asked), opening = whole(folder, 10.0), Settings().silhouette.init_frames  # nine samples
    assert asked[0] == asked[opening - 1] < asked[opening] == asked[-1]


def test_still_trunk_stays_in_the_masks(tmp_path: Path) -> None:
    folder = write_people(tmp_path / "still", [lambda k: (0.03 * np.sin(k), 0.0)], FRAMES)
    found = labels_of(capture_of(folder)[0])
    assert max(wrong(labels.masks, truth(folder, k)) for k, labels in enumerate(found)) < 0.2  # thin


def test_changed_scene_is_left_to_the_segmenter(tmp_path: Path) -> None:
    """In camera c1 a door behind the person opens after two thirds of the recording."""
    folder, opened = write_people(tmp_path / "changed", [walking], FRAMES), 2 * FRAMES // 3
    for k in range(opened, FRAMES):
        path = str(folder / "images" / "c1" / f"{k:06d}.png")
        image = cv2.imread(path)
        image[:, 15:80][~truth(folder, k)[1, :, 15:80]] = (20, 60, 20)
        cv2.imwrite(path, image)
    found = labels_of(capture_of(folder)[0])
    sources = np.array([labels.sources for labels in found])
    assert (sources[opened + 8 :, 1] == SEGMENTER).all() and not (sources[:, [0, 2, 3]] == SEGMENTER).any()
    assert (sources[: FRAMES // 2, 1] != SEGMENTER).all()
    after = found[opened + 8 :]
    assert max(wrong(labels.masks, truth(folder, k)) for k, labels in enumerate(after, opened + 8)) < 0.1


@dataclass(frozen=True)
class Live:
    """A capture as a source of unknown length."""

    capture: Capture
    frame_count = None

    def __getattr__(self, name: str) -> object:
        return getattr(self.capture, name)

    def frames(self, start: int = 0, stop: int | None = None) -> AbstractContextManager[Iterator[FrameSet]]:
        return self.capture.frames(start, stop)

    def shifted(self, time_offset_s: Sequence[float]) -> None:
        return None


def test_source_of_unknown_length_is_learned_while_it_runs(folder: Path) -> None:
    capture = replace(capture_of(folder)[0], fps=8.0)
    label = make_labeller(Task(capture.setup(), Live(capture)), lambda _: None)  # type: ignore[arg-type]
    sources, errors = [], []
    with capture.frames(0, 32) as frames:
        for frame in frames:
            found = label(frame)
            sources.append(np.array(found.sources))
            errors.append(wrong(found.masks, truth(folder, frame.index)))
    kinds = np.array(sources)
    learned = int(np.argmax((kinds != SEGMENTER).all(axis=1)))
    assert (kinds[:learned] == SEGMENTER).all() and learned == 7 * 4  # the eighth sample, two a second
    assert (kinds[learned + 1 :] == LEARNED).all() and max(errors) < 0.1
