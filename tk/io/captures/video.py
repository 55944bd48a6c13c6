"""Clips that are video files, decoded by OpenCV, or by PyAV where an image is reduced before it becomes BGR."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.io.captures.clip import Clip, Image, Reader, check_size, deliver
from tk.io.paths import c_name

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv")

_FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG
_REORDERED = 16  # most images that precede another one in the file but follow it in the video, H.264


@dataclass(frozen=True)
class VideoClip(Clip):
    """A video file; made by :func:`probe_video`."""

    turned: bool = False  # whether the file asks for its coded images to be turned

    def open(self) -> Reader:
        return _open_planes(self) or _VideoReader(self)


def probe_video(path: Path, is_mask: bool = False) -> VideoClip:
    """Open a video file and decode its first image.

    Frames are counted, and their times read, from the coded packets without decoding (about 10 µs a frame): the header
    of an `.mkv` is only an estimate, and the header of a truncated file counts all frames.

    Raises:
        VideoError: no video, empty, cut off, or of a codec that OpenCV cannot decode.
    """
    capture = _open_video(path)
    try:
        promised = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        turned = capture.get(cv2.CAP_PROP_ORIENTATION_META) != 0
        ok, picture = capture.read()
    finally:
        capture.release()
    if not ok:
        raise VideoError(f"{path}: no picture in it can be decoded; re-encode it, e.g. as H.264")
    times_s = _packet_times(path)
    frame_count = len(times_s)
    # one percent: headers that give a duration only are rounded
    if frame_count < promised - max(1, promised // 100):
        raise VideoError(
            f"{path}: is cut off: {frame_count} of its {promised} frames are there; copy it again, or re-encode it"
        )
    height, width = picture.shape[:2]
    increasing = bool((np.diff(times_s) > 0).all())
    times = times_s if increasing else None
    return VideoClip(path, width, height, frame_count, is_mask, times, turned=turned)


def damaged_images(path: Path, stop: int) -> list[int]:
    """Return the images of a video before ``stop`` that FFmpeg cannot decode unless it repairs them, which it does
    without an error, so that no reader notices."""
    import av  # slow to import, and only needed for a message
    import av.error

    times: list[int] = []
    damaged: set[int] = set()
    with av.open(c_name(path, VideoError)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "SLICE"  # threads of whole images report errors with later ones
        stream.codec_context.options = {"err_detect": "explode"}
        packets = container.demux(stream)
        while len(times) < stop + _REORDERED:
            try:
                packet = next(packets)
            except (StopIteration, av.error.FFmpegError):  # in an error a reader fails, too
                break
            time = packet.dts if packet.pts is None else packet.pts  # AVI has no other times
            if time is None:  # the last packet has no image
                continue
            times.append(time)
            try:
                packet.decode()
            except av.error.FFmpegError:
                damaged.add(time)
    return [i for i, time in enumerate(sorted(times)[:stop]) if time in damaged]


class _VideoReader:
    def __init__(self, clip: VideoClip) -> None:
        self._clip = clip
        self._index = 0
        self._capture = _open_video(clip.path)
        self._whole: NDArray[Any] | None = None  # memory of the last recorded image

    def skip(self) -> None:
        # no seeking: depending on codec and FFmpeg version it lands on key frames, or is off by one
        if not self._capture.grab():
            self._fail()
        self._index += 1

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


def _open_planes(clip: VideoClip) -> _PlaneReader | None:
    """Return a reader of the planes of a reduced video, None for a video that is left to OpenCV.

    These are: full size, masks, turned images, and, because they are rare, colours at full size, more than 8 bits, and
    sizes that the reduction divides with a remainder.
    """
    if not clip.recorded_size or clip.is_mask or clip.turned:
        return None
    import av  # slow to import, and small videos do without

    container = av.open(c_name(clip.path, VideoError))
    context = container.streams.video[0].codec_context
    context.thread_count = 1  # as in _open_video
    factor = clip.recorded_size[0] // clip.width
    divided = (factor * clip.width, factor * clip.height) == clip.recorded_size
    if divided and clip.width % 2 == clip.height % 2 == 0 and context.pix_fmt in ("yuv420p", "yuvj420p"):
        return _PlaneReader(clip, container)
    container.close()
    return None


class _PlaneReader:
    """Reads a reduced video. The planes of brightness and colour are reduced before they become BGR.

    Measured on 1920×1080, read at half the size: 3.8 ms an image, of which decoding is 3.3. OpenCV at full size and a
    reduction after it take 5.2 ms.
    """

    def __init__(self, clip: VideoClip, container: Any) -> None:
        self._clip = clip
        self._index = 0
        self._container = container
        self._images = container.decode(video=0)
        # brightness, and below it the two colours, as COLOR_YUV2BGR_I420 expects them
        self._planes = np.empty((clip.height * 3 // 2, clip.width), np.uint8)
        colors = self._planes[clip.height :].reshape(2, clip.height // 2, clip.width // 2)
        self._small = (self._planes[: clip.height], *colors)

    def _next(self) -> Any:
        import av.error

        try:
            image = next(self._images)
        except (av.error.FFmpegError, StopIteration):
            raise _undecodable(self._clip, self._index) from None
        self._index += 1
        return image

    def skip(self) -> None:
        self._next()

    def read(self, out: Image) -> None:
        image = self._next()
        check_size(self._clip, image.width, image.height, self._clip.path)
        full_range = image.color_range == _FULL_RANGE or image.format.name == "yuvj420p"
        for k, (plane, small) in enumerate(zip(image.planes, self._small, strict=True)):
            whole = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
            cv2.resize(whole, small.shape[::-1], dst=small, interpolation=cv2.INTER_AREA)
            if full_range:  # to the range that the conversion expects: 16 to 235, and 16 to 240 about 128
                scale = (219 if k == 0 else 224) / 255
                cv2.convertScaleAbs(small, dst=small, alpha=scale, beta=16 if k == 0 else 128 * (1 - scale))
        cv2.cvtColor(self._planes, cv2.COLOR_YUV2BGR_I420, dst=out)

    def close(self) -> None:
        self._container.close()


def _undecodable(clip: VideoClip, index: int) -> VideoError:
    return VideoError(
        f"{clip.path}: image {index} of {clip.frame_count} cannot be decoded: the file is cut off or damaged; "
        "copy it again, or use the frames before",
        hint=f"with --frames 0:{index}",
    )


def _open_video(path: Path) -> cv2.VideoCapture:
    if path.exists() and not path.is_file():  # OpenCV would wait for a pipe
        raise VideoError(f"{path}: is not a file")
    # one decoding thread: the cameras are decoded in parallel already (measured: 5 % faster on 2 cores, less memory)
    capture = cv2.VideoCapture(c_name(path, VideoError), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    if not capture.isOpened():
        raise VideoError(f"{path}: {_why_unreadable(path)}")
    return capture


def _why_unreadable(path: Path) -> str:
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError as reason:
        return f"cannot be read ({reason.strerror or reason})"
    if not head:
        return "is an empty file; copy it again"
    if _has_sound_only(path):
        return "holds sound, but no video; put the camera's video in its place"
    if head[4:8] in (b"ftyp", b"mdat", b"wide", b"free"):
        return "is cut off: the index at its end is missing; copy it again, or finish the recording"
    return "is not a video that can be decoded; put a video file in its place"


def _has_sound_only(path: Path) -> bool:
    """Return whether a file has streams, but none of images."""
    import av  # slow to import, and only needed for this message

    try:
        with av.open(str(path)) as container:
            return len(container.streams) > 0 and not container.streams.video
    except (OSError, ValueError):  # base classes of PyAV's errors
        return False


def _packet_times(path: Path) -> NDArray[np.float64]:
    """Return the times (N,) of the coded images in a video file, seconds, ascending."""
    raw = -1  # CAP_PROP_FORMAT's way to ask for packets
    capture = cv2.VideoCapture(c_name(path, VideoError), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, raw])
    times: list[float] = []
    try:
        while capture.grab():
            times.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    finally:
        capture.release()
    return 1e-3 * np.sort(times)  # some codecs store images in another order
