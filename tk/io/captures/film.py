"""A film: small images of some frames, kept while a run decodes its videos, so that drawing them needs no second time.

The images are in a file without a name in the result's folder: nothing remains of it however the processes end. The
process that decodes the frames writes it; the process that tracks reads it afterwards. Images of a long recording are
compressed. Those of a short one are not, and most systems delete them before they have written them to the disk.
"""

from __future__ import annotations

import math
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.io.captures.clip import Image
from tk.io.captures.frames import AHEAD
from tk.system.files import NamelessFile

# Most frames of a second, and in all: every run pays the time for them.
_MOST_PER_S, _MOST = 15.0, 3000
# Bytes of all images above which they become JPEG, a tenth of the size. For 5 images of 430×320 that takes 6 ms, a
# third of what their frame of the video takes in all.
_PLAIN = 500_000_000
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 90)  # appearance only
_WITHDRAWN = -1  # instead of a frame's number
#: bytes on the disk that are left to the result and its masks
LEFT_FREE = 1_000_000_000


def filmed(begin: int, stop: int, fps: float) -> range:
    """Return the frames of a result, ``begin`` to ``stop`` - 1, that its video shows."""
    step = max(math.ceil(fps / _MOST_PER_S - 0.01), -(-(stop - begin) // _MOST))
    return range(begin, stop, step)


@dataclass
class Film:
    """The images of :attr:`frames`. Another process continues a film that is sent to it.

    Attributes:
        where: the folder, as messages name it.
        sizes: (C,) width and height of the images.
        file: where they are.
        late_frames: (C,) delays of the cameras that the images are corrected by, whole frames.
        frames: which frames are kept; none until a run has chosen them.
    """

    where: Path
    sizes: Sequence[tuple[int, int]]
    file: NamelessFile
    late_frames: tuple[int, ...] = ()
    frames: range = range(0)
    _end: int = field(default=0, init=False)  # bytes written
    _kept: dict[int, NDArray[np.int64]] = field(default_factory=dict, init=False)  # :meth:`places` of those written

    @staticmethod
    def in_folder(folder: Path, sizes: Sequence[tuple[int, int]], late_frames: tuple[int, ...] = ()) -> Film | None:
        """Return a film in a folder; None if no file can be made there."""
        try:
            return Film(folder, sizes, NamelessFile.in_folder(folder), late_frames)
        except OSError:
            return None

    def put(self, index: int, images: Sequence[Image | None], note: Callable[[str], None]) -> None:
        """Keep the images (C,) of a frame if it is one of :attr:`frames`.

        None instead of an image, in a frame that was withdrawn: the image that was kept. If the disk is full, ``note``
        receives a line, and the film ends.
        """
        if index not in self.frames:
            return
        kept = self._kept.get(index)
        coded = [] if kept is None else self._coded(kept)
        for c, image in enumerate(images):
            if image is not None:
                small = _resized(image, self.sizes[c])
                coded[c : c + 1] = [small if self._plain else np.asarray(cv2.imencode(".jpg", small, _JPEG)[1])]
        lengths = [each.nbytes for each in coded]
        head = _head(index, lengths)
        place = self._end
        if kept is not None and np.array_equal(np.diff(kept), lengths):
            place = int(kept[0]) - head.nbytes
        size = head.nbytes + sum(lengths)
        try:
            if shutil.disk_usage(self.where).free < LEFT_FREE + size:
                raise OSError(f"less than {LEFT_FREE / 1e9:g} GB is free")
            if self.file.write([head.data, *(part.data for part in coded)], place) < size:
                raise OSError("it is full")
        except OSError as error:
            self.frames = range(0)
            self._kept.clear()
            self.file.truncate(0)
            reason = error.strerror or error
            note(f"{self.where}: no small images can be kept there ({reason}): the videos are decoded twice")
            return
        self._end = max(self._end, place + size)
        self._kept[index] = place + head.nbytes + np.cumsum([0, *lengths])

    def withdraw(self) -> list[int]:
        """Remove all frames, and return their numbers, ascending; each is there again when it is put once more, with
        images that are kept or new."""
        for bounds in self._kept.values():
            head = _head(_WITHDRAWN, np.diff(bounds).tolist())
            self.file.write([head.data], int(bounds[0]) - head.nbytes)
        return sorted(self._kept)

    def places(self) -> dict[int, NDArray[np.int64]]:
        """Return the frames in the file, and where the images of each begin and end, (C + 1,) bytes; of two records of
        a frame, the second."""
        found, end, whole = dict[int, NDArray[np.int64]](), 0, self.file.size()
        size = _head(0, [0] * len(self.sizes)).nbytes
        while end + size <= whole:
            index, *sizes = np.frombuffer(self.file.read(size, end), np.int64)
            bounds = end + size + np.cumsum([0, *sizes])
            end = int(bounds[-1])
            if end <= whole:  # else the process was killed while it wrote
                found[int(index)] = bounds
        found.pop(_WITHDRAWN, None)
        return found

    def images(self, frames: Iterable[int]) -> Iterator[tuple[int, list[Image]]]:
        """Yield these frames, which must be in the file, and their images (C,), BGR; decoded ahead."""
        places = self.places()
        with ThreadPoolExecutor(1) as thread:
            coming = deque[tuple[int, Callable[[], list[Image]]]]()
            for frame in frames:
                coming.append((frame, thread.submit(self._read, places[frame]).result))
                if len(coming) > AHEAD:
                    frame, result = coming.popleft()
                    yield frame, result()
            for frame, result in coming:
                yield frame, result()

    def _coded(self, bounds: NDArray[np.int64]) -> list[NDArray[np.uint8]]:
        """Return the images (C,) between these bounds as they are in the file."""
        record = np.frombuffer(self.file.read(int(bounds[-1] - bounds[0]), int(bounds[0])), np.uint8)
        return np.split(record, bounds[1:-1] - bounds[0])

    def _read(self, bounds: NDArray[np.int64]) -> list[Image]:
        coded = self._coded(bounds)
        if self._plain:
            return [image.reshape(height, width, 3) for image, (width, height) in zip(coded, self.sizes, strict=True)]
        return [np.asarray(cv2.imdecode(each, cv2.IMREAD_COLOR), np.uint8) for each in coded]

    @property
    def _plain(self) -> bool:
        return len(self.frames) * sum(3 * width * height for width, height in self.sizes) <= _PLAIN


def _head(index: int, sizes: Sequence[int]) -> NDArray[np.int64]:
    """Return what precedes the images (C,) of a frame: its number, and the images' bytes."""
    return np.array([index, *sizes], np.int64)


def _resized(image: Image, size: tuple[int, int]) -> Image:
    if size == image.shape[1::-1]:
        return np.ascontiguousarray(image)
    # down to half the size, linear interpolation uses every pixel, and takes a fifth of the time
    method = cv2.INTER_LINEAR if 2 * size[0] > image.shape[1] else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)
