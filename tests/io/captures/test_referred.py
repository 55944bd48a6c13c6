"""Captures that refer to videos which stay where they are: other start times, rates and clocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from tests.conftest import refused
from tests.io.conftest import HEIGHT, WIDTH, calibration_tables, write_toml, write_video
from tk.errors import CaptureError
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.referred import open_video_files
from tk.io.captures.video import probe_video

VOLUME = {"center": [0.0, 0.0, 1.0], "size": [1.0, 1.0, 1.0]}
TICK = Fraction(1, 90_000)


def at(seconds: float) -> np.ndarray:
    """Return an image that shows a time, in ms, as two rows of eight black or white stripes; the last one is white."""
    bits = np.array([round(1000 * seconds) >> bit & 1 for bit in range(15)] + [1], np.uint8).reshape(2, 8)
    grey = np.kron(255 * bits, np.ones((HEIGHT // 2, WIDTH // 8), np.uint8))
    return np.ascontiguousarray(np.broadcast_to(grey[..., None], (HEIGHT, WIDTH, 3)))


def seconds_in(image: np.ndarray) -> float:
    """Return the time that an image made by :func:`at` shows; NaN of a blank one."""
    grey = image.mean(axis=2).reshape(2, HEIGHT // 2, 8, WIDTH // 8).mean(axis=(1, 3)).ravel()
    return float(sum(1 << bit for bit in range(15) if grey[bit] > 127)) / 1000 if image.any() else np.nan


def record(path: Path, common: Sequence[float], own: Sequence[float], **options: str) -> None:
    """Write a video whose images show the common time of the moments at which its own clock shows ``own``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=30, options={"crf": "10", "preset": "ultrafast", **options})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = TICK
        for moment, time in zip(common, own, strict=True):
            frame = av.VideoFrame.from_ndarray(at(moment), format="bgr24")
            frame.pts, frame.time_base = round(time / TICK), TICK
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def write_capture(folder: Path, videos: Mapping[str, Any], **settings: Any) -> Path:
    folder.mkdir(exist_ok=True)
    write_toml(folder / "calibration.toml", calibration_tables(len(videos)))
    write_toml(folder / "capture.toml", {"volume": VOLUME, **settings, "videos": dict(videos)})
    return folder


def make(root: Path, clocks: Mapping[str, tuple[float, float, np.ndarray]], **settings: Any) -> Path:
    """Record what cameras with an offset, a rate, and own times show, and a capture that refers to their videos."""
    tables = {}
    for name, (offset, rate, own) in clocks.items():
        record(root / "raw" / f"{name}.mp4", offset + rate * own, own)
        tables[name] = {"path": f"../raw/{name}.mp4", "offset": offset, "rate": rate}
    return write_capture(root / "cap", tables, **settings)


def shown(capture: Capture, start: int = 0, stop: int | None = None) -> np.ndarray:
    """Return (F, C) the times that the images of all frames show."""
    with capture.frames(start, stop) as reader:
        return np.array([[seconds_in(image) for image in frame.images] for frame in reader])


def check_instants(capture: Capture, **asked: Any) -> np.ndarray:
    """Check that every image is within half a frame of its frame's time; return the times that the images show."""
    assert capture.clock is not None
    times = shown(capture, **asked)
    clock = capture.clock.times_s[asked.get("start", 0) :][: len(times)]
    late = np.abs(times - clock[:, None])
    assert (late[np.isfinite(late)] < 0.55 / capture.fps + 1e-3).all()
    return times


def test_other_starts_rates_and_clocks_show_the_same_instant(tmp_path: Path) -> None:
    k = np.arange(100)
    jitter = np.random.default_rng(1).uniform(-0.006, 0.006, 100)
    folder = make(
        tmp_path,
        {
            "cam1": (2.0, 1.0, k / 30),
            "cam2": (1.2137, 1.001, k * 1001 / 30_000 + 0.4),
            "cam3": (2.5, 1.0, k / 30 + jitter + 0.01),
            "cam4": (0.25, 0.999, np.arange(150) / 25),
        },
    )
    capture = open_capture(folder)
    assert capture.fps == pytest.approx(25 / 0.999, rel=1e-3)
    times = check_instants(capture)
    assert np.isfinite(times).all()
    assert times[0].min() > 2.48 and times[-1].max() > 4.9
    assert capture.clock is not None and capture.clock.begin_s == pytest.approx(2.51, abs=0.5 / 25)
    assert any("of the common time" in line for line in capture.warnings)


