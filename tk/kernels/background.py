"""How unlike the empty scene each pixel is: the clamped collinearity statistic, for all cameras in one launch.

The colour values of a 3×3 window of the picture and of the (gain-corrected) plate are stacked into two vectors **a**,
**b** of 27 components; a constant component, the darkness offset, is added to both (Mester et al. 2001; Griesser et al.
2005). The smaller eigenvalue of their Gram matrix is ``min over s of |a - s b|² / (1 + s²)``: the distance from being
collinear, whatever the factor ``s``. A cast shadow can only darken, and only so far, thus here ``s`` is confined to
``[shadow_min, 1]`` (neither paper does so; a black shoe is collinear with any floor). With ``s = 1`` the same
expression is ``|a - b|² / 2``, an upper bound, so that the costlier statistic is needed only where this plain
difference is significant.

Only a box of each camera's picture is looked at. Sums are integers and the results are levels on a logarithmic scale in
one byte, so they repeat bit for bit. What lies outside the picture adds nothing to a sum.
"""

import numpy as np
from numpy.typing import NDArray

from tk.kernels.launch import Launcher
from tk.kernels.runtime import ensure_runtime, spread_of, ti

STEPS_PER_OCTAVE = 8
"""Levels of the logarithmic scale for a factor of two."""

GREY = (29, 150, 77)
"""Weights of blue, green and red in the brightness (ITU-R BT.601, 256ths)."""

BRIGHT, DARK = 1, 2
"""Shades: brighter than the scene; darker than the scene is under the faintest shadow."""

_MANTISSA_SHIFT = 20  # 23 bits of float32 mantissa less log2(STEPS_PER_OCTAVE)
_LEVEL_ONE = 128  # the level of 1.0
_EXPONENT_BIAS = (127 << 3) - _LEVEL_ONE


def level_of(value: float) -> int:
    """The level of a positive value: about ``128 + 8 log2(value)``, piecewise linear, clipped to 0…255."""
    bits = int(np.float32(value).view(np.int32)) >> _MANTISSA_SHIFT
    return min(max(bits - _EXPONENT_BIAS, 0), 255)


@ti.func
def _level(value: ti.f32) -> ti.u8:
    bits = (ti.bit_cast(value, ti.i32) >> _MANTISSA_SHIFT) - _EXPONENT_BIAS
    return ti.cast(ti.min(ti.max(bits, 0), 255), ti.u8)


@ti.func
def _square(images: ti.template(), plates: ti.template(), i: ti.i32) -> ti.i32:
    """|a - b|² of one pixel; ``i`` is the index of its first channel."""
    d0 = ti.cast(images[i], ti.i32) - ti.cast(plates[i], ti.i32)
    d1 = ti.cast(images[i + 1], ti.i32) - ti.cast(plates[i + 1], ti.i32)
    d2 = ti.cast(images[i + 2], ti.i32) - ti.cast(plates[i + 2], ti.i32)
    return d0 * d0 + d1 * d1 + d2 * d2


@ti.func
def _column(images: ti.template(), plates: ti.template(), pixel: ti.i32, width: ti.i32, up: ti.i32, down: ti.i32):
    """(d·b, b·b, brightness of d) over a column of the window: rows ``up`` (-1 or 0) to ``down`` (0 or 1) around it."""
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
def _relaxed(labels: ti.template(), i: ti.i32, stride: ti.i32, level: ti.i32, per_neighbour: ti.i32, threshold: ti.i32):
    """The label of pixel ``i`` under those of its eight neighbours, 0 or 1."""
    above = labels[i - stride - 1] + labels[i - stride] + labels[i - stride + 1]
    below = labels[i + stride - 1] + labels[i + stride] + labels[i + stride + 1]
    count = ti.cast(above + below + labels[i - 1] + labels[i + 1], ti.i32)
    return ti.cast(level + per_neighbour * (count - 4) >= threshold, ti.u8)


