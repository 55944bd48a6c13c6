"""Masks of a whole recording in little memory: a bit a pixel, compressed; some 10 kB for five pictures of 640×480.

Those of a long recording go to a temporary file without a name, so that memory stays flat.
"""

from __future__ import annotations

import os
import tempfile
import weakref
import zlib
from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from tk.errors import TkError

Masks = NDArray[np.uint8]

#: bytes that are kept in memory; with more, all of them are on disk
IN_MEMORY = 32 * 2**20


class MaskStore:
    """Masks (C, H, W), 0 or 255, by frame number."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115 (closed with the store)
        weakref.finalize(self, self._file.close)
        self._places: dict[int, tuple[int, int]] = {}  # where a frame begins, and its bytes
        self._shape: tuple[int, ...] = ()

    def __contains__(self, index: int) -> bool:
        return index in self._places

    def put(self, index: int, masks: Masks) -> None:
        """Keep a frame's masks; values of 128 and more are the person.

        Raises:
            TkError: there is no room for them on the disk.
        """
        self._shape = masks.shape
        packed = zlib.compress(np.packbits(masks >= 128).tobytes(), 1)
        try:
            self._file.seek(0, os.SEEK_END)
            place = self._file.tell()
            self._file.write(packed)
            self._file.flush()
        except OSError as error:
            raise TkError(f"{tempfile.gettempdir()}: masks cannot be kept there: {error.strerror or error}") from None
        self._places[index] = (place, len(packed))

    def get(self, index: int) -> Masks:
        """(C, H, W) the masks of a frame that was put."""
        place, size = self._places[index]
        self._file.seek(place)
        bits = np.frombuffer(zlib.decompress(self._file.read(size)), np.uint8)
        count = int(np.prod(self._shape))
        return np.unpackbits(bits, count=count).reshape(self._shape) * np.uint8(255)

    def sequence(self, indices: NDArray[np.int64]) -> Frames:
        """The masks of these frames, unpacked when they are asked for."""
        return Frames(self, [int(i) for i in indices])


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
