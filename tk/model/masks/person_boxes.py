"""Find a box around the person in each image, quickly and coarsely, so that the exact test runs only there.

The search runs on images reduced once more by two. Pixels count if they are brighter than the scene, darker than a
shadow or of another colour. Regions that are far from the largest one and much smaller are coding noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.masks.background import Images, reduced
from tk.model.masks.regions import SQUARE3

_DEVIATIONS = 3.0  # a coarse pixel differs from the scene by this many standard deviations of a reduced pixel's noise
_WHOLE = 128  # fixed-point value of the share 1 of the scene's light, so that twice the light fits into a byte
# Side of a cell in coarse pixels. Regions in cells that touch, or are one cell apart, are one region. It sets how far a
# hand may be from the body.
_CELL = 4
# Regions with a smaller share of the largest region's pixels are ignored.
_SHARE = 0.02
# Margin of a box, share of the image height. In 535 images of five rendered captures a margin of 20 of 240 pixels cuts
# nothing off; one of 12 pixels cuts a hand off in five of them.
_MARGIN = 0.085


class PersonBoxes:
    """Finds the boxes in the images of a rig."""

    def __init__(self, plates: Images, shadow_min: float, height: int) -> None:
        """Prepare buffers.

        Args:
            plates: (C, h, w, 3), the reduced empty scene.
            shadow_min: darkest shadow, share of the lit scene.
            height: image height that the margin refers to, reduced pixels.
        """
        self._plates = reduced(plates, 2)
        self._scenes = np.empty_like(self._plates)
        darkest = self._plates.min(axis=3)
        self._darkest = darkest.reshape(-1, darkest.shape[2])
        self._shadow_min = shadow_min
        self._margin = round(_MARGIN * height)

    def boxes(self, images: Images, gains: NDArray[np.float32], noise: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return the boxes (C, 4): left, top, width, height in reduced pixels; all 0 where nothing differs.

        Args:
            images: (C, h, w, 3), reduced.
            gains: (C, 3), gain of the images relative to the plates.
            noise: (C,), variance in grey levels².
        """
        coarse = reduced(images, 2)
        count, height, width = coarse.shape[:3]
        for plate, gain, scene in zip(self._plates, gains, self._scenes, strict=True):
            cv2.transform(plate, np.diag(gain), dst=scene)
        # stacked vertically, the images of all cameras are one image
        tall, scenes = coarse.reshape(-1, width, 3), self._scenes.reshape(-1, width, 3)
        shaded = cv2.convertScaleAbs(scenes, alpha=self._shadow_min)
        # a shadow scales all colours by the same factor
        blue, green, red = cv2.split(cv2.divide(tall, scenes, scale=_WHOLE))
        uneven = cv2.subtract(cv2.max(cv2.max(blue, green), red), cv2.min(cv2.min(blue, green), red))
        tinted = cv2.multiply(uneven, self._darkest, scale=1 / _WHOLE)
        blue, green, red = cv2.split(cv2.max(cv2.subtract(tall, scenes), cv2.subtract(shaded, tall)))
        beyond = np.asarray(cv2.max(cv2.max(blue, green), cv2.max(red, tinted)), np.uint8).reshape(count, -1)
        least = (_DEVIATIONS * np.sqrt(noise)).astype(np.uint8)
        differs = (beyond > least[:, None]).reshape(-1, width).view(np.uint8)
        cells = cv2.boxFilter(
            differs, -1, (_CELL, _CELL), anchor=(0, 0), normalize=False, borderType=cv2.BORDER_CONSTANT
        ).reshape(count, height, width)[:, ::_CELL, ::_CELL]
        boxes = np.zeros((count, 4), np.int32)
        for c, mask in enumerate(differs.reshape(count, height, width)):
            x, y, w, h = (2 * n for n in _largest(mask, cells[c]))
            if w > 0:
                left, top = max(x - self._margin, 0), max(y - self._margin, 0)
                right = min(x + w + self._margin, images.shape[2])  # also of a last column that is in no square
                bottom = min(y + h + self._margin, images.shape[1])
                boxes[c] = left, top, right - left, bottom - top
        return boxes


def _largest(differs: Images, cells: Images) -> tuple[int, ...]:
    """Return left, top, width, height of the box around all large regions; zeros if there is none.

    ``differs`` (h, w) is 0 or 1; ``cells`` counts the pixels of each cell that differ.
    """
    grown = cv2.dilate(np.minimum(cells, 1), SQUARE3)
    count, regions = cv2.connectedComponents(grown)
    if count <= 2:  # the scene and one region
        return tuple(cv2.boundingRect(differs))
    sizes = np.bincount(np.asarray(regions).ravel(), weights=cells.ravel(), minlength=count)
    large = sizes >= _SHARE * sizes.max()
    large[0] = False
    left, top, width, height = (_CELL * n for n in cv2.boundingRect(large[regions].view(np.uint8)))
    x, y, w, h = cv2.boundingRect(differs[top : top + height, left : left + width])
    return x + left, y + top, w, h
