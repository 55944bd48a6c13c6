"""The empty scene: its plates and noise, learned once, and each frame's gain and noise against them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import CaptureError

Images = NDArray[np.uint8]
Float = NDArray[np.float32]

_DARKEST, _BRIGHTEST = 20, 245  # grey levels between which a pixel is neither drowned in noise nor saturated
_LEAST_SAMPLES = 64  # with fewer usable ones a picture keeps the plate's gain

# Least noise variance of a pixel, as a share of its picture's: coding rounds small noise away in places and then lets
# it jump. Measured on rendered captures and a real one.
_LEAST_RELATIVE_NOISE = 0.5

# Unsteadiness of camera and coding, pixels: adds noise where the plate has contrast. Measured likewise.
_JITTER_PX = 0.04


def median_plate(frames: Sequence[Images], sizes: ArrayLike) -> tuple[Images, ...]:
    """An empty scene from a recording without one: the median over frames that are spread over it.

    It holds where the person covers a pixel in less than half of the frames.

    Args:
        frames: pictures (C, H, W, 3) uint8, a few dozen.
        sizes: (C, 2) each camera's (width, height), pixels.

    Returns:
        one clip (1, h, w, 3) a camera, as ``learn`` takes them.

    Raises:
        CaptureError: there are no frames.
    """
    if not frames:
        raise CaptureError("no frames to take a background from: the recording is empty")
    plates = []
    for c, (width, height) in enumerate(np.asarray(sizes, dtype=int)):
        stack = np.stack([frame[c, :height, :width] for frame in frames])
        plates.append(np.median(stack, axis=0).round().astype(np.uint8)[None])
    return tuple(plates)


def check_clips(clips: Sequence[Images], frame_shape: tuple[int, int], sizes: NDArray[np.int_]) -> None:
    """One clip (T, h, w, 3) a camera, of its size, that fits into the packed pictures (H, W).

    Raises:
        CaptureError: a clip is missing, empty, or of another size than its camera.
    """
    if len(clips) != len(sizes):
        raise CaptureError(f"background: {len(clips)} clips for {len(sizes)} cameras; one a camera is needed")
    for c, (clip, (width, height)) in enumerate(zip(clips, sizes, strict=True)):
        if clip.ndim != 4 or len(clip) == 0 or clip.shape[1:] != (height, width, 3):
            raise CaptureError(
                f"background: the clip of camera {c + 1} has shape {clip.shape}, "
                f"its calibration wants (T, {height}, {width}, 3)"
            )
        if height > frame_shape[0] or width > frame_shape[1]:
            raise CaptureError(f"background: camera {c + 1} is larger than the frame {frame_shape}")


def reduced(images: Images, factor: int, out: Images | None = None) -> Images:
    """(N, H // factor, W // factor, 3): means over squares of pixels; what is left over on the right and below goes.

    Into ``out``, where it is given, which is contiguous.
    """
    count, height, width = len(images), images.shape[1] // factor, images.shape[2] // factor
    whole = np.ascontiguousarray(images[:, : factor * height, : factor * width])
    # one below the other they are one picture
    tall = whole.reshape(-1, *whole.shape[2:])
    into = None if out is None else out.reshape(count * height, width, 3)
    small = cv2.resize(tall, (width, count * height), dst=into, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8).reshape(count, height, width, 3)


def samples(images: NDArray[Any]) -> NDArray[Any]:
    """(C, K, N) of the pixels of pictures (C, h, w, K), on a coarse grid: about thirty rows."""
    step = max(min(images.shape[1:3]) // 30, 1)
    grid = images[:, step // 2 :: step, step // 2 :: step]
    return np.ascontiguousarray(np.moveaxis(grid, -1, 1)).reshape(len(images), images.shape[3], -1)


def gain_and_noise(images: Images, plates: Float, relative: Float) -> tuple[Float, Float]:
    """Pictures' gains against their plates and their noise, from samples of which most show the empty scene.

    Args:
        images, plates: (C, 3, N) grey levels.
        relative: (C, N) relative noise variance.

    Returns:
        gains (C, 3) and noise variances (C,), grey levels²; gain 1 and variance 0 where too little can be seen.
    """
    a = images.astype(np.float32)
    low, high = np.minimum(a, plates).min(axis=1), np.maximum(a, plates).max(axis=1)
    usable = (low > _DARKEST) & (high < _BRIGHTEST)
    count = np.count_nonzero(usable, axis=1)
    b = np.maximum(plates, 1)
    ratios = np.where(usable[:, None], a / b, np.inf).reshape(-1, usable.shape[1])
    rough = _medians(ratios, np.repeat(count, 3)).reshape(-1, 3)
    rough[count < _LEAST_SAMPLES] = 1
    residual = np.abs(a - rough[:, :, None] * b).max(axis=1) / np.sqrt(relative)
    residual[~usable] = np.inf
    # twice: the person and the shadow inflate the first median, and lie outside three times it
    for _ in range(2):
        inlier = residual <= 3 * _medians(residual, count)[:, None]
        count = np.count_nonzero(inlier, axis=1)
    inner = np.where(inlier[:, None], b, 0)
    gain = (a * inner).sum(axis=2) / np.maximum((b * inner).sum(axis=2), 1)
    rest = np.square(a - gain[:, :, None] * b).sum(axis=1) / relative
    variance = np.where(inlier, rest, 0).sum(axis=1) / np.maximum(3 * count, 1)
    seen = np.count_nonzero(usable, axis=1) >= _LEAST_SAMPLES
    return np.where(seen[:, None], gain, 1).astype(np.float32), np.where(seen, variance, 0).astype(np.float32)


def median(values: Float) -> Float:
    """(C,) the middle value of each row (C, N), the upper one of two."""
    middle = values.shape[1] // 2
    return np.asarray(np.partition(values, middle, axis=1)[:, middle], np.float32)


def _medians(values: Float, count: NDArray[np.int_]) -> Float:
    """(C,) the median of the ``count`` (C,) smallest values of each row (C, N)."""
    ranks = np.minimum(count // 2, values.shape[1] - 1)
    ordered = np.partition(values, np.unique(ranks), axis=1)
    return np.take_along_axis(ordered, ranks[:, None], axis=1)[:, 0]


def mean_scene(clip: Images) -> Float:
    """Mean (h, w, 3) of a clip of the empty scene, flicker taken off."""
    total = np.zeros(clip.shape[1:], np.float32)
    scaled = np.empty_like(total)
    for frame, gain in zip(clip, _flicker(clip), strict=True):
        np.multiply(frame, 1 / gain, out=scaled)
        total += scaled
    return total / np.float32(len(clip))


def learn_scene(clip: Images) -> tuple[Float, Float | None]:
    """Mean and temporal variance (h, w, 3) of a clip of the empty scene, flicker taken off; no variance for T = 1."""
    reference = clip[0].astype(np.float32)
    if len(clip) == 1:
        return reference, None
    total = np.zeros_like(reference)
    squares = np.zeros_like(reference)
    for frame, gain in zip(clip, _flicker(clip), strict=True):
        # sums of differences from the first frame: no cancellation in float32
        difference = frame / gain - reference
        total += difference
        squares += difference * difference
    mean = total / len(clip)
    variance = (squares - total * mean) / (len(clip) - 1)
    return reference + mean, np.maximum(variance, 0)


def _flicker(clip: Images) -> Float:
    """(T, 3) the gains of a clip's pictures against its first."""
    if len(clip) == 1:
        return np.ones((1, 3), np.float32)
    sample = samples(clip)
    first = np.broadcast_to(sample[:1].astype(np.float32), sample.shape)
    return gain_and_noise(sample, first, np.ones((len(clip), sample.shape[2]), np.float32))[0]


def relative_noise(plate: Float, variance: Float | None, floor: float) -> Float:
    """(h, w) noise variance of each 3×3 window as a multiple of the picture's level.

    Args:
        plate: (h, w, 3) grey levels.
        variance: (h, w, 3) temporal variance, grey levels²; None takes the noise to be even.
        floor: what coding adds to it, grey levels².
    """
    level, window = floor, np.full(plate.shape[:2], floor, np.float32)
    if variance is not None:
        window = _box_mean(variance).mean(axis=2)
        middle = float(np.median(window))
        window = np.maximum(window, _LEAST_RELATIVE_NOISE * middle) + floor
        level = middle + floor
    contrast = np.maximum(_box_mean(plate * plate) - _box_mean(plate) ** 2, 0).mean(axis=2)
    return ((window + _JITTER_PX**2 * contrast) / level).astype(np.float32)


def _box_mean(values: Float) -> Float:
    mean = cv2.boxFilter(values, cv2.CV_32F, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(mean, dtype=np.float32)
