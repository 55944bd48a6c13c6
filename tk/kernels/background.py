"""Measure how each pixel differs from the empty scene: the clamped collinearity statistic, all cameras in one launch.

The colour values of a 3×3 window of the image and of the (gain-corrected) plate are stacked into two vectors **a**,
**b** of 27 components; a constant component, the darkness offset, is added to both (Mester et al. 2001; Griesser et al.
2005). The smaller eigenvalue of their Gram matrix is ``min over s of |a - s b|² / (1 + s²)``: the distance from being
collinear, whatever the factor ``s``. A cast shadow can only darken, and only so far, thus here ``s`` is confined to
``[shadow_min, 1]`` (neither paper does so; a black shoe is collinear with any floor). With ``s = 1`` the same
expression is ``|a - b|² / 2``, an upper bound, so that the costlier statistic is needed only where this plain
difference is significant.

Only a box of each camera's image is measured. Sums are integers and the results are levels on a logarithmic scale in
one byte, so they repeat bit for bit. Pixels outside the image add nothing to a sum.
"""

import numpy as np
from numpy.typing import NDArray

from tk.kernels.runtime import ensure_runtime, spread_of, ti
from tk.kernels.taichi_internals import Launcher

STEPS_PER_OCTAVE = 8
"""Levels of the logarithmic scale for a factor of two."""

GREY = (29, 150, 77)
"""Weights of blue, green and red in the brightness (ITU-R BT.601, 256ths)."""

# The results' planes.
PLANES = 3
DIFFERENCE, COLLINEARITY, BRIGHT = range(PLANES)

_MANTISSA_SHIFT = 20  # 23 bits of float32 mantissa less log2(STEPS_PER_OCTAVE)
_LEVEL_ONE = 128  # the level of 1.0
_EXPONENT_BIAS = (127 << 3) - _LEVEL_ONE


def level_of(value: float) -> int:
    """Return the level of a positive value: about ``128 + 8 log2(value)``, piecewise linear, clipped to 0…255."""
    bits = int(np.float32(value).view(np.int32)) >> _MANTISSA_SHIFT
    return min(max(bits - _EXPONENT_BIAS, 0), 255)


@ti.func
def _level(value: ti.f32) -> ti.u8:
    bits = (ti.bit_cast(value, ti.i32) >> _MANTISSA_SHIFT) - _EXPONENT_BIAS
    return ti.cast(ti.min(ti.max(bits, 0), 255), ti.u8)


@ti.func
def _square(images: ti.template(), plates: ti.template(), i: ti.i32) -> ti.i32:
    """Return |a - b|² of one pixel; ``i`` is the index of its first channel."""
    d0 = ti.cast(images[i], ti.i32) - ti.cast(plates[i], ti.i32)
    d1 = ti.cast(images[i + 1], ti.i32) - ti.cast(plates[i + 1], ti.i32)
    d2 = ti.cast(images[i + 2], ti.i32) - ti.cast(plates[i + 2], ti.i32)
    return d0 * d0 + d1 * d1 + d2 * d2


@ti.func
def _column(images: ti.template(), plates: ti.template(), pixel: ti.i32, width: ti.i32, up: ti.i32, down: ti.i32):
    """Return (d·b, b·b, brightness of d) over a column of the window, rows ``up`` (-1 or 0) to ``down`` (0 or 1)."""
    db = 0
    bb = 0
    brighter = 0
    for row in range(up, down + 1):
        i = (pixel + row * width) * 3
        for k in ti.static(range(3)):
            b = ti.cast(plates[i + k], ti.i32)
            d = ti.cast(images[i + k], ti.i32) - b
            db += d * b
            bb += b * b
            brighter += GREY[k] * d
    return ti.Vector([db, bb, brighter])


