from __future__ import annotations

import dataclasses
import gc
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from tests.io.conftest import HEIGHT, WIDTH, picture, read_tag, write_picture, write_video
from tk.errors import VideoError
from tk.io.captures.clip import Clip, Image
from tk.io.captures.clip_folder import list_clips, probe
from tk.io.captures.frames import FrameReader
from tk.io.captures.video import VideoClip, damaged_images, probe_video


@pytest.fixture(autouse=True)
def no_thread_left_behind() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


def read_all(clip: Clip, start: int = 0) -> list[np.ndarray]:
    with closing(clip.open()) as reader:
        for _ in range(start):
            reader.skip()
        images = []
        for _ in range(start, clip.frame_count):
            out = np.zeros((clip.height, clip.width, 3), np.uint8)
            reader.read(out)
            images.append(out)
    return images


@pytest.mark.parametrize("name", ["a.mp4", "a.avi", "a.mkv", "a.mov", "A.MP4"])
def test_images_of_a_video_are_read_in_order(tmp_path: Path, name: str) -> None:
    written = tmp_path / name.lower()
    write_video(written, [picture(1, k) for k in range(12)], fps=25)
    path = written.rename(tmp_path / name)
    clip = probe(path)
    assert (clip.width, clip.height, clip.frame_count) == (WIDTH, HEIGHT, 12)
    assert clip.times_s == pytest.approx(np.arange(12) / 25)
    assert [read_tag(image) for image in read_all(clip)] == [(1, k) for k in range(12)]
    assert [read_tag(image) for image in read_all(clip, start=7)] == [(1, k) for k in range(7, 12)]


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("pattern", ["{:06d}.png", "frame_{:03d}.jpg"])
def test_numbered_images_are_read_in_order(tmp_path: Path, first: int, pattern: str) -> None:
    for k in range(11):
        write_picture(tmp_path / "cam" / pattern.format(k + first), picture(2, k))
    clip = probe(tmp_path / "cam")
    assert (clip.frame_count, clip.times_s) == (11, None)
    assert [read_tag(image) for image in read_all(clip, start=4)] == [(2, k) for k in range(4, 11)]


def test_folders_with_gaps_or_damaged_images_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "cam"
    folder.mkdir()
    with pytest.raises(VideoError, match="holds no pictures"):
        probe(folder)
    for k in (0, 1, 2, 4):
        write_picture(folder / f"{k:06d}.png", picture(0, k))
    with pytest.raises(VideoError, match=r"picture 3 is missing between 000002\.png and 000004\.png"):
        probe(folder)
    write_picture(folder / "3.jpg", picture(0, 3))
    write_picture(folder / "000003.png", picture(0, 3))
    with pytest.raises(VideoError, match=r"are picture 3; keep one"):
        probe(folder)
    (folder / "3.jpg").unlink()
    (folder / "000000.png").write_bytes((folder / "000000.png").read_bytes()[:40])
    with pytest.raises(VideoError, match=r"000000\.png: is not a picture that can be decoded"):
        probe(folder)
    write_picture(folder / "cover.png", picture(0, 3))
    with pytest.raises(VideoError, match=r"cover\.png: its name has no number"):
        probe(folder)


def test_the_first_image_must_have_number_0_or_1(tmp_path: Path) -> None:
    write_picture(tmp_path / "cam" / "000100.png", picture(0, 0))
    with pytest.raises(VideoError, match=r"starts with 000100\.png"):
        probe(tmp_path / "cam")


def test_masks_are_binarised_at_128(tmp_path: Path) -> None:
    grey = np.array([[0, 1, 127, 128, 200, 255]], np.uint8)
    write_picture(tmp_path / "cam" / "000000.png", grey)
    clip = probe(tmp_path / "cam", is_mask=True)
    out = np.full((2, 8), 7, np.uint8)
    with closing(clip.open()) as reader:
        reader.read(out[:1, :6])
    np.testing.assert_array_equal(out[0], [0, 0, 0, 255, 255, 255, 7, 7])

    blob = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    blob[8:40, 16:48] = 255
    write_video(tmp_path / "m.mp4", [blob] * 3)
    with closing(probe(tmp_path / "m.mp4", is_mask=True).open()) as reader:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        reader.read(mask)
    assert set(np.unique(mask)) == {0, 255}
    assert np.mean(mask != blob[..., 0]) < 0.03  # coding blurs the outline


