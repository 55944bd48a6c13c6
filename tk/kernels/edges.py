"""Edges of colour images: Euclidean distance and vector angle, mixed by intensity (Kehl 2006, section 4.2).

A shadow or a wrinkle scales a colour and leaves its direction in colour space; a change of material turns it. So the
distance of two pixels ``a``, ``b`` is ::

    d(a, b) = w · VA + (1 - w) · ED
    VA      = min(1, |a/|a| - b/|b|| / (2 sin(full_angle_rad / 2)))
    ED      = |a - b| / (255 √3)
    w       = angle_share · s(mean of a) · s(mean of b),   s(i) = 1 / (1 + exp(-intensity_slope (i - intensity_offset)))

with values from 0 to 1. The vector angle counts only where both pixels are bright: in the dark it is noise. Intensity
is the mean of the channels, as in the paper. The paper gives no formula for the weight; the sigmoid on each pixel is
from its reference (Wesolkowski & Jernigan 1999). The angle θ enters by the chord ``|â - b̂| = 2 sin(θ/2)``, which is
monotonic and needs no arc cosine. Angles between materials in a room are small (10° between skin and a pale wall),
hence the scale. A share of the Euclidean distance remains at any brightness, or a white sleeve in front of a grey wall
would have no edge.

The gradient at a pixel is the greatest distance over the four opposite pairs of its 3×3 window (difference vector
operator). The paper needs its direction (eq. 11) and is silent about its computation; the best of four pairs is exact
to 22° only. Here each pair's difference is projected on the difference of the winning pair, which turns vectors into
signed numbers, and these are combined as in Scharr's derivative. The direction points across the edge, towards the
brighter side. Where both sides are equally bright the sign is arbitrary: compare directions by the absolute value of
their dot product.

Other kernels evaluate :func:`rgb_gradient_at` along their search lines only; scripts/paper/edge_maps.py draws whole
images.
"""

import math

from tk.kernels.runtime import ti

# Parameters of the gradient, chosen with scripts/figure4_edges.py on two rendered captures: little clutter at equal
# recall of the person's outline. The paper tuned its own by hand for each camera and prints none.
# Mean of the channels, 0…255, at which a pixel's sigmoid is one half, and the sigmoid's slope, per level.
INTENSITY_OFFSET, INTENSITY_SLOPE = 80.0, 0.1
# Angle between two colours that weighs as much as the step from black to white, radians.
FULL_ANGLE_RAD = 0.7
# Weight of the angle between two bright pixels; at 0 only the Euclidean distance counts.
ANGLE_SHARE = 0.75

_ANGLE_SCALE = 1 / (2 * math.sin(FULL_ANGLE_RAD / 2))
_ED_SCALE = 1 / (255 * math.sqrt(3))
_AXIS_WEIGHT = 10 / 3  # weight of two pixels on an axis relative to two on a diagonal: Scharr's operator
_TINY = 1e-12


@ti.func
def _color(images: ti.template(), c: ti.i32, y: ti.i32, x: ti.i32):
    return ti.Vector([ti.cast(images[c, y, x, k], ti.f32) for k in ti.static(range(3))])


@ti.func
def rgb_gradient_at(
    images: ti.template(),  # (C, H, W, 3) u8
    c: ti.i32,
    y: ti.i32,
    x: ti.i32,
    height: ti.i32,  # of camera c's own image
    width: ti.i32,
):
    """Return (magnitude, dx, dy) of the colour gradient at pixel (y, x) of image c; see the module.

    The pixel must lie in the image, which is continued beyond its border by its last row or column. (dx, dy) is
    a unit vector, (1, 0) where the magnitude is 0.
    """
    magnitude = ti.f32(-1.0)
    winner = ti.Vector([0.0] * 6, ti.f32)
    winner_dx = ti.f32(1.0)
    winner_dy = ti.f32(0.0)
    differences = ti.Matrix.zero(ti.f32, 4, 6)
    brighter_x = ti.f32(0.0)
    brighter_y = ti.f32(0.0)
    for k in ti.static(range(4)):
        dx = ti.static((1, 0, 1, 1)[k])
        dy = ti.static((0, 1, 1, -1)[k])
        a = _color(images, c, ti.math.clamp(y - dy, 0, height - 1), ti.math.clamp(x - dx, 0, width - 1))
        b = _color(images, c, ti.math.clamp(y + dy, 0, height - 1), ti.math.clamp(x + dx, 0, width - 1))
        mean_a = a.sum() / 3
        mean_b = b.sum() / 3
        weight = ANGLE_SHARE / (
            (1 + ti.exp(INTENSITY_SLOPE * (INTENSITY_OFFSET - mean_a)))
            * (1 + ti.exp(INTENSITY_SLOPE * (INTENSITY_OFFSET - mean_b)))
        )
        # black has no direction; its weight is almost zero, so the direction does not matter
        angle = weight * _ANGLE_SCALE * (b / ti.max(b.norm(), 1.0) - a / ti.max(a.norm(), 1.0))
        euclidean = (1 - weight) * _ED_SCALE * (b - a)
        distance = ti.min(angle.norm(), weight) + euclidean.norm()
        for j in ti.static(range(3)):
            differences[k, j] = angle[j]
            differences[k, j + 3] = euclidean[j]
        if distance > magnitude:
            magnitude = distance
            for j in ti.static(range(6)):
                winner[j] = differences[k, j]
            winner_dx = dx
            winner_dy = dy
        share = ti.static(_AXIS_WEIGHT if k < 2 else 1.0)
        brighter_x += share * dx * (mean_b - mean_a)
        brighter_y += share * dy * (mean_b - mean_a)
    gx = ti.f32(0.0)
    gy = ti.f32(0.0)
    for k in ti.static(range(4)):
        projection = ti.f32(0.0)
        for j in ti.static(range(6)):
            projection += differences[k, j] * winner[j]
        share = ti.static(_AXIS_WEIGHT if k < 2 else 1.0)
        gx += share * ti.static((1, 0, 1, 1)[k]) * projection
        gy += share * ti.static((0, 1, 1, -1)[k]) * projection
    if gx * gx + gy * gy <= _TINY * magnitude**4:  # the pairs cancel each other, as on a saddle
        gx = winner_dx
        gy = winner_dy
    if gx * brighter_x + gy * brighter_y < 0:
        gx = -gx
        gy = -gy
    norm = ti.sqrt(gx * gx + gy * gy)
    return magnitude, gx / norm, gy / norm