@ti.func
def _clamped(dd: ti.f32, db: ti.f32, bb: ti.f32, shadow_min: ti.f32, light_max: ti.f32) -> ti.f32:
    """Return the least ``|a - s b|² / (1 + s²)``, s in [shadow_min, light_max], from d·d, d·b, b·b with d = a - b."""
    # every product follows from these without cancellation
    excess = dd + 2.0 * db  # a·a - b·b
    cross = bb + db  # a·b, positive thanks to the offset
    s = (excess + ti.sqrt(excess * excess + 4.0 * cross * cross)) / (2.0 * cross)
    s = ti.min(ti.max(s, shadow_min), light_max)
    t = 1.0 - s
    return (dd + 2.0 * t * db + t * t * bb) / (1.0 + s * s)


@ti.kernel
def _label_kernel(
    # constants: images and plates [C * H * W * 3], 1 / relative noise variance [C * H * W]
    images: ti.types.ndarray(dtype=ti.u8, ndim=1),
    plates: ti.types.ndarray(dtype=ti.u8, ndim=1),
    weights: ti.types.ndarray(dtype=ti.f32, ndim=1),
    # scratch
    squares: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [C * 3 * (W + 2)] |a - b|² of three rows
    planes: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [PLANES * mosaic] out, from DIFFERENCE to BRIGHT; zero before
    # the frame
    precision: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [C] 1 / noise variance
    bright_sum: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [C] a larger sum of the brightness difference is bright
    boxes: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [C, 6] left, top, width, height; left, top in the mosaic
    stride: ti.i32,  # of the mosaic
    height: ti.i32,
    width: ti.i32,
    spread: ti.i32,
    # settings
    offset_squared: ti.i32,
    shadow_min: ti.f32,
    light_max: ti.f32,
    difference_min: ti.f32,  # noise variances, summed over the window
):
    for turn in range(spread * precision.shape[0]):
        if turn % spread != 0:
            continue
        c = turn // spread
        left, top, w, h = boxes[c, 0], boxes[c, 1], boxes[c, 2], boxes[c, 3]
        if w * h == 0:
            continue
        plane = planes.shape[0] // PLANES
        first = c * height * width  # of the camera's pixels
        corner = boxes[c, 5] * stride + boxes[c, 4]
        line = w + 2  # of a row of squares: one more pixel on either side
        row_0 = c * 3 * (width + 2)
        smallest = difference_min / precision[c]
        for y in range(-1, h + 1):  # the statistic is a row behind the squares
            row = row_0 + (y + 1) % 3 * line
            inside = 0 <= top + y < height
            for x in range(-1, w + 1):
                square = 0
                if inside and 0 <= left + x < width:
                    square = _square(images, plates, 3 * (first + (top + y) * width + left + x))
                squares[row + x + 1] = square
            if y >= 1:
                v = top + y - 1  # in the image
                up = -1 if v > 0 else 0
                down = 1 if v < height - 1 else 0
                to = corner + (y - 1) * stride
                sum_0 = squares[row_0] + squares[row_0 + line] + squares[row_0 + 2 * line]
                sum_1 = squares[row_0 + 1] + squares[row_0 + line + 1] + squares[row_0 + 2 * line + 1]
                slid = -2  # the pixel that column_1, column_2 belong to
                column_0 = ti.Vector([0, 0, 0])
                column_1 = ti.Vector([0, 0, 0])
                column_2 = ti.Vector([0, 0, 0])
                for x in range(w):
                    at = row_0 + x + 2
                    sum_2 = squares[at] + squares[at + line] + squares[at + 2 * line]
                    dd = ti.cast(sum_0 + sum_1 + sum_2, ti.f32)
                    u = left + x
                    pixel = first + v * width + u
                    plain = dd * weights[pixel]
                    sum_0 = sum_1
                    sum_1 = sum_2
                    if plain >= smallest:
                        if slid == x - 1:
                            column_0 = column_1
                            column_1 = column_2
                        else:
                            column_0 = ti.Vector([0, 0, 0])
                            if u > 0:
                                column_0 = _column(images, plates, pixel - 1, width, up, down)
                            column_1 = _column(images, plates, pixel, width, up, down)
                        column_2 = ti.Vector([0, 0, 0])
                        if u < width - 1:
                            column_2 = _column(images, plates, pixel + 1, width, up, down)
                        slid = x
                        sums = column_0 + column_1 + column_2
                        db, bb = ti.cast(sums[0], ti.f32), ti.cast(sums[1] + offset_squared, ti.f32)
                        residual = _clamped(dd, db, bb, shadow_min, light_max)
                        i = to + x
                        planes[DIFFERENCE * plane + i] = _level(plain * (precision[c] / 54.0))
                        planes[COLLINEARITY * plane + i] = _level(residual * weights[pixel] * (precision[c] / 27.0))
                        planes[BRIGHT * plane + i] = ti.cast(ti.cast(sums[2], ti.f32) > bright_sum[c], ti.u8)