def test_a_pixel_of_a_reduced_image_is_the_mean_of_a_square(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (9, 15, 3), dtype=np.uint8)
    write_picture(tmp_path / "cam" / "0.png", image)
    clip = probe(tmp_path / "cam").reduced(2)
    (small,) = read_all(clip)
    assert small.shape == (4, 7, 3)
    squares = image[:8, :14].reshape(4, 2, 7, 2, 3)
    np.testing.assert_allclose(small, squares.mean(axis=(1, 3)), atol=0.51)
    write_picture(tmp_path / "cam" / "1.png", image[:8])
    with pytest.raises(VideoError, match=r"1\.png: is 15×8; the pictures before it are 15×9"):
        read_all(probe(tmp_path / "cam").reduced(2))


def test_a_pixel_of_a_reduced_mask_shows_the_person_if_half_of_its_square_does(tmp_path: Path) -> None:
    grey = np.array([[0, 255, 255, 255, 0, 0], [0, 0, 0, 255, 255, 255]], np.uint8)
    write_picture(tmp_path / "cam" / "0.png", grey)
    with closing(probe(tmp_path / "cam", is_mask=True).reduced(2).open()) as reader:
        mask = np.zeros((1, 3), np.uint8)
        reader.read(mask)
    np.testing.assert_array_equal(mask, [[0, 255, 255]])


