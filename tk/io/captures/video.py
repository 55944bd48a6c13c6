"""Clips that are video files.

OpenCV decodes them. PyAV decodes images that are reduced before they become BGR, and those that OpenCV gets wrong:
interlaced ones, files whose packets are not all images, and files of which the first images differ. These are compared
when OpenCV is to decode the file.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.io.captures.clip import Clip, Image, Reader, check_size, deliver
from tk.io.captures.packets import REORDERED, Contents, as_bgr, decoded, open_video, read_contents
from tk.io.captures.planes import read_reduced
from tk.io.paths import c_name

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv", ".3gp"),
    *(".3g2", ".asf", ".dv", ".flv", ".mxf", ".ogv", ".vob"),
)

# see VideoClip.planar
_PLANAR = (
    *("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p"),
    *("yuv420p10le", "yuv422p10le", "yuv444p10le"),
)
#: the first images of OpenCV and PyAV are compared at every so many pixels; the mean difference of right ones, which
#: convert colours differently, is 1 at most, that of a black or a turned one 40
_EVERY, _MOST_DIFFERENCE = 4, 8.0
#: key images, the nearest first, from which decoding is tried: at the first ones of a gradual refresh images are not
#: whole. After these the file is decoded from its start.
_KEYS_TRIED = 4
_WITHOUT_INDEX = ("mpegts", "mpeg")  # FFmpeg's names of containers


@dataclass(frozen=True)
class FirstImages:
    """The first images of a file, as PyAV decodes them.

    Attributes:
        count: number of them.
        last: every :data:`_EVERY`-th pixel of the last one, BGR.
        differ: whether it differs from the first.
        size: width and height, pixels.
    """

    count: int
    last: Image
    differ: bool
    size: tuple[int, int]

    @classmethod
    def of(cls, contents: Contents) -> FirstImages:
        whole = as_bgr(contents.first[-1], contents.turn // 90)
        planes = [bytes(image.planes[0]) for image in contents.first]
        last = np.ascontiguousarray(whole[::_EVERY, ::_EVERY])
        return cls(len(planes), last, planes[0] != planes[-1], (contents.width, contents.height))


@dataclass(frozen=True)
class VideoClip(Clip):
    """A video file; made by :func:`probe_video`.

    Attributes:
        turn: degrees, counter-clockwise, by which the file asks players to turn its images: 0, 90, 180 or 270.
        interlaced: whether images are marked as interlaced.
        undecodable: number of coded images before the first one that can be decoded.
        first: what OpenCV has to decode; None: PyAV decodes the file.
        as_coded: whether the images are not turned.
        planar: whether the images consist of a plane of brightness and two planes of colours, 8 or 10 bits.
        keys: (K,) numbers of the images from which decoding can begin, increasing; none without times.
    """

    turn: int = 0
    interlaced: bool = False
    undecodable: int = 0
    first: FirstImages | None = field(default=None, compare=False, repr=False)
    as_coded: bool = False
    planar: bool = False
    keys: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64), compare=False, repr=False)

    def open(self) -> Reader:
        return _OpenCVReader(self) if not self.by_planes and self.by_opencv else _PyAVReader(self)

    @functools.cached_property
    def by_opencv(self) -> bool:
        """Whether OpenCV decodes the file, unless :attr:`by_planes`; else PyAV. Decodes the first images."""
        return self.first is not None and _opencv_agrees(self.path, self.first)

    def unturned(self) -> VideoClip:
        """Return the same images as they are coded."""
        size = (self.height, self.width) if self.turn % 180 else (self.width, self.height)
        return replace(self, width=size[0], height=size[1], as_coded=True, first=None)

    @property
    def by_planes(self) -> bool:
        """Whether the planes are reduced before they become BGR; rare videos and masks are reduced afterwards."""
        if not self.recorded_size or self.is_mask or not self.planar:
            return False
        factor = self.recorded_size[0] // self.width
        return (factor * self.width, factor * self.height) == self.recorded_size


def probe_video(path: Path, is_mask: bool = False) -> VideoClip:
    """Open a video file, and decode its first images by PyAV.

    Frames are counted, and their times read, from the coded packets (about 10 µs a frame): the header of an `.mkv` is
    only an estimate, and the header of a truncated file counts all frames.

    Raises:
        VideoError: no video, empty, cut off, or of a codec that cannot be decoded.
    """
    found = read_contents(path)
    return VideoClip(
        path,
        found.width,
        found.height,
        found.frame_count,
        is_mask,
        found.times_s,
        turn=found.turn,
        interlaced=found.interlaced,
        undecodable=found.undecodable,
        first=None if found.interlaced or found.cut else FirstImages.of(found),
        planar=found.pixels in _PLANAR,
        keys=found.keys,
    )


def as_calibrated(clip: Clip, size: tuple[int, int]) -> Clip:
    """Return a clip without the turn that its file asks for, if only then it has the size of the calibration."""
    if isinstance(clip, VideoClip) and clip.turn % 180 and (clip.height, clip.width) == size != size[::-1]:
        return clip.unturned()
    return clip


def notes_on(clips: Sequence[Clip]) -> list[str]:
    """Return lines about videos that the user should know of: interlaced ones, and ones that are not turned."""
    lines = []
    videos = _videos(clips)
    if marked := [clip for clip in videos if clip.interlaced]:
        lines.append(
            f"{marked[0].path}{f' and {len(marked) - 1} more' if marked[1:] else ''}: marked as interlaced; if moving "
            "edges look like combs, deinterlace the videos: ffmpeg -i IN -vf bwdif=mode=send_frame OUT"
        )
    lines += [
        f"{clip.path}: asks for a turn by {clip.turn}°, but the calibration is of images that are not turned: it is "
        "read without the turn"
        for clip in videos
        if clip.as_coded
    ]
    return lines


def odd_turn(clip: Clip, clips: Sequence[Clip]) -> str:
    """Return in words by how much the file of a clip asks for a turn, if most of the other clips ask for another."""
    turns = [each.turn for each in _videos(clips)]
    own = [each.turn for each in _videos([clip])]
    if not own or 2 * turns.count(own[0]) >= len(turns):
        return ""
    asks = f"asks players to turn its images by {own[0]}°" if own[0] else "asks for no turn of its images"
    return f"its file {asks}, unlike most of the others: the calibration may be of images without this turn"


def _videos(clips: Sequence[Clip]) -> list[VideoClip]:
    return [part for clip in clips for part in clip.parts if isinstance(part, VideoClip)]


def damaged_images(clip: VideoClip, stop: int, start: int = 0) -> list[int]:
    """Return the images ``start`` to ``stop`` - 1 of a video that FFmpeg cannot decode unless it repairs them, which it
    does without an error, so that no reader notices."""
    import av.error

    times: list[int] = []
    damaged: set[int] = set()
    container, stream = open_video(clip.path)
    key = int(clip.keys[clip.keys <= start].max(initial=0))
    with container:
        stream.thread_type = "SLICE"  # threads of whole images report errors with later ones
        stream.codec_context.options = {"err_detect": "explode"}
        if key and clip.times_s is not None:
            container.seek(round(clip.times_s[key] / stream.time_base), stream=stream)
        packets = container.demux(stream)
        while len(times) < (0 if key else clip.undecodable) + stop - key + REORDERED:
            try:
                packet = next(packets)
            except (StopIteration, av.error.FFmpegError):  # in an error a reader fails, too
                break
            time = packet.dts if packet.pts is None else packet.pts  # AVI has no other times
            if time is None:  # the last packet has no image
                continue
            if not packet.is_discard:
                times.append(time)
            try:
                packet.decode()
            except av.error.FFmpegError:
                damaged.add(time)
        tick = float(stream.time_base)
    if key and clip.times_s is not None:
        # images before the key refer to others that were not read
        numbers = np.searchsorted(clip.times_s, tick * np.array(sorted(damaged)) - 0.5 * tick)
        return numbers[(start <= numbers) & (numbers < stop)].tolist()
    shown = sorted(times)[clip.undecodable :][start:stop]
    return [i for i, time in enumerate(shown, start) if time in damaged]


class _OpenCVReader:
    def __init__(self, clip: VideoClip) -> None:
        self._clip = clip
        self._index = 0
        self._capture = _open_opencv(clip.path)
        self._whole: NDArray[Any] | None = None  # memory of the last recorded image

    def skip(self) -> None:
        if not self._capture.grab():
            self._fail()
        self._index += 1

    def jump(self, number: int) -> int:
        # no seeking: depending on codec and FFmpeg version it lands on key frames, or is off by one
        return self._index

    def read(self, out: Image) -> None:
        clip = self._clip
        # OpenCV decodes directly into a suitable array, and allocates its own otherwise
        whole = self._whole if clip.is_mask or clip.recorded_size or not out.flags.c_contiguous else out
        ok, picture = self._capture.read(whole)
        if not ok:
            self._fail()
        self._index += 1
        if whole is not out:
            self._whole = picture
        deliver(clip, picture, clip.path, out)

    def close(self) -> None:
        self._capture.release()

    def _fail(self) -> None:
        raise _undecodable(self._clip, self._index)


class _PyAVReader:
    """Reads what OpenCV does not. Of a reduced video the planes of brightness and colour are reduced before they become
    BGR.

    Measured on 1920×1080, read at half the size: 4.8 ms an image, of which decoding is 4.3. OpenCV at full size and a
    reduction after it take 6.5 ms.
    """

    def __init__(self, clip: VideoClip) -> None:
        self._clip = clip
        self._index = 0
        self._container: Any = None
        self._sought = False  # whether images are counted by their time stamps
        self._begin()

    def _begin(self) -> None:
        self.close()
        self._container, self._stream = open_video(self._clip.path)
        self._images = decoded(self._container.demux(self._stream))
        self._waiting: Any = None  # an image that has been decoded before its turn

    def _next(self) -> Any:
        import av.error

        try:
            image = self._waiting or next(self._images)
            while self._sought and (number := self._number(image)) < self._index:
                image = next(self._images)
        except (av.error.FFmpegError, StopIteration):
            raise _undecodable(self._clip, self._index) from None
        # an image that cannot be decoded is missing: the one after it is shown in its place
        self._waiting = image if self._sought and number > self._index else None
        self._index += 1
        return image

    def _number(self, image: Any) -> int:
        """Return the number of a decoded image, by its time stamp; -1 without one."""
        times = self._clip.times_s
        if times is None or image.pts is None:
            return -1
        time = image.pts * float(self._stream.time_base)
        after = int(np.clip(np.searchsorted(times, time), 1, max(len(times) - 1, 1)))
        return after - 1 if len(times) < 2 or time - times[after - 1] < times[after] - time else after

    def jump(self, number: int) -> int:
        keys = self._clip.keys
        keys = keys[(keys > self._index + REORDERED) & (keys <= number)]
        for key in keys[: -_KEYS_TRIED - 1 : -1].tolist():
            if self._begin_at(key):
                self._index, self._sought = key, True
                return key
        if len(keys):  # the file cannot be read from the middle: from its start to where this reader was
            self._begin()
            if not self._sought:
                for _ in range(self._index):
                    next(self._images, None)
        return self._index

    def _begin_at(self, key: int) -> bool:
        """Let decoding begin at a key image; return whether it is whole then."""
        import av.error

        times = self._clip.times_s
        assert times is not None
        # containers without an index are sought by decoding times, which are earlier than presentation times
        start = max(key - REORDERED, 0) if self._container.format.name in _WITHOUT_INDEX else key
        self._waiting = None
        try:
            self._container.seek(round(times[start] / self._stream.time_base), stream=self._stream)
            self._images = decoded(self._container.demux(self._stream))
            image = next(self._images)
            while 0 <= self._number(image) < key:
                image = next(self._images)
        except (av.error.FFmpegError, StopIteration):
            return False
        self._waiting = image
        return self._number(image) == key and not image.is_corrupt

    def skip(self) -> None:
        self._next()

    def read(self, out: Image) -> None:
        clip, image = self._clip, self._next()
        turns = 0 if clip.as_coded else clip.turn // 90
        if clip.by_planes and image.format.name in _PLANAR:
            check_size(clip, *((image.height, image.width) if turns % 2 else (image.width, image.height)), clip.path)
            coded = np.empty((clip.width, clip.height, 3) if turns % 2 else out.shape, np.uint8) if turns else out
            read_reduced(image, coded)
            if turns:
                out[...] = np.rot90(coded, turns)
        else:
            deliver(clip, as_bgr(image, turns), clip.path, out)

    def close(self) -> None:
        if self._container is not None:
            self._container.close()


def _undecodable(clip: VideoClip, index: int) -> VideoError:
    return VideoError(
        f"{clip.path}: image {index} of {clip.frame_count} cannot be decoded: the file is cut off or damaged; "
        "copy it again, or use the frames before",
        hint=f"with --frames 0:{index}",
    )


def _open_opencv(path: Path) -> cv2.VideoCapture:
    # one decoding thread: the cameras are decoded in parallel already (measured: 5 % faster on 2 cores, less memory)
    capture = cv2.VideoCapture(c_name(path, VideoError), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    if not capture.isOpened():
        raise VideoError(f"{path}: cannot be opened by OpenCV")
    return capture


def _opencv_agrees(path: Path, first: FirstImages) -> bool:
    """Return whether OpenCV decodes the last of the first images of a file as PyAV does, and not an older one."""
    found = []
    try:
        capture = _open_opencv(path)
    except VideoError:
        return False
    try:
        for _ in range(first.count):
            ok, image = capture.read()
            if not ok or image.shape[1::-1] != first.size:
                return False
            found.append(np.ascontiguousarray(image[::_EVERY, ::_EVERY]))
    finally:
        capture.release()
    if cv2.absdiff(first.last, found[-1]).mean() > _MOST_DIFFERENCE:
        return False
    return not first.differ or not np.array_equal(found[0], found[-1])
