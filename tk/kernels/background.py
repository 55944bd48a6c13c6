"""How unlike the empty scene each pixel is: the clamped collinearity statistic, for all cameras in one launch.

The colour values of a 3×3 window of the picture and of the (gain-corrected) plate are stacked into two vectors **a**,
**b** of 27 components; a constant component, the darkness offset, is added to both (Mester et al. 2001; Griesser et al.
2005). The smaller eigenvalue of their Gram matrix is ``min over s of |a - s b|² / (1 + s²)``: the distance from being
collinear, whatever the factor ``s``. A cast shadow can only darken, and only so far, thus here ``s`` is confined to
``[shadow_min, 1]`` (neither paper does so; a black shoe is collinear with any floor). With ``s = 1`` the same
expression is ``|a - b|² / 2``, an upper bound, so that the costlier statistic is needed only where this plain
difference is significant.

Sums are integers and the results are levels on a logarithmic scale in one byte, so they repeat bit for bit. Planes have
a frame of :data:`PAD` zero pixels around each camera's picture: nothing has to test for borders, and what lies outside
the picture adds nothing to a sum.
"""

import numpy as np
from numpy.typing import NDArray

from tk.kernels.runtime import ensure_runtime, spread_of, ti

PAD = 2
"""Zero pixels around each picture in a plane, on all four sides."""

STEPS_PER_OCTAVE = 8
"""Levels of the logarithmic scale for a factor of two."""

_MANTISSA_SHIFT = 20  # 23 bits of float32 mantissa less log2(STEPS_PER_OCTAVE)
_LEVEL_ONE = 128  # the level of 1.0
_EXPONENT_BIAS = (127 << 3) - _LEVEL_ONE
STRIP = 24
"""Rows that a thread handles at a time: their sums stay in its second-level cache."""


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
    """(d·b, b·b) over a column of the window: rows ``up`` (-1 or 0) to ``down`` (0 or 1) around ``pixel``."""
    db = 0
    bb = 0
    for row in range(up, down + 1):
        i = (pixel + row * width) * 3
        for k in ti.static(range(3)):
            b = ti.cast(plates[i + k], ti.i32)
            db += (ti.cast(images[i + k], ti.i32) - b) * b
            bb += b * b
    return ti.Vector([db, bb])


@ti.kernel
def _statistic_kernel(
    images: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [C * H * W * 3]
    plates: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [C * H * W * 3]
    weights: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [C * H * W] 1 / relative noise variance
    precision: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [C] 1 / noise variance
    height: ti.i32,
    width: ti.i32,
    spread: ti.i32,
    offset_squared: ti.i32,
    shadow_min: ti.f32,
    difference_min: ti.f32,  # noise variances, summed over the window
    scratch: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [C * strips * (STRIP + 2) * (W + 2)] outer columns are zero
    difference: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [C * (H + 2 PAD) * (W + 2 PAD)] out, zero before
    collinearity: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [C * (H + 2 PAD) * (W + 2 PAD)] out, zero before
):
    strips = (height + STRIP - 1) // STRIP
    line = width + 2
    for turn in range(spread * (precision.shape[0] * strips)):
        if turn % spread != 0:
            continue
        strip = turn // spread
        c = strip // strips
        first = (strip - c * strips) * STRIP
        rows = ti.min(STRIP, height - first)
        base = strip * (STRIP + 2) * line + 1
        for r in range(rows + 2):  # a row more above and below
            y = first + r - 1
            to = base + r * line
            if y < 0 or y >= height:
                for x in range(width):
                    scratch[to + x] = 0
            else:
                start = (c * height + y) * width * 3
                for x in range(width):
                    scratch[to + x] = _square(images, plates, start + 3 * x)
        smallest = difference_min / precision[c]
        for r in range(rows):
            y = first + r
            up = -1 if y > 0 else 0
            down = 1 if y < height - 1 else 0
            start = (c * height + y) * width
            to = (c * (height + 2 * PAD) + y + PAD) * (width + 2 * PAD) + PAD
            middle = base + (r + 1) * line
            left = 0
            centre = scratch[middle - line] + scratch[middle] + scratch[middle + line]
            slid = -2  # the pixel that column_1, column_2 belong to
            column_0 = ti.Vector([0, 0])
            column_1 = ti.Vector([0, 0])
            column_2 = ti.Vector([0, 0])
            for x in range(width):
                at = middle + x + 1
                right = scratch[at - line] + scratch[at] + scratch[at + line]
                dd = ti.cast(left + centre + right, ti.f32)
                plain = dd * weights[start + x]
                left = centre
                centre = right
                if plain >= smallest:
                    pixel = start + x
                    if slid == x - 1:
                        column_0 = column_1
                        column_1 = column_2
                    else:
                        column_0 = ti.Vector([0, 0])
                        if x > 0:
                            column_0 = _column(images, plates, pixel - 1, width, up, down)
                        column_1 = _column(images, plates, pixel, width, up, down)
                    column_2 = ti.Vector([0, 0])
                    if x < width - 1:
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
                    collinearity[to + x] = _level(residual * weights[pixel] * (precision[c] / 27.0))