def test_constant_delays_below_half_a_frame_are_known(tmp_path: Path) -> None:
    own = np.arange(60) / 30
    folder = make(tmp_path, {"cam1": (0.0, 1.0, own), "cam2": (0.5 + 0.012, 1.0, own), "cam3": (0.1, 1.0, own)})
    capture = open_capture(folder)
    assert capture.fps == 30 and capture.late_frames == (0, 0, 0)
    late = np.array(capture.time_offset_s)
    assert late[1] - late[0] == pytest.approx(0.012, abs=1e-4) and late[2] == pytest.approx(late[0], abs=1e-4)
    times = check_instants(capture)
    assert times[:, 1] - times[:, 0] == pytest.approx(0.012, abs=2e-3)


def test_synchronous_cameras_show_the_same_image_wherever_the_frames_begin(tmp_path: Path) -> None:
    own = np.arange(60) / 25
    clocks = {name: (0.0, 1.0, np.round(own + e, 3)) for name, e in (("cam1", 4e-4), ("cam2", -4e-4), ("cam3", 0.0))}
    clocks["cam2"][2][0] = 0.0
    for begin in (0.5, 0.51, 0.52, 0.53):  # 0.02 s is half an interval
        times = check_instants(open_capture(make(tmp_path, clocks, **{"from": begin})))
        assert np.ptp(times, axis=1).max() < 3e-3


def test_from_and_to_bound_the_frames(tmp_path: Path) -> None:
    own = np.arange(120) / 30
    capture = open_capture(make(tmp_path, {"cam1": (0.0, 1, own), "cam2": (0.0, 1, own)}, **{"from": 1.0, "to": 2.0}))
    times = check_instants(capture)
    assert capture.frame_count == 30 and times[0, 0] == 1.0 and times[-1, 0] == pytest.approx(1.967)
    assert (shown(capture, 20, 25) == times[20:25]).all()


def test_chapters_follow_one_another(tmp_path: Path) -> None:
    own = np.arange(60) / 30
    for chapter in range(3):
        record(tmp_path / "raw" / f"GX0{chapter}.MP4", own + 2 * chapter, own)
    record(tmp_path / "raw" / "cam2.mp4", own + 3.5, own)
    tables = {
        "cam1": {"path": [f"../raw/GX0{chapter}.MP4" for chapter in range(3)]},
        "cam2": {"path": "../raw/cam2.mp4", "offset": 3.5},
    }
    capture = open_capture(write_capture(tmp_path / "cap", tables))
    times = check_instants(capture)
    assert capture.frame_count == 60 and np.isfinite(times).all()
    assert (shown(capture, 30, 33) == times[30:33]).all()


def test_a_gap_leaves_the_camera_blank_and_is_reported(tmp_path: Path) -> None:
    own = np.arange(60) / 30
    capture = open_capture(make(tmp_path, {"cam1": (0, 1, own), "cam2": (0, 1, np.delete(own, range(20, 26)))}))
    assert capture.fps == 30
    times = check_instants(capture)
    assert np.flatnonzero(np.isnan(times[:, 1])).tolist() == list(range(20, 26)) and np.isfinite(times[:, 0]).all()
    assert any("frames without an image: cam2 6" in line for line in capture.warnings)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts", ".avi"])
@pytest.mark.parametrize("bframes", ["0", "3"])
def test_reading_begins_at_a_key_image_and_counts_by_time_stamps(tmp_path: Path, suffix: str, bframes: str) -> None:
    own = np.arange(400) / 25
    path = tmp_path / f"a{suffix}"
    record(path, own, own, g="20", bf=bframes, preset="veryfast", sc_threshold="0")
    clip = open_video_files([path])
    if clip.times_s is None:
        pytest.skip("the file gives no times")
    out, reader = np.empty((HEIGHT, WIDTH, 3), np.uint8), clip.open()
    for wanted in (3, 333, 334, 391):
        at_number = reader.jump(wanted)
        assert at_number >= wanted - 40 or not len(clip.keys)  # a key image every 20: it decodes few others
        while at_number < wanted:
            reader.skip()
            at_number += 1
        reader.read(out)
        assert seconds_in(out) == own[wanted]
    reader.close()
    assert len(clip.keys) == 20 or (suffix, bframes) == (".avi", "3")  # such a file has no presentation times


