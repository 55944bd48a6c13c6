"""Colour edges: against slow NumPy, what the measure promises (shadow, hue, dark noise), direction, thinning."""

import math
from collections import deque

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scripts.paper.edge_maps import HIGH, edge_map, follow_edges, rgb_gradient, thin_edges
from tk.kernels.edges import ANGLE_SHARE, FULL_ANGLE_RAD, INTENSITY_OFFSET, INTENSITY_SLOPE, rgb_gradient_at
from tk.kernels.runtime import ensure_runtime, ti

PAIRS = ((1, 0), (0, 1), (1, 1), (1, -1))
FLOAT32 = 2e-5  # magnitudes are at most 1; the sigmoid's exponent is up to 20
SIZE = 21


def distance(a: NDArray, b: NDArray) -> tuple[float, NDArray]:
    """The mixed distance of two colours and its signed parts (6,), by the formula in the module."""
    weight = ANGLE_SHARE
    for color in (a, b):
        weight /= 1 + math.exp(-INTENSITY_SLOPE * (color.mean() - INTENSITY_OFFSET))
    unit_a, unit_b = (c / np.linalg.norm(c) if c.any() else c for c in (a, b))
    chord = (unit_b - unit_a) / (2 * math.sin(FULL_ANGLE_RAD / 2))
    step = (b - a) / (255 * math.sqrt(3))
    value = weight * min(1, np.linalg.norm(chord)) + (1 - weight) * np.linalg.norm(step)
    return value, np.concatenate([weight * chord, (1 - weight) * step])