@ti.kernel
def _relax_kernel(
    collinearity: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [C * (H + 2 PAD) * (W + 2 PAD)], zeros to 8 n
    eights: ti.types.ndarray(dtype=ti.i64, ndim=1),  # the same memory, eight pixels a word
    threshold: ti.i32,  # level
    per_neighbour: ti.i32,  # levels
    stride: ti.i32,  # W + 2 PAD
    labels: ti.types.ndarray(dtype=ti.u8, ndim=1),  # as collinearity, 0 or 1
    out: ti.types.ndarray(dtype=ti.u8, ndim=1),  # as collinearity, 0 or 1; zero where collinearity is
):
    for word in range(eights.shape[0]):
        if eights[word] != 0:
            for i in range(8 * word, 8 * word + 8):
                level = ti.cast(collinearity[i], ti.i32)
                if level > 0:
                    above = labels[i - stride - 1] + labels[i - stride] + labels[i - stride + 1]
                    below = labels[i + stride - 1] + labels[i + stride] + labels[i + stride + 1]
                    count = ti.cast(above + below + labels[i - 1] + labels[i + 1], ti.i32)
                    out[i] = ti.cast(level + per_neighbour * (count - 4) >= threshold, ti.u8)


class Planes:
    """The buffers of one rig, made once: (C, H + 2 PAD, W + 2 PAD) uint8 planes and their views without the frame.

    Attributes:
        difference: level of ``|a - b|² / 2`` over 27 noise variances, 0 where it is below ``difference_min``.
        collinearity: level of the clamped statistic over 27 noise variances, 0 where ``difference`` is.
        labels: 0 or 1.
    """

    def __init__(self, cameras: int, height: int, width: int) -> None:
        self.shape = (cameras, height, width)
        self._framed = (cameras, height + 2 * PAD, width + 2 * PAD)
        size = -(-int(np.prod(self._framed)) // 8) * 8
        self._difference, self._collinearity, self._labels, self._spare = (
            np.zeros(size, dtype=np.uint8) for _ in range(4)
        )
        strips = -(-height // STRIP)
        self._scratch = np.zeros(cameras * strips * (STRIP + 2) * (width + 2), dtype=np.int32)

    def _picture(self, plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return plane[: int(np.prod(self._framed))].reshape(self._framed)[:, PAD:-PAD, PAD:-PAD]

    @property
    def difference(self) -> NDArray[np.uint8]:
        return self._picture(self._difference)

    @property
    def collinearity(self) -> NDArray[np.uint8]:
        return self._picture(self._collinearity)

    @property
    def labels(self) -> NDArray[np.uint8]:
        return self._picture(self._labels)

    def measure(
        self,
        images: NDArray[np.uint8],
        plates: NDArray[np.uint8],
        weights: NDArray[np.float32],
        precision: NDArray[np.float32],
        *,
        darkness_offset: float,
        shadow_min: float,
        difference_min: float,
    ) -> None:
        """Fill ``difference`` and ``collinearity`` for one set of pictures: one kernel launch.

        Args:
            images, plates: (C, H, W, 3) uint8; the plates under this frame's gain.
            weights: (C, H, W) 1 / relative noise variance.
            precision: (C,) 1 / noise variance, grey levels⁻².
            darkness_offset: the constant component, grey levels, > 0.
            shadow_min: the darkest shadow, as a factor of the plate, in (0, 1].
            difference_min: below this many noise variances of plain difference a pixel is background for certain.
        """
        ensure_runtime()
        _, height, width = self.shape
        self._difference.fill(0)
        self._collinearity.fill(0)
        _statistic_kernel(
            np.ascontiguousarray(images).reshape(-1),
            np.ascontiguousarray(plates).reshape(-1),
            weights.reshape(-1),
            precision,
            height,
            width,
            spread_of(len(images) * -(-height // STRIP)),
            max(round(darkness_offset**2), 1),
            shadow_min,
            54.0 * difference_min,
            self._scratch,
            self._difference,
            self._collinearity,
        )

    def relax(self, threshold: float, octaves_per_neighbour: float, iterations: int) -> None:
        """Label the pixels, the threshold falling with the number ``n`` of foreground neighbours out of eight.

        A pixel is foreground where the statistic reaches ``threshold * 2 ** (octaves_per_neighbour * (4 - n))``. The
        labels start from the bare threshold and are updated all at once, a fixed number of times.
        """
        ensure_runtime()
        level = level_of(threshold)
        np.greater_equal(self._collinearity, level, out=self._labels.view(np.bool_))
        self._spare.fill(0)
        for _ in range(iterations):
            _relax_kernel(
                self._collinearity,
                self._collinearity.view(np.int64),
                level,
                round(octaves_per_neighbour * STEPS_PER_OCTAVE),
                self._framed[2],
                self._labels,
                self._spare,
            )
            self._labels, self._spare = self._spare, self._labels
