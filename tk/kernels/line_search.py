"""Search along a contour's normal line for the silhouette's edge or for the border between two colours.

The silhouette paper, sections 4.1 and 4.4; region-based tracking (Stoiber et al. 2022, SRT3D).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS
from tk.kernels.runtime import ti

# Colour bins: 16 levels of each channel.
COLOR_BINS = 4096
# Maximum log likelihood ratio of one pixel (a factor of 20): colour models are not more certain.
MOST_LOG_RATIO = 3.0
# Neighbouring pixels of a line are correlated (texture, blur, coding): this many count as one. Chosen; sensitivity not
# measured.
_ALIKE_PIXELS = 3.0


@dataclass(frozen=True)
class SearchSettings:
    """Settings of the search along normals."""

    window_px: float = 8.0  # search range along the normal, in pixels of the scale (the paper: typically 8)
    # distance between samples, in pixels of the scale (the paper: typically every pixel; with three, joints differ by
    # less than a millimetre, in a third of the time)
    spacing_px: float = 3.0
    # maximum number of samples of a curve; longer curves have wider spacing and more weight a sample
    most_samples: int = 64
    # an edgel nearer than this, in pixels of the scale, to a model edge of another limb is shared with it (4.4); at 0
    # every edgel has its full weight. The paper gives no distance; 8 is its window.
    ambiguous_px: float = 0.0
    # weight of the row along the contour (1: the paper's dx and dy; 0: the distance along the normal)
    tangential: float = 0.3
    # distance at which the Geman-McClure weights (1 + (d/s)²)⁻² are a quarter, in pixels of the scale; 0: the paper's
    # least squares, which shadows at the feet distort. 8 is the window
    robust_px: float = 8.0
    # whether contours in front of another part are searched, too, as in the paper. No silhouette edge is expected
    # there, and most edges found belong to other contours. Sharing ambiguous edgels (4.4) corrects this in part;
    # excluding these contours corrects more.
    interior: bool = False
    # precision about zero of the displacement of a segment's contours in one view, which the equations then contain as
    # an unknown; in their unit, pixels of contour times square pixels a square metre. 0: contours are not displaced
    displacement: float = 0.0


class Regions(NamedTuple):
    """Colours on either side of contours in front of another part (region-based tracking; Stoiber et al. 2022)."""

    image: NDArray[np.uint8]  # (V, h, w, 3) uint8 BGR
    log_likelihood: NDArray[np.float32]  # (G, `COLOR_BINS`) float32 log p(colour | group), see `color_bin`
    weight: float  # weight of a contour with an exact colour border, relative to a silhouette's edge
    step: int = 1  # pixels of the camera along an edge of a pixel of the image


@ti.func
def bilinear(mask: ti.template(), v: int, width: int, height: int, x):
    """Return the mask value, 0 to 255, at a place inside the image."""
    i = ti.min(ti.max(ti.cast(ti.floor(x[0]), ti.i32), 0), width - 2)
    j = ti.min(ti.max(ti.cast(ti.floor(x[1]), ti.i32), 0), height - 2)
    s, t = x[0] - i, x[1] - j
    top = (1.0 - s) * mask[v, j, i] + s * mask[v, j, i + 1]
    low = (1.0 - s) * mask[v, j + 1, i] + s * mask[v, j + 1, i + 1]
    return (1.0 - t) * top + t * low


@ti.func
def in_picture(width: int, height: int, x):
    return x[0] >= 0.0 and x[1] >= 0.0 and x[0] <= width - 1.0 and x[1] <= height - 1.0


@ti.func
def beside_others(mask: ti.template(), v: int, width: int, height: int, x):
    """Return whether one of the four pixels around a place shows another person."""
    i = ti.min(ti.max(ti.cast(ti.floor(x[0]), ti.i32), 0), width - 2)
    j = ti.min(ti.max(ti.cast(ti.floor(x[1]), ti.i32), 0), height - 2)
    top = mask[v, j, i] == OTHERS or mask[v, j, i + 1] == OTHERS
    return top or mask[v, j + 1, i] == OTHERS or mask[v, j + 1, i + 1] == OTHERS


@ti.func
def search_mask(mask: ti.template(), v: int, width: int, height: int, x, n, window):
    """Return (found, signed distance) of the transition along ±n: outwards from foreground, inwards from background.

    ``found`` is -1 where the search begins at pixels of another person or meets them: the edge may be hidden there.
    """
    before = bilinear(mask, v, width, height, x)
    inside = before >= 127.5
    direction = 1.0 + 0.0 * window
    if not inside:
        direction = -direction
    found = 0
    distance = 0.0 * window
    if before > 0.0 and before < 255.0 and beside_others(mask, v, width, height, x):
        found = -1
    step = 1
    while step <= window and found == 0:
        place = x + direction * step * n
        if not in_picture(width, height, place):
            step = 1 << 20
        else:
            value = bilinear(mask, v, width, height, place)
            if value > 0.0 and value < 255.0 and beside_others(mask, v, width, height, place):
                found = -1
            elif (value >= 127.5) != inside:
                found = 1
                distance = direction * (step - 1.0 + (before - 127.5) / (before - value))
            before = value
            step += 1
    return found, distance


@ti.func
def color_bin(image: ti.template(), v: int, j: int, i: int):
    """Return the bin of a pixel's colour: blue, green and red in 16 levels each."""
    b, g, r = ti.cast(image[v, j, i, 0], ti.i32), ti.cast(image[v, j, i, 1], ti.i32), ti.cast(image[v, j, i, 2], ti.i32)
    return ((b >> 4) << 8) | ((g >> 4) << 4) | (r >> 4)


@ti.func
def search_colors(
    image: ti.template(), likelihood: ti.template(), v: int, width: int, height: int, ratio, x, n, window, scale, front,
    back,
):  # fmt: skip
    """Return (certainty in [0, 1], mean place) of the border between two colour groups on the line x + s n.

    The border lies behind step d with a probability proportional to the exponential of the summed log ratios of the
    pixels before it (Stoiber et al. 2022, eqs. 3-8 with a hard step). Its mean is the Newton step; its variance,
    relative to a uniform distribution's, gives the weight. ``width``, ``height``: of the camera's image, in pixels of
    the scale. ``ratio``: size of the image to that of the camera.
    """
    log_sum = 0.0 * window
    total, first, second = 1.0 + 0.0 * window, -(window + 0.5), (window + 0.5) ** 2
    reach = ti.cast(window, ti.i32)
    at = (x + 0.5) / scale - 0.5
    start, along = (x + 0.5) * ratio - 0.5, (scale * ratio) * n
    for k in range(-reach, reach + 1):
        place = start + k * along
        i, j = ti.cast(ti.round(place[0]), ti.i32), ti.cast(ti.round(place[1]), ti.i32)
        if in_picture(width, height, at + k * n) and i < image.shape[2] and j < image.shape[1]:
            bin = color_bin(image, v, j, i)
            log_ratio = likelihood[front, bin] - likelihood[back, bin]
            log_sum += ti.min(ti.max(log_ratio, -MOST_LOG_RATIO), MOST_LOG_RATIO) / _ALIKE_PIXELS
        p = ti.exp(log_sum)
        d = k + 0.5
        total += p
        first += p * d
        second += p * d * d
    mean = first / total
    variance = second / total - mean * mean
    certainty = ti.max(1.0 - 3.0 * variance / ((window + 1.0) * (window + 1.0)), 0.0)
    return certainty * certainty, mean