def oracle_gradient(image: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Magnitude (h, w), direction (h, w, 2), and the lead of the greatest pair over the next (h, w)."""
    h, w = image.shape[:2]
    magnitude, direction, lead = np.zeros((h, w)), np.zeros((h, w, 2)), np.zeros((h, w))
    colors = np.pad(image.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    for y in range(h):
        for x in range(w):
            found = []
            for dx, dy in PAIRS:
                a, b = colors[y + 1 - dy, x + 1 - dx], colors[y + 1 + dy, x + 1 + dx]
                found.append((*distance(a, b), (b - a).mean()))
            values = [value for value, _, _ in found]
            best = int(np.argmax(values))
            magnitude[y, x] = values[best]
            lead[y, x] = values[best] - sorted(values)[-2]
            shares = (10 / 3, 10 / 3, 1, 1)
            gradient = sum(
                s * np.array(p) * (part @ found[best][1])
                for s, p, (_, part, _) in zip(shares, PAIRS, found, strict=True)
            )
            if np.linalg.norm(gradient) <= 1e-6 * magnitude[y, x] ** 2:
                gradient = np.array(PAIRS[best], float)
            brighter = sum(s * np.array(p) * rise for s, p, (_, _, rise) in zip(shares, PAIRS, found, strict=True))
            gradient = -gradient if gradient @ brighter < 0 else gradient
            direction[y, x] = gradient / np.linalg.norm(gradient)
    return magnitude, direction, lead


def oracle_thin(magnitude: NDArray, direction: NDArray) -> NDArray:
    padded = np.pad(magnitude.astype(np.float64), 3)

    def sample(y: float, x: float) -> float:
        y0, x0 = math.floor(y), math.floor(x)
        fy, fx = y - y0, x - x0
        block = padded[y0 + 3 : y0 + 5, x0 + 3 : x0 + 5]
        return float(np.array([1 - fy, fy]) @ block @ np.array([1 - fx, fx]))

    thin = np.zeros_like(magnitude)
    for y, x in np.ndindex(magnitude.shape):
        dx, dy = direction[y, x] if tuple(direction[y, x]) > (0, 0) else -direction[y, x]
        m = magnitude[y, x]
        thin[y, x] = m if m > sample(y - dy, x - dx) and m >= sample(y + dy, x + dx) else 0
    return thin


def oracle_follow(thin: NDArray, low: float, high: float) -> NDArray:
    edges = thin >= high
    queue = deque(zip(*np.nonzero(edges), strict=True))
    while queue:
        y, x = queue.popleft()
        for ny in range(max(0, y - 1), min(thin.shape[0], y + 2)):
            for nx in range(max(0, x - 1), min(thin.shape[1], x + 2)):
                if not edges[ny, nx] and thin[ny, nx] >= low:
                    edges[ny, nx] = True
                    queue.append((ny, nx))
    return edges


def random_pictures(seed: int, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
    """From pitch dark to bright, black pixels included."""
    rng = np.random.default_rng(seed)
    top = rng.uniform(0, 255, (*shape, 1))
    return (rng.random((*shape, 3)) * top * (rng.random((*shape, 1)) > 0.05)).astype(np.uint8)


def halves(
    left: tuple[int, ...], right: tuple[int, ...], angle_rad: float = 0.0, blur_px: float = 0.6
) -> NDArray[np.uint8]:
    """A (SIZE, SIZE, 3) picture of an edge through its middle; ``left`` to ``right`` is at ``angle_rad`` from x."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    t = 0.5 * (1 + np.tanh((x * math.cos(angle_rad) + y * math.sin(angle_rad)) / blur_px))[..., None]
    return np.rint((1 - t) * np.array(left) + t * np.array(right)).astype(np.uint8)


def strength(image: NDArray[np.uint8]) -> float:
    """Greatest magnitude in the picture."""
    return float(rgb_gradient(image[None])[0].max())


def euclidean(image: NDArray[np.uint8]) -> float:
    """The same of the Euclidean distance alone."""
    c = np.pad(image.astype(float), ((1, 1), (1, 1), (0, 0)), mode="edge")
    h, w = image.shape[:2]
    ends = [[c[1 + s * dy : 1 + s * dy + h, 1 + s * dx : 1 + s * dx + w] for s in (-1, 1)] for dx, dy in PAIRS]
    return max(float(np.linalg.norm(b - a, axis=-1).max()) for a, b in ends) / (255 * math.sqrt(3))


def test_gradient_agrees_with_slow_numpy() -> None:
    images = random_pictures(1, (2, 14, 17))
    magnitude, direction = rgb_gradient(images)
    assert magnitude.max() <= 1 + FLOAT32
    for image, m, d in zip(images, magnitude, direction, strict=True):
        expected_m, expected_d, lead = oracle_gradient(image)
        np.testing.assert_allclose(m, expected_m, atol=FLOAT32)
        # where two pairs are as great as each other, either may win
        clear = lead > 1e-4
        assert clear.mean() > 0.95
        along = np.abs((d * expected_d).sum(-1))[clear]
        assert (along > 1 - 1e-4).mean() == 1
        # and where no side is brighter, the sign is anybody's
        assert ((d * expected_d).sum(-1)[clear] > 0).mean() > 0.99


def test_padding_has_no_edges_and_makes_none() -> None:
    images = np.zeros((2, 12, 15, 3), np.uint8)
    small = random_pictures(2, (1, 9, 10))[0]
    images[0] = random_pictures(3, (1, 12, 15))[0]
    images[1, :9, :10] = small
    magnitude, direction = rgb_gradient(images, np.array([[12, 15], [9, 10]]))
    alone_m, alone_d = rgb_gradient(small[None])
    np.testing.assert_array_equal(magnitude[1, :9, :10], alone_m[0])
    np.testing.assert_array_equal(direction[1, :9, :10], alone_d[0])
    assert not magnitude[1, 9:].any() and not magnitude[1, :, 10:].any()
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-6)


@ti.kernel
def _along_line(
    images: ti.types.ndarray(dtype=ti.u8, ndim=4),
    pixels: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (N, 3) c, y, x
    found: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (N, 3) out
):
    for i in range(pixels.shape[0]):
        c, y, x = pixels[i, 0], pixels[i, 1], pixels[i, 2]
        m, dx, dy = rgb_gradient_at(images, c, y, x, images.shape[1], images.shape[2])
        found[i, 0] = m
        found[i, 1] = dx
        found[i, 2] = dy


