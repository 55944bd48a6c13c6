"""Learn the empty scene from images in which a person covers changing pixels: one kernel launch a camera."""

import numpy as np
from numpy.typing import NDArray

from tk.kernels.runtime import ensure_runtime, ti
from tk.kernels.taichi_internals import Launcher


@ti.func
def _gap(images: ti.template(), i: ti.i32, j: ti.i32) -> ti.i32:
    """Return the largest difference of two pixels' channels; ``i`` and ``j`` are indices of first channels."""
    gap = 0
    for k in ti.static(range(3)):
        gap = ti.max(gap, ti.abs(ti.cast(images[i + k], ti.i32) - ti.cast(images[j + k], ti.i32)))
    return gap


@ti.func
def _support(images: ti.template(), weights: ti.template(), i: ti.i32, pixel: ti.i32, size: ti.i32, tolerance: ti.i32):
    """Return the summed weight of a pixel's samples that agree with sample ``i``."""
    total = 0
    for j in range(weights.shape[0] // size):
        weight = ti.cast(weights[j * size + pixel], ti.i32)
        if weight > 0 and _gap(images, 3 * (i * size + pixel), 3 * (j * size + pixel)) <= tolerance:
            total += weight
    return total


@ti.func
def _is_shadow(
    images: ti.template(), dark: ti.i32, lit: ti.i32, tolerance: ti.i32, darkest: ti.f32, spread: ti.f32
) -> ti.i32:
    """Return whether a pixel is another one in a shadow: darker by nearly the same factor in all channels."""
    low = 1e9
    high = 0.0
    for k in ti.static(range(3)):
        factor = ti.cast(images[dark + k], ti.f32) / ti.max(ti.cast(images[lit + k], ti.f32), 1.0)
        low = ti.min(low, factor)
        high = ti.max(high, factor)
    differs = _gap(images, dark, lit) > tolerance
    return ti.cast(differs and low >= darkest and high < 1.0 and high - low <= spread, ti.i32)


@ti.kernel
def _learn_kernel(
    # constants
    images: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [K * H * W * 3]
    weights: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [K * H * W]
    # parameters
    size: ti.i32,  # H * W
    tolerance: ti.i32,
    least: ti.i32,
    darkest: ti.f32,
    spread: ti.f32,
    # out
    plate: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [H * W * 3]
    support: ti.types.ndarray(dtype=ti.u8, ndim=1),  # [H * W]
):
    for pixel in range(size):
        count = weights.shape[0] // size
        total = 0
        for i in range(count):
            total += ti.cast(weights[i * size + pixel], ti.i32)
        best = -1
        most = 0
        for i in range(count):
            if weights[i * size + pixel] > 0 and 2 * most <= total:
                agreeing = _support(images, weights, i, pixel, size, tolerance)
                if agreeing > most:
                    best = i
                    most = agreeing
        if most < total:
            for i in range(count):
                dark, lit = 3 * (best * size + pixel), 3 * (i * size + pixel)
                if weights[i * size + pixel] > 0 and _is_shadow(images, dark, lit, tolerance, darkest, spread) == 1:
                    agreeing = _support(images, weights, i, pixel, size, tolerance)
                    if agreeing >= least:
                        best = i
                        most = agreeing
        if best >= 0:
            sums = ti.Vector([0, 0, 0])
            for j in range(count):
                weight = ti.cast(weights[j * size + pixel], ti.i32)
                at = 3 * (j * size + pixel)
                if weight > 0 and _gap(images, 3 * (best * size + pixel), at) <= tolerance:
                    for k in ti.static(range(3)):
                        sums[k] += weight * ti.cast(images[at + k], ti.i32)
            for k in ti.static(range(3)):
                plate[3 * pixel + k] = ti.cast((sums[k] + most // 2) // most, ti.u8)
        support[pixel] = ti.cast(ti.min(most, 255), ti.u8)


_learn = Launcher(_learn_kernel)


def learn_scene(
    images: NDArray[np.uint8],
    weights: NDArray[np.uint8],
    *,
    tolerance: int,
    least: int,
    darkest: float,
    spread: float,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the empty scene of one camera (H, W, 3), and its support (H, W): the summed weight of agreeing samples.

    The scene is the mean of the largest group of a pixel's samples that agree with one of them. Shadows only darken:
    if that group looks like a shadow of another group with enough support, the brighter group is the scene.

    Args:
        images: (K, H, W, 3), corrected for gain.
        weights: (K, H, W), 0 where a sample shows the person.
        tolerance: samples agree if no channel differs by more grey levels.
        least: support that a brighter group needs.
        darkest, spread: least factor of a shadow, and largest difference between its factors of the three channels.
    """
    ensure_runtime()
    plate = np.zeros(images.shape[1:], np.uint8)
    support = np.zeros(images.shape[1:3], np.uint8)
    _learn(
        images.reshape(-1), weights.reshape(-1), support.size, tolerance, least, darkest, spread,
        plate.reshape(-1), support.reshape(-1),
    )  # fmt: skip
    return plate, support
