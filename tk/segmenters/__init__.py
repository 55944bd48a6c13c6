"""Segmenters: networks that tell which pixels of a picture show a person, with no empty scene to compare with.

:class:`~tk.segmenters.blazepose.BlazePose` is built in. A package adds another one with an entry point of the group
``tk.segmenters``: its name, and what makes an object with the protocol :class:`Segmenter`, called without arguments.
"""

from __future__ import annotations

import importlib.util
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError

if TYPE_CHECKING:
    from tk.model.masks.subject import Sighting

GROUP = "tk.segmenters"

_BUILT_IN = "mediapipe"
#: how to get the built-in one
INSTALL = "pip install tk-mocap[segmenter]"


class Segmenter(Protocol):
    """Tells which pixels show a person."""

    def segment(self, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(h, w) the probability of each pixel to show the person; ``picture``: (h, w, 3) BGR, the person about its
        middle. The same picture must give the same answer: a run that is resumed sees the same masks."""
        ...


@runtime_checkable
class Finder(Protocol):
    """What a segmenter may do beyond :class:`Segmenter`: tell where people are."""

    def find(self, picture: NDArray[np.uint8]) -> list[Sighting]:
        """The people in a picture (h, w, 3) BGR, in any order."""
        ...


def names() -> tuple[str, ...]:
    """The segmenters that are installed; those of other packages first, for somebody has chosen them."""
    others = sorted({entry.name for entry in entry_points(group=GROUP)})
    built_in = [_BUILT_IN] if importlib.util.find_spec("ai_edge_litert") else []
    return (*others, *built_in)


def load(name: str) -> Segmenter:
    """The segmenter of this name.

    Raises:
        ConfigError: it is not installed, or cannot be loaded.
    """
    for entry in entry_points(group=GROUP):
        if entry.name == name:
            try:
                made: Segmenter = entry.load()()
            except Exception as error:  # of a package that we know nothing about
                raise ConfigError(f"segmenter {name}: {entry.value} cannot be loaded: {error!r}") from error
            return made
    if name != _BUILT_IN or name not in names():
        known = ", ".join(names()) or f"none; {INSTALL} adds {_BUILT_IN}"
        raise ConfigError(f"segmenter {name}: is not installed; installed: {known}")
    from tk.segmenters.blazepose import BlazePose

    return BlazePose()


def probabilities(segmenter: Segmenter, name: str, picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """What the segmenter says about a picture, checked.

    Raises:
        ConfigError: it is no probability for each pixel.
    """
    found = np.asarray(segmenter.segment(picture))
    if found.shape != picture.shape[:2] or found.dtype.kind != "f":
        raise ConfigError(
            f"segmenter {name}: gave an array {found.shape} of {found.dtype} for a picture {picture.shape[:2]}; "
            "a probability for each pixel is needed"
        )
    if not (found.min() >= 0 and found.max() <= 1):  # NaN fails, too
        raise ConfigError(f"segmenter {name}: gave values outside 0 to 1; a probability for each pixel is needed")
    return found.astype(np.float32, copy=False)
