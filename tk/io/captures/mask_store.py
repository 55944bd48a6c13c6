"""Masks of a whole recording in little memory: one bit for each pixel of a box around the person, compressed.

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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import FULL, DiskFullError, TkError
from tk.kernels.mask_values import OTHERS, PERSON

Masks = NDArray[np.uint8]

#: most bytes in memory; larger stores are on disk
IN_MEMORY = 32_000_000


#: header of each frame: its number (~number for the pixels of other people), the number of bytes that follow, and the
#: masks' shape. Compressed bytes follow: left, top, width, height of each camera's box, and the boxes' bits.
_HEAD = struct.Struct("<qqiii")
_BOX = np.dtype("<i4")


class MaskStore:
    """Masks (C, H, W), 0, 255 or :data:`~tk.kernels.mask_values.OTHERS`, by frame number.

    Args:
        path: file of the masks, created with the first frame; None: memory, or a file without a name.
        resume: use the frames in the file, up to the first damaged one.
    """

    def __init__(self, path: Path | None = None, resume: bool = False) -> None:
        self._path = path
        self._places: dict[int, tuple[int, int]] = {}  # start and size of each frame, bytes
        self._shape: tuple[int, ...] = ()
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
        """Find the frames in the file; cut off the file at the first damaged frame."""
        whole, end = os.fstat(file.fileno()).st_size, 0
        while end + _HEAD.size <= whole:
            index, size, *shape = _HEAD.unpack(file.read(_HEAD.size))
            begin = end + _HEAD.size
            if not 0 < size <= whole - begin or min(shape) <= 0 or self._shape not in ((), tuple(shape)):
                break
            if not _is_whole(file.read(size), shape):
                break
            self._shape, self._places[index], end = tuple(shape), (begin, size), begin + size
        file.truncate(end)

    def __contains__(self, index: int) -> bool:
        return index in self._places

    def put(self, index: int, masks: Masks) -> None:
        """Store a frame's masks; values of 128 and more are the person.

        Raises:
            TkError: the file cannot be written, for example because the disk is full.
        """
        boxes = np.array([cv2.boundingRect(mask) for mask in masks], _BOX)
        crops = [mask[y : y + h, x : x + w] for mask, (x, y, w, h) in zip(masks, boxes, strict=True)]
        if any((crop == OTHERS).any() for crop in crops):  # first: a frame whose masks are in the file is whole
            self._put(~index, masks.shape, boxes, [crop == OTHERS for crop in crops])
        self._put(index, masks.shape, boxes, [crop >= PERSON for crop in crops])

    def _put(
        self, index: int, shape: tuple[int, ...], boxes: NDArray[np.int32], crops: Sequence[NDArray[np.bool_]]
    ) -> None:
        self._shape = shape
        bits = np.packbits(np.concatenate([crop.ravel() for crop in crops]))
        packed = zlib.compress(boxes.tobytes() + bits.tobytes(), 1)
        file = self._opened or self._open("w+b")
        try:
            file.seek(0, os.SEEK_END)
            place = file.tell() + _HEAD.size
            file.write(_HEAD.pack(index, len(packed), *shape) + packed)
            file.flush()
        except OSError as error:
            raise self._no_room(error) from None
        self._places[index] = (place, len(packed))

    def get(self, index: int) -> Masks:
        """Return the masks (C, H, W) of a stored frame."""
        masks = np.zeros(self._shape, np.uint8)
        self._draw(index, masks, 255)
        if ~index in self._places:
            self._draw(~index, masks, OTHERS)
        return masks

    def _draw(self, index: int, masks: Masks, value: int) -> None:
        """Set the stored pixels of masks (C, H, W) to a value."""
        place, size = self._places[index]
        assert self._opened is not None
        self._opened.seek(place)
        stored = zlib.decompress(self._opened.read(size))
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
        for index in self._places:
            if index >= 0:
                masks = self.get(index)
                masks[cameras] = 0
                result.put(index, masks)
        return result

    def sequence(self, indices: NDArray[np.int64]) -> Frames:
        """Return the masks of these frames, unpacked on access."""
        return Frames(self, [int(i) for i in indices])


def _is_whole(packed: bytes, shape: Sequence[int]) -> bool:
    """Return whether a stored frame holds boxes inside masks of a shape (C, H, W), and all of the boxes' bits."""
    cameras, height, width = shape
    head = 4 * _BOX.itemsize * cameras
    reader = zlib.decompressobj()
    try:
        stored = reader.decompress(packed, head + cameras * height * width // 8 + 2)
    except zlib.error:
        return False
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


class Frames(Sequence[Masks]):
    """A sequence of masks that holds one at a time."""

    def __init__(self, store: MaskStore, indices: list[int]) -> None:
        self._store, self._indices = store, indices

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, i: int) -> Masks: ...

    @overload
    def __getitem__(self, i: slice) -> Frames: ...

    def __getitem__(self, i: int | slice) -> Masks | Frames:
        if isinstance(i, slice):
            return Frames(self._store, self._indices[i])
        return self._store.get(self._indices[i])

    def __iter__(self) -> Iterator[Masks]:
        return (self._store.get(i) for i in self._indices)
