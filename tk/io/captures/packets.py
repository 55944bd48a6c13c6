"""What a video file contains, found from its coded packets by PyAV: which images a decoder returns, and their times.

Not every packet is an image. The edit list of an MP4 file that was cut without encoding it again excludes packets from
its beginning. A cut at an open group of pictures leaves images that refer to others before the cut. Some cameras store
the two fields of an interlaced image as two packets. AVI files repeat an image by an empty packet.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.io.paths import c_name

REORDERED = 16  # most images that precede another one in the file but follow it in the video, H.264
_HEAD = 3 * REORDERED  # packets after the first key frame that are decoded if it is uncertain which are images
_FIRST = 2  # images at the start that are always decoded
_PROGRESSIVE = 1  # FFmpeg's AV_FIELD_PROGRESSIVE; 0: unknown


@dataclass(frozen=True)
class Contents:
    """The images of a video file.

    Attributes:
        width, height: of the images, turned as the file asks for, pixels.
        first: the first images, as PyAV decodes them.
        frame_count: number of images that a decoder returns.
        times_s: (N,) their presentation time stamps, seconds, increasing; None if the file gives none.
        keys: (K,) numbers of the images from which decoding can begin, increasing; none without times.
        undecodable: number of coded images before the first, in the order of the video, that a decoder does not return.
        turn: degrees, counter-clockwise, by which the file asks players to turn its images: 0, 90, 180 or 270.
        interlaced: whether images are marked as interlaced.
        cut: whether packets are no images.
        pixels: FFmpeg's name of the pixel format.
    """

    width: int
    height: int
    first: tuple[Any, ...]
    frame_count: int
    times_s: NDArray[np.float64] | None
    keys: NDArray[np.int64]
    undecodable: int
    turn: int
    interlaced: bool
    cut: bool
    pixels: str


def open_video(path: Path, options: Mapping[str, str] | None = None) -> tuple[Any, Any]:
    """Return PyAV's container of a file, which the caller closes, and its stream of images, decoded by one thread.
    ``options``: of FFmpeg's demuxer.

    Raises:
        VideoError: the file is not there, or holds no video.
    """
    import av  # slow to import
    import av.error

    if path.exists() and not path.is_file():  # FFmpeg would wait for a pipe
        raise VideoError(f"{path}: is not a file")
    name = c_name(path, VideoError)
    try:
        container = av.open(name, options=dict(options or {}))
    except (OSError, ValueError):  # base classes of PyAV's errors
        raise VideoError(f"{path}: {_why_unreadable(path)}") from None
    cover = av.stream.Disposition.attached_pic
    stream = next((each for each in container.streams.video if not each.disposition & cover), None)
    if stream is None:
        has_sound = len(container.streams) > 0
        container.close()
        reason = "holds sound, but no video; put the camera's video in its place" if has_sound else "holds no video"
        raise VideoError(f"{path}: {reason}")
    stream.codec_context.thread_count = 1  # the cameras are decoded in parallel already
    return container, stream


def decoded(packets: Iterable[Any]) -> Iterator[Any]:
    """Yield the images of packets in the order of the video.

    Errors before the first image are ignored: a file that was cut begins with images that refer to missing ones.

    Raises:
        av.error.FFmpegError: a later packet cannot be decoded.
    """
    import av.error

    begun = False
    for packet in packets:
        try:
            images = packet.decode()
        except av.error.FFmpegError:
            if begun:
                raise
            continue
        begun = begun or bool(images)
        yield from images


def quarter_turns(image: Any) -> int:
    """Return the number of quarter turns, counter-clockwise, that a decoded image asks for; 0 for other angles."""
    turns, rest = divmod(image.rotation, 90)
    return 0 if rest else int(turns) % 4


def as_bgr(image: Any, turns: int) -> NDArray[np.uint8]:
    """Return a decoded image as (H, W, 3) BGR after some quarter turns, counter-clockwise."""
    pixels = image.to_ndarray(format="bgr24")
    return np.ascontiguousarray(np.rot90(pixels, turns)) if turns else np.asarray(pixels, np.uint8)


def read_contents(path: Path) -> Contents:
    """Read all packets of a video file and decode its first images; further ones only if the packets leave in doubt
    which images a decoder returns.

    Raises:
        VideoError: no video, empty, cut off, or of a codec that cannot be decoded.
    """
    import av.error

    packets: list[_Packet] = []

    def read() -> Iterator[Any]:
        try:
            for packet in container.demux(stream):
                if packet.size:
                    packets.append(_Packet.of(packet))
                yield packet
        except av.error.FFmpegError:  # the end of a truncated file
            return

    container, stream = open_video(path)
    with container:
        rest = read()
        try:
            images = list(islice(decoded(rest), _FIRST))
        except av.error.FFmpegError:
            images = []
        if not images:
            raise VideoError(f"{path}: no picture in it can be decoded; re-encode it, e.g. as H.264")
        for _ in rest:
            pass
        context, turns = stream.codec_context, quarter_turns(images[0])
        order = getattr(context, "field_order", 0)  # PyAV 18
        interlaced = any(image.interlaced_frame for image in images) or order > _PROGRESSIVE
        reordered_avi = container.format.name == "avi" and context.has_b_frames  # the times are those of decoding
        promised, duration_s = _promised(container, stream)
        tick = float(stream.time_base)
    times = np.sort([packet.time for packet in packets if packet.time is not None and not packet.discarded])
    # durations in headers begin with 0 or with the first image
    ends_s = tick * float(max(times[-1], times[-1] - times[0])) if len(times) else 0.0
    shown = sum(not packet.discarded for packet in packets)
    if shown < len(packets):
        promised = 0  # the index was read completely
    if len(packets) < promised - max(1, promised // 100) and ends_s * (1 + 2 / max(shown, 1)) < 0.99 * duration_s:
        raise VideoError(
            f"{path}: is cut off: {len(packets)} of its {promised} frames are there; copy it again, or re-encode it"
        )
    count = shown
    if interlaced or reordered_avi or _uncertain(packets):
        count, found = _count(path, packets)
        times = times if found is None else found
    times = times[len(times) - count :] if len(times) >= count else np.empty(0)
    increasing = len(times) == count and bool((np.diff(times) > 0).all())
    ordered = increasing and not reordered_avi
    begins = np.array([packet.time for packet in packets if packet.key and not packet.discarded and ordered])
    return Contents(
        width=images[0].height if turns % 2 else images[0].width,
        height=images[0].width if turns % 2 else images[0].height,
        first=tuple(images),
        frame_count=count,
        times_s=tick * times if increasing else None,
        keys=np.flatnonzero(np.isin(times, begins)),
        undecodable=shown - count,
        turn=90 * turns,
        interlaced=interlaced,
        cut=count < len(packets),
        pixels=images[0].format.name,
    )


@dataclass(frozen=True)
class _Packet:
    time: int | None  # ticks
    key: bool
    discarded: bool  # by the edit list

    @staticmethod
    def of(packet: Any) -> _Packet:
        time = packet.dts if packet.pts is None else packet.pts  # some formats have no other times
        return _Packet(time, packet.is_keyframe, packet.is_discard)


def _promised(container: Any, stream: Any) -> tuple[int, float]:
    """Return the number of images in the file's header, 0 if that is unknown, and the duration of the video, seconds.

    Where the header gives only a duration of the file, its sound may be longer than the images.
    """
    if stream.frames:
        return stream.frames, float((stream.duration or 0) * stream.time_base)
    if len(container.streams) > 1 or not container.duration or not stream.average_rate:
        return 0, 0.0
    duration_s = container.duration / 1e6
    return round(duration_s * stream.average_rate), duration_s


def _uncertain(packets: list[_Packet]) -> bool:
    """Return whether the file may begin with images that cannot be decoded."""
    first = packets[0]
    early = [packet for packet in packets[1:_HEAD] if not packet.discarded]
    return not first.key or any(
        packet.time is None or (first.time is not None and packet.time < first.time) for packet in early
    )


def _count(path: Path, packets: list[_Packet]) -> tuple[int, NDArray[np.int64] | None]:
    """Return the number of images that a decoder returns; and their times, ticks, if all had to be decoded.

    Images that a cut has made undecodable are few, and at the start. If more are missing, two packets are one image.
    """
    key = next((k for k, packet in enumerate(packets) if packet.key), len(packets))
    head = packets[: key + _HEAD]
    shown = sum(not packet.discarded for packet in packets)
    lost = sum(not packet.discarded for packet in head) - len(_decode_times(path, len(head)))
    if lost <= key + REORDERED:
        return shown - lost, None
    times = _decode_times(path, len(packets))
    known = [time for time in times if time is not None]
    return len(times), np.sort(np.array(known, np.int64))


def _decode_times(path: Path, most: int) -> list[int | None]:
    """Return the times, ticks, of the images in the first packets of a file."""
    import av.error

    container, stream = open_video(path)
    with container:
        times: list[int | None] = []
        try:
            packets = (packet for packet in container.demux(stream) if packet.size)
            for image in decoded(islice(packets, most)):
                times.append(image.pts)
            times += [image.pts for image in stream.codec_context.decode(None)]  # those that wait for their place
        except av.error.FFmpegError:  # the reader reports it
            pass
        return times


def _why_unreadable(path: Path) -> str:
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError as reason:
        return f"cannot be read ({reason.strerror or reason})"
    if not head:
        return "is an empty file; copy it again"
    if head[4:8] in (b"ftyp", b"mdat", b"wide", b"free"):
        return "is cut off: the index at its end is missing; copy it again, or finish the recording"
    return "is not a video that can be decoded; put a video file in its place"
