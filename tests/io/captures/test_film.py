"""Small images of some frames, in a file that has no name and leaves room on the disk."""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tk.io.captures.film import Film, filmed
from tk.system.files import NamelessFile


def scene(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Return a smooth image, which JPEG hardly changes."""
    coarse = np.random.default_rng(seed).integers(0, 255, (4, 5, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC))


def nobody(text: str) -> None:
    raise AssertionError(text)


@pytest.fixture
def film(tmp_path: Path) -> Film:
    """A film of frames 3, 5 and 7 of two cameras, whose images are 120×80 and 100×70."""
    made = Film.in_folder(tmp_path, [(60, 40), (100, 70)])
    assert made is not None
    made.frames = range(3, 9, 2)
    return made


IMAGES = {k: [scene(k, (80, 120)), scene(k + 100, (70, 100))] for k in range(2, 9)}


@pytest.mark.usefixtures("system")
@pytest.mark.parametrize("plain", [True, False])
def test_images_of_the_chosen_frames_are_kept_small(film: Film, tmp_path: Path, plain: bool) -> None:
    """Without compression if all images of the film together are small."""
    if not plain:
        film.frames = range(3, 50_000, 2)
    images = {index: IMAGES[index] for index in (2, 3, 5, 7)}
    film.file.hide()  # as a run does
    for index, both in images.items():
        film.put(index, both, nobody)
    assert not list(tmp_path.iterdir()), "nothing remains, however the process ends"
    found = dict(film.images([3, 7]))
    assert film.places().keys() == {3, 5, 7} and list(found) == [3, 7]
    for index, (first, second) in found.items():
        expected = cv2.resize(IMAGES[index][0], (60, 40), interpolation=cv2.INTER_AREA)
        assert first.shape == (40, 60, 3) and np.abs(first.astype(int) - expected).mean() < 3
        assert second.shape == (70, 100, 3) and np.abs(second.astype(int) - IMAGES[index][1]).mean() < 3
        assert np.array_equal(second, IMAGES[index][1]) == plain


@pytest.mark.parametrize("plain", [True, False])
def test_images_of_one_camera_are_exchanged(film: Film, plain: bool) -> None:
    if not plain:
        film.frames = range(3, 50_000, 2)
    for index in (3, 5, 7):
        film.put(index, IMAGES[index], nobody)
    before = dict(film.images([3, 5, 7]))
    assert film.withdraw() == [3, 5, 7] and not film.places()
    for index in (3, 5):  # the process is killed
        film.put(index, [None, IMAGES[index + 1][1]], nobody)
    assert film.places().keys() == {3, 5}
    for index, (first, second) in film.images([3, 5]):
        np.testing.assert_array_equal(first, before[index][0])
        assert np.abs(second.astype(int) - IMAGES[index + 1][1]).mean() < 3
        assert not np.array_equal(second, before[index][1])


def test_another_process_continues_the_film(film: Film) -> None:
    theirs = replace(film, file=NamelessFile(os.dup(film.file.handle)))
    for index, images in IMAGES.items():
        theirs.put(index, images, nobody)
    assert film.places().keys() == {3, 5, 7}
    film.file.truncate(film.file.size() - 1)  # it was killed while it wrote
    assert film.places().keys() == {3, 5}
    film.file.truncate(int(film.places()[5][0]) - 1)
    assert film.places().keys() == {3}


def test_room_is_left_on_the_disk(film: Film, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[str] = []
    film.put(3, IMAGES[3], notes.append)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**9))
    film.put(5, IMAGES[5], notes.append)
    monkeypatch.undo()
    film.put(7, IMAGES[7], notes.append)
    (note,) = notes
    assert note.startswith(f"{tmp_path}: ") and "GB is free" in note and "\n" not in note
    assert not film.places() and film.file.size() == 0


def test_a_full_disk_ends_the_film(film: Film, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[str] = []
    write = NamelessFile.write

    def full(file: NamelessFile, data: list[memoryview], place: int) -> int:
        if place:
            raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))
        return write(file, data, place)

    monkeypatch.setattr(NamelessFile, "write", full)
    for index, images in IMAGES.items():
        film.put(index, images, notes.append)
    assert len(notes) == 1 and os.strerror(errno.EDQUOT) in notes[0] and not film.places()


def test_a_folder_without_room_for_a_file_has_no_film(tmp_path: Path) -> None:
    assert Film.in_folder(tmp_path / "nothing", [(60, 40)]) is None


@pytest.mark.parametrize(
    ("begin", "stop", "fps", "step"),
    [(4, 84, 15, 1), (0, 60, 30, 2), (0, 60, 29.97, 2), (0, 36_000, 60, 12), (7, 8, 240, 16)],
)
def test_films_have_15_images_a_second_and_3000_in_all(begin: int, stop: int, fps: float, step: int) -> None:
    frames = filmed(begin, stop, fps)
    assert frames.step == step and frames[0] == begin and frames[-1] < stop
