"""Masks of a whole recording in little memory: one bit for each pixel of a box around the person, compressed.

What the masks' pixels show may be kept, too: for each ray of a tracker's grid a number of 16 bits.

Masks of a long recording are stored in a file: a temporary one without a name, or one beside the result, with which a
killed run can be resumed.
"""

from __future__ import annotations

import glob
import os
import struct
import tempfile
import weakref
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, TypeVar, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import FULL, DiskFullError, TkError
from tk.kernels.mask_values import OTHERS, PERSON

Masks = NDArray[np.uint8]
Colors = NDArray[np.uint16]
T = TypeVar("T")

#: most bytes in memory; larger stores are on disk
IN_MEMORY = 32_000_000
#: frames of a sequence whose masks lie one after the other: as many as the second pass optimises in one launch
#: (:data:`tk.trackers.alternatives.AT_ONCE`), which joins them without a copy
TOGETHER = 16


#: header of each record: the frame's number, the kind of the record, the number of bytes that follow, and the shape of
#: what they hold. Compressed bytes follow: of masks left, top, width, height of each camera's box, and the boxes' bits;
#: of colours the numbers.
_HEAD = struct.Struct("<qiqiii")
_PERSON, _OTHERS, _COLORS = range(3)
_BOX, _COLOR = np.dtype("<i4"), np.dtype("<u2")


