"""Small grey images of a recording, and what moves in them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.io.captures.packets import decoded, open_video, quarter_turns
from tk.synchronise.raw import Recording

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

#: longer side of the small images, pixels.
SIDE_PX = 160
#: seconds of each recording that are looked at. Offsets up to a minute leave two in common.
LOOKED_S = 180.0
#: 1/s: of the clock on which signals are compared; images are looked at with up to half of it
GRID_HZ = 120
#: grey levels by which a pixel must change from image to image, beyond the noise, to count as moving; and a level above
#: which a change counts no more: reflections
_MOVES, _MOST = 3.0, 40.0
#: of a long recording, to find the person: seconds between key images; grey levels, and share of an image, that differ
#: while somebody is there (half and twice that share find the same frozen pictures); seconds before that
_KEYS_S, DIFFERS, SOMEBODY, _BEFORE_S = 5.0, 18.0, 0.003, 30.0
#: grey levels by which coding changes the small images of one picture; the noise of a camera is more
_CODING = 8


@dataclass(frozen=True)
class Look:
    """Small images of a recording.

    Attributes:
        times_s: (N,) own times, seconds.
        greys: (N, h, w) upright.
        turns: counter-clockwise quarter turns that the file asked for.
    """

    times_s: Float
    greys: Image
    turns: int = 0

    @cached_property
    def brightness(self) -> Float:
        """(N,) mean grey level."""
        return np.asarray(self.greys.mean(axis=(1, 2)), np.float64)

    @cached_property
    def middles_s(self) -> Float:
        """(N - 1,) own times of the changes: between two images."""
        return np.asarray((self.times_s[1:] + self.times_s[:-1]) / 2)

    @cached_property
    def changes(self) -> NDArray[np.float32]:
        """(N - 1, h, w) how much each pixel changes from image to image beyond noise and changes of the light, grey
        levels."""
        found = np.empty((len(self.greys) - 1, *self.greys.shape[1:]), np.float32)
        for k in range(len(found)):
            change = self.greys[k + 1].astype(np.float32) - self.greys[k]
            change -= np.median(change)
            found[k] = np.abs(change)
        noise = max(float(np.percentile(found[:: max(1, len(found) // 50)], 70)), 0.7)
        np.clip(found - 4 * noise - _MOVES, 0, _MOST, out=found)
        return found

    @cached_property
    def moving(self) -> Float:
        """(N - 1,) share of the pixels that move from image to image."""
        return np.asarray((self.changes > 0).mean(axis=(1, 2)))

    @cached_property
    def moved(self) -> NDArray[np.float32]:
        """(h, w) the sum of all changes of each pixel."""
        return np.asarray(self.changes.sum(axis=0))

    @property
    def constant(self) -> bool:
        """Whether all images are the same, up to their coding."""
        return int((self.greys.max(axis=0) - self.greys.min(axis=0)).max()) <= _CODING


def look_at(recording: Recording, begin_s: float | None = None, length_s: float = LOOKED_S) -> Look:
    """Return small images of a part of a recording, which begins at an own time or with the recording.

    Raises:
        VideoError: an image cannot be decoded.
    """
    begin = recording.span[0] if begin_s is None else begin_s
    times: list[float] = []
    greys: list[Image] = []
    turns = 0
    least = 0.0
    for time, image in _images(recording, begin, begin + length_s):
        if times and time - times[-1] < least:
            continue
        least = 0.9 * 2 / GRID_HZ
        scale = SIDE_PX / max(image.width, image.height)
        size = max(round(image.width * scale), 2), max(round(image.height * scale), 2)
        small = image.reformat(*size, format="gray", interpolation="AREA").to_ndarray()
        turns = quarter_turns(image)
        times.append(time)
        greys.append(np.ascontiguousarray(np.rot90(small, turns), np.uint8))
    if len(times) < 2:
        raise VideoError(f"{recording.paths[0]}: {recording.where}: has no pictures from {begin:.1f} s on")
    return Look(np.array(times), np.stack(greys), turns)


def first_motion(recording: Recording) -> float | None:
    """Return an own time, seconds, half a minute before the first key image that differs from most; None if that is at
    the start, or if none differs."""
    times, greys = [], []
    for time, image in _images(recording, recording.span[0], recording.span[1], keys_s=_KEYS_S):
        times.append(time)
        greys.append(image.reformat(SIDE_PX, round(SIDE_PX * image.height / image.width), format="gray").to_ndarray())
    if len(greys) < 3:
        return None
    values = np.stack(greys).astype(np.float32)
    change = values - np.median(values, axis=0)
    change -= np.median(change, axis=(1, 2), keepdims=True)
    differs = (np.abs(change) > DIFFERS).mean(axis=(1, 2)) > SOMEBODY
    first = times[int(np.argmax(differs))] - _BEFORE_S if differs.any() else recording.span[0]
    return first if first > recording.span[0] else None


def pictures_at(recording: Recording, owns_s: list[float], height: int) -> list[Image]:
    """Return the images (height, w, 3) BGR nearest to own times, ascending."""
    wanted = [float(recording.times_s[np.abs(recording.times_s - own).argmin()]) for own in owns_s]
    found: list[Image] = []
    if not wanted:
        return found
    for time, image in _images(recording, wanted[0] - 1e-3, wanted[-1] + 1e-3):
        while len(found) < len(wanted) and time > wanted[len(found)] - 1e-3:
            picture = np.rot90(image.to_ndarray(format="bgr24"), quarter_turns(image))
            width = round(picture.shape[1] * height / picture.shape[0])
            small = cv2.resize(np.ascontiguousarray(picture), (width, height), interpolation=cv2.INTER_AREA)
            found.append(np.asarray(small, np.uint8))
        if len(found) == len(wanted):
            break
    return found


def _images(recording: Recording, begin: float, end: float, keys_s: float | None = None) -> Iterator[tuple[float, Any]]:
    """Yield own times and decoded images from ``begin`` to ``end``; decoding starts at a key frame before. ``keys_s``:
    only key images, of which two lie so many seconds apart."""
    import av.error

    last = -np.inf
    for n, (path, shift) in enumerate(zip(recording.paths, recording.shifts_s, strict=True)):
        later = recording.shifts_s[n + 1] if n + 1 < len(recording.shifts_s) else np.inf
        if shift > end or (np.isfinite(later) and later + recording.times_s[0] < begin - 1.0):
            continue
        # seeking goes to a key frame before; without an index, in an MPEG stream, it may go too far
        seeks = begin - shift > recording.times_s[0] - shift + 1.0
        with ExitStack() as opened:
            try:
                images = _decoded(opened, path, begin - shift if seeks else None, keys_s)
                first = next(images, None)
                if seeks and (first is None or first.time is None or first.time + shift > begin):
                    images = _decoded(opened, path, None, keys_s)
                    first = next(images, None)
                for image in chain(() if first is None else (first,), images):
                    if image.time is None:
                        continue
                    time = float(image.time) + shift
                    if time > end:
                        return
                    if time >= begin and time > last:
                        last = time
                        yield time, image
            except av.error.FFmpegError:
                raise VideoError(
                    f"{path}: {recording.where}: cannot be decoded after {last:.1f} s: the file is cut off or damaged; "
                    "copy it again"
                ) from None


def _decoded(opened: ExitStack, path: Path, start_s: float | None, keys_s: float | None) -> Iterator[Any]:
    """Return the images of a file from a key frame about half a second before a time, or from its beginning.
    ``keys_s``: see :func:`_images`."""
    import av.error

    container, stream = open_video(path)
    opened.enter_context(container)
    stream.thread_type = "AUTO"
    if start_s is not None:
        with suppress(av.error.FFmpegError):  # no index
            container.seek(int((start_s - 0.5) / stream.time_base), stream=stream)
    packets = container.demux(stream)
    return decoded(packets if keys_s is None else _keys(packets, keys_s / float(stream.time_base)))


def _keys(packets: Iterator[Any], apart: float) -> Iterator[Any]:
    """Yield the packets of key images that lie so many ticks apart."""
    last = -np.inf
    for packet in packets:
        if packet.is_keyframe and packet.dts is not None and packet.dts - last >= apart:
            last = packet.dts
            yield packet
        elif packet.dts is None:
            yield packet  # the end: images that wait for their place
