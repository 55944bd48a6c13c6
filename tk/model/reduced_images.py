"""Pixels of images that may be smaller than the cameras: reduced by a whole number, as a tracker wants them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def every(images: NDArray[Any], size: tuple[int, ...], step: int) -> NDArray[Any]:
    """Return what images (V, h, w, ...) show at every ``step``-th pixel of the cameras, from the middle of the first
    ``step`` on; (H, W): ``size`` of the cameras."""
    if not images.size:
        return images
    factor, first = size[0] // images.shape[1], step // 2
    rows, columns = (len(range(first, side, step)) for side in size[:2])
    if step % factor == 0:
        start, apart = first // factor, step // factor
        return images[:, start::apart, start::apart][:, :rows, :columns]
    # several times as fast as numbers of pixels as an index
    return np.stack([cv2.resize(one, (columns, rows), interpolation=cv2.INTER_NEAREST_EXACT) for one in images])


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
