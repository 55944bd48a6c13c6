"""Faults of a video that its offset does not show: speed, order, a frozen picture, exchanged videos."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from tests.synchronise.scenes import ring, wander, watch
from tests.synchronise.test_command import write
from tests.synchronise.test_sound import steps
from tk.synchronise.faults import (
    SURE,
    exchanged_videos,
    other_speed_or_order,
    sound_in_other_order,
    still_parts,
    unchecked_chapters,
)
from tk.synchronise.looks import GRID_HZ, Look
from tk.synchronise.raw import Recording
from tk.synchronise.sound import RATE, Track, hear, read_track
from tk.synchronise.ties import Clocks, Tie

Float = NDArray[np.float64]
LENGTH_S, FPS = 16.0, 15.0


def clocks(offsets: Sequence[float] = (0.0, 0.0, 0.0)) -> Clocks:
    count = len(offsets)
    return Clocks(np.array(offsets), np.ones(count), np.zeros(count), np.zeros(count))


def recordings(looks: Sequence[Look]) -> list[Recording]:
    return [Recording(f"cam{c}", (Path("v"),), (0.0,), look.times_s, 160, 90) for c, look in enumerate(looks)]


@pytest.fixture(scope="module")
def looks() -> list[Look]:
    """What three cameras see of two balls, without offsets."""
    return [watch(camera, [wander(0), wander(1)], 0.0, LENGTH_S, FPS, seed=c) for c, camera in enumerate(ring(3))]


def motion(length_s: float = 40.0) -> list[Float]:
    """Return (N, 2) signals of the motion that three cameras see, with noise."""
    random = np.random.default_rng(0)
    common = gaussian_filter1d(random.standard_normal((round(length_s * GRID_HZ), 2)), 0.15 * GRID_HZ, axis=0)
    noise = gaussian_filter1d(random.standard_normal((3, *common.shape)), 0.1 * GRID_HZ, axis=1)
    return list(common / common.std() + 0.7 * noise / noise.std())


def slowed(signal: Float) -> Float:
    """Return a signal as of 30 images/s that are labelled 25."""
    at = np.arange(0, len(signal) - 1, 1 / 1.2)
    return np.stack([np.interp(at, np.arange(len(signal)), column) for column in signal.T], axis=1)


def motion_fault(
    signals: Sequence[Float], offsets: Sequence[float] = (0.0, 0.0, 0.0), ties: Sequence[Tie] = ()
) -> dict[int, str]:
    looks = [Look(np.arange(len(one)) / GRID_HZ, np.zeros((2, 2, 2), np.uint8)) for one in signals]
    return other_speed_or_order(recordings(looks), [(0.0, one) for one in signals], clocks(offsets), ties)


def test_right_motion_has_no_fault() -> None:
    one, two, three = motion()
    assert motion_fault([one, two[5 * GRID_HZ :], three], (0.0, 5.0, 0.0)) == {}


@pytest.mark.parametrize("known", [True, False])
def test_wrong_rate_of_a_file_is_named(known: bool) -> None:
    """30 images/s that are labelled 25, also where no method gives an offset."""
    one, two, three = motion()
    (camera, text), = motion_fault([one, slowed(two), three], (0, 0 if known else np.nan, 0)).items()  # fmt: skip
    assert camera == 1 and "its motion is 1.2 times slower than that of the others" in text


def test_camera_that_is_synchronised_is_not_blamed_for_one_that_is_not() -> None:
    one, two, three = motion()
    assert motion_fault([one, slowed(two), np.roll(three, 9 * GRID_HZ, axis=0)], (0.0, 0.0, np.nan)) == {}


def test_chapters_in_another_order_are_named() -> None:
    one, two, three = motion()
    half = len(two) // 2
    (camera, text), = motion_fault(
        [one, np.concatenate([two[half:], two[:half]]), three], (0.0, 20.0, 0.0)
    ).items()  # fmt: skip
    assert camera == 1 and "from 20.0 s to 40.0 s fits the others 40.0 s earlier than the rest" in text


def test_motion_that_repeats_is_no_fault_where_sounds_fit_in_both_halves() -> None:
    """A rhythm, as of a board that is held at place after place, fits as well a period later."""
    one, two, three = motion()
    half = len(two) // 2
    two = np.concatenate([two[:half], np.roll(three[half:], 5 * GRID_HZ, axis=0)])
    sounds = [Tie(0, 1, at, at, 3e-4, "sound") for at in (2.0, 38.0)]
    for known, fits in ((sounds, True), (sounds[:1], False), ([sounds[0], replace(sounds[1], own_i=33.0)], False)):
        assert (motion_fault([one, two, three], ties=known) == {}) == fits


def test_seconds_in_which_hardly_anything_moves_are_no_fault() -> None:
    """The end of all recordings is alike, and so is a pause of one camera: two seconds would fit there exactly."""
    one, two, three = (signal.copy() for signal in motion())
    pause = np.linspace(-3.0, 3.0, round(2.5 * GRID_HZ))[:, None].repeat(2, axis=1)
    for signal in (one, two, three):
        signal[-len(pause) :] = pause
    half = len(two) // 2
    two[half : half + len(pause)] = pause
    assert motion_fault([one, two, three]) == {}


def test_right_pictures_have_no_fault(looks: list[Look]) -> None:
    assert still_parts(recordings(looks), looks, clocks()) == []


def test_sound_of_chapters_in_another_order_is_named() -> None:
    sound = 0.3 * steps(0, 40.0)
    noise = 0.01 * np.random.default_rng(0).standard_normal((3, len(sound)))
    tracks = [Track(0.0, (sound + one).astype(np.float32)) for one in noise]
    assert sound_in_other_order(hear(tracks)) == {}
    lost = np.concatenate([tracks[1].samples[: 20 * RATE], tracks[1].samples[24 * RATE :]])
    (camera, text), = sound_in_other_order(hear([tracks[0], Track(0.0, lost), tracks[2]])).items()  # fmt: skip
    assert camera == 1 and "fits the others 4.0 s later than the rest" in text


def test_picture_that_freezes_is_named(looks: list[Look]) -> None:
    greys = looks[1].greys.copy()
    greys[100:] = greys[100]
    (line,) = still_parts(recordings(looks), [looks[0], replace(looks[1], greys=greys), looks[2]], clocks())
    assert line.startswith("camera cam1: nothing moves in its picture from 7.0 s to 16.0 s") and "frozen" in line


def test_exchanged_videos_are_named() -> None:
    looks = [watch(camera, [wander(0)], 0.0, 8.0, FPS, seed=c) for c, camera in enumerate(ring(4))]
    zero = clocks((0.0,) * 4)
    right = exchanged_videos(recordings(looks), looks, ring(4), zero)
    assert right is not None and right[0] > SURE
    turned = [looks[0], looks[3], looks[2], looks[1]]
    wrong = exchanged_videos(recordings(turned), turned, ring(4), zero)
    assert wrong is not None and wrong[0] < 1 - SURE and wrong[1] == (1, 3)
    other = [recordings(turned)[0], replace(recordings(turned)[1], width=90)]
    assert exchanged_videos(other, turned[:2], ring(4)[:2], clocks((0.0, 0.0))) is None  # images of another size


def test_exchange_is_open_where_nothing_moves() -> None:
    looks = [watch(camera, [], 0.0, 8.0, FPS, seed=c) for c, camera in enumerate(ring(3))]
    found = exchanged_videos(recordings(looks), looks, ring(3), clocks())
    assert found is not None and 1 - SURE < found[0] < SURE


def test_chapter_that_nothing_confirms_is_named() -> None:
    """A mute camera has a chapter of 1.5 s; the motion of the others is known for all of it."""
    one, two, three = motion()
    looks = [Look(np.arange(len(one)) / GRID_HZ, np.zeros((2, 2, 2), np.uint8))] * 3
    every = recordings(looks)
    signals = [(0.0, each) for each in (one, two, three)]
    every[1] = replace(every[1], paths=(Path("1.mp4"), Path("2.mp4")), shifts_s=(0.0, 20.0))
    assert unchecked_chapters(every, signals, clocks(), ()) == []
    every[1] = replace(every[1], shifts_s=(0.0, 38.5))
    (line,) = unchecked_chapters(every, signals, clocks(), ())
    assert line.startswith("camera cam1: nothing confirms when 2.mp4 was recorded")
    heard = Tie(0, 1, 39.2, 39.2, 3e-4, "sound")
    assert unchecked_chapters(every, signals, clocks(), (heard,)) == []


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no FFmpeg is installed (Debian's package: ffmpeg)")
def test_sound_of_a_file_that_was_cut_between_two_images_is_in_the_time_of_its_images(tmp_path: Path) -> None:
    """FFmpeg gives the first image that is shown the time 0; the sound begins 0.03 s before it."""
    whole, cut = tmp_path / "whole.mp4", tmp_path / "cut.mp4"
    look = Look(np.arange(100) / 25, np.random.default_rng(0).integers(0, 255, (100, 48, 64), np.uint8))
    write(whole, look, steps(0, 4.0))
    subprocess.run(["ffmpeg", "-v", "error", "-ss", "1.37", "-i", str(whole), "-c", "copy", str(cut)], check=True)
    a, b = (read_track(Recording("a", (path,), (0.0,), look.times_s, 64, 48)) for path in (whole, cut))
    assert a is not None and b is not None and b.start_s == pytest.approx(-0.03, abs=1e-3)
    ties = hear([a, b])[0, 1].ties
    assert ties and ties[0].own_i - ties[0].own_j == pytest.approx(1.40, abs=2e-3)
