"""Observations: frames decoded and segmented, ahead of the tracker in a separate process where there is a second core.

A thread would not do: Taichi's launches hold the interpreter, so the tracker would wait while a thread segments. The
process is a fresh interpreter (a fork would hang in Taichi, and multiprocessing's spawn imports the user's script
again). Messages pass through a channel, frames through memory that both processes map, divided into slots of one frame:

    tracker ── task, span of frames, numbers of free slots ──► process ──► small images (tk.io.captures.film)
            ◄── _Ready: number of a slot with a frame, notes, _Failed, None after the last frame ──
            ── delays of the cameras that the run has found, seconds, or None ──► their small images once more, if any

The system frees the memory when both processes have ended, however they end. When the tracker ends, the channel closes,
and the process ends, too. The frames equal those of :class:`Serial` bit for bit.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import mmap
import pickle
import subprocess
import sys
import time
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import TkError, WorkerError
from tk.io.captures.capture import Capture
from tk.io.captures.clip import Image
from tk.io.captures.film import Film
from tk.kernels.runtime import ensure_runtime
from tk.model.cameras.camera import Rig
from tk.run import worker
from tk.run.segmentation import make_labeller, mask_source, prepare_kernels
from tk.run.task import Task
from tk.segmenters import Segmenter
from tk.system import machine, signals
from tk.system.files import NamelessFile, give_back
from tk.system.processes import Channel, parent
from tk.trackers.protocol import Frame, Stopwatch

Note = Callable[[str], None]
#: a frame, and its seconds: "decode", "masks", and "wait", the time that the tracker waited for it
Observed = tuple[Frame, Mapping[str, float]]

TIMING_STAGES = ("decode", "masks", "wait")

#: frames that the tracker usually holds: the current one, and the one before while it asks for the next
_HELD = 2
#: slots of frames that the tracker holds, more than an opening has; further frames are copied. The memory of all but
#: :data:`_HELD` free ones is given back to the system.
_SPARE = 42
#: most bytes of the frames made ahead: a few of eight full-HD cameras. Fewer would make the process wait.
_AHEAD_BYTES = 400_000_000
#: seconds in which the process may end by itself. A shorter time would lose kernels that it has compiled.
_PATIENCE_S = 5.0


class Observations(Protocol):
    """The observations of a source. A context manager."""

    def frames(self, start: int, stop: int | None) -> Iterator[Observed]:
        """Return the frames from ``start`` on, up to ``stop``, exclusive, or to the end; to be called once.

        Raises:
            TkError: a frame cannot be read; all frames before it have been returned.
        """
        ...

    def film_again(self, time_offset_s: Sequence[float] | None) -> None:
        """After the last frame: take the small images again, with delays (C,) of the cameras that the run has found,
        while the tracker does something else; None: they stay as they are."""
        ...

    def __enter__(self) -> Observations: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_observations(task: Task, note: Note, image_step: int = 1, film: Film | None = None) -> Observations:
    """Return the observations of a source, made ahead if there is a second core and ``settings.ahead`` is not 0.

    Args:
        task: its source yields the frames.
        note: called with each line that the user should read.
        image_step: as the tracker's; 2 reduces the images, (C, H // 2, W // 2, 3), 0 leaves them empty, (C, 0, 0, 3),
            without uncertain pixels.
        film: takes small images of the frames.

    Raises:
        CaptureError: there is nothing to make masks from.
    """
    mask_source(task.source)  # before a process is started
    if task.settings.ahead and machine.cores() > 1 and sys.executable and _can_be_sent(task.source.segmenter):
        try:
            return Ahead(task, note, image_step, film)
        except OSError as error:  # ulimit -f, -n or -v
            note(
                f"no memory can be shared with another process ({error.strerror}): frames are made one after the other"
            )
    worker.dismiss()
    if film is not None:
        film.file.hide()
    return Serial(task, note, image_step, film)


def _can_be_sent(segmenter: Segmenter | None) -> bool:
    """Return whether another process can receive a segmenter that a script has made."""
    try:
        # what the script itself defines is unknown to the other process
        return segmenter is None or (type(segmenter).__module__ != "__main__" and bool(pickle.dumps(segmenter)))
    except Exception:  # pickling calls methods of the object, which may raise anything
        return False


def observe(
    task: Task, note: Note, span: tuple[int, int | None], image_step: int, film: Film | None
) -> Iterator[tuple[Frame, Stopwatch]]:
    """Decode and segment frames in this process; ``span``: first frame, and the end, exclusive."""
    with task.source.frames(*span) as frames:
        label = make_labeller(task, note)  # threads decode the first frames meanwhile
        while True:
            watch = Stopwatch()
            frame = next(frames, None)
            if frame is None:
                return
            if film is not None:
                _keep(film, frame.index, dict(enumerate(frame.images)), task.setup.rig, note)
            watch.lap("decode")
            labels = label(frame)
            images = frame.halved if image_step == 2 else frame.images
            if not image_step:
                images, labels = np.empty((len(images), 0, 0, 3), np.uint8), labels._replace(uncertain=None)
            labelled = Frame(frame.index, images, time=frame.time, **labels._asdict())
            watch.lap("masks")
            yield labelled, watch


def _keep(film: Film, index: int, images: Mapping[int, Image], rig: Rig, note: Note) -> None:
    """Keep the images of a frame by some cameras, by their index, without the padding."""
    film.put(index, [images[c][: one.height, : one.width] if c in images else None for c, one in enumerate(rig)], note)


@dataclass(frozen=True)
class Serial:
    """Observations that are made when the tracker asks for them."""

    task: Task
    note: Note
    image_step: int = 1
    film: Film | None = None

    def frames(self, start: int, stop: int | None) -> Iterator[Observed]:
        for observation, watch in observe(self.task, self.note, (start, stop), self.image_step, self.film):
            yield observation, {**watch.laps, "wait": sum(watch.laps.values())}

    def film_again(self, time_offset_s: Sequence[float] | None) -> None:
        """There is no other process: the images are decoded when they are shown."""

    def __enter__(self) -> Serial:
        return self

    def __exit__(self, *_: object) -> None:
        pass


# --- what passes between the two processes ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Order:
    """What the process needs first; the span of frames follows."""

    task: Task
    image_step: int
    slots: int
    memory: NamelessFile
    film: Film | None


@dataclass(frozen=True)
class _Ready:
    """A frame lies in a slot. ``frame``: without its layers; ``layers``: the names of those that it has."""

    slot: int
    frame: Frame
    layers: tuple[str, ...]
    laps: Mapping[str, float]


@dataclass(frozen=True)
class _Failed:
    """What ended the process: a user's mistake, or a defect of the program and its traceback."""

    error: TkError | None
    trace: str


