"""Frames decoded and segmented ahead of the tracker, in a process of their own.

A thread would not do: Taichi's launches hold the interpreter, so what a thread segments the tracker waits for. The
process is a fresh interpreter (a fork would hang in Taichi, and multiprocessing's spawn imports the user's script
again) that gets its task through a socket and hands frames over in a ring of memory that both processes map. That
memory has no name, and the system frees it with the last of the two, however they end. When the tracker ends, the
socket closes, and the process ends, too.

The frames are the same, bit for bit, as those that :func:`observe` makes in the tracker's own process.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import TkError, WorkerError
from tk.io.captures.capture import Capture
from tk.run.segmentation import Labeller, make_labeller, mask_source
from tk.settings import ForegroundSettings
from tk.trackers.protocol import Observation, Stopwatch

if TYPE_CHECKING:
    from tk.settings import Settings

Note = Callable[[str], None]
#: a frame, and what it took: seconds in "decode", "masks", and how long the tracker had to "wait" for it
Observed = tuple[Observation, Mapping[str, float]]

TIMING_STAGES = ("decode", "masks", "wait")

#: frames that the tracker may hold without a copy: the one at hand, and the one before while it asks for the next
_HELD = 2
#: bytes that the ring may take
_RING_BYTES = 384 * 2**20
#: seconds that the process has to end by itself
_PATIENCE_S = 5.0

_START = (
    "import sys; sys.path[:] = sys.argv[3:]; from tk.run.prefetch import serve; "
    "serve(int(sys.argv[1]), int(sys.argv[2]))"
)


class Source(Protocol):
    """Where a tracker's observations come from. A context manager."""

    def frames(self, start: int, stop: int) -> Iterator[Observed]:
        """The frames ``start`` … ``stop - 1``; to be asked for once.

        Raises:
            TkError: a frame cannot be read; all before it have been handed out.
        """
        ...

    def __enter__(self) -> Source: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_source(capture: Capture, config: Settings, note: Note, keep_images: bool = True) -> Source:
    """The observations of a capture: ahead of the tracker where there is a second core and ``config.ahead`` is not 0.

    Args:
        capture: whose frames.
        config: how they are segmented, and how many frames ahead.
        note: who hears what is worth knowing.
        keep_images: False leaves the images empty, (C, 0, 0, 3), for a tracker that looks at masks alone.

    Raises:
        CaptureError: nothing to make masks from.
    """
    mask_source(capture)  # before anything is started
    if config.ahead == 0 or _cores() < 2 or not sys.executable:
        return Serial(capture, config, note, keep_images)
    return Ahead(capture, config, note, keep_images)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _threads() -> str:
    """For the process's kernels: half the cores, for the tracker is what should not wait. Fewer if the user says so."""
    asked = os.environ.get("TK_THREADS")
    half = max(_cores() // 2, 1)
    return str(min(half, int(asked)) if asked else half)


def observe(
    capture: Capture, label: Labeller, span: tuple[int, int], keep_images: bool
) -> Iterator[tuple[Observation, Stopwatch]]:
    """Decode and segment here and now; ``span``: the first frame and the one to stop before."""
    with capture.frames(*span) as frames:
        while True:
            watch = Stopwatch()
            frame = next(frames, None)
            if frame is None:
                return
            watch.lap("decode")
            masks, uncertain = label(frame)
            images = frame.images if keep_images else np.empty((len(masks), 0, 0, 3), np.uint8)
            watch.lap("masks")
            yield Observation(frame.index, images, masks, uncertain if keep_images else None), watch


@dataclass(frozen=True)
class Serial:
    """The source that makes each frame when the tracker asks for it."""

    capture: Capture
    config: Settings
    note: Note
    keep_images: bool = True

    def frames(self, start: int, stop: int) -> Iterator[Observed]:
        label = make_labeller(self.capture, self.config, self.note)
        for observation, watch in observe(self.capture, label, (start, stop), self.keep_images):
            yield observation, {**watch.laps, "wait": sum(watch.laps.values())}

    def __enter__(self) -> Serial:
        return self

    def __exit__(self, *_: object) -> None:
        pass


# --- what passes between the two processes ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Task:
    """What the process needs to begin with; the span of frames follows. It has the settings that
    :class:`tk.run.segmentation.MaskSettings` names."""

    capture: Capture
    segmentation: str
    foreground: ForegroundSettings
    keep_images: bool
    slots: int


@dataclass(frozen=True)
class _Ready:
    """A frame lies in a slot. ``uncertain``: there is such a layer."""

    slot: int
    index: int
    uncertain: bool
    laps: Mapping[str, float]


@dataclass(frozen=True)
class _Failed:
    """What ended the process: a user's mistake, or a defect of ours and its traceback."""

    error: TkError | None
    trace: str


class _Layout:
    """Where a slot's layers are: images, masks, uncertain."""

    def __init__(self, capture: Capture, keep_images: bool) -> None:
        self.masks = (len(capture.rig), *capture.rig.frame_shape)
        self.images = (*self.masks, 3) if keep_images else (len(capture.rig), 0, 0, 3)
        self.bytes = math.prod(self.images) + 2 * math.prod(self.masks)

    def layers(self, slot: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.bool_]]:
        """Views of a slot (bytes,): images (C, H, W, 3), masks (C, H, W), uncertain (C, H, W)."""
        a = math.prod(self.images)
        b = a + math.prod(self.masks)
        images, masks, uncertain = slot[:a], slot[a:b], slot[b:].view(np.bool_)
        return images.reshape(self.images), masks.reshape(self.masks), uncertain.reshape(self.masks)


