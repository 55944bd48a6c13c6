"""Containers and codecs that cameras write: images are found by their time stamps, also after seeking."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from tk.io.captures.referred import open_video_files
from tk.synchronise.looks import first_motion, pictures_at
from tk.synchronise.raw import Recording, read_raw

IMAGES, FPS = 130, 25
FORMATS = [("a.avi", "mjpeg", "yuvj420p"), ("a.mts", "libx264", "yuv420p"), ("a.mkv", "libx264", "yuv420p"),
           ("a.mov", "libx265", "yuv420p"), ("a.mp4", "mpeg4", "yuv420p")]  # fmt: skip


def picture_of(number: int) -> np.ndarray:
    """Return an image (48, 64, 3) whose halves tell its number."""
    picture = np.empty((48, 64, 3), np.uint8)
    picture[:, :32], picture[:, 32:] = 30 + 16 * (number % 13), 30 + 18 * (number // 13)
    return picture


def number_of(picture: np.ndarray) -> int:
    """Return the number that an image shows."""
    left, right = (float(half.mean()) - 30 for half in (picture[:, 4:28], picture[:, 36:60]))
    return 13 * round(right / 18) + round(left / 16)


def write_numbers(path: Path, codec: str, pixels: str, apart: int = 60) -> None:
    """Write a video whose image k is :func:`picture_of` k; ``apart``: images between two key frames."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
        stream.time_base = stream.codec_context.time_base = Fraction(1, FPS)
        stream.codec_context.gop_size = apart
        if codec == "libx265":
            stream.options = {"x265-params": "log-level=error", "preset": "ultrafast"}
        for k in range(IMAGES):
            image = av.VideoFrame.from_ndarray(picture_of(k), format="bgr24")
            image.pts, image.time_base = k, Fraction(1, FPS)
            container.mux(stream.encode(image))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(("name", "codec", "pixels"), FORMATS)
def test_images_are_found_by_their_times(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    """An MPEG stream has no index, and begins with a time that is not 0."""
    write_numbers(tmp_path / name, codec, pixels)
    write_numbers(tmp_path / "b.mp4", "libx264", "yuv420p", 10)
    recording, _ = read_raw(tmp_path)
    assert len(recording.times_s) == IMAGES
    for number in (0, 55, 70, IMAGES - 1):
        (picture,) = pictures_at(recording, [float(recording.times_s[number])], 48)
        assert number_of(picture) == number


@pytest.mark.parametrize(("name", "codec", "pixels"), FORMATS)
def test_a_capture_reads_the_images_that_it_jumps_to(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    write_numbers(tmp_path / name, codec, pixels)
    clip = open_video_files([tmp_path / name])
    out = np.empty((48, 64, 3), np.uint8)
    for number in (3, 70, 125):
        reader = clip.open()
        at = reader.jump(number)
        for _ in range(number - at):
            reader.skip()
        reader.read(out)
        reader.close()
        assert number_of(out) == number


def test_person_who_comes_late_is_found_in_the_key_images(tmp_path: Path) -> None:
    grey = np.full((600, 48, 64), 90, np.uint8) + np.random.default_rng(0).integers(0, 4, (600, 48, 64), np.uint8)
    grey[450:, 10:40, 20:30] = 200
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=3, options={"preset": "ultrafast", "g": "9"})
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        for image in grey:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "gray")))
        container.mux(stream.encode())
    recording = Recording("a", (path,), (0.0,), np.arange(600) / 3, 64, 48)
    begin = first_motion(recording)
    assert begin is not None and 120 <= begin <= 126  # half a minute before 150 s, to a key image
    assert first_motion(replace(recording, times_s=np.arange(300) / 3)) is None  # nobody comes