class _Layout:
    """Size of a slot, and the place of a frame's layers in it. Messages are small: a large one would make the process
    wait until the tracker reads it."""

    def __init__(self, rig: Rig, image_step: int) -> None:
        masks = len(rig), *rig.frame_shape
        height, width = (side // image_step if image_step else 0 for side in rig.frame_shape)
        #: fields of :class:`~tk.trackers.protocol.Frame`, their shapes and types
        self._layers = {
            "images": ((len(rig), height, width, 3), np.uint8),
            "masks": (masks, np.uint8),
            "uncertain": (masks, np.bool_),
            "people": (masks, np.uint8),
        }
        page = mmap.ALLOCATIONGRANULARITY
        self.bytes = -(-sum(math.prod(shape) for shape, _ in self._layers.values()) // page) * page

    def layers(self, slot: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Return views of a slot (bytes,)."""
        found: dict[str, NDArray[Any]] = {}
        begin = 0
        for name, (shape, kind) in self._layers.items():
            end = begin + math.prod(shape)
            found[name] = slot[begin:end].view(kind).reshape(shape)
            begin = end
        return found


# --- the tracker's side -----------------------------------------------------------------------------------------------


class Ahead:
    """Observations that a separate process makes.

    The arrays of a frame stay as they are while they are referenced; then their slot is used again. For each frame that
    it receives, the tracker gives the process a free slot, so the process always has ``settings.ahead`` of them. It
    begins with one for each frame of the opening, because the tracker begins when it has all of these.
    """

    def __init__(self, task: Task, note: Note, image_step: int = 1, film: Film | None = None) -> None:
        self._source, self._film, self._note = task.source, film, note
        self._layout = _Layout(task.setup.rig, image_step)
        most = max(_AHEAD_BYTES // self._layout.bytes, 1)
        slots = max(min(task.settings.ahead, most), 1)
        first = max(min(task.settings.silhouette.init_frames, most, slots + _SPARE - _HELD), slots)
        size = (slots + _SPARE) * self._layout.bytes  # the system provides memory where it is written
        memory = NamelessFile.in_memory(size)
        self._memory = memory.map()
        self._free = list(range(first, slots + _SPARE))
        self._given = first - slots  # slots that the process has in advance
        self._dropped: deque[int] = deque()  # slots of frames that are no longer referenced
        self._begun = self._ended = False
        child = worker.take()
        self._process, self._channel = child.process, child.channel
        self._send(_Order(task, image_step, first, memory, film))

    def frames(self, start: int, stop: int | None) -> Iterator[Observed]:
        self._begun = True
        self._send((start, stop))  # now, not when the first is asked for
        return self._arriving()

    def _arriving(self) -> Iterator[Observed]:
        while True:
            asked = time.perf_counter()
            self._collect()
            message = self._receive()
            if message is None:
                self._ended = True
                return
            observation = self._take(message)
            yield observation, {**message.laps, "wait": time.perf_counter() - asked}
            del observation

    def _take(self, ready: _Ready) -> Frame:
        size = self._layout.bytes
        slot = np.frombuffer(self._memory, np.uint8, size, ready.slot * size)
        if self._free:
            # every view has this array for its base, so it goes with the last of them
            weakref.finalize(slot, self._dropped.append, ready.slot).atexit = False
            if self._given:
                self._given -= 1
            else:
                self._send(self._free.pop())
        else:
            slot = slot.copy()
            self._send(ready.slot)
        layers = self._layout.layers(slot)
        present: dict[str, Any] = {name: layers[name] for name in ready.layers}
        return replace(ready.frame, **present)

    def _collect(self) -> None:
        """Make the dropped frames' slots free."""
        while self._dropped:
            slot = self._dropped.popleft()
            if len(self._free) < _SPARE - _HELD:
                give_back(self._memory, slot * self._layout.bytes, self._layout.bytes)
            self._free.append(slot)

    def _send(self, message: object) -> None:
        with contextlib.suppress(EOFError):  # its last messages are still to be read
            self._channel.send(message)

    def _receive(self) -> _Ready | None:
        """The next frame, None after the last.

        Raises:
            TkError: what the process raised.
            WorkerError: the process has been killed.
            RuntimeError: a defect of the program in it.
        """
        while True:
            try:
                message = self._channel.receive()
            except EOFError:
                how = f"the process that decodes and segments its frames {signals.how_it_ended(self._process.wait())}"
                raise WorkerError(f"{self._source.where}: {how}; ahead = 0 avoids this process") from None
            if isinstance(message, str):
                self._note(message)
            elif isinstance(message, _Failed):
                if message.error is not None:
                    raise message.error
                raise RuntimeError("the process that decodes and segments frames failed:\n" + message.trace)
            else:
                return message

    def film_again(self, time_offset_s: Sequence[float] | None) -> None:
        if not (self._ended and self._film is not None and isinstance(self._source, Capture)):
            return
        self._send(time_offset_s)
        if time_offset_s is not None:
            self._film.late_frames = self._source.shifted(time_offset_s).late_frames

    def __enter__(self) -> Ahead:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process. Closing twice is fine."""
        self._channel.close()
        if self._begun:  # it ends by itself, after the last small images, and stores the kernels that it has compiled
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_PATIENCE_S)
        self._process.kill()
        self._process.wait()


# --- the process's side -----------------------------------------------------------------------------------------------


class _Slots:
    """The process's end of the shared memory."""

    def __init__(self, tracker: Channel, order: _Order) -> None:
        self._tracker = tracker
        self._memory = order.memory.map()
        self._layout = _Layout(order.task.setup.rig, order.image_step)
        self._free = list(range(order.slots))

    def put(self, observation: Frame, watch: Stopwatch) -> None:
        """Hand a frame over; waits for a free slot."""
        while not self._free:
            self._free.append(self._tracker.receive())
        number, size = self._free.pop(), self._layout.bytes
        layers = self._layout.layers(np.frombuffer(self._memory, np.uint8, size, number * size))
        present = tuple(name for name in layers if getattr(observation, name) is not None)
        for name in present:
            layers[name][...] = getattr(observation, name)
        none = np.empty((0, 0, 0), np.uint8)
        bare = replace(observation, images=none, masks=none, uncertain=None, people=None)
        self._tracker.send(_Ready(number, bare, present, watch.laps))


def serve() -> None:
    """Run the process: take a task, pass frames until the last one, or until the tracker has ended."""
    tracker = parent()
    cv2.setNumThreads(1)  # the cameras are segmented in parallel already
    signals.ignore_requests()  # may be sent to all processes of a job; the tracker ends this one
    with contextlib.suppress(EOFError):  # the tracker closed its end of the channel
        _warm_up(tracker)
        try:
            _serve(tracker)
        except EOFError:
            raise
        except TkError as error:
            tracker.send(_Failed(error, ""))
        except Exception:
            tracker.send(_Failed(None, traceback.format_exc()))


def _warm_up(tracker: Channel) -> None:
    """Compile the kernels of the masks, and import PyAV, until the task arrives: the tracker's process imports
    meanwhile."""
    for step in (ensure_runtime, prepare_kernels, lambda: importlib.import_module("av")):
        if tracker.waiting():
            return
        step()


def _serve(tracker: Channel) -> None:
    order: _Order = tracker.receive()
    slots = _Slots(tracker, order)
    span: tuple[int, int | None] = tracker.receive()
    for observation, watch in observe(order.task, tracker.send, span, order.image_step, order.film):
        slots.put(observation, watch)
    tracker.send(None)
    film, source = order.film, order.task.source
    if film is None or order.task.options.causal or not isinstance(source, Capture):
        return
    while isinstance(delays := tracker.receive(), int):  # slots that are free again
        pass
    if delays is not None:
        shifted = source.shifted(delays)
        late = [c for c, frames in enumerate(shifted.late_frames) if frames != source.late_frames[c]]
        if late:
            with shifted.images_of(late, film.withdraw()) as frames:  # it is incomplete until the end
                for frame in frames:
                    images = dict(zip(late, frame.images, strict=True))
                    _keep(film, frame.index, images, order.task.setup.rig, tracker.send)