def _nameless_file(size: int) -> int:
    """A descriptor of ``size`` bytes that go with their last user: nothing to be cleaned up, whoever is killed."""
    if hasattr(os, "memfd_create"):  # Linux
        handle = os.memfd_create("tk-ahead", os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            handle = os.dup(file.fileno())
    os.ftruncate(handle, size)
    return handle


# --- the tracker's side -----------------------------------------------------------------------------------------------


class Ahead:
    """The source that makes frames in a process of its own, which starts at once and learns the background.

    An array stays as it is as long as somebody holds it: its slot is used again once it is dropped.
    """

    def __init__(self, capture: Capture, config: Settings, note: Note, keep_images: bool = True) -> None:
        self._path, self._note = capture.path, note
        self._layout = _Layout(capture, keep_images)
        slots = max(min(config.ahead, _RING_BYTES // self._layout.bytes), 1) + _HELD
        handle = _nameless_file(slots * self._layout.bytes)
        self._memory = mmap.mmap(handle, slots * self._layout.bytes)
        self._held = 0
        self._returned: deque[int] = deque()
        self._begun = False
        self._connection, theirs = Pipe()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START, str(theirs.fileno()), str(handle), *sys.path],
                env={**os.environ, "TK_THREADS": _threads()},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), handle),
                start_new_session=True,  # Ctrl-C is for the tracker, which then ends this process
            )
        finally:
            theirs.close()
            os.close(handle)
        self._send(_Task(capture, config.segmentation, config.foreground, keep_images, slots))

    def frames(self, start: int, stop: int) -> Iterator[Observed]:
        self._begun = True
        self._send((start, stop))  # now, not when the first is asked for
        return self._arriving()

    def _arriving(self) -> Iterator[Observed]:
        while True:
            asked = time.perf_counter()
            self._give_back()
            message = self._receive()
            if message is None:
                return
            observation = self._take(message)
            yield observation, {**message.laps, "wait": time.perf_counter() - asked}
            del observation

    def _take(self, ready: _Ready) -> Observation:
        size = self._layout.bytes
        slot = np.frombuffer(self._memory, np.uint8, size, ready.slot * size)
        if self._held < _HELD:
            # every view has this array for its base, so it goes with the last of them
            weakref.finalize(slot, self._returned.append, ready.slot).atexit = False
            self._held += 1
        else:
            slot = slot.copy()
            self._send([ready.slot])
        images, masks, uncertain = self._layout.layers(slot)
        return Observation(ready.index, images, masks, uncertain if ready.uncertain else None)

    def _give_back(self) -> None:
        slots = [self._returned.popleft() for _ in range(len(self._returned))]
        self._held -= len(slots)
        if slots:
            self._send(slots)

    def _send(self, message: object) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # what it had to say is still to be read
            self._connection.send(message)

    def _receive(self) -> _Ready | None:
        """The next frame, None after the last.

        Raises:
            TkError: what the process raised.
            WorkerError: it is no more.
            RuntimeError: a defect of ours in it.
        """
        while True:
            try:
                message = self._connection.recv()
            except (EOFError, ConnectionResetError):
                raise WorkerError(f"{self._path}: {self._last_words()}; set ahead = 0 to do without it") from None
            if isinstance(message, str):
                self._note(message)
            elif isinstance(message, _Failed):
                if message.error is not None:
                    raise message.error
                raise RuntimeError("the process that decodes and segments frames failed:\n" + message.trace)
            else:
                return message

    def _last_words(self) -> str:
        code = self._process.wait()
        how = f"ended with code {code}" if code >= 0 else f"was ended by {signal.Signals(-code).name}"
        memory = " (out of memory?)" if code == -signal.SIGKILL else ""
        return f"the process that decodes and segments its frames {how}{memory}"

    def __enter__(self) -> Ahead:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process. Closing twice is fine."""
        self._connection.close()
        if self._begun:  # it leaves by itself, and keeps the kernels that it has compiled
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_PATIENCE_S)
        self._process.kill()
        self._process.wait()


# --- the process's side -----------------------------------------------------------------------------------------------


class _Ring:
    """The process's end of it."""

    def __init__(self, tracker: Connection, memory: mmap.mmap, task: _Task) -> None:
        self._tracker = tracker
        self._memory = memory
        self._layout = _Layout(task.capture, task.keep_images)
        self._free = list(range(task.slots))

    def put(self, observation: Observation, watch: Stopwatch) -> None:
        """Hand a frame over; waits for a free slot."""
        while not self._free:
            self._free += self._tracker.recv()
        number, size = self._free.pop(), self._layout.bytes
        images, masks, uncertain = self._layout.layers(np.frombuffer(self._memory, np.uint8, size, number * size))
        images[...] = observation.images
        masks[...] = observation.masks
        if observation.uncertain is not None:
            uncertain[...] = observation.uncertain
        self._tracker.send(_Ready(number, observation.index, observation.uncertain is not None, watch.laps))


def serve(socket: int, handle: int) -> None:
    """The process: take a task, hand over frames until there are no more, or nobody to take them.

    Args:
        socket, handle: descriptors of the socket to the tracker and of the memory that both share.
    """
    cv2.setNumThreads(1)  # the cameras are segmented side by side already
    with Connection(socket) as tracker, mmap.mmap(handle, 0) as memory:
        os.close(handle)
        # the other end closed: the tracker has ended, or has stopped asking
        with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
            try:
                _serve(tracker, memory)
            except (EOFError, BrokenPipeError, ConnectionResetError):
                raise
            except TkError as error:
                tracker.send(_Failed(error, ""))
            except Exception:
                tracker.send(_Failed(None, traceback.format_exc()))


def _serve(tracker: Connection, memory: mmap.mmap) -> None:
    task: _Task = tracker.recv()
    label = make_labeller(task.capture, task, tracker.send)
    ring = _Ring(tracker, memory, task)
    span: tuple[int, int] = tracker.recv()
    for observation, watch in observe(task.capture, label, span, task.keep_images):
        ring.put(observation, watch)
    tracker.send(None)