def encode(
    path: Path, images: list[np.ndarray], pixels: str = "yuv420p", full_range: bool = False, bt709: bool = False
) -> None:
    """Write an H.264 video without visible loss; its colours are those of BT.601, or of BT.709."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=15, options={"crf": "4"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.color_range = 2 if full_range else 1
        stream.codec_context.colorspace = 1 if bt709 else 5
        matrix = "ITU709" if bt709 else "ITU601"
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            planes = frame.reformat(format=pixels, dst_colorspace=matrix, dst_color_range=2 if full_range else 1)
            container.mux(stream.encode(planes))
        container.mux(stream.encode())


def turn(path: Path, size: tuple[int, int], quarters: int) -> None:
    """Change the header of an MP4 file so that players turn the images clockwise."""
    one, minus = 1 << 16, (1 << 32) - (1 << 16)
    before = struct.pack(">9I", one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
    numbers = {
        1: (0, one, 0, minus, 0, 0, size[1] << 16, 0),
        2: (minus, 0, 0, 0, minus, 0, size[0] << 16, size[1] << 16),
    }
    head, track, rest = path.read_bytes().partition(b"tkhd")
    path.write_bytes(head + track + rest.replace(before, struct.pack(">9I", *numbers[quarters], 1 << 30), 1))


@pytest.mark.parametrize(
    "kind", ["usual", "full range", "a quarter", "a half", "colours at full size", "not divisible"]
)
def test_a_reduced_video_equals_the_reduced_images_of_the_video(tmp_path: Path, kind: str) -> None:
    width, height = (94, 66) if kind == "not divisible" else (96, 64)
    y, x = np.mgrid[:height, :width]
    images = [
        np.stack([255 * x // width, 255 * y // height, 255 - (40 * k + x) % 256], axis=2).astype(np.uint8)
        for k in range(4)
    ]
    path = tmp_path / "a.mp4"
    encode(path, images, "yuv444p" if kind == "colours at full size" else "yuv420p", kind == "full range")
    quarters = {"a quarter": 1, "a half": 2}.get(kind, 0)
    if quarters:
        turn(path, (width, height), quarters)
        images = [np.rot90(image, -quarters) for image in images]
    clip = probe(path)
    small = clip.reduced(2)
    assert (small.height, small.width) == (images[0].shape[0] // 2, images[0].shape[1] // 2)
    assert isinstance(small, VideoClip) and small.by_planes
    found = read_all(small, start=1)
    for image, whole, read in zip(images[1:], read_all(clip, start=1), found, strict=True):
        assert np.abs(whole.astype(int) - image).mean() < 3
        squares = whole[: 2 * small.height, : 2 * small.width].reshape(small.height, 2, small.width, 2, 3)
        # the colours of neighbours mix, and OpenCV and FFmpeg round differently
        assert np.abs(read - squares.mean(axis=(1, 3))).mean() < 3


@pytest.mark.parametrize(("pixels", "factor"), [("yuv420p", 2), ("yuv422p", 3), ("yuv444p", 4), ("yuv420p10le", 6)])
@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("bt709", [False, True])
def test_the_planes_of_every_coding_give_the_colors_that_ffmpeg_gives(
    tmp_path: Path, factor: int, pixels: str, full_range: bool, bt709: bool
) -> None:
    """Patches of all hues, of which BT.601's colours would differ by 9 levels from BT.709's."""
    patches = np.random.default_rng(0).integers(30, 226, (4, 6, 3), np.uint8)
    image = cv2.resize(patches, (144, 96), interpolation=cv2.INTER_CUBIC)
    encode(tmp_path / "a.mp4", [image], pixels, full_range, bt709)
    small = probe(tmp_path / "a.mp4").reduced(factor)
    assert isinstance(small, VideoClip) and small.by_planes
    with av.open(str(tmp_path / "a.mp4")) as container:
        whole = next(container.decode(video=0)).to_ndarray(format="bgr24")
    expected = cv2.resize(whole, (small.width, small.height), interpolation=cv2.INTER_AREA)
    difference = np.abs(read_all(small)[0].astype(int) - expected)
    # FFmpeg interpolates the colours of 10 bits between their places
    assert difference.mean() < (3 if pixels.endswith("10le") else 2)


@pytest.mark.parametrize("end", [0.7, 0.9])
def test_a_damaged_video_is_reported_at_the_same_image_if_it_is_reduced(tmp_path: Path, end: float) -> None:
    images = [np.random.default_rng(k).integers(0, 255, (64, 96, 3), dtype=np.uint8) for k in range(12)]
    encode(tmp_path / "a.mkv", images)
    data = (tmp_path / "a.mkv").read_bytes()
    clip = probe(tmp_path / "a.mkv")
    (tmp_path / "a.mkv").write_bytes(data[: int(end * len(data))])
    said = []
    for each in (clip, clip.reduced(2)):
        with pytest.raises(VideoError, match="cannot be decoded") as error:
            read_all(each)
        said.append(str(error.value))
    assert said[0] == said[1]


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "cam" / "0.png", picture(0, 0))
    write_picture(tmp_path / "cam" / "1.png", picture(0, 1, (32, 32)))
    with pytest.raises(VideoError, match=r"1\.png: is 32×32; the pictures before it are 64×48"):
        read_all(probe(tmp_path / "cam"))


def noise_video(path: Path, frames: int) -> None:
    rng = np.random.default_rng(0)
    write_video(path, [rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(frames)])


def index_first(data: bytes) -> bytes:
    """Return an mp4 with its index (moov) before the images (mdat), as streaming cameras write it."""
    boxes, at = [], 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        boxes.append(data[at : at + size])
        at += size
    moov = next(box for box in boxes if box[4:8] == b"moov")
    before = sum(len(box) for box in boxes[: boxes.index(moov)] if box[4:8] != b"moov")
    assert before > 0
    table = moov.index(b"stco") + 8
    count = int.from_bytes(moov[table : table + 4], "big")
    shifted = bytearray(moov)
    for k in range(count):
        entry = slice(table + 4 + 4 * k, table + 8 + 4 * k)
        shifted[entry] = (int.from_bytes(moov[entry], "big") + len(moov)).to_bytes(4, "big")
    rest = [box for box in boxes if box is not moov]
    return rest[0] + bytes(shifted) + b"".join(rest[1:])


def test_a_truncated_video_is_refused(tmp_path: Path) -> None:
    noise_video(tmp_path / "whole.mp4", 40)
    data = (tmp_path / "whole.mp4").read_bytes()
    path = tmp_path / "cut.mp4"
    path.write_bytes(data[: len(data) // 2])  # without the index, which is at the end
    with pytest.raises(VideoError, match=r"cut\.mp4: is cut off: the index"):
        probe(path)
    data = index_first(data)
    path.write_bytes(data)
    assert probe(path).frame_count == 40
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(VideoError, match=r"cut\.mp4: is cut off: \d+ of its 40 frames are there"):
        probe(path)


def test_a_video_that_ends_early_is_reported_at_its_last_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [picture(0, k) for k in range(12)])
    clip = dataclasses.replace(probe_video(tmp_path / "a.mp4"), frame_count=20)
    reader = FrameReader([clip, clip], None, (HEIGHT, WIDTH), range(20))
    seen = []
    with pytest.raises(VideoError, match=r"a\.mp4: image 12 of 20 cannot be decoded: .*copy it again"):
        for frame_set in reader:
            seen.append(read_tag(frame_set.images[1])[1])
    assert seen == list(range(12))


def test_files_that_are_no_video_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cam.mp4"
    path.write_text("These are the minutes of the meeting.\n" * 20)
    with pytest.raises(VideoError, match=r"cam\.mp4: is not a video"):
        probe(path)
    path.write_bytes(b"")
    with pytest.raises(VideoError, match=r"cam\.mp4: is an empty file"):
        probe(path)
    path.unlink()
    with pytest.raises(VideoError, match=r"cam\.mp4: cannot be read"):
        probe(path)


def test_a_file_with_sound_only_is_named_so(tmp_path: Path) -> None:
    path = tmp_path / "cam.mp4"
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(VideoError, match=r"cam\.mp4: holds sound, but no video"):
        probe(path)


def test_a_folder_with_the_name_of_a_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cam2.mp4").mkdir()
    with pytest.raises(VideoError, match=r"cam2\.mp4: is a folder with the name of a video"):
        list_clips(tmp_path)


def test_opencv_and_ffmpeg_print_nothing(tmp_path: Path) -> None:
    noise_video(tmp_path / "whole.mp4", 20)
    data = index_first((tmp_path / "whole.mp4").read_bytes())
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.mp4").write_text("not a video" * 50)
    for suffix in ("png", "jpg"):
        write_picture(tmp_path / f"cut.{suffix}", picture(0, 5))
        coded = (tmp_path / f"cut.{suffix}").read_bytes()
        (tmp_path / f"cut.{suffix}").write_bytes(coded[: len(coded) * 2 // 3])
    (tmp_path / "empty.png").touch()
    program = (
        "import cv2, sys, pathlib\n"  # OpenCV is imported first, as in a user's script
        "from tk.io.captures.clip_folder import probe\n"
        "from tk.errors import VideoError\n"
        "for name in ('cut.mp4', 'text.mp4', 'cut.png', 'cut.jpg', 'none.mp4', 'empty.png'):\n"
        "    try: probe(pathlib.Path(sys.argv[1]) / name)\n"
        "    except VideoError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) == 6
    assert done.stderr == ""


def test_list_clips_finds_videos_and_folders_by_stem(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.MOV", "c.png", "notes.txt", ".hidden.mp4"):
        (tmp_path / name).touch()
    (tmp_path / "d.1").mkdir()
    assert set(list_clips(tmp_path)) == {"a", "b", "d.1"}
    assert set(list_clips(tmp_path, pictures=True)) == {"a", "b", "c", "d.1"}
    (tmp_path / "a.avi").touch()
    with pytest.raises(VideoError, match=r"holds both a\.avi and a\.mp4"):
        list_clips(tmp_path)


# ---------------------------------------------------------------------------------------------------- reading ahead


@dataclass
class FakeClip:
    """A clip in memory that records its position and fails at a given frame."""

    camera: int
    frame_count: int = 100
    fails_at: int | None = None
    width: int = 4
    height: int = 3
    path: Path = Path("fake.mp4")
    times_s: None = None
    position: int = 0
    opened: int = 0
    closed: int = 0

    def open(self) -> FakeClip:
        self.opened += 1
        return self

    def shown(self, frames: np.ndarray) -> np.ndarray:
        return np.clip(frames, 0, self.frame_count - 1)

    def skip(self) -> None:
        self.position += 1

    def jump(self, number: int) -> int:
        return self.position

    def read(self, out: Image) -> None:
        if self.position == self.fails_at:
            raise VideoError(f"camera {self.camera} fails at {self.position}")
        out[...] = 10 * self.camera + self.position
        self.position += 1

    def close(self) -> None:
        self.closed += 1


def reader_of(
    clips: list[FakeClip], start: int = 0, stop: int = 100, masks: list[FakeClip] | None = None
) -> FrameReader:
    return FrameReader(clips, masks, (4, 6), range(start, stop))


def test_frame_sets_are_packed_and_padded() -> None:
    clips = [FakeClip(0), FakeClip(1, width=6, height=4)]
    masks = [FakeClip(5), FakeClip(6, width=6, height=4)]
    with reader_of(clips, 3, 9, masks) as reader:
        assert len(reader) == 6
        frame_sets = list(reader)
    assert [frame_set.index for frame_set in frame_sets] == list(range(3, 9))
    for frame_set in frame_sets:
        assert frame_set.images.shape == (2, 4, 6, 3) and frame_set.images.dtype == np.uint8
        expected = np.zeros((2, 4, 6), np.uint8)
        expected[0, :3, :4] = frame_set.index
        expected[1] = 10 + frame_set.index
        np.testing.assert_array_equal(frame_set.images, np.repeat(expected[..., None], 3, axis=-1))
        assert frame_set.masks is not None
        np.testing.assert_array_equal(frame_set.masks, np.where(expected > 0, expected + 50, 0))
    assert all(clip.opened == clip.closed == 1 for clip in clips + masks)


def test_reading_ahead_is_bounded() -> None:
    clips = [FakeClip(0), FakeClip(1)]
    with reader_of(clips) as reader:
        for _ in range(5):
            next(reader)
        assert all(clip.position <= 5 + 8 for clip in clips)


def test_memory_is_reused_once_unreferenced() -> None:
    clips = [FakeClip(0), FakeClip(1)]
    with reader_of(clips) as reader:
        held = [next(reader).images[1:, ::2] for _ in range(3)]
        copies = [view.copy() for view in held]
        addresses = set()
        for _ in range(60):
            addresses.add(next(reader).images.ctypes.data)
        # free ones, one being filled, and the current one
        assert len(addresses) <= 8 + 2
        for view, copy in zip(held, copies, strict=True):
            np.testing.assert_array_equal(view, copy)


def test_all_frames_before_an_error_are_returned() -> None:
    clips = [FakeClip(0), FakeClip(1, fails_at=20), FakeClip(2, fails_at=20)]
    seen = []
    reader = reader_of(clips)
    with pytest.raises(VideoError, match="camera 1 fails at 20"):
        for frame_set in reader:
            seen.append(frame_set.index)
    assert seen == list(range(20))
    with pytest.raises(StopIteration):
        next(reader)
    assert all(clip.closed == 1 for clip in clips)


def test_an_error_on_opening_is_raised_at_the_first_frame() -> None:
    class Locked(FakeClip):
        def open(self) -> FakeClip:
            raise VideoError("locked")

    with reader_of([FakeClip(0), Locked(1)], start=4) as reader, pytest.raises(VideoError, match="locked"):
        next(reader)


def test_threads_end_when_the_consumer_raises() -> None:
    clips = [FakeClip(0), FakeClip(1)]
    with pytest.raises(ZeroDivisionError), reader_of(clips) as reader:
        for _ in reader:
            _ = 1 // 0
    assert all(clip.closed == 1 for clip in clips)


def test_threads_end_when_the_reader_is_deleted() -> None:
    clips = [FakeClip(0), FakeClip(1)]
    for frame_set in reader_of(clips):
        if frame_set.index == 3:
            break
    gc.collect()
    assert all(clip.closed == 1 for clip in clips)


def frame_indices(clips: list[FakeClip]) -> Iterator[int]:
    with reader_of(clips) as reader:
        for frame_set in reader:
            yield frame_set.index


@pytest.mark.parametrize("generator", [False, True])
def test_deleting_a_reader_does_not_wait_for_an_image(generator: bool) -> None:
    """The garbage collector may delete it, or a generator that reads from it, in a thread that the decoding threads
    wait for."""
    begun, go_on = threading.Event(), threading.Event()

    class Slow(FakeClip):
        def read(self, out: Any) -> None:
            if self.position:
                begun.set()
                assert go_on.wait(30)
            super().read(out)

    clip = Slow(0)
    reader = frame_indices([clip]) if generator else reader_of([clip])
    next(reader)
    assert begun.wait(30)
    del reader
    gc.collect()
    assert clip.closed == 0
    go_on.set()
    for thread in threading.enumerate():
        if thread.name.startswith("tk-decode-"):
            thread.join(30)
    assert clip.closed == 1


def test_a_reader_can_be_closed_twice_and_while_skipping() -> None:
    clips = [FakeClip(0, frame_count=10**9)]
    reader = reader_of(clips, start=10**9 - 1, stop=10**9)
    reader.close()
    reader.close()
    assert list(reader) == []
    assert clips[0].closed == 1


def test_an_open_reader_does_not_block_the_exit(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [picture(0, k) for k in range(30)])
    program = (
        "import sys, pathlib\n"
        "from tk.io.captures.clip_folder import probe\n"
        "from tk.io.captures.frames import FrameReader\n"
        "clip = probe(pathlib.Path(sys.argv[1]))\n"
        "reader = FrameReader([clip, clip], None, (clip.height, clip.width), range(30))\n"
        "print(next(reader).index)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.mp4")], capture_output=True, text=True, timeout=60, check=True
    )
    assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.mark.parametrize("name", ["video.avi", "video.mp4"])
def test_damaged_images_are_found_in_every_container(tmp_path: Path, name: str) -> None:
    path, rng = tmp_path / name, np.random.default_rng(0)
    write_video(path, [rng.integers(0, 255, (64, 96, 3), np.uint8) for _ in range(12)])
    assert damaged_images(probe_video(path), 12) == []
    data = bytearray(path.read_bytes())
    for place in rng.integers(len(data) // 3, len(data) // 2, 200).tolist():
        data[place] ^= 0xFF
    path.write_bytes(data)
    found = damaged_images(probe_video(path), 12)
    assert found and set(found) <= set(range(12))
    path.write_bytes(data[: 2 * len(data) // 3])
    if name.endswith("avi"):  # an MP4 that is cut off cannot be opened
        assert set(damaged_images(probe_video(path), 12)) <= set(range(12))