class Statistic:
    """The test of one rig's images against its plates, with its buffers, made once.

    :meth:`measure` reads images and plates where they lie. Its results are mosaics of the boxes that it is given, in
    arrays that the next call overwrites.

    Attributes:
        difference: level of ``|a - b|² / 2`` over 27 noise variances, 0 where it is below the least.
        collinearity: level of the clamped statistic over 27 noise variances, 0 where ``difference`` is.
        bright: 1 where the image is brighter than the scene and ``difference`` is not 0, else 0.
        labels: whether ``collinearity`` reaches the threshold.
    """

    def __init__(self, images: NDArray[np.uint8], plates: NDArray[np.uint8], weights: NDArray[np.float32]) -> None:
        """Take images (C, H, W, 3), gain-corrected plates alike, and 1 / relative noise variance (C, H, W)."""
        cameras, self._height, self._width = images.shape[:3]
        self._spread = 0
        self._inputs = (images.reshape(-1), plates.reshape(-1), weights.reshape(-1))
        self._squares = np.zeros(cameras * 3 * (self._width + 2), np.int32)
        self._planes = np.zeros((PLANES, 0), np.uint8)
        self._launch: Launcher | None = None
        self.difference, self.collinearity, self.bright = (np.zeros((0, 0), np.uint8) for _ in range(3))
        self.labels = np.zeros((0, 0), np.bool_)

    def measure(
        self,
        precision: NDArray[np.float32],
        bright_sum: NDArray[np.float32],
        boxes: NDArray[np.int32],
        corners: NDArray[np.int32],
        shape: tuple[int, int],
        *,
        darkness_offset: float,
        shadow_min: float,
        light_max: float = 1.0,
        difference_min: float,
        threshold: float,
    ) -> None:
        """Compare and label the pixels within the boxes: one kernel launch.

        Args:
            precision: (C,) 1 / noise variance, grey levels⁻².
            bright_sum: (C,) least sum over a window of the difference in brightness (weights :data:`GREY`) that is
                brighter than the scene.
            boxes: (C, 4) left, top, width, height of what is measured, within the image; nothing else is labelled.
            corners: (C, 2) left, top of each box in the mosaic, a pixel or more from each other and the edge.
            shape: (height, width) of the mosaic.
            darkness_offset: the constant component, grey levels, > 0.
            shadow_min: the darkest shadow, as a factor of the plate, in (0, 1].
            light_max: the brightest light, likewise; above 1 where the plate may lie in a shadow.
            difference_min: below this many noise variances of plain difference a pixel is background for certain.
            threshold: a pixel is labelled where the statistic reaches it, noise variances.
        """
        ensure_runtime()
        size = shape[0] * shape[1]
        if self._launch is None or size > self._planes.shape[1]:
            self._planes = np.zeros((PLANES, size + size // 2), np.uint8)
            self._launch = Launcher(_label_kernel, *self._inputs, self._squares, self._planes.reshape(-1))
            self._spread = spread_of(len(precision))
        self._planes[:, :size] = 0
        self._launch(
            precision,
            bright_sum,
            np.concatenate([boxes, corners], axis=1),
            shape[1],
            self._height,
            self._width,
            self._spread,
            max(round(darkness_offset**2), 1),
            shadow_min,
            light_max,
            54.0 * difference_min,
        )
        planes = self._planes[:, :size].reshape(PLANES, *shape)
        self.difference, self.collinearity, self.bright = planes
        self.labels = self.collinearity >= max(level_of(threshold), 1)
