"""Segmenters: networks that find the pixels of people in an image without an image of the empty scene.

:class:`~tk.segmenters.blazepose.BlazePose` is built in. A package adds another one with an entry point of the group
``tk.segmenters``: a name, and a callable without arguments that returns a :class:`Segmenter`.
"""

from __future__ import annotations

import functools
import importlib.util
import sys
from importlib.metadata import EntryPoints, entry_points
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError
from tk.model.body.body_points import JOINT_LANDMARKS, LANDMARKS

if TYPE_CHECKING:
    from tk.model.masks.sightings import Sighting

GROUP = "tk.segmenters"

_BUILT_IN = "mediapipe"
#: command that installs the built-in segmenter
INSTALL = "pip install tk-mocap[segmenter]"


class Segmenter(Protocol):
    """Estimates which pixels show a person.

    With an attribute ``parallel`` that is true, several threads call it at once.
    """

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the probability (h, w) that each pixel of an image (h, w, 3) BGR shows a person.

        A :class:`Finder` may segment the person in the middle only.
        The same image must give the same result, so that a resumed run sees the same masks.
        """
        ...


@runtime_checkable
class Finder(Protocol):
    """A segmenter that can also detect people."""

    def find(self, image: NDArray[np.uint8]) -> list[Sighting]:
        """Return the people in an image (h, w, 3) BGR, in any order."""
        ...


@runtime_checkable
class PoseSegmenter(Protocol):
    """A segmenter that also sees where points of the person's body are.

    Its attribute ``landmarks`` names them, see :data:`tk.model.body.body_points.LANDMARKS`; without it, they are
    :data:`tk.model.body.body_points.JOINT_LANDMARKS`.
    """

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the probability (h, w) of :meth:`Segmenter.segment`, and the landmarks (L, 3) or (L, 4) of the same
        person: x, y, pixels of the image (h, w, 3), and visibility, 0 to 1; NaN if there is nobody. A fourth column
        is the depth: metres behind the middle of the hips, along the line of sight.
        """
        ...


@functools.lru_cache(1)
def _entries(path: tuple[str, ...]) -> EntryPoints:
    """Return the segmenters of other packages. It takes 20 ms: the files of all packages in ``path`` are read."""
    return entry_points(group=GROUP)


def names() -> tuple[str, ...]:
    """Return the installed segmenters; those of other packages first, because the user chose to install them."""
    others = sorted({entry.name for entry in _entries(tuple(sys.path))})
    built_in = [_BUILT_IN] if importlib.util.find_spec("ai_edge_litert") else []
    return (*others, *built_in)


def at_hand() -> str | None:
    """Return the built-in segmenter if it is installed with its weights: it may serve where the user has not asked for
    one. Those of other packages may download something, or fail, when they are loaded."""
    from tk.segmenters import weights

    return _BUILT_IN if _BUILT_IN in names() and weights.at_hand() else None


def load(name: str) -> Segmenter:
    """Return the segmenter of this name.

    Raises:
        ConfigError: it is not installed, or cannot be loaded.
    """
    for entry in _entries(tuple(sys.path)):
        if entry.name == name:
            try:
                made: Segmenter = entry.load()()
            except Exception as error:  # another package may raise anything
                raise ConfigError(f"segmenter {name}: {entry.value} cannot be loaded: {error!r}") from error
            return made
    if name != _BUILT_IN or name not in names():
        known = ", ".join(names()) or f"none; {INSTALL} adds {_BUILT_IN}"
        raise ConfigError(f"segmenter {name}: is not installed; installed: {known}")
    from tk.segmenters.blazepose import BlazePose

    return BlazePose()


def segmented(
    segmenter: Segmenter, name: str, image: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the checked result of a segmenter for an image: the probabilities (h, w), and the landmarks (L, 4) in the
    order of :data:`~tk.model.body.body_points.LANDMARKS`, NaN where the segmenter has none.

    Raises:
        ConfigError: the result is not a probability for each pixel, or not three or four numbers for each landmark.
    """
    landmarks = np.full((len(LANDMARKS), 4), np.nan)
    if isinstance(segmenter, PoseSegmenter):
        names = getattr(segmenter, "landmarks", JOINT_LANDMARKS)
        found, seen = segmenter.segment_pose(image)
        if np.shape(seen) not in ((len(names), 3), (len(names), 4)):
            raise ConfigError(
                f"segmenter {name}: returned landmarks {np.shape(seen)}; they must be ({len(names)}, 3) or "
                f"({len(names)}, 4): x, y, visibility and, if it is known, depth of each landmark"
            )
        for each, row in zip(names, seen, strict=True):
            if each in LANDMARKS:
                landmarks[LANDMARKS.index(each), : len(row)] = row
    else:
        found = np.asarray(segmenter.segment(image))
    if found.shape != image.shape[:2] or found.dtype.kind != "f":
        raise ConfigError(
            f"segmenter {name}: returned an array {found.shape} of {found.dtype} for an image {image.shape[:2]}; "
            "it must return a probability for each pixel"
        )
    if not (found.min() >= 0 and found.max() <= 1):  # also fails for NaN
        raise ConfigError(
            f"segmenter {name}: returned values outside 0 to 1; it must return a probability for each pixel"
        )
    return found.astype(np.float32, copy=False), landmarks
