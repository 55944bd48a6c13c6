"""Synchronised frames of all cameras, decoded ahead of the consumer."""

from __future__ import annotations

import functools
import math
import threading
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.clip import Clip, Image, Reader
from tk.model.masks.background import reduced

#: most frames decoded ahead, and most bytes of them. Fewer make the consumer wait for a slow image.
AHEAD = 8
_AHEAD_BYTES = 128_000_000


@dataclass(frozen=True)
class FrameSet:
    """Images of all cameras at one time.

    Attributes:
        index: number of the frame in its source.
        time: time stamp, seconds.
        images: (C, H, W, 3) uint8 BGR; the image of a smaller camera is padded with zeros at the right and bottom.
        masks: (C, H, W) uint8, 255 where the person is, else 0; None without given masks.
    """

    index: int
    time: float
    images: NDArray[np.uint8]
    masks: NDArray[np.uint8] | None

    @functools.cached_property
    def halved(self) -> NDArray[np.uint8]:
        """(C, H // 2, W // 2, 3) the images reduced by two: each pixel is the mean of a square."""
        return reduced(self.images, 2)


class FrameReader(Iterator[FrameSet]):
    """Iterates over frames in ascending order, one decoding thread a camera.

    Every thread decodes directly into its layer of a shared stack, up to 8 frames (128 MiB) ahead. The threads end with
    the context manager, with the iteration, or when the reader is no longer referenced.

    An error in an image is raised when the iteration reaches that frame; all frames before it have been returned.
    """

    def __init__(
        self,
        clips: Sequence[Clip],
        mask_clips: Sequence[Clip] | None,
        frame_shape: tuple[int, int],
        wanted: Sequence[int],
        late: Sequence[int] = (),
        fps: float = 1.0,
    ) -> None:
        """``wanted``: indices of the frames, ascending; images between them are not converted. ``late``: delay of each
        clip in frames; frame k holds image k - late. The first image is repeated before the clip's start, the last one
        after its end. ``fps``: frame rate, for the time stamps.
        """
        count = len(clips)
        self._wanted, self._fps, self._scheduled = wanted, fps, 0
        ahead = max(2, min(AHEAD, _AHEAD_BYTES // (count * math.prod(frame_shape) * (4 if mask_clips else 3))))
        self._images = _Stacks((count, *frame_shape, 3), ahead)
        self._masks = _Stacks((count, *frame_shape), ahead) if mask_clips else None
        stop = threading.Event()
        self._cameras = []
        for camera, clip in enumerate(clips):
            own = [clip] if mask_clips is None else [clip, mask_clips[camera]]
            frames = np.asarray(wanted) - (late[camera] if late else 0)
            self._cameras.append([Images(each, frames, stop) for each in own])
        # a thread knows its films, not this reader: dropping the reader ends the threads
        self._threads = [ThreadPoolExecutor(1, f"tk-decode-{camera}") for camera in range(count)]
        films = [film for camera in self._cameras for film in camera]
        self._finalizer = weakref.finalize(self, _end, stop, self._threads, films)
        self._coming: deque[tuple[FrameSet, list[Future[None]]]] = deque()
        for _ in range(ahead):
            self._schedule()

    def __len__(self) -> int:
        """Frames still to come."""
        return len(self._wanted) - self._scheduled + len(self._coming)

    def __iter__(self) -> FrameReader:
        return self

    def __next__(self) -> FrameSet:
        try:
            if not self._coming:
                raise StopIteration
            frame_set, decoded = self._coming.popleft()
            self._schedule()
            for camera in decoded:
                camera.result()
        except BaseException:
            self.close()
            raise
        return frame_set

    def _schedule(self) -> None:
        """Let the threads decode the next frame."""
        place = self._scheduled
        if place >= len(self._wanted) or not self._finalizer.alive:
            return
        self._scheduled += 1
        index = self._wanted[place]
        frame_set = FrameSet(index, index / self._fps, self._images.take(), self._masks.take() if self._masks else None)
        stacks = [frame_set.images] if frame_set.masks is None else [frame_set.images, frame_set.masks]
        decoded = [
            thread.submit(_decode, films, place, [stack[camera] for stack in stacks])
            for camera, (thread, films) in enumerate(zip(self._threads, self._cameras, strict=True))
        ]
        self._coming.append((frame_set, decoded))

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is GeneratorExit:  # perhaps by the garbage collector, in a thread that must not wait for another one
            self._finalizer()
        else:
            self.close()

    def close(self) -> None:
        """Stop decoding and wait for the threads to end. Closing twice is fine."""
        self._coming.clear()
        self._scheduled = len(self._wanted)
        self._finalizer()
        for thread in self._threads:
            thread.shutdown()


class _Stacks:
    """Stacks of images whose memory is used again when they are no longer referenced.

    With new memory each time, each decoding thread would keep freed memory in its own part of the heap: 20 MB more in
    1,000 frames (measured). New memory also has to be cleared.
    """

    def __init__(self, shape: tuple[int, ...], most: int) -> None:
        """Keep at most ``most`` free stacks."""
        self._shape = shape
        self._free: deque[bytearray] = deque(maxlen=most)

    def take(self) -> NDArray[np.uint8]:
        """Return a stack of the shape. Pixels that were never written are zero."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = bytearray(math.prod(self._shape))
        stack = np.frombuffer(memory, np.uint8)
        # every view has this array as its base, so it is freed with the last view
        weakref.finalize(stack, self._free.append, memory).atexit = False
        return stack.reshape(self._shape)


class Images:
    """The images of a clip in the order in which some of its frames show them. One thread at a time.

    Args:
        clip: the images.
        frames: (F,) the frames, ascending.
        stop: once it is set, no further image is read.
    """

    def __init__(self, clip: Clip, frames: NDArray[np.int64], stop: threading.Event | None = None) -> None:
        self._clip, self._numbers, self._stop = clip, clip.shown(frames).tolist(), stop or threading.Event()
        self._reader: Reader | None = None
        self._busy = threading.Lock()
        self._following = 0  # number of the next image in the clip
        self._kept: Image | None = None  # an image that several frames show

    def read(self, place: int, stack: Image) -> None:
        """Write the image of ``frames[place]`` into the upper left of (H, W, 3), or (H, W) for a mask; black if the
        frame is blank."""
        with self._busy:
            self._read(place, stack)
        if self._stop.is_set():
            self.close()

    def _read(self, place: int, stack: Image) -> None:
        out, number = stack[: self._clip.height, : self._clip.width], self._numbers[place]
        if number < 0:
            out[...] = 0
        elif number < self._following and self._kept is not None:
            out[...] = self._kept
        else:
            reader = self._reader = self._reader or self._clip.open()
            if self._following < number:
                self._following = reader.jump(number)
            while self._following < number:
                if self._stop.is_set():
                    return
                reader.skip()
                self._following += 1
            reader.read(out)
            self._following += 1
            again = number in self._numbers[place + 1 : place + 2]
            self._kept = out.copy() if again else None

    def close(self) -> None:
        """Close the clip, without waiting: if an image is being read, it is closed after that."""
        if self._busy.acquire(blocking=False):
            if self._reader is not None:
                self._reader.close()
            self._reader = None
            self._busy.release()


def _decode(films: Sequence[Images], place: int, layers: Sequence[Image]) -> None:
    """Decode one camera's images of a frame; runs in the camera's thread."""
    for film, layer in zip(films, layers, strict=True):
        film.read(place, layer)


def _end(stop: threading.Event, threads: Sequence[ThreadPoolExecutor], films: Sequence[Images]) -> None:
    """Let decoding end, without waiting: the garbage collector may call this anywhere, also in a thread that is just
    starting and holds a lock without which no thread ends."""
    stop.set()
    for thread in threads:
        thread.shutdown(wait=False, cancel_futures=True)
    for film in films:
        film.close()
