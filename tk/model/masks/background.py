"""Learn the empty scene, its plates and noise, and measure each frame's gain and noise relative to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import CaptureError
from tk.model.reduced_images import every

Images = NDArray[np.uint8]
Float = NDArray[np.float32]

# The constants were chosen on rendered captures and one real one. Sensitivities: see tk.model.masks.foreground.

_DARKEST, _BRIGHTEST = 20, 245  # usable grey levels: darker ones are mostly noise, brighter ones may be saturated
_LEAST_SAMPLES = 64  # with fewer usable samples the gain is 1; the median of 64 has an error of 0.16 deviations
_OUTLIER = 3.0  # samples beyond this multiple of the median residual are no empty scene

# Least noise variance of a pixel as a share of its image's: coding removes small noise in places, temporarily.
_LEAST_RELATIVE_NOISE = 0.5

# Bytes of a band of rows.
_BAND_BYTES = 200_000

# Motion of camera and coding, pixels: adds noise where the plate has contrast.
_JITTER_PX = 0.04


def median_plate(frames: Sequence[Images], sizes: ArrayLike) -> tuple[Images, ...]:
    """Return the median over frames, as the empty scene of a recording without one.

    The median is right where the person covers a pixel in less than half of the frames.

    Args:
        frames: a few dozen images (C, H, W, 3) uint8, spread over the recording.
        sizes: (C, 2), each camera's (width, height) in pixels.

    Returns:
        One clip (1, h, w, 3) per camera.

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
    """Check that there is one clip (T, h, w, 3) of the right size per camera, not larger than a frame (H, W).

    Raises:
        CaptureError: a clip is missing or empty, or its size is not its camera's.
    """
    if len(clips) != len(sizes):
        raise CaptureError(f"background: {len(clips)} clips for {len(sizes)} cameras; one per camera is needed")
    for c, (clip, (width, height)) in enumerate(zip(clips, sizes, strict=True)):
        if clip.ndim != 4 or len(clip) == 0 or clip.shape[1:] != (height, width, 3):
            raise CaptureError(
                f"background: the clip of camera {c + 1} has shape {clip.shape}, "
                f"its calibration requires (T, {height}, {width}, 3)"
            )
        if height > frame_shape[0] or width > frame_shape[1]:
            raise CaptureError(f"background: camera {c + 1} is larger than the frame {frame_shape}")


def reduced(images: Images, factor: int, out: Images | None = None) -> Images:
    """Return means over squares of pixels, (N, H // factor, W // factor, 3).

    Remaining columns and rows at the right and bottom are dropped. The result goes into ``out`` (contiguous) if given.
    """
    count, height, width = len(images), images.shape[1] // factor, images.shape[2] // factor
    whole = np.ascontiguousarray(images[:, : factor * height, : factor * width])
    # stacked vertically, the images of all cameras are one image
    tall = whole.reshape(-1, *whole.shape[2:])
    into = None if out is None else out.reshape(count * height, width, 3)
    small = cv2.resize(tall, (width, count * height), dst=into, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8).reshape(count, height, width, 3)


