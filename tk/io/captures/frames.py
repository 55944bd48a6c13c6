"""Synchronised frames of all cameras, decoded ahead of the consumer."""

from __future__ import annotations

import math
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.video import Clip

#: most frames decoded ahead, and most bytes of them. Fewer make the consumer wait for a slow image.
_AHEAD = 8
_AHEAD_BYTES = 128 * 2**20


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
        late = tuple(late) or (0,) * len(clips)
        self._left = len(wanted)
        count = len(clips)

        set_bytes = count * frame_shape[0] * frame_shape[1] * (4 if mask_clips else 3)
        ahead = max(2, min(_AHEAD, _AHEAD_BYTES // set_bytes))
        images = _Stacks((count, *frame_shape, 3), ahead)
        masks = _Stacks((count, *frame_shape), ahead) if mask_clips else None

        def blank(place: int) -> FrameSet:
            index = wanted[place]
            return FrameSet(index, index / fps, images.take(), masks.take() if masks else None)

        window = _Window(blank, count, ahead)
        self._window = window
        # The threads know the window, not this reader: dropping the reader closes the window. Daemons, so that a
        # reader that is still referenced when the interpreter ends does not hold it up.
        self._threads = [
            threading.Thread(
                target=_decode,
                args=(window, camera, clip, mask_clips[camera] if mask_clips else None, wanted, late[camera]),
                name=f"tk-decode-{camera}",
                daemon=True,
            )
            for camera, clip in enumerate(clips)
        ]
        self._finalizer = weakref.finalize(self, _shut, window, self._threads)
        for thread in self._threads:
            thread.start()

    def __len__(self) -> int:
        """Frames still to come."""
        return self._left

    def __iter__(self) -> FrameReader:
        return self

    def __next__(self) -> FrameSet:
        try:
            frame_set = self._window.take() if self._left else None
        except BaseException:
            self.close()
            raise
        if frame_set is None:
            self.close()
            raise StopIteration
        self._left -= 1
        return frame_set

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop decoding and wait for the threads to end. Closing twice is fine."""
        self._finalizer()


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


class _Slot:
    """A frame set that is not complete yet."""

    def __init__(self, frame_set: FrameSet, cameras: int) -> None:
        self.frame_set = frame_set
        self.pending = cameras
        self.failures: dict[int, BaseException] = {}


class _Window:
    """The frame sets between the consumer and the fastest camera, shared by the threads; by their place in the
    reader's order."""

    def __init__(self, blank: Callable[[int], FrameSet], cameras: int, ahead: int) -> None:
        self._blank = blank
        self._cameras = cameras
        self._next = 0  # the consumer's frame
        self._ahead = ahead
        self._slots: dict[int, _Slot] = {}
        self.closed = False
        self._changed = threading.Condition()

    def claim(self, place: int) -> _Slot | None:
        """Wait until a frame may be decoded and return its slot; None after the reader was closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or place < self._next + self._ahead)
            if self.closed:
                return None
            if place not in self._slots:
                self._slots[place] = _Slot(self._blank(place), self._cameras)
            return self._slots[place]

    def finish(self, slot: _Slot, camera: int, failure: BaseException | None = None) -> None:
        with self._changed:
            slot.pending -= 1
            if failure is not None:
                slot.failures[camera] = failure
            if slot.pending == 0:
                self._changed.notify_all()

    def take(self) -> FrameSet | None:
        """Return the consumer's next frame set, None after closing. Waits for all cameras; raises the first failure."""
        with self._changed:
            self._changed.wait_for(self._ready)
            if self.closed:
                return None
            slot = self._slots.pop(self._next)
            self._next += 1
            self._changed.notify_all()
        if slot.failures:
            raise slot.failures[min(slot.failures)]
        return slot.frame_set

    def _ready(self) -> bool:
        slot = self._slots.get(self._next)
        return self.closed or (slot is not None and slot.pending == 0)

    def close(self) -> None:
        with self._changed:
            self.closed = True
            self._slots.clear()
            self._changed.notify_all()


def _decode(window: _Window, camera: int, clip: Clip, mask_clip: Clip | None, wanted: Sequence[int], late: int) -> None:
    """Decode one camera's images; runs in its own thread."""
    place = 0
    slot: _Slot | None = None
    last = clip.frame_count - 1 if mask_clip is None else min(clip.frame_count, mask_clip.frame_count) - 1
    # the first or last image may stand for several frames
    numbers = np.clip(np.asarray(wanted) - late, 0, last).tolist()
    kept, kept_mask = np.empty((2, 0), np.uint8)  # an image that several frames show
    following = 0  # number of the next image in the clip
    try:
        with ExitStack() as stack:
            pictures = stack.enter_context(closing(clip.open()))
            masks = stack.enter_context(closing(mask_clip.open())) if mask_clip else None
            for place, number in enumerate(numbers):
                stands_in = number < following
                while following < number:
                    if window.closed:
                        return
                    pictures.skip()
                    if masks is not None:
                        masks.skip()
                    following += 1
                slot = window.claim(place)
                if slot is None:
                    return
                again = place + 1 < len(numbers) and numbers[place + 1] == number
                layer = slot.frame_set.images[camera, : clip.height, : clip.width]
                if stands_in:
                    layer[...] = kept
                else:
                    pictures.read(layer)
                if masks is not None and slot.frame_set.masks is not None:
                    mask_layer = slot.frame_set.masks[camera, : clip.height, : clip.width]
                    if stands_in:
                        mask_layer[...] = kept_mask
                    else:
                        masks.read(mask_layer)
                    if again:
                        kept_mask = mask_layer.copy()
                if again:
                    kept = layer.copy()
                following = number + 1
                window.finish(slot, camera)
                slot = None
    except BaseException as failure:
        slot = slot or window.claim(place)
        if slot is not None:
            window.finish(slot, camera, failure)


def _shut(window: _Window, threads: Sequence[threading.Thread]) -> None:
    window.close()
    # The garbage collector may call this from a decoding thread, which cannot wait for itself or its siblings.
    if threading.current_thread() in threads:
        return
    for thread in threads:
        if thread.ident is not None:
            thread.join()
