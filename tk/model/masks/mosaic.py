"""Put boxes of several cameras' images side by side in one image, so that a filter runs once for all cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_FRAME = 2  # pixels around all boxes: the reach of a 5×5 filter, the largest that reads beyond a box


@dataclass(frozen=True)
class Mosaic:
    """The place of each camera's box. Zeros separate the boxes."""

    boxes: NDArray[np.int32]  # (C, 4) int32, left, top, width, height in the camera's image; a box may be empty
    corners: NDArray[np.int32]  # (C, 2) int32, left, top in the mosaic
    shape: tuple[int, int]  # (height, width) of the mosaic

    @staticmethod
    def of(boxes: NDArray[np.int32], gap: int) -> Mosaic:
        """Arrange boxes (C, 4) from left to right, with ``gap`` pixels between them and two around them."""
        widths = boxes[:, 2] + gap
        corners = np.full((len(boxes), 2), _FRAME, np.int32)
        corners[:, 0] += np.cumsum(widths) - widths
        return Mosaic(boxes, corners, (int(boxes[:, 3].max()) + 2 * _FRAME, int(widths.sum()) - gap + 2 * _FRAME))

    def enlarged(self, factor: int) -> Mosaic:
        """Return the same mosaic for images that are larger by an integer factor."""
        return Mosaic(factor * self.boxes, factor * self.corners, (factor * self.shape[0], factor * self.shape[1]))

    def part(self, mosaic: NDArray[Any], c: int) -> NDArray[Any]:
        """Return a view of camera ``c``'s box in a mosaic."""
        x, y = self.corners[c]
        _, _, w, h = self.boxes[c]
        return mosaic[y : y + h, x : x + w]

    def crop(self, image: NDArray[Any], c: int) -> NDArray[Any]:
        """Return a view of camera ``c``'s box in its image."""
        x, y, w, h = self.boxes[c]
        return image[y : y + h, x : x + w]

    def part_of(self, mosaic: NDArray[Any], c: int, box: NDArray[np.int32]) -> NDArray[Any]:
        """Return a view, in a mosaic, of a box that lies inside camera ``c``'s box, in image coordinates."""
        x, y = self.corners[c] + box[:2] - self.boxes[c, :2]
        return mosaic[y : y + box[3], x : x + box[2]]

    def tightened(self, mosaic: NDArray[np.uint8], margin: int, gap: int) -> Mosaic:
        """Shrink each box to the pixels that are not 0 in a mosaic, plus a margin inside the box; see :meth:`of`."""
        boxes = np.zeros_like(self.boxes)
        for c, (left, top, width, height) in enumerate(self.boxes):
            x, y, w, h = cv2.boundingRect(self.part(mosaic, c)) if width > 0 else (0, 0, 0, 0)
            if w > 0:
                right, bottom = min(x + w + margin, width), min(y + h + margin, height)
                x, y = max(x - margin, 0), max(y - margin, 0)
                boxes[c] = left + x, top + y, right - x, bottom - y
        return Mosaic.of(boxes, gap)


def doubled(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat each pixel of an image (h, w) four times: (2 h, 2 w)."""
    height, width = image.shape
    result = np.empty((2 * height, 2 * width), np.uint8)
    result[0::2] = result[1::2] = np.multiply(image, 257, dtype=np.uint16).view(np.uint8)  # 257 = 0x0101
    return result