@ti.kernel
def _label_kernel(
    images: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [C * H * W * 3]
    plates: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [C * H * W * 3]
    weights: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [C * H * W] 1 / relative noise variance
    squares: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [C * 3 * (W + 2)] scratch: |a - b|² of three rows
    difference: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [mosaic] out, and so are the others; zero before
    collinearity: ti.types.ndarray(dtype=ti.u8, ndim=1),
    shades: ti.types.ndarray(dtype=ti.u8, ndim=1),
    labels: ti.types.ndarray(dtype=ti.u8, ndim=1),  # after an even number of iterations
    spare: ti.types.ndarray(dtype=ti.u8, ndim=1),  # after an odd one
    open_pixels: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [mosaic] scratch: those whose labels neighbours can change
    precision: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [C] 1 / noise variance
    brightness: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [C, 2] least of what is bright, and of the scene
    boxes: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [C, 4] left, top, width, height
    corners: ti.types.ndarray(dtype=ti.i32, ndim=2),  # [C, 2] left, top in the mosaic
    stride: ti.i32,  # of the mosaic
    height: ti.i32,
    width: ti.i32,
    spread: ti.i32,
    offset_squared: ti.i32,
    shadow_min: ti.f32,
    shadow_max: ti.f32,
    difference_min: ti.f32,  # noise variances, summed over the window
    threshold: ti.i32,  # level
    per_neighbour: ti.i32,  # levels
    iterations: ti.i32,
):
    for turn in range(spread * precision.shape[0]):
        if turn % spread != 0:
            continue
        c = turn // spread
        left = boxes[c, 0]
        top = boxes[c, 1]
        w = boxes[c, 2]
        h = boxes[c, 3]
        if w * h == 0:
            continue
        first = c * height * width  # of the camera's pixels
        corner = corners[c, 1] * stride + corners[c, 0]
        line = w + 2  # of a row of squares: a pixel more on either side
        row_0 = c * 3 * (width + 2)
        smallest = difference_min / precision[c]
        swing = 4 * per_neighbour
        begin = corners[c, 0] * (labels.shape[0] // stride)  # of its open pixels
        end = begin
        for y in range(-1, h + 1):  # the statistic is a row behind the squares
            row = row_0 + (y + 1) % 3 * line
            inside = 0 <= top + y < height
            for x in range(-1, w + 1):
                square = 0
                if inside and 0 <= left + x < width:
                    square = _square(images, plates, 3 * (first + (top + y) * width + left + x))
                squares[row + x + 1] = square
            if y >= 1:
                v = top + y - 1  # in the picture
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
                        # a = b + d: every product follows from d·d, d·b and b·b without cancellation
                        db = ti.cast(sums[0], ti.f32)
                        bb = ti.cast(sums[1] + offset_squared, ti.f32)
                        excess = dd + 2.0 * db  # a·a - b·b
                        cross = bb + db  # a·b, positive thanks to the offset
                        s = (excess + ti.sqrt(excess * excess + 4.0 * cross * cross)) / (2.0 * cross)
                        s = ti.min(ti.max(s, shadow_min), 1.0)
                        t = 1.0 - s
                        residual = (dd + 2.0 * t * db + t * t * bb) / (1.0 + s * s)
                        difference[to + x] = _level(plain * (precision[c] / 54.0))
                        level = ti.cast(_level(residual * weights[pixel] * (precision[c] / 27.0)), ti.i32)
                        collinearity[to + x] = ti.cast(level, ti.u8)
                        label = ti.cast(level >= threshold, ti.u8)
                        labels[to + x] = label
                        spare[to + x] = label
                        if level > 0 and threshold - swing <= level < threshold + swing:
                            open_pixels[end] = to + x
                            end += 1
                        scene = 0
                        for k in ti.static(range(3)):
                            scene += GREY[k] * ti.cast(plates[3 * pixel + k], ti.i32)
                        brighter = ti.cast(sums[2], ti.f32)
                        shade = 0
                        if brighter > brightness[c, 0]:
                            shade = BRIGHT
                        elif brighter < brightness[c, 1] + (shadow_max - 1.0) * 9.0 * scene:
                            shade = DARK
                        shades[to + x] = ti.cast(shade, ti.u8)
        for turn_of_labels in range(iterations):
            for k in range(begin, end):
                i = open_pixels[k]
                level = ti.cast(collinearity[i], ti.i32)
                if turn_of_labels % 2 == 0:
                    spare[i] = _relaxed(labels, i, stride, level, per_neighbour, threshold)
                else:
                    labels[i] = _relaxed(spare, i, stride, level, per_neighbour, threshold)


class Statistic:
    """The test of one rig's pictures against its plates, with its buffers, made once.

    Pictures and plates are read where they lie whenever :meth:`measure` is called. What it finds lies in mosaics of the
    boxes that it is given, as arrays that the next call writes over.

    Attributes:
        difference: level of ``|a - b|² / 2`` over 27 noise variances, 0 where it is below the least.
        collinearity: level of the clamped statistic over 27 noise variances, 0 where ``difference`` is.
        shades: :data:`BRIGHT`, :data:`DARK` or 0 where ``difference`` is not 0.
        labels: 0 or 1.
    """

    def __init__(self, images: NDArray[np.uint8], plates: NDArray[np.uint8], weights: NDArray[np.float32]) -> None:
        """Pictures (C, H, W, 3); plates likewise, under each frame's gain; (C, H, W) 1 / relative noise variance."""
        cameras, self._height, self._width = images.shape[:3]
        self._spread = 0
        self._inputs = (images.reshape(-1), plates.reshape(-1), weights.reshape(-1))
        self._squares = np.zeros(cameras * 3 * (self._width + 2), np.int32)
        self._planes = np.zeros((5, 0), np.uint8)
        self._launch: Launcher | None = None
        self.difference, self.collinearity, self.shades, self.labels = (np.zeros((0, 0), np.uint8) for _ in range(4))

    def measure(
        self,
        precision: NDArray[np.float32],
        brightness: NDArray[np.float32],
        boxes: NDArray[np.int32],
        corners: NDArray[np.int32],
        shape: tuple[int, int],
        *,
        darkness_offset: float,
        shadow_min: float,
        shadow_max: float,
        difference_min: float,
        threshold: float,
        octaves_per_neighbour: float,
        iterations: int,
    ) -> None:
        """Compare and label the pixels within the boxes: one kernel launch.

        A pixel is labelled where the statistic reaches ``threshold * 2 ** (octaves_per_neighbour * (4 - n))`` with
        ``n`` of its eight neighbours labelled. The labels start from the bare threshold and are updated all at once, a
        fixed number of times.

        Args:
            precision: (C,) 1 / noise variance, grey levels⁻².
            brightness: (C, 2) sums over a window of the difference in brightness (weights :data:`GREY`): that of the
                least bright thing that the scene is not, and of the scene itself.
            boxes: (C, 4) left, top, width, height of what is looked at, within the picture; nothing else is labelled.
            corners: (C, 2) left, top of each box in the mosaic, a pixel or more from each other and the edge.
            shape: (height, width) of the mosaic.
            darkness_offset: the constant component, grey levels, > 0.
            shadow_min, shadow_max: the darkest and the faintest shadow, as factors of the plate, in (0, 1].
            difference_min: below this many noise variances of plain difference a pixel is background for certain.
        """
        ensure_runtime()
        size = shape[0] * shape[1]
        if self._launch is None or size > self._planes.shape[1]:
            self._planes = np.zeros((5, size + size // 2), np.uint8)
            pixels = np.zeros(self._planes.shape[1], np.int32)
            self._launch = Launcher(_label_kernel, *self._inputs, self._squares, *self._planes, pixels)
            self._spread = spread_of(len(precision))
        self._planes[:, :size] = 0
        self._launch(
            precision,
            brightness,
            boxes,
            corners,
            shape[1],
            self._height,
            self._width,
            self._spread,
            max(round(darkness_offset**2), 1),
            shadow_min,
            shadow_max,
            54.0 * difference_min,
            level_of(threshold),
            round(octaves_per_neighbour * STEPS_PER_OCTAVE),
            iterations,
        )
        planes = self._planes[:, :size].reshape(5, *shape)
        self.difference, self.collinearity, self.shades = planes[:3]
        self.labels = planes[3 + iterations % 2]
