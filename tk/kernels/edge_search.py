"""Assign image edges to the model's contour points (Kehl 2006, section 6.1.2). One launch for all lines.

Two kinds of search, both along a straight line of pixels (Bresenham's: a pixel a step along the longer axis):

pair
    through two contour points symmetric about the limb's axis, and ``reach`` beyond each. It takes the pair of edges
    with the least ``|length difference| / (s_a s_b)`` (eq. 12), with the gradient score s of eq. 11.
single
    through one point along the contour's normal. It takes the edge with the greatest score (eq. 14).

An edge is a pixel whose colour gradient (section 4.2) is at least ``threshold`` and a maximum along the line. The
gradient is evaluated on demand.

Departure from eq. 12: as printed, a pair of equal length wins with any gradient, because the numerator is 0. A length
is exact to about a pixel, so one pixel is added. The paper is silent about the border: here lines end there.
"""

import numpy as np

from tk.kernels.edges import rgb_gradient_at
from tk.kernels.runtime import ensure_runtime, spread_of, ti

PAIR, SINGLE = range(2)
# Columns of a line: kind, camera, the pixels a and b (b = a unless PAIR), the outward unit normals at a and b, and the
# reach of the search beyond the points, pixels.
LINE_NUMBERS = 11
# Maximum number of edges of one line; the first are used. Only clutter has more.
MOST_EDGES = 24


@ti.kernel
def _search_kernel(
    threshold: ti.f32,
    spread: ti.i32,
    sizes: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (C, 2) height, width
    images: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (C, H, W, 3)
    lines: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (R, 11)
    edges: ti.types.ndarray(dtype=ti.f32, ndim=3),  # (R, MOST_EDGES, 3) scratch: position, score for a, for b
    found: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (R, 5) out: 1 or 0, the edges' pixels for a and for b
):
    for turn in range(spread * (lines.shape[0])):
        if turn % spread != 0:
            continue
        r = turn // spread
        kind = ti.cast(lines[r, 0], ti.i32)
        c = ti.cast(lines[r, 1], ti.i32)
        ax, ay, bx, by = lines[r, 2], lines[r, 3], lines[r, 4], lines[r, 5]
        nax, nay, nbx, nby = lines[r, 6], lines[r, 7], lines[r, 8], lines[r, 9]
        reach = lines[r, 10]
        height, width = sizes[c, 0], sizes[c, 1]
        for k in range(5):
            found[r, k] = 0.0
        # the line from a to b; from inside to outside for a single point
        ux, uy = nax, nay
        length = ax * 0.0
        if kind == PAIR:
            length = ti.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
            ux, uy = (bx - ax) / ti.max(length, 1e-6), (by - ay) / ti.max(length, 1e-6)
        step = 1.0 / ti.max(ti.max(ti.abs(ux), ti.abs(uy)), 1e-6)
        steps = ti.cast((length + 2.0 * reach) / step, ti.i32) + 1
        count = 0
        # three values in a row: the middle one is an edge if it is the greatest
        t1 = -reach
        m0, m1, gx1, gy1 = t1 * 0.0, t1 * 0.0, t1 * 0.0, t1 * 0.0
        for i in range(steps + 1):
            t = -reach + i * step
            x = ti.cast(ti.round(ax + t * ux), ti.i32)
            y = ti.cast(ti.round(ay + t * uy), ti.i32)
            m, gx, gy = t * 0.0, t * 0.0, t * 0.0
            if i < steps and 0 <= x < width and 0 <= y < height:
                m, gx, gy = rgb_gradient_at(images, c, y, x, height, width)
                m *= ti.abs(gx * ux + gy * uy)
            if m1 >= threshold and m1 >= m0 and m1 > m and count < MOST_EDGES:
                # the gradient's part along the line is in m1; the score wants it along the normals
                along = ti.max(ti.abs(gx1 * ux + gy1 * uy), 1e-6)
                edges[r, count, 0] = t1
                edges[r, count, 1] = m1 / along * ti.abs(gx1 * nax + gy1 * nay)
                edges[r, count, 2] = m1 / along * ti.abs(gx1 * nbx + gy1 * nby)
                count += 1
            t1, m0, m1, gx1, gy1 = t, m1, m, gx, gy
        if kind == SINGLE:
            best = t1 * 0.0
            for i in range(count):
                if edges[r, i, 1] > best:
                    best = edges[r, i, 1]
                    found[r, 0] = 1.0
                    found[r, 1], found[r, 2] = ax + edges[r, i, 0] * ux, ay + edges[r, i, 0] * uy
                    found[r, 3], found[r, 4] = found[r, 1], found[r, 2]
        else:
            best = t1 * 0.0 + 1e30
            for i in range(count):
                for j in range(count):
                    if edges[r, j, 0] > edges[r, i, 0] and edges[r, i, 1] > 0 and edges[r, j, 2] > 0:
                        difference = ti.abs(edges[r, j, 0] - edges[r, i, 0] - length) + 1.0
                        cost = difference / (edges[r, i, 1] * edges[r, j, 2])
                        if cost < best:
                            best = cost
                            found[r, 0] = 1.0
                            found[r, 1], found[r, 2] = ax + edges[r, i, 0] * ux, ay + edges[r, i, 0] * uy
                            found[r, 3], found[r, 4] = ax + edges[r, j, 0] * ux, ay + edges[r, j, 0] * uy


def search_edges(images: np.ndarray, sizes: np.ndarray, lines: np.ndarray, threshold: float) -> np.ndarray:
    """Return the edges assigned to R lines.

    Args:
        images: (C, H, W, 3) uint8 BGR.
        sizes: (C, 2) int32 height and width of each image within its zero padding.
        lines: (R, 11) float32: kind, camera, pixel a (x, y), pixel b, outward unit normal at a, at b, reach
            in pixels.
        threshold: minimum colour gradient of an edge, 0…1, along the line.

    Returns:
        (R, 5) float32: 1 if found, pixel (x, y) of a's edge, of b's.
    """
    ensure_runtime()
    R = len(lines)
    found: np.ndarray = np.zeros((R, 5), np.float32)
    if R:
        _search_kernel(
            threshold,
            spread_of(R),
            sizes,
            images,
            np.ascontiguousarray(lines, np.float32),
            np.empty((R, MOST_EDGES, 3), np.float32),
            found,
        )
    return found