class MaskStore:
    """Masks (C, H, W), 0, 255 or :data:`~tk.kernels.mask_values.OTHERS`, by frame number.

    Args:
        path: file of the masks, created with the first frame; None: memory, or a file without a name.
        resume: use the frames in the file, up to the first damaged one.
    """

    def __init__(self, path: Path | None = None, resume: bool = False) -> None:
        self._path = path
        # start and size of each record, bytes, by number and kind
        self._places: dict[tuple[int, int], tuple[int, int]] = {}
        self._shapes: dict[int, tuple[int, ...]] = {}  # of masks and colours, by kind
        self._opened: IO[bytes] | None = None
        if path is not None and resume and path.is_file():
            self._take_up(self._open("r+b"))

    def _open(self, mode: str) -> IO[bytes]:
        try:
            # closed with the store
            file = self._path.open(mode) if self._path else tempfile.SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115
        except OSError as error:
            raise self._no_room(error) from None
        weakref.finalize(self, file.close)
        self._opened = file
        return file

    def _no_room(self, error: OSError) -> TkError:
        where = self._path or tempfile.gettempdir()
        kind = DiskFullError if error.errno in FULL else TkError
        return kind(f"{where}: masks cannot be kept there: {error.strerror or error}")

    def _take_up(self, file: IO[bytes]) -> None:
        """Find the frames in the file; cut off the file at the first damaged record."""
        whole, end = os.fstat(file.fileno()).st_size, 0
        while end + _HEAD.size <= whole:
            index, kind, size, *shape = _HEAD.unpack(file.read(_HEAD.size))
            begin = end + _HEAD.size
            known = kind in (_PERSON, _OTHERS, _COLORS) and self._shapes.get(kind, tuple(shape)) == tuple(shape)
            if not (known and 0 < size <= whole - begin and min(shape) > 0 and _is_whole(file.read(size), kind, shape)):
                break
            self._shapes[kind], end = tuple(shape), begin + size
            self._place(index, kind, (begin, size))
        file.truncate(end)

    def _place(self, index: int, kind: int, place: tuple[int, int]) -> None:
        """Note where a record is. If a frame's masks are stored again, its other records that are older than its former
        masks are forgotten: each time a frame is stored, its masks are the last record."""
        before, _ = self._places.get((index, _PERSON), (-1, 0))
        if kind == _PERSON:
            for other in (_OTHERS, _COLORS):
                if self._places.get((index, other), (before, 0))[0] < before:
                    del self._places[index, other]
        self._places[index, kind] = place

    def __contains__(self, index: int) -> bool:
        return (index, _PERSON) in self._places

    def put(self, index: int, masks: Masks, colors: Colors | None = None) -> None:
        """Store a frame's masks, values of 128 and more are the person, and what they show, (C, h, w).

        Raises:
            TkError: the file cannot be written, for example because the disk is full.
        """
        boxes = np.array([cv2.boundingRect(mask) for mask in masks], _BOX)
        crops = [mask[y : y + h, x : x + w] for mask, (x, y, w, h) in zip(masks, boxes, strict=True)]
        if colors is not None:  # first, as pixels of others: a frame whose masks are in the file is whole
            self._put(index, _COLORS, colors.shape, colors.astype(_COLOR).tobytes())
        for kind, drawn in (
            (_OTHERS, [crop == OTHERS for crop in crops]),
            (_PERSON, [crop >= PERSON for crop in crops]),
        ):
            if kind == _PERSON or any(one.any() for one in drawn):
                bits = np.packbits(np.concatenate([one.ravel() for one in drawn]))
                self._put(index, kind, masks.shape, boxes.tobytes() + bits.tobytes())

    def _put(self, index: int, kind: int, shape: tuple[int, ...], values: bytes) -> None:
        self._shapes[kind] = shape
        packed = zlib.compress(values, 1)
        file = self._opened or self._open("w+b")
        try:
            file.seek(0, os.SEEK_END)
            place = file.tell() + _HEAD.size
            file.write(_HEAD.pack(index, kind, len(packed), *shape) + packed)
            file.flush()
        except OSError as error:
            raise self._no_room(error) from None
        self._place(index, kind, (place, len(packed)))

    def get(self, index: int) -> Masks:
        """Return the masks (C, H, W) of a stored frame."""
        masks = np.zeros(self._shapes[_PERSON], np.uint8)
        self._draw(index, masks)
        return masks

    def colors(self, index: int) -> Colors | None:
        """Return what the masks of a frame show, (C, h, w); None if that is not stored."""
        if (index, _COLORS) not in self._places:
            return None
        return np.frombuffer(self._read(index, _COLORS), _COLOR).reshape(self._shapes[_COLORS])

    def _read(self, index: int, kind: int) -> bytes:
        place, size = self._places[index, kind]
        assert self._opened is not None
        self._opened.seek(place)
        return zlib.decompress(self._opened.read(size))

    def _draw(self, index: int, masks: Masks) -> None:
        """Set the stored pixels of a frame in masks (C, H, W) that show nobody."""
        for kind, value in ((_PERSON, 255), (_OTHERS, OTHERS)):
            if (index, kind) not in self._places:
                continue
            stored = self._read(index, kind)
            boxes = np.frombuffer(stored, _BOX, 4 * len(masks)).reshape(-1, 4)
            bits = np.unpackbits(np.frombuffer(stored, np.uint8, offset=boxes.nbytes))
            begin = 0
            for mask, (x, y, w, h) in zip(masks, boxes.tolist(), strict=True):
                mask[y : y + h, x : x + w] |= bits[begin : begin + w * h].reshape(h, w) * np.uint8(value)
                begin += w * h

    def without(self, cameras: NDArray[np.bool_]) -> MaskStore:
        """Return a store in which some cameras (C,) show nobody: a copy, or this one if there is no such camera."""
        if not cameras.any():
            return self
        result = MaskStore()
        for index, kind in self._places:
            if kind == _PERSON:
                masks = self.get(index)
                masks[cameras] = 0
                result.put(index, masks, self.colors(index))
        return result

    def sequence(self, indices: NDArray[np.int64]) -> Frames[Masks]:
        """Return the masks of these frames, not to be changed, unpacked on access; those of :data:`TOGETHER` frames lie
        in one array."""
        numbers, blocks = indices.tolist(), weakref.WeakValueDictionary[int, Masks]()
        unpacked: dict[int, set[int]] = {}  # frames of each block

        def get(i: int) -> Masks:
            block = blocks.get(i // TOGETHER)
            if block is None:
                blocks[i // TOGETHER] = block = np.zeros((TOGETHER, *self._shapes[_PERSON]), np.uint8)
                unpacked[i // TOGETHER] = set()
            masks = block[i % TOGETHER]
            if i not in unpacked[i // TOGETHER]:
                self._draw(numbers[i], masks)
                unpacked[i // TOGETHER].add(i)
            masks.flags.writeable = False
            return masks

        return Frames(get, range(len(numbers)))

    def color_sequence(self, indices: NDArray[np.int64], whole: NDArray[np.bool_]) -> Frames[Colors | None]:
        """Return what the masks of these frames (F,) show, as :meth:`colors`, unpacked on access; None unless ``whole``
        (F,)."""
        numbers = indices.tolist()
        return Frames(lambda row: self.colors(numbers[row]) if whole[row] else None, range(len(numbers)))


def _is_whole(packed: bytes, kind: int, shape: Sequence[int]) -> bool:
    """Return whether a record holds all numbers of a shape (C, h, w), or boxes inside masks of a shape (C, H, W), and
    all of the boxes' bits."""
    cameras, height, width = shape
    head, numbers = 4 * _BOX.itemsize * cameras, _COLOR.itemsize * cameras * height * width
    reader = zlib.decompressobj()
    try:
        most = numbers if kind == _COLORS else head + cameras * height * width // 8
        stored = reader.decompress(packed, most + 2)
    except zlib.error:
        return False
    if kind == _COLORS:
        return reader.eof and len(stored) == numbers
    if not reader.eof or len(stored) < head:
        return False
    x, y, w, h = np.frombuffer(stored, _BOX, 4 * cameras).reshape(-1, 4).T.astype(np.int64)
    inside = (np.minimum(x, y) >= 0) & (np.minimum(w, h) >= 0) & (x + w <= width) & (y + h <= height)
    return bool(inside.all()) and len(stored) == head + -(-int((w * h).sum()) // 8)


class MaskStores:
    """The masks of several people, in files beside a result.

    Args:
        result: the result file.
        resume: as for :class:`MaskStore`.
    """

    def __init__(self, result: Path, resume: bool) -> None:
        self._result, self._resume = result, resume
        self._stores: dict[int, MaskStore] = {}

    def __getitem__(self, person: int) -> MaskStore:
        """Return a person's store."""
        if person not in self._stores:
            self._stores[person] = MaskStore(self._path(person), self._resume)
        return self._stores[person]

    def remove(self) -> None:
        """Delete the files of all people, also those of a stopped run."""
        self._path(0).unlink(missing_ok=True)
        for path in self._result.parent.glob(f".{glob.escape(self._result.name)}.masks.*"):
            path.unlink(missing_ok=True)

    def _path(self, person: int) -> Path:
        return self._result.with_name(f".{self._result.name}.masks" + (f".{person}" if person else ""))


class Frames(Sequence[T]):
    """A sequence of what is stored of frames, which holds one at a time."""

    def __init__(self, get: Callable[[int], T], indices: Sequence[int]) -> None:
        self._get, self._indices = get, indices

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, i: int) -> T: ...

    @overload
    def __getitem__(self, i: slice) -> Frames[T]: ...

    def __getitem__(self, i: int | slice) -> T | Frames[T]:
        if isinstance(i, slice):
            return Frames(self._get, self._indices[i])
        return self._get(self._indices[i])