def test_a_file_that_cannot_be_sought_is_read_from_its_start(tmp_path: Path) -> None:
    """Seeking for later times than its own leads to its end."""
    own = np.arange(120) / 25
    record(tmp_path / "a.mp4", own, own, g="20")
    clip = probe_video(tmp_path / "a.mp4")
    assert clip.times_s is not None
    reader, out = replace(clip, times_s=clip.times_s + 100).open(), np.empty((HEIGHT, WIDTH, 3), np.uint8)
    reader.skip()
    assert reader.jump(100) == 1
    reader.read(out)
    assert seconds_in(out) == own[1]
    reader.close()


def test_a_part_of_the_recording_is_the_background_and_not_tracked(tmp_path: Path) -> None:
    own = np.arange(150) / 30
    clocks = {"cam1": (0.0, 1.0, own), "cam2": (0.4, 1.0, own)}
    empty = {"from": 1.0, "to": 2.0}
    capture = open_capture(make(tmp_path, clocks, background=empty))
    assert capture.masks_from == "none"
    assert capture.clock is not None and capture.clock.begin_s == pytest.approx(2.0, abs=0.02)
    background = capture.background()
    assert background is not None
    for images in background:
        seen = [seconds_in(image) for image in images]
        assert len(seen) >= 25 and min(seen) >= 1.0 and max(seen) < 2.0
    assert shown(capture).min() > 1.98
    # at the end of the recording, and with a given begin
    capture = open_capture(make(tmp_path, clocks, background={"from": 4.0, "to": 4.9}))
    assert shown(capture).min() < 0.45 and shown(capture).max() <= 4.0
    capture = open_capture(make(tmp_path, clocks, background=empty, **{"from": 0.5}))
    assert shown(capture).min() < 0.55 and any("include the empty scene" in line for line in capture.warnings)
    with refused(CaptureError, "cap/capture.toml: [background]", "cam1.mp4 has no image from 7 to 8 s"):
        open_capture(make(tmp_path, clocks, background={"from": 7.0, "to": 8.0}))
    (tmp_path / "cap" / "background").mkdir()
    with refused(CaptureError, "has [background], and the folder background/ is there, too"):
        open_capture(make(tmp_path, clocks, background=empty))


def test_span_and_background_also_hold_for_videos_in_the_folder(tmp_path: Path) -> None:
    own = np.arange(90) / 30
    folder = write_capture(tmp_path / "cap", {"cam1": {}, "cam2": {}})
    for name in ("cam1", "cam2"):
        record(folder / "videos" / f"{name}.mp4", own, own)
    write_toml(folder / "capture.toml", {"volume": VOLUME, "background": {"from": 0.0, "to": 1.0}, "to": 2.5})
    capture = open_capture(folder)
    times = check_instants(capture)
    assert times[0].tolist() == [1.0, 1.0] and times[-1].max() < 2.5
    assert capture.background() is not None