def samples(images: NDArray[Any]) -> NDArray[Any]:
    """Return pixels of images (C, h, w, K) on a coarse grid of about thirty rows, as (C, K, N)."""
    step = max(min(images.shape[1:3]) // 30, 1)
    grid = every(images, images.shape[1:3], step)
    return np.ascontiguousarray(np.moveaxis(grid, -1, 1)).reshape(len(images), images.shape[3], -1)


def gain_and_noise(images: Images, plates: Float, relative: Float) -> tuple[Float, Float]:
    """Measure images' gains relative to their plates, and their noise, from samples that mostly show the empty scene.

    Args:
        images, plates: (C, 3, N), grey levels.
        relative: (C, N), relative noise variance.

    Returns:
        Gains (C, 3) and noise variances (C,) in grey levels²; 1 and 0 with too few usable samples.
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
    # twice: the first median is too large because of the person and the shadow
    for _ in range(2):
        inlier = residual <= _OUTLIER * _medians(residual, count)[:, None]
        count = np.count_nonzero(inlier, axis=1)
    inner = np.where(inlier[:, None], b, 0)
    gain = (a * inner).sum(axis=2) / np.maximum((b * inner).sum(axis=2), 1)
    rest = np.square(a - gain[:, :, None] * b).sum(axis=1) / relative
    variance = np.where(inlier, rest, 0).sum(axis=1) / np.maximum(3 * count, 1)
    seen = np.count_nonzero(usable, axis=1) >= _LEAST_SAMPLES
    return np.where(seen[:, None], gain, 1).astype(np.float32), np.where(seen, variance, 0).astype(np.float32)


def _medians(values: Float, count: NDArray[np.int_]) -> Float:
    """Return the median of the ``count`` (C,) smallest values of each row (C, N), as (C,)."""
    ranks = np.minimum(count // 2, values.shape[1] - 1).tolist()
    # each row for its own rank: six times as fast as all rows for all ranks
    return np.array([np.partition(row, k)[k] for row, k in zip(values, ranks, strict=True)], np.float32)


def mean_scene(clip: Images) -> Float:
    """Return the mean (h, w, 3) of a clip of the empty scene, corrected for flicker."""
    frames, gains = _in_rows(clip, np.float32(1) / flicker(clip))
    total = np.zeros(frames.shape[1:], np.float32)
    for rows in _bands(total):
        part, scaled = total[rows], np.empty_like(total[rows])
        for frame, gain in zip(frames, gains, strict=True):
            scaled[...] = frame[rows]
            scaled *= gain
            part += scaled
    return (total / np.float32(len(clip))).reshape(clip.shape[1:])


def learn_scene(clip: Images) -> tuple[Float, Float | None]:
    """Return mean and temporal variance (h, w, 3) of a clip, corrected for flicker; None as variance for T = 1."""
    reference = clip[0].astype(np.float32)
    if len(clip) == 1:
        return reference, None
    frames, gains = _in_rows(clip, flicker(clip))
    total, squares = np.zeros((2, *frames.shape[1:]), np.float32)
    for rows in _bands(total):
        part, squared, first = total[rows], squares[rows], frames[0, rows].astype(np.float32)
        difference = np.empty_like(first)
        for frame, gain in zip(frames, gains, strict=True):
            # differences from the first frame avoid cancellation in float32
            difference[...] = frame[rows]
            difference /= gain
            difference -= first
            part += difference
            difference *= difference
            squared += difference
    mean = total / len(clip)
    variance = np.maximum((squares - total * mean) / (len(clip) - 1), 0)
    return reference + mean.reshape(reference.shape), variance.reshape(reference.shape)


def _in_rows(clip: Images, factors: Float) -> tuple[Images, Float]:
    """Return frames as (T, h, 3 w) and their factors (T, 3) as (T, 3 w): three times as fast as (h, w, 3), (3,)."""
    frames = np.ascontiguousarray(clip).reshape(len(clip), clip.shape[1], -1)
    return frames, np.tile(factors, clip.shape[2])


def _bands(image: Float) -> Iterator[slice]:
    """Yield the rows of an image in bands that the processor's cache holds: 2.5 times as fast as whole images."""
    count = max(_BAND_BYTES // image[0].nbytes, 1)
    return (slice(top, top + count) for top in range(0, len(image), count))


def flicker(clip: Images) -> Float:
    """Return the gains (T, 3) of a clip's images relative to its first."""
    if len(clip) == 1:
        return np.ones((1, 3), np.float32)
    sample = samples(clip)
    first = np.broadcast_to(sample[:1].astype(np.float32), sample.shape)
    return gain_and_noise(sample, first, np.ones((len(clip), sample.shape[2]), np.float32))[0]


def relative_noise(plate: Float, variance: Float | None, floor: float) -> Float:
    """Return the noise variance (h, w) of each 3×3 window relative to the image's level.

    Args:
        plate: (h, w, 3), grey levels.
        variance: (h, w, 3), temporal variance in grey levels²; None for even noise.
        floor: variance that coding adds, grey levels².
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
