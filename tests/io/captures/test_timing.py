"""Cameras of different and variable rates: refused, or resampled by their time stamps."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from tests.conftest import refused
from tests.io.conftest import MakeCapture, picture, read_tag, write_toml, write_video
from tk.errors import CaptureError, ClockError
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.timing import chapter_shifts

VOLUME = {"center": [0.0, 0.0, 1.0], "size": [1.0, 1.0, 1.0]}


def write_uneven_video(path: Path, pictures: Sequence[np.ndarray], seconds: Sequence[float]) -> None:
    """Write a video with these time stamps, as phones do."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=30, options={"crf": "10"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.codec_context.time_base = Fraction(1, 90_000)
        for image, time in zip(pictures, seconds, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
            frame.pts, frame.time_base = round(90_000 * time), Fraction(1, 90_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def film(folder: Path, **rates: int) -> None:
    """Write a video of 0.8 s for each camera. No image is black, as the first one of :func:`make_capture` is."""
    for number, (camera, fps) in enumerate(rates.items(), 1):
        images = [picture(number, k) for k in range(round(0.8 * fps))]
        write_video(folder / "videos" / f"{camera}.mp4", images, fps)


def write_times(folder: Path, **seconds: Sequence[float]) -> None:
    (folder / "timestamps").mkdir(exist_ok=True)
    for camera, times in seconds.items():
        text = "\n".join(f"{time:.6f}" for time in times)
        (folder / "timestamps" / f"{camera}.csv").write_text(f"seconds\n{text}\n")


def shown(capture: Capture) -> list[list[int | None]]:
    """Return the number of the image that each camera shows in each frame; None for a blank one."""
    frames = []
    with capture.frames() as reader:
        for frame in reader:
            tags = [read_tag(image) if image.any() else None for image in frame.images]
            assert all(tag is None or tag[0] == c + 1 for c, tag in enumerate(tags))
            frames.append([None if tag is None else tag[1] for tag in tags])
    return frames


@pytest.fixture
def mixed(make_capture: MakeCapture) -> Path:
    """Three cameras for 0.8 s: two of 15 frames/s, and cam2 of 30."""
    folder = make_capture()
    film(folder, cam1=15, cam2=30, cam3=15)
    return folder


def test_cameras_of_different_rates_are_refused(mixed: Path) -> None:
    with refused(ClockError, mixed / "videos" / "cam2.mp4", "30 frames/s", "cam1.mp4 15 frames/s") as caught:
        open_capture(mixed)
    assert "--" not in str(caught.value)
    assert "--resample" in caught.value.hint


def test_resampling_takes_the_nearest_images_at_the_slowest_rate(mixed: Path) -> None:
    capture = open_capture(mixed, resample=True)
    assert (capture.fps, capture.frame_count, capture.resampled) == (15.0, 12, True)
    assert any("resampled to 15 frames/s" in line for line in capture.warnings)
    assert shown(capture) == [[k, 2 * k, k] for k in range(12)]
    with capture.frames(7, 9) as reader:  # decoding starts before the first of these
        assert [read_tag(frame.images[1])[1] for frame in reader] == [14, 16]


def test_frames_without_a_near_image_are_blank(mixed: Path) -> None:
    write_toml(mixed / "capture.toml", {"fps": 30.0, "volume": VOLUME})
    capture = open_capture(mixed, resample=True)
    assert capture.fps == 30
    assert any("frames without an image: cam1 11, cam3 11" in line for line in capture.warnings)
    rows = shown(capture)
    assert rows[:4] == [[0, 0, 0], [None, 1, None], [1, 2, 1], [None, 3, None]]


def test_masks_are_resampled_with_their_images(mixed: Path) -> None:
    for camera, count in enumerate((12, 24, 12)):
        images = [np.full((48, 64, 3), 255 * (k % 4 == 0), np.uint8) for k in range(count)]
        write_video(mixed / "masks" / f"cam{camera + 1}.mp4", images)
    with open_capture(mixed, resample=True).frames() as reader:
        white = [[bool(mask.any()) for mask in frame.masks] for frame in reader if frame.masks is not None]
    assert white == [[k % 4 == 0, k % 2 == 0, k % 4 == 0] for k in range(12)]


def test_fps_that_contradicts_the_videos_is_refused(make_capture: MakeCapture) -> None:
    folder = make_capture()
    write_toml(folder / "capture.toml", {"fps": 25.0, "volume": VOLUME})
    with refused(ClockError, folder / "capture.toml", "fps = 25", "cam1.mp4 has 15 frames/s", "remove fps"):
        open_capture(folder)


def test_slow_motion_is_read_at_the_rate_at_which_it_was_recorded(make_capture: MakeCapture) -> None:
    folder = make_capture()
    film(folder, cam1=15, cam2=15, cam3=15)
    write_toml(folder / "capture.toml", {"fps": 60.0, "volume": VOLUME})
    with refused(ClockError, "fps = 60", "15 frames/s", "slow motion", 'times = "fps"') as caught:
        open_capture(folder)
    assert caught.value.hint == ""  # resampling would leave three of four frames without an image
    with refused(ClockError, "no camera has more than 15 frames/s", "fps = 60", 'times = "fps"'):
        open_capture(folder, resample=True)
    write_toml(folder / "capture.toml", {"fps": 60.0, "times": "fps", "volume": VOLUME})
    capture = open_capture(folder)
    assert (capture.fps, capture.frame_count, capture.warnings) == (60.0, 12, ())
    assert shown(capture) == [[k, k, k] for k in range(12)]
    assert open_capture(folder, resample=True).frame_count == 12


def test_time_stamps_also_describe_slow_motion(make_capture: MakeCapture) -> None:
    folder = make_capture()
    film(folder, cam1=15, cam2=15, cam3=15)
    write_toml(folder / "capture.toml", {"fps": 60.0, "volume": VOLUME})
    write_times(folder, **{f"cam{k}": np.arange(12) / 60 for k in (1, 2, 3)})
    assert open_capture(folder).fps == 60


def test_times_by_fps_need_fps(make_capture: MakeCapture) -> None:
    for settings, part in (({"times": "fps"}, "needs fps"), ({"times": "slow"}, "must be one of files, fps")):
        folder = make_capture(settings=settings, name=part)
        with refused(CaptureError, folder / "capture.toml", part):
            open_capture(folder)


def test_a_lower_rate_may_be_resampled(make_capture: MakeCapture) -> None:
    folder = make_capture()
    film(folder, cam1=30, cam2=30, cam3=30)
    write_toml(folder / "capture.toml", {"fps": 15.0, "volume": VOLUME})
    with pytest.raises(ClockError) as caught:
        open_capture(folder)
    assert "--resample" in caught.value.hint
    assert shown(open_capture(folder, resample=True))[:12] == [[2 * k] * 3 for k in range(12)]


def test_a_camera_that_drops_images_has_the_rate_of_its_intervals(make_capture: MakeCapture) -> None:
    folder = make_capture()
    kept = [k for k in range(30) if k % 10 != 5]
    for camera in (1, 2, 3):
        images = [picture(camera, k) for k in kept]
        write_uneven_video(folder / "videos" / f"cam{camera}.mp4", images, [k / 30 for k in kept])
    write_toml(folder / "capture.toml", {"fps": 30.0, "volume": VOLUME})
    rows = shown(open_capture(folder, resample=True))
    assert rows[:8] == [[k, k, k] if k != 5 else [None] * 3 for k in range(8)]


@pytest.mark.parametrize("rates", [(30.0, 29.97, 30.0), (29.97, 29.97, 29.97), (30.0, 30.0, 30.0)])
def test_rounded_rates_are_accepted(make_capture: MakeCapture, rates: Sequence[float]) -> None:
    folder = make_capture(settings={"fps": 30.0, "volume": VOLUME})
    for camera, fps in enumerate(rates):
        write_video(folder / "videos" / f"cam{camera + 1}.mp4", [picture(camera, k) for k in range(30)], fps)
    capture = open_capture(folder)
    assert capture.fps == 30 and capture.warnings == ()


def test_a_variable_rate_is_noted_and_resampled(make_capture: MakeCapture) -> None:
    folder = make_capture()
    for camera in (1, 3):
        write_video(folder / "videos" / f"cam{camera}.mp4", [picture(camera, k) for k in range(22)])
    times = np.arange(22) / 15
    times[8:14] += 1.2 / 15  # frames 7 and 8 are farther apart, frames 13 and 14 nearer
    times[13] = times[14] - 0.01
    write_uneven_video(folder / "videos" / "cam2.mp4", [picture(2, k) for k in range(22)], times.tolist())
    notes = " ".join(open_capture(folder).warnings)
    assert "cam2.mp4: has a variable frame rate" in notes and "the option resample corrects that" in notes
    capture = open_capture(folder, resample=True)
    rows = shown(capture)
    nearest = [int(np.abs(times - k / 15).argmin()) for k in range(22)]
    near = [abs(times[n] - k / 15) < 0.5 / 15 for k, n in enumerate(nearest)]
    assert [row[1] for row in rows] == [n if ok else None for n, ok in zip(nearest, near, strict=True)]
    assert None in [row[1] for row in rows] and [row[0] for row in rows] == list(range(22))


def test_time_stamps_replace_the_times_of_the_videos(mixed: Path) -> None:
    even = np.arange(12) / 15
    write_times(mixed, cam1=even, cam2=np.arange(24) / 15, cam3=even)
    assert open_capture(mixed).fps == 15  # the videos' own rates do not count
    write_times(mixed, cam1=even, cam2=np.arange(24) / 15 - 0.2, cam3=even)  # cam2 has begun 0.2 s before
    with refused(ClockError, mixed / "timestamps" / "cam2.csv", "0.2 s earlier"):
        open_capture(mixed)
    capture = open_capture(mixed, resample=True)
    assert shown(capture) == [[k, k + 3, k] for k in range(12)]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0\n1\n", "has 2 times, and"),
        ("0\nx\n", "line 2: 'x' must be seconds"),
        ("0\n" * 24, "must be finite and increase"),
        ("nan\n" * 24, "must be finite and increase"),
        ("", "has 0 times"),
        ("\n".join(map(str, range(30))), "has 30 times, and"),
        ("\n".join(str(1000 * k / 30) for k in range(24)), "must be seconds, and are 33.33 apart"),
    ],
)
def test_bad_time_stamps_are_refused(mixed: Path, text: str, complaint: str) -> None:
    write_times(mixed, cam1=np.arange(12) / 15, cam2=np.arange(24) / 30, cam3=np.arange(12) / 15)
    (mixed / "timestamps" / "cam2.csv").write_text(text)
    with refused(CaptureError, mixed / "timestamps" / "cam2.csv", complaint):
        open_capture(mixed, resample=True)
    (mixed / "timestamps" / "cam2.csv").unlink()
    with refused(CaptureError, mixed / "timestamps" / "cam2.csv", "is missing"):
        open_capture(mixed)


def test_images_without_times_cannot_be_resampled(make_capture: MakeCapture) -> None:
    from tests.io.conftest import write_picture

    folder = make_capture()
    (folder / "videos").rename(folder / "old")
    for camera in range(3):
        for k in range(4):
            write_picture(folder / "images" / f"cam{camera + 1}" / f"{k:06d}.png", picture(camera, k))
    with refused(CaptureError, "cam1", "add timestamps/"):
        open_capture(folder, resample=True)
    write_times(folder, cam1=[0, 1, 2, 3], cam2=[0, 1, 2, 3], cam3=[0, 1, 2, 3])
    assert open_capture(folder).fps == 1


def test_chapter_begins_one_interval_of_the_one_before_after_its_end() -> None:
    slow, fast = np.arange(5) / 10, np.arange(5) / 100
    assert chapter_shifts([slow, fast, slow]) == pytest.approx([0, 0.5, 0.55])
