"""Where images come from: a recording, live cameras, or a simulation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.frames import FrameSet

if TYPE_CHECKING:
    from tk.segmenters import Segmenter


@runtime_checkable
class Source(Protocol):
    """Yields the frame sets of all cameras of a setup. It needs no folder, and need not know its length."""

    @property
    def name(self) -> str:
        """Name that a result stores."""
        ...

    @property
    def where(self) -> str:
        """Path or address that messages begin with."""
        ...

    @property
    def first_frame(self) -> int:
        """First frame of which every camera has an image."""
        ...

    @property
    def frame_count(self) -> int | None:
        """Frames in all; None if unknown, as with live cameras."""
        ...

    @property
    def time_offset_s(self) -> tuple[float, ...]:
        """(C,) delay of each camera, seconds. :meth:`frames` corrects whole frames of it."""
        ...

    @property
    def has_masks(self) -> bool:
        """Whether frame sets hold masks."""
        ...

    @property
    def masks_from(self) -> str:
        """Name of the given masks if :attr:`has_masks`; else "none" if there is a :meth:`background`, "median" if the
        median of the frames is to replace it, "" if only a segmenter can make masks."""
        ...

    @property
    def segmenter(self) -> Segmenter | None:
        """Makes the masks if none are given; None: the empty scene, or an installed segmenter."""
        ...

    def frames(self, start: int = 0, stop: int | None = None) -> AbstractContextManager[Iterator[FrameSet]]:
        """Return the frame sets from ``start`` on, up to ``stop``, exclusive, or to the end.

        Raises:
            TkError: there are no such frames, or, during the iteration, one cannot be read.
        """
        ...

    def background(self) -> Sequence[NDArray[np.uint8]] | None:
        """Return images (T, h, w, 3) uint8 BGR of the empty scene by camera; None if there are none."""
        ...

    def shifted(self, time_offset_s: Sequence[float]) -> Source | None:
        """Return the same frames with other delays (C,); None if they cannot be read a second time."""
        ...

    def damaged(self, stop: int, cameras: NDArray[np.bool_]) -> Sequence[str]:
        """Return a line on each of some cameras, (C,) bool, with damaged images before frame ``stop``, or with another
        reason in its file to contradict the others. This may decode all of their images again."""
        ...
