"""Videos as camcorders, phones and editors write them: each image is read once, in order, and counted as decoded."""

from __future__ import annotations

import dataclasses
import shutil
import struct
from collections.abc import Callable, Sequence
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from tests.conftest import refused
from tests.io.conftest import HEIGHT, WIDTH, MakeCapture, picture, read_tag
from tk.errors import VideoError
from tk.io.captures import video
from tk.io.captures.capture import open_capture
from tk.io.captures.clip import Clip
from tk.io.captures.packets import read_contents
from tk.io.captures.video import probe_video

CODECS = {".wmv": "wmv2", ".mpg": "mpeg2video", ".webm": "libvpx"}
INTERLACED = {"flags": "+ilme+ildct", "x264-params": "tff=1"}
GROUPS = {"x264-params": "keyint=8:min-keyint=8:scenecut=0:bframes=2:b-adapt=0:open-gop=1"}


def write(
    path: Path,
    numbers: Sequence[int],
    codec: str = "libx264",
    options: dict[str, str] | None = None,
    fps: int = 25,
    camera: int = 1,
    times: Callable[[int], float] | None = None,
    keep: Callable[[int, Any], bool] | None = None,
    shift: int = 0,
    sound_s: float = 0.0,
    turn: int = 0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Path:
    """Write a video of :func:`picture`, coded by PyAV.

    Args:
        times: time of an image, seconds; by default regular.
        keep: whether the packet with a number is written.
        shift: frames by which all times are earlier; MP4 gets an edit list that excludes what lies before 0.
        sound_s: duration of a track of sound.
        turn: degrees, counter-clockwise, by which the file asks players to turn its images.
        size: of the images as they are coded.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=fps, options={"crf": "10"} | (options or {}))
        (stream.width, stream.height), stream.pix_fmt = size, "yuv420p"
        if codec == "mpeg2video":
            stream.codec_context.max_b_frames, stream.codec_context.bit_rate = 2, 2_000_000
        if times:
            stream.codec_context.time_base = Fraction(1, 1000)
        sound: Any = container.add_stream("aac", rate=8000, layout="mono") if sound_s else None
        packets = []
        for place, number in enumerate(numbers):
            frame = av.VideoFrame.from_ndarray(picture(camera, number, size), format="bgr24")
            if times:
                frame.pts, frame.time_base = round(1000 * times(place)), Fraction(1, 1000)
            packets += stream.encode(frame)
        packets += stream.encode(None)
        for k, packet in enumerate(packets):
            if keep is None or keep(k, packet):
                if shift:
                    ticks = round(shift / fps / packet.time_base)
                    packet.pts, packet.dts = packet.pts - ticks, packet.dts - ticks
                container.mux(packet)
        if sound:
            quiet = av.AudioFrame.from_ndarray(np.zeros((1, round(8000 * sound_s)), np.float32), "fltp", "mono")
            quiet.rate = 8000
            for packet in [*sound.encode(quiet), *sound.encode(None)]:
                container.mux(packet)
    if turn:  # the matrix in the header of the track
        one, cos, sin = 1 << 16, round(np.cos(np.radians(turn))), round(np.sin(np.radians(turn)))
        before = struct.pack(">9i", one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
        after = struct.pack(">9i", cos * one, -sin * one, 0, sin * one, cos * one, 0, 0, 0, 1 << 30)
        head, track, rest = path.read_bytes().partition(b"tkhd")
        path.write_bytes(head + track + rest.replace(before, after, 1))
    return path


def tags(clip: Clip) -> list[int]:
    """Return the numbers of a clip's images, up to the last that can be read."""
    found, out = [], np.zeros((clip.height, clip.width, 3), np.uint8)
    with closing(clip.open()) as reader:
        while True:
            try:
                reader.read(out)
            except VideoError:
                return found
            found.append(read_tag(out)[1])


@pytest.mark.parametrize("name", ["a.mp4", "a.mts", "a.mkv", "a.mpg"])
def test_interlaced_videos_are_read_and_noted(tmp_path: Path, name: str) -> None:
    codec = CODECS.get(Path(name).suffix, "libx264")
    path = write(tmp_path / name, range(12), codec, INTERLACED if codec == "libx264" else {"flags": "+ilme+ildct"})
    clip = probe_video(path)
    assert (clip.interlaced, clip.frame_count, clip.by_opencv) == (True, 12, False)
    assert tags(clip) == list(range(12))
    assert tags(clip.reduced(2)) == list(range(12))
    (note,) = video.notes_on([clip, clip])
    assert "a" + path.suffix in note and "1 more" in note and "ffmpeg" in note and "bwdif" in note


@pytest.mark.parametrize("name", ["a.mp4", "a.mov"])
def test_a_video_cut_by_an_edit_list_has_the_images_that_players_show(tmp_path: Path, name: str) -> None:
    clip = probe_video(write(tmp_path / name, range(12), shift=5))
    assert (clip.frame_count, clip.undecodable) == (7, 0)
    assert tags(clip) == list(range(5, 12))
    assert clip.times_s == pytest.approx(np.arange(7) / 25)


@pytest.mark.parametrize("name", ["a.mkv", "a.ts", "a.mp4", "a.avi"])
@pytest.mark.parametrize("begins", ["with an open group", "within a group"])
def test_images_that_refer_to_missing_ones_are_not_counted(tmp_path: Path, name: str, begins: str) -> None:
    keys = []

    def keep(k: int, packet: Any) -> bool:
        if packet.is_keyframe:
            keys.append(k)
        return len(keys) >= 2 or (begins == "within a group" and k >= 3)

    clip = probe_video(write(tmp_path / name, range(24), options=GROUPS, keep=keep))
    found = tags(clip)
    assert len(found) == clip.frame_count
    assert found == list(range(found[0], 24)) and 4 <= found[0] <= 10
    if clip.times_s is not None:
        assert np.diff(clip.times_s) == pytest.approx(1 / 25, abs=2e-3)


def test_videos_of_normal_files_are_left_to_opencv(tmp_path: Path) -> None:
    for name, options in (("a.mp4", {}), ("a.mkv", GROUPS), ("a.avi", {"x264-params": "bframes=0"}), ("a.ts", {})):
        clip = probe_video(write(tmp_path / name, range(20), options=options))
        assert (clip.by_opencv, clip.frame_count, name) == (True, 20, name)


@pytest.mark.parametrize("fault", ["black", "old", "silent"])
def test_a_fault_of_the_decoder_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    path = write(tmp_path / "a.mp4", range(12))

    class Faulty:
        def __init__(self) -> None:
            self.first = np.full((HEIGHT, WIDTH, 3), 0, np.uint8) if fault == "black" else picture(1, 0)

        def read(self) -> tuple[bool, np.ndarray | None]:
            return (False, None) if fault == "silent" else (True, self.first)

        def isOpened(self) -> bool:
            return True

        def release(self) -> None: ...

    assert probe_video(path).by_opencv
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: Faulty())
    clip = probe_video(path)
    assert not clip.by_opencv and tags(clip) == list(range(12))


