"""A coarse look at whole pictures: boxes that hold the person, so that all else happens in them.

Its pixels are two of the reduced pictures that are tested each way. What is brighter than the scene, darker than a
shadow makes it, or of another colour counts. A person is in one piece, or nearly; what lies apart from the largest
thing and is much smaller is what coding makes of clutter.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.masks.background import Images, reduced

_NOISE = 3.0  # deviations of a reduced pixel by which a coarse one differs
_WHOLE = 128  # shares of the scene's light are counted in so many parts, to fit a byte
_CROWD = 4  # of a coarse pixel and its eight neighbours, how many differ: fewer are noise
# Coarse pixels that are one cell each way. Things in cells that touch, or with one cell between them, are one thing.
_CELL = 4
# A thing is left out that has less than this share of the largest one's pixels. A hand beyond a sleeve that cannot be
# seen has more. Measured: the masks of 225 sets of pictures of four rendered captures are those of boxes about
# everything; with a share of 0.1 nothing is cut off either.
_SHARE = 0.02
# The margin about them, share of the picture's height. The boxes of 535 pictures of five rendered captures cut nothing
# off with 20 of 240 pixels, a hand in five of them with 12.
_MARGIN = 0.085

_SQUARE3 = np.ones((3, 3), np.uint8)


class PersonBoxes:
    """Where to look in the pictures of a rig."""

    def __init__(self, plates: Images, shadow_min: float, height: int) -> None:
        """Reduced plates (C, h, w, 3); the darkest shadow, a share of the scene; the reduced pictures' usual height."""
        self._plates = reduced(plates, 2)
        self._scenes = np.empty_like(self._plates)
        darkest = self._plates.min(axis=3)
        self._darkest = darkest.reshape(-1, darkest.shape[2])
        self._shadow_min = shadow_min
        self._margin = round(_MARGIN * height)

    def boxes(self, pictures: Images, gains: NDArray[np.float32], noise: NDArray[np.float32]) -> NDArray[np.int32]:
        """(C, 4) left, top, width, height of the boxes in reduced pictures (C, h, w, 3); all 0 where there is nothing.

        Args:
            pictures: reduced.
            gains: (C, 3) of the pictures against the plates.
            noise: (C,) variance, grey levels².
        """
        coarse = reduced(pictures, 2)
        count, height, width = coarse.shape[:3]
        for plate, gain, scene in zip(self._plates, gains, self._scenes, strict=True):
            cv2.transform(plate, np.diag(gain), dst=scene)
        # one below the other they are one picture
        tall, scenes = coarse.reshape(-1, width, 3), self._scenes.reshape(-1, width, 3)
        shaded = cv2.convertScaleAbs(scenes, alpha=self._shadow_min)
        # a shadow leaves the same share of every colour
        blue, green, red = cv2.split(cv2.divide(tall, scenes, scale=_WHOLE))
        uneven = cv2.subtract(cv2.max(cv2.max(blue, green), red), cv2.min(cv2.min(blue, green), red))
        tinted = cv2.multiply(uneven, self._darkest, scale=1 / _WHOLE)
        blue, green, red = cv2.split(cv2.max(cv2.subtract(tall, scenes), cv2.subtract(shaded, tall)))
        beyond = np.asarray(cv2.max(cv2.max(blue, green), cv2.max(red, tinted)), np.uint8).reshape(count, -1)
        least = (_NOISE * np.sqrt(noise)).astype(np.uint8)
        differs = (beyond > least[:, None]).reshape(-1, width).view(np.uint8)
        crowd = cv2.boxFilter(differs, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        differs &= crowd >= _CROWD
        cells = cv2.boxFilter(
            differs, -1, (_CELL, _CELL), anchor=(0, 0), normalize=False, borderType=cv2.BORDER_CONSTANT
        ).reshape(count, height, width)[:, ::_CELL, ::_CELL]
        boxes = np.zeros((count, 4), np.int32)
        for c, picture in enumerate(differs.reshape(count, height, width)):
            x, y, w, h = (2 * n for n in _largest(picture, cells[c]))
            if w > 0:
                left, top = max(x - self._margin, 0), max(y - self._margin, 0)
                right, bottom = min(x + w + self._margin, 2 * width), min(y + h + self._margin, 2 * height)
                boxes[c] = left, top, right - left, bottom - top
        return boxes


def _largest(differs: Images, cells: Images) -> tuple[int, ...]:
    """Left, top, width, height of the largest thing in a coarse picture (h, w) of 0 and 1, and of all that is not much
    smaller; zeros where there is nothing. ``cells``: how many pixels of each cell differ."""
    grown = cv2.dilate(np.minimum(cells, 1), _SQUARE3)
    things, numbers = cv2.connectedComponents(grown)
    if things <= 2:  # the scene, and one
        return tuple(cv2.boundingRect(differs))
    sizes = np.bincount(np.asarray(numbers).ravel(), weights=cells.ravel(), minlength=things)
    large = sizes >= _SHARE * sizes.max()
    large[0] = False
    left, top, width, height = (_CELL * n for n in cv2.boundingRect(large[numbers].view(np.uint8)))
    x, y, w, h = cv2.boundingRect(differs[top : top + height, left : left + width])
    return x + left, y + top, w, h
