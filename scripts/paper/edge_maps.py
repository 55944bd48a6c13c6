"""Colour edges of whole pictures (Kehl 2006, section 4.2): what the tracker evaluates along its search lines only."""

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.edges import rgb_gradient_at
from tk.kernels.runtime import ensure_runtime, ti

# Thresholds of :func:`edge_map` on the magnitude: edges count from the high one on, and are followed down to the low
# one. The high one finds 80 to 90 % of a person's outline (``scripts/figure4_edges.py``).
LOW, HIGH = 0.08, 0.20


@ti.kernel
def _gradient_kernel(
    sizes: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (C, 2) height, width
    images: ti.types.ndarray(dtype=ti.u8, ndim=4),  # (C, H, W, 3)
    magnitude: ti.types.ndarray(dtype=ti.f32, ndim=3),  # (C, H, W) out
    direction: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (C, H, W, 2) out
):
    rows = images.shape[1]
    for row in range(images.shape[0] * rows):
        c = row // rows
        y = row % rows
        height = sizes[c, 0]
        width = sizes[c, 1]
        if y < height:
            for x in range(width):
                m, dx, dy = rgb_gradient_at(images, c, y, x, height, width)
                magnitude[c, y, x] = m
                direction[c, y, x, 0] = dx
                direction[c, y, x, 1] = dy


@ti.func
def _bilinear(magnitude: ti.template(), c: ti.i32, y: ti.f32, x: ti.f32) -> ti.f32:
    """Magnitude between pixels, 0 beyond the picture."""
    value = ti.f32(0.0)
    y0 = ti.cast(ti.floor(y), ti.i32)
    x0 = ti.cast(ti.floor(x), ti.i32)
    for dy, dx in ti.static(ti.ndrange(2, 2)):
        yy = y0 + dy
        xx = x0 + dx
        if 0 <= yy < magnitude.shape[1] and 0 <= xx < magnitude.shape[2]:
            value += magnitude[c, yy, xx] * (1 - ti.abs(y - yy)) * (1 - ti.abs(x - xx))
    return value


@ti.kernel
def _thin_kernel(
    magnitude: ti.types.ndarray(dtype=ti.f32, ndim=3),  # (C, H, W)
    direction: ti.types.ndarray(dtype=ti.f32, ndim=4),  # (C, H, W, 2)
    thin: ti.types.ndarray(dtype=ti.f32, ndim=3),  # (C, H, W) out
):
    rows = magnitude.shape[1]
    for row in range(magnitude.shape[0] * rows):
        c = row // rows
        y = row % rows
        for x in range(magnitude.shape[2]):
            m = magnitude[c, y, x]
            dx = direction[c, y, x, 0]
            dy = direction[c, y, x, 1]
            # a step lies between two equal pixels: one half plane of directions for all, so that one of them stays
            if dx < 0 or (dx == 0 and dy < 0):
                dx = -dx
                dy = -dy
            is_ridge = m > _bilinear(magnitude, c, y - dy, x - dx) and m >= _bilinear(magnitude, c, y + dy, x + dx)
            thin[c, y, x] = m if is_ridge else 0.0


def rgb_gradient(
    images: NDArray[np.uint8], sizes: NDArray[np.integer] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colour gradient of whole pictures (Kehl 2006, section 4.2).

    Args:
        images: (C, H, W, 3) uint8; the order of the channels does not matter.
        sizes: (C, 2) height and width of each picture in its zero-padded place; (H, W) for all if None.

    Returns:
        magnitude: (C, H, W) float32, 0…1; 0 in the padding.
        direction: (C, H, W, 2) float32 unit vectors (x, y), across the edge, towards the brighter side; (1, 0) where
            the magnitude is 0.

    Raises:
        ValueError: ``images`` is no stack of colour pictures.
    """
    if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
        raise ValueError(f"images must be (C, H, W, 3) uint8, not {images.shape} {images.dtype}")
    ensure_runtime()
    if sizes is None:
        sizes = np.tile(np.array(images.shape[1:3]), (len(images), 1))
    magnitude = np.zeros(images.shape[:3], np.float32)
    direction = np.zeros((*images.shape[:3], 2), np.float32)
    direction[..., 0] = 1
    _gradient_kernel(
        np.ascontiguousarray(sizes, np.int32),
        np.ascontiguousarray(images),
        magnitude,
        direction,
    )
    return magnitude, direction


def thin_edges(magnitude: NDArray[np.float32], direction: NDArray[np.float32]) -> NDArray[np.float32]:
    """Non-maximum suppression: the magnitude where it is greatest along the gradient's direction, else 0.

    Args:
        magnitude: (C, H, W); direction: (C, H, W, 2) unit vectors; the sign does not matter.
    """
    ensure_runtime()
    thin = np.empty(magnitude.shape, np.float32)
    _thin_kernel(np.ascontiguousarray(magnitude), np.ascontiguousarray(direction), thin)
    return thin


def follow_edges(thin: NDArray[np.float32], low: float, high: float) -> NDArray[np.bool_]:
    """Hysteresis: what is at least ``low`` and hangs together, 8-connected, with something at least ``high``.

    Args:
        thin: (C, H, W), see :func:`thin_edges`.
    """
    edges = np.zeros(thin.shape, bool)
    for picture, out in zip(thin, edges, strict=True):
        count, labels = cv2.connectedComponents((picture >= low).astype(np.uint8), connectivity=8)
        strong = np.zeros(count, bool)
        strong[labels[picture >= high]] = True
        strong[0] = False
        out[:] = strong[labels]
    return edges


def edge_map(images: NDArray[np.uint8], sizes: NDArray[np.integer] | None = None) -> NDArray[np.bool_]:
    """Thin edges of whole pictures, (C, H, W): colour gradient, non-maximum suppression, hysteresis.

    The paper thresholds its gradients and does not say how; these are Canny's steps, so that the two can be compared.
    Arguments as for :func:`rgb_gradient`.
    """
    magnitude, direction = rgb_gradient(images, sizes)
    return follow_edges(thin_edges(magnitude, direction), LOW, HIGH)