def test_two_packets_an_image_are_one_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As camcorders store the two fields; no encoder at hand does."""
    from tk.io.captures import packets

    path = write(tmp_path / "a.ts", range(40), options=INTERLACED)
    decode = packets._decode_times
    monkeypatch.setattr(packets, "_decode_times", lambda path, most: decode(path, most)[::2])
    found = read_contents(path)
    assert found.frame_count == 20
    assert found.times_s is not None
    assert found.times_s - found.times_s[0] == pytest.approx(np.arange(20) * 2 / 25, abs=1e-3)


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_a_track_of_sound_may_be_longer_than_the_images(tmp_path: Path, name: str) -> None:
    clip = probe_video(write(tmp_path / name, range(20), sound_s=2.0))
    assert clip.frame_count == 20 and tags(clip) == list(range(20))


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_a_variable_rate_is_no_damage(tmp_path: Path, name: str) -> None:
    clip = probe_video(write(tmp_path / name, range(20), times=lambda k: 0.04 * k + 0.4 * (k >= 10)))
    assert clip.frame_count == 20 and tags(clip) == list(range(20))
    assert clip.times_s is not None and clip.times_s[-1] == pytest.approx(1.16, abs=2e-3)


@pytest.mark.parametrize("name", ["Cam 1.MOV", "cam_1.M4V", "CAM1.MTS", "cam1.ts", "cam1.webm", "cam1.wmv", "cam1.mpg"])
def test_other_formats_and_spellings_are_found(make_capture: MakeCapture, name: str) -> None:
    folder = make_capture()
    for camera in (1, 2, 3):
        (folder / "videos" / f"cam{camera}.mp4").unlink()
        codec = CODECS.get(Path(name).suffix.lower(), "libx264")
        other = folder / "videos" / name.replace("1", str(camera))
        write(other.with_suffix(other.suffix.lower()), range(8), codec, camera=camera).rename(other)
    capture = open_capture(folder)
    assert (capture.frame_count, capture.fps) == (8, 25.0)
    with capture.frames() as frames:
        assert [read_tag(image) for image in next(frames).images] == [(1, 0), (2, 0), (3, 0)]


def test_the_message_about_a_missing_video_lists_the_folder(make_capture: MakeCapture) -> None:
    folder = make_capture()
    (folder / "videos" / "cam2.mp4").rename(folder / "videos" / "cam2.r3d")
    with refused(VideoError, folder / "videos" / "cam2.mp4", "'cam2' has no video", "cam1.mp4, cam2.r3d, cam3.mp4"):
        open_capture(folder)


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_images_are_turned_as_the_file_asks(tmp_path: Path, turn: int) -> None:
    path = write(tmp_path / "a.mp4", range(6), turn=turn, camera=2)
    clip = probe_video(path)
    size = (HEIGHT, WIDTH) if turn % 180 else (WIDTH, HEIGHT)
    assert (clip.width, clip.height, clip.turn, clip.by_opencv) == (*size, turn, True)
    out = np.zeros((clip.height, clip.width, 3), np.uint8)
    for each in (clip, dataclasses.replace(clip, first=None)):
        with closing(each.open()) as reader:
            reader.skip()
            reader.read(out)
        assert read_tag(np.rot90(out, -turn // 90)) == (2, 1)
    assert tags(clip.unturned()) == list(range(6))


def test_a_turn_that_contradicts_the_calibrated_size_is_left_out(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=4)
    path = write(folder / "videos" / "cam2.mp4", range(12), fps=15, camera=1, turn=90)
    write(folder / "background" / "cam2.mp4", range(12), fps=15, camera=1, turn=90)
    for name in ("cam1", "cam3", "cam4"):
        shutil.copy(folder / "videos" / f"{name}.mp4", folder / "background" / f"{name}.mp4")
    capture = open_capture(folder)
    assert any(str(path) in line and "turn by 90°" in line for line in capture.warnings)
    with capture.frames() as frames:
        assert read_tag(next(frames).images[1]) == (1, 0)
    empty = capture.background()
    assert empty is not None and read_tag(empty[1][0]) == (1, 0)


def test_a_doubted_camera_whose_file_alone_asks_for_a_turn_is_named_with_it(make_capture: MakeCapture) -> None:
    folder = make_capture(cameras=4)
    path = write(folder / "videos" / "cam3.mp4", range(12), fps=15, camera=2, turn=180)
    capture = open_capture(folder)
    (line,) = capture.damaged(12, np.array([True, True, True, True]))
    assert line.startswith(f"{path}: ") and "180°" in line
    assert capture.damaged(12, np.array([True, True, False, True])) == []
    for camera in (1, 2, 4):
        write(folder / "videos" / f"cam{camera}.mp4", range(12), fps=15, camera=camera - 1, turn=180)
    assert open_capture(folder).damaged(12, np.ones(4, bool)) == []  # the calibration is of turned images