def test_masks_of_tk_masks_are_of_frames_and_other_masks_of_images(tmp_path: Path) -> None:
    own = np.arange(60) / 30
    folder = make(tmp_path, {"cam1": (0.0, 1.0, own), "cam2": (1.0, 1.0, own)})
    for name in ("cam1", "cam2"):
        write_video(
            folder / "masks" / f"{name}.mp4", [np.full((48, 64, 3), 255 * (k % 5 == 0), np.uint8) for k in range(60)]
        )

    def white() -> list[list[bool]]:
        with open_capture(folder).frames() as reader:
            return [[bool(mask.any()) for mask in frame.masks] for frame in reader if frame.masks is not None]

    assert white() == [[(k + 30) % 5 == 0, k % 5 == 0] for k in range(30)]
    clock = open_capture(folder).clock
    assert clock is not None
    write_toml(folder / "masks" / "masks.toml", {"clock": clock.text})
    for name in ("cam1", "cam2"):
        write_video(
            folder / "masks" / f"{name}.mp4", [np.full((48, 64, 3), 255 * (k % 7 == 0), np.uint8) for k in range(30)]
        )
    assert white() == [[k % 7 == 0] * 2 for k in range(30)]
    settings = {"volume": VOLUME, "from": 1.5, "videos": {n: {"path": f"../raw/{n}.mp4"} for n in ("cam1", "cam2")}}
    write_toml(folder / "capture.toml", settings)
    with refused(CaptureError, "masks.toml", "of other frames", "make them again with tk masks"):
        open_capture(folder)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"rate": 0.0}, "capture.toml: [videos.cam2]: rate = 0 must be positive"),
        ({"rate": float("nan")}, "[videos.cam2]: rate = nan must be a finite number"),
        ({"rate": -1.0}, "[videos.cam2]: rate = -1 must be positive"),
        ({"offset": float("nan")}, "[videos.cam2]: offset = nan must be a finite number"),
        ({"offset": float("inf")}, "[videos.cam2]: offset = inf must be a finite number"),
        ({"offset": 100.0}, "cam2.mp4: begins at 100.00 s of the common time, and"),
        ({"offset": 0.4}, "fewer than 2 frames"),
        ({"path": "../raw/none.mp4"}, "[videos.cam2]: path ../raw/none.mp4 does not exist"),
        ({"path": "../raw"}, "[videos.cam2]: path ../raw is a folder"),
        ({"path": []}, "[videos.cam2]: path must be the name of a file"),
        ({"path": 3}, "[videos.cam2]: path must be the name of a file"),
        ({"path": "../raw/cam1.mp4"}, "is given twice, also in [videos.cam1]"),
        ({"path": ["../raw/cam2.mp4", "../raw/cam2.mp4"]}, "is given twice"),
        ({"path": "capture.toml"}, "cap/capture.toml: "),
    ],
)
def test_bad_videos_are_refused(tmp_path: Path, change: dict[str, Any], complaint: str) -> None:
    own = np.arange(13) / 30
    tables: dict[str, Any] = {}
    for name in ("cam1", "cam2"):
        record(tmp_path / "raw" / f"{name}.mp4", own, own)
        tables[name] = {"path": f"../raw/{name}.mp4"}
    tables["cam2"] |= change
    with refused(CaptureError, complaint):
        open_capture(write_capture(tmp_path / "cap", tables))


def test_names_and_folders_that_contradict_the_videos_are_refused(tmp_path: Path) -> None:
    own = np.arange(13) / 30
    record(tmp_path / "raw" / "a.mp4", own, own)
    record(tmp_path / "raw" / "b.mp4", own, own)
    cap = tmp_path / "cap"
    tables = {"cam1": {"path": "../raw/a.mp4"}, "cam2": {"path": "../raw/b.mp4"}}
    write_capture(cap, tables)
    write_toml(cap / "capture.toml", {"volume": VOLUME, "videos": {**tables, "door": {"path": "../raw/b.mp4"}}})
    with refused(CaptureError, "[videos.door]: calibration.toml has no such camera; it has cam1, cam2"):
        open_capture(cap)
    write_toml(cap / "capture.toml", {"volume": VOLUME, "videos": {"cam1": tables["cam1"]}})
    with refused(CaptureError, "camera 'cam2' has no table in [videos]"):
        open_capture(cap)
    write_toml(cap / "capture.toml", {"volume": VOLUME, "from": 3.0, "to": 2.0, "videos": tables})
    with refused(CaptureError, "from = 3 must be before to = 2"):
        open_capture(cap)
    write_toml(cap / "capture.toml", {"volume": VOLUME, "from": 3.0, "videos": tables})
    with refused(CaptureError, "from = 3 is after the end of the videos, 0.40 s"):
        open_capture(cap)
    for folder in ("videos", "images", "timestamps"):
        write_capture(cap, tables)
        (cap / folder).mkdir()
        with refused(CaptureError, f"has [videos], and the folder {folder}/ is there, too"):
            open_capture(cap)
        (cap / folder).rmdir()


def test_times_by_fps_and_delays_of_the_calibration_count(tmp_path: Path) -> None:
    slow = np.arange(60) / 30  # as it is played; recorded at 120 frames/s
    tables = {}
    for name, offset in (("cam1", 0.0), ("cam2", 0.1)):
        record(tmp_path / "raw" / f"{name}.mp4", offset + slow / 4, slow)
        tables[name] = {"path": f"../raw/{name}.mp4", "offset": offset}
    folder = write_capture(tmp_path / "cap", tables, fps=120.0, times="fps")
    assert check_instants(open_capture(folder)).shape == (48, 2)
    document = calibration_tables(2)
    document["cam2"]["time_offset"] = 0.1
    tables["cam2"]["offset"] = 0.0
    write_capture(tmp_path / "cap", tables, fps=120.0, times="fps")
    write_toml(folder / "calibration.toml", document)
    assert check_instants(open_capture(folder)).shape == (48, 2)
