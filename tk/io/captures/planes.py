"""Images from the planes of brightness and colour that a video consists of, reduced before they become BGR.

The colours of a video are differences to the brightness, multiplied by numbers that depend on the standard (ITU-R
BT.601, BT.709, BT.2020), and the values use the whole range of a byte or leave its ends free. Videos say which.
"""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[Any]  # (h, w) uint8, or uint16 with 10 bits

#: weights of red and blue in the brightness by FFmpeg's AVCOL_SPC; others, and videos that say nothing, are BT.601's
_WEIGHTS = {1: (0.2126, 0.0722), 7: (0.212, 0.087), 9: (0.2627, 0.0593), 10: (0.2627, 0.0593)}
_BT601 = (0.299, 0.114)
#: largest side of a square of which the sum of 10 bits fits into 16
_MOST_ADDED = 7


def read_reduced(image: Any, out: NDArray[np.uint8]) -> None:
    """Write PyAV's ``image``, whose planes have 8 or 10 bits, into ``out`` (H, W, 3), BGR.

    The size of the image is a multiple of that of ``out``.
    """
    from av.video.reformatter import ColorRange

    ten_bits = image.format.name.endswith("10le")
    full_range = image.color_range == ColorRange.JPEG or image.format.name.startswith("yuvj")
    size = out.shape[1], out.shape[0]
    planes = [_reduced(_values(plane, ten_bits), size) for plane in image.planes]
    if ten_bits:
        planes = [cv2.convertScaleAbs(plane, alpha=0.25) for plane in planes]
    cv2.transform(cv2.merge(planes), _to_bgr(*_WEIGHTS.get(int(image.colorspace), _BT601), full_range), dst=out)


def _values(plane: Any, ten_bits: bool) -> Plane:
    """Return the values of a decoded plane, (h, w); those of ten bits in 0 to 1023."""
    kind = np.dtype(np.uint16 if ten_bits else np.uint8)
    rows = np.frombuffer(plane, kind).reshape(plane.height, plane.line_size // kind.itemsize)
    return rows[:, : plane.width]


def _reduced(plane: Plane, size: tuple[int, int]) -> Plane:
    """Return means over squares, (h, w) of ``size`` (w, h); the values of a smaller plane, of colours, are repeated.

    OpenCV's mean is fast over 2×2 values only.
    """
    while plane.shape[0] >= 2 * size[1] and plane.shape[0] % (2 * size[1]) == 0 == plane.shape[1] % (2 * size[0]):
        half = plane.shape[1] // 2, plane.shape[0] // 2
        plane = np.asarray(cv2.resize(plane, half, interpolation=cv2.INTER_AREA), plane.dtype)
    side = plane.shape[0] // size[1]
    if plane.shape == size[::-1]:
        return plane
    if plane.shape == (side * size[1], side * size[0]) and side <= _MOST_ADDED:
        rows = functools.reduce(np.add, [plane[k::side] for k in range(1, side)], plane[::side].astype(np.uint16))
        total = functools.reduce(np.add, [rows[:, k::side] for k in range(1, side)], rows[:, ::side])
        return np.asarray(cv2.multiply(total, 1 / side**2, dtype=cv2.CV_8U if plane.dtype == np.uint8 else cv2.CV_16U))
    repeated = plane.shape[0] < size[1] or plane.shape[1] < size[0]
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST if repeated else cv2.INTER_LINEAR))


@functools.cache
def _to_bgr(red: float, blue: float, full_range: bool) -> NDArray[np.float64]:
    """Return the matrix (3, 4) from brightness, difference of blue and of red, 0 to 255 each, to BGR."""
    green = 1 - red - blue
    light, color, black = (1.0, 1.0, 0.0) if full_range else (255 / 219, 255 / 224, 16.0)
    of_blue, of_red = 2 * (1 - blue) * color, 2 * (1 - red) * color
    rows = [[light, of_blue, 0], [light, -of_blue * blue / green, -of_red * red / green], [light, 0, of_red]]
    matrix = np.array(rows)
    return np.column_stack([matrix, -matrix @ (black, 128, 128)])
