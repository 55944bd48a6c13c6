"""Pixels of images that may be smaller than the cameras: reduced by a whole number, as a tracker wants them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def every(images: NDArray[Any], size: tuple[int, ...], step: int) -> NDArray[Any]:
    """Return what images (V, h, w, ...) show at every ``step``-th pixel of the cameras, from the middle of the first
    ``step`` on; (H, W): ``size`` of the cameras."""
    if not images.size:
        return images
    if size[0] == images.shape[1]:
        return images[:, step // 2 :: step, step // 2 :: step]
    rows, columns, flat = _places(size[0], size[1], *images.shape[1:3], step)
    values = images.reshape(len(images), -1, *images.shape[3:]).take(flat, axis=1)
    return values.reshape(-1, rows, columns, *images.shape[3:])


@lru_cache(32)
def _places(height: int, width: int, h: int, w: int, step: int) -> tuple[int, int, NDArray[np.int64]]:
    """Return the number of rows and of columns of every ``step``-th pixel of a camera, and the indices (N,) of these
    pixels in a reduced image (h, w), row by row. The last pixels may be beyond its last whole square."""
    factor = height // h
    y = np.minimum(np.arange(step // 2, height, step) // factor, h - 1)
    x = np.minimum(np.arange(step // 2, width, step) // factor, w - 1)
    return len(y), len(x), (y[:, None] * w + x).ravel()


def crop(
    image: NDArray[np.uint8], size: tuple[int, ...], rows: slice, columns: slice, step: int = 1
) -> NDArray[np.uint8]:
    """Return what an image (h, w, 3) shows at some rows and columns of a camera of ``size`` (H, W): every ``step``-th
    pixel, from the first one on."""
    factor = size[0] // image.shape[0]
    y, x = (range(part.start, min(part.stop, side), step) for part, side in zip((rows, columns), size, strict=False))
    if step % factor == 0 and y[-1] < factor * image.shape[0] and x[-1] < factor * image.shape[1]:
        apart = step // factor
        return image[y.start // factor :: apart, x.start // factor :: apart][: len(y), : len(x)]
    top, left = rows.start // factor, columns.start // factor
    small = image[top : -(-rows.stop // factor), left : -(-columns.stop // factor)]
    shape = min(rows.stop, size[0]) - rows.start, min(columns.stop, size[1]) - columns.start
    below, right = (-(-n // factor) + 1 for n in shape)  # the last row or column may be beyond the last whole square
    missing = max(below - small.shape[0], 0), max(right - small.shape[1], 0)
    framed = cv2.copyMakeBorder(small, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE)
    whole = cv2.resize(framed, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    y0, x0 = rows.start % factor, columns.start % factor
    return np.asarray(whole, np.uint8)[y0 : y0 + shape[0], x0 : x0 + shape[1]][::step, ::step]
