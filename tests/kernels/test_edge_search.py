"""The search along lines against NumPy: pairs (eq. 12) and single points (eq. 14)."""

import numpy as np
import pytest

from scripts.paper.edge_maps import rgb_gradient
from tk.kernels.edge_search import MOST_EDGES, PAIR, SINGLE, search_edges

THRESHOLD = 0.12
H, W = 48, 64
# float32 of pixels below a hundred
EXACT_PX = 1e-4


def picture(*boxes):
    """(1, H, W, 3): bright boxes (x0, x1, y0, y1, level), ends excluded, on a dark ground."""
    image = np.full((1, H, W, 3), 40, np.uint8)
    for x0, x1, y0, y1, level in boxes:
        image[0, y0:y1, x0:x1] = level
    return image


def line(kind, at, other=None, normal=(1.0, 0.0), other_normal=None, reach=8.0, camera=0):
    other = at if other is None else other
    other_normal = normal if other_normal is None else other_normal
    return np.array([[kind, camera, *at, *other, *normal, *other_normal, reach]], np.float32)


def search(images, lines, threshold=THRESHOLD, sizes=None):
    sizes = np.tile([images.shape[1:3]], (len(images), 1)) if sizes is None else sizes
    return search_edges(images, np.asarray(sizes, np.int32), lines, threshold)


def oracle(gradients, sizes, row, threshold=THRESHOLD):
    """(found, a's edge, b's edge) of one line, and whether a choice was too close to call in float32."""
    kind, c = int(row[0]), int(row[1])
    p, q, na, nb, reach = row[2:4], row[4:6], row[6:8], row[8:10], row[10]
    h, w = sizes[c]
    magnitude, direction = (x[c] for x in gradients)
    length = np.float32(np.linalg.norm(q - p)) if kind == PAIR else np.float32(0)
    u = (q - p) / max(length, 1e-6) if kind == PAIR else na
    step = 1 / np.abs(u).max()
    steps = int((length + 2 * reach) / step) + 1
    t = -reach + step * np.arange(steps)
    xy = np.rint(p + t[:, None] * u).astype(int)
    inside = (xy >= 0).all(axis=1) & (xy[:, 0] < w) & (xy[:, 1] < h)
    strength, gradient = np.zeros(steps + 2), np.zeros((steps, 2))
    for i in np.flatnonzero(inside):
        x, y = xy[i]
        gradient[i] = direction[y, x]
        strength[i + 1] = magnitude[y, x] * abs(gradient[i] @ u)
    edges = []
    for i in range(steps):
        before, here, after = strength[i : i + 3]
        if here >= threshold and here >= before and here > after:
            x, y = xy[i]
            edges.append((t[i], magnitude[y, x] * abs(gradient[i] @ na), magnitude[y, x] * abs(gradient[i] @ nb)))
    assert len(edges) <= MOST_EDGES
    if kind == SINGLE:
        choices = [(-s, at, at) for at, s, _ in edges if s > 0]
    else:
        choices = [
            ((abs(tb - ta - length) + 1) / (sa * sb), ta, tb)
            for ta, sa, _ in edges
            for tb, _, sb in edges
            if tb > ta and sa > 0 and sb > 0
        ]
    if not choices:
        return None, False
    choices.sort()
    close = len(choices) > 1 and abs(choices[1][0] - choices[0][0]) < 1e-4 * abs(choices[0][0])
    return (p + choices[0][1] * u, p + choices[0][2] * u), close


@pytest.mark.parametrize("kind", [PAIR, SINGLE])
def test_search_is_the_slow_one(kind):
    """Lines of all directions, some over the border, on blocks: two cameras, one smaller than its place."""
    rng = np.random.default_rng(kind)
    small = rng.integers(0, 256, (2, 6, 8, 3)).astype(np.float32)
    images = np.stack([np.kron(s, np.ones((8, 8, 1))) for s in small]).astype(np.uint8)
    sizes = np.array([(H, W), (40, 50)])
    images[1, 40:], images[1, :, 50:] = 0, 0
    count, compared, hits = 150, 0, 0
    rows = np.zeros((count, 11), np.float32)
    rows[:, 0], rows[:, 1] = kind, rng.integers(0, 2, count)
    rows[:, 2:4] = rng.uniform(-4, 66, (count, 2))
    turn = rng.uniform(0, 2 * np.pi, (count, 2))
    rows[:, 6], rows[:, 7] = np.cos(turn[:, 0]), np.sin(turn[:, 0])
    rows[:, 8], rows[:, 9] = (np.cos(turn[:, 1]), np.sin(turn[:, 1])) if kind == PAIR else rows[:, 6:8].T
    far = rng.uniform(3, 15, (count, 1)) if kind == PAIR else 0
    rows[:, 4:6] = rows[:, 2:4] + far * -rows[:, 6:8]
    rows[:, 10] = rng.uniform(2, 9, count)
    gradient = rgb_gradient(images, sizes)
    found = search(images, rows, sizes=sizes)
    for row, got in zip(rows, found, strict=True):
        expected, close = oracle(gradient, sizes, row)
        if close:
            continue
        compared += 1
        if expected is None:
            assert not got.any()
        else:
            hits += 1
            assert got[0] == 1
            np.testing.assert_allclose(got[1:], np.concatenate(expected), rtol=0, atol=EXACT_PX)
    assert compared > 0.9 * count and 0.2 < hits / compared < 0.95


def test_a_pair_finds_a_bars_two_sides():
    found = search(picture((20, 40, 0, H, 200)), line(PAIR, (23, 24), (43, 24), (-1, 0), (1, 0)))[0]
    assert found[0] == 1
    # between the pixels 19 and 20, and 39 and 40: either may be the greatest of the 3×3 operator
    assert abs(found[1] - 19.5) <= 1 and abs(found[3] - 39.5) <= 1
    np.testing.assert_allclose(found[[2, 4]], 24)


def test_no_edge_no_answer_and_no_lines_no_work():
    flat = picture()
    for kind in (PAIR, SINGLE):
        assert not search(flat, line(kind, (20, 24), (30, 24), (-1, 0), (1, 0))).any()
    assert search(flat, np.zeros((0, 11), np.float32)).shape == (0, 5)


def test_a_padded_picture_ends_where_it_ends():
    image = picture((0, 30, 0, H, 200))
    assert search(image, line(SINGLE, (27, 24)))[0, 0] == 1
    assert not search(image, line(SINGLE, (27, 24)), sizes=[(H, 30)]).any()