def test_on_demand_equals_whole_picture() -> None:
    ensure_runtime()
    images = random_pictures(4, (2, 20, 30))
    pixels = np.array([(c, i // 2, i) for c in range(2) for i in range(30)], np.int32)
    found = np.empty((len(pixels), 3), np.float32)
    _along_line(images, pixels, found)
    magnitude, direction = rgb_gradient(images)
    c, y, x = pixels.T
    np.testing.assert_array_equal(found[:, 0], magnitude[c, y, x])
    np.testing.assert_array_equal(found[:, 1:], direction[c, y, x])


@given(
    color=st.tuples(*[st.integers(60, 250)] * 3).filter(lambda c: sum(c) > 450),
    factor=st.floats(0.75, 0.95),
)
@settings(max_examples=60)
def test_shadow_counts_little(color: tuple[int, ...], factor: float) -> None:
    """A bright colour scaled: what remains is the Euclidean share, and rounding."""
    shaded = tuple(round(factor * c) for c in color)
    picture = halves(color, shaded)
    assert strength(picture) < 0.5 * euclidean(picture) + 0.01


def test_hue_step_without_luminance_is_an_edge() -> None:
    reddish, greenish = (110, 120, 190), (110, 155.7, 120)  # BGR, the same in Rec. 601 luma
    picture = halves(reddish, tuple(round(c) for c in greenish))
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    assert int(np.ptp(grey)) <= 1, "the test's own premise"
    assert strength(picture) > HIGH > strength(np.repeat(grey[..., None], 3, axis=2))
    assert strength(picture) > 2 * euclidean(picture)


def test_dark_noise_does_not_fire() -> None:
    noise = np.random.default_rng(5).integers(0, 14, (1, 60, 60, 3)).astype(np.uint8)
    assert not edge_map(noise).any()


COLORS = st.tuples(*[st.integers(0, 255)] * 3)


@given(left=COLORS, right=COLORS, angle=st.floats(-math.pi, math.pi), blur_px=st.sampled_from([0.4, 0.8, 2.0, 5.0]))
@settings(max_examples=150)
def test_direction_of_steps_and_ramps(
    left: tuple[int, ...], right: tuple[int, ...], angle: float, blur_px: float
) -> None:
    contrast = np.linalg.norm(np.subtract(left, right))
    assume(contrast > 30 * max(1, blur_px))  # or rounding to whole levels decides
    image = halves(left, right, angle, blur_px)
    magnitude, direction = rgb_gradient(image[None])
    middle = np.s_[0, SIZE // 2, SIZE // 2]
    assert magnitude[middle] > 0
    normal = np.array([math.cos(angle), math.sin(angle)])
    assert abs(direction[middle] @ normal) > math.cos(math.radians(15))
    rise = np.mean(right) - np.mean(left)
    if abs(rise) > 10 * blur_px:
        assert direction[middle] @ normal * rise > 0, "towards the brighter side"


def test_thinning_agrees_with_slow_numpy() -> None:
    image = cv2.GaussianBlur(random_pictures(8, (1, 30, 40))[0], (0, 0), 1.0)
    magnitude, direction = rgb_gradient(image[None])
    expected = oracle_thin(magnitude[0], direction[0].astype(np.float64))
    found = thin_edges(magnitude, direction)[0]
    assert (found != expected).mean() < 0.002  # float32 against float64 at ties
    np.testing.assert_array_equal(found, thin_edges(magnitude, -direction)[0])


@pytest.mark.parametrize("angle_deg", [0, 30, 45, 90, 115, 160])
def test_a_step_gives_one_thin_line(angle_deg: int) -> None:
    edges = edge_map(halves((200, 60, 60), (60, 60, 200), math.radians(angle_deg), 0.3)[None])[0]
    y, x = np.nonzero(edges[2:-2, 2:-2])
    away = (x + 2 - SIZE // 2) * math.cos(math.radians(angle_deg)) + (y + 2 - SIZE // 2) * math.sin(
        math.radians(angle_deg)
    )
    assert np.abs(away).max() <= 1.0
    assert SIZE - 4 <= len(y) <= 1.5 * SIZE  # 8-connected, one pixel thick


def test_hysteresis_agrees_with_slow_numpy() -> None:
    rng = np.random.default_rng(9)
    thin = np.where(rng.random((2, 40, 40)) < 0.35, rng.random((2, 40, 40)), 0).astype(np.float32)
    found = follow_edges(thin, 0.3, 0.9)
    for picture, edges in zip(thin, found, strict=True):
        np.testing.assert_array_equal(edges, oracle_follow(picture, 0.3, 0.9))
    weak = (thin >= 0.3) & ~found
    assert weak.any() and found.sum() > (thin >= 0.9).sum(), "some follow a strong one, some stay behind"


def test_wrong_pictures_are_refused() -> None:
    with pytest.raises(ValueError, match="uint8"):
        rgb_gradient(np.zeros((1, 8, 8, 3), np.float32))
    with pytest.raises(ValueError, match="images must be"):
        rgb_gradient(np.zeros((8, 8, 3), np.uint8))
