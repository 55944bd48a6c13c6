"""How far the still parts of each camera's image have moved since the first frame: a camera that was bumped, sags or is
zoomed.

The shift of an image is the translation, with a zoom about the middle, that registers it with the first one, beside the
person (Lucas & Kanade, "An Iterative Image Registration Technique with an Application to Stereo Vision", IJCAI 1981),
together with the ratio of their contrasts, because the light may change. Shadows and other things that move are
outliers of the registration and have small weights (Tukey's biweight). A turn of a camera by a small angle shifts its
whole image; a roll or a step to the side do so in part. Along the planks of a floor, noise alone can shift an image by
a pixel. A shift therefore counts only if the images differ clearly more without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.stateful import Stateful

Float = NDArray[np.float64]
Gray = NDArray[np.float32]
Masks = NDArray[np.uint8]

# Longer side of a registered image, pixels.
_SIZE = 96
# Standard deviations of the Gaussians between which the details lie that are compared, pixels: finer ones are noise and
# limit the reach, coarser ones are shadows and light.
_FINE, _COARSE = 1.0, 3.0
# A camera is looked at in every second frame: a tripod moves for longer.
_PAUSE = 2
# Iterations, and the last step in pixels, after which a registration ends.
_ITERATIONS, _CONVERGED = 8, 0.02
# Tukey's constant: 95 % efficiency for normal noise.
_TUKEY = 4.685
# Least share of the image that a person leaves free: 0.65 in fifteen captures. Least share that is compared.
_FREE, _LEAST_STILL = 0.5, 0.2
# Least correlation of registered images; that of unrelated ones is 0.
_LEAST_CORRELATION = 0.75
# Least ratio of the images' difference without the shift to that with it.
_LEAST_RATIO = 1.25
# Zooms from which a registration begins after a jump: the nearest one is off by at most 1.4 pixels, at the border.
_ZOOMS = 1.06 ** np.arange(-4.0, 5.0)
# Largest shift, share of the longer side, of an image that shows another camera's empty scene.
_SAME_PLACE = 0.1


@dataclass(frozen=True)
class ShiftState:
    """What is known of C cameras.

    Attributes:
        first: (C, n, n) the images that later ones are registered with, each in the upper left; None before the first
            frame.
        still: (C, n, n) where nobody is in them.
        begun: (C,) whether a camera's mask could be trusted in a frame.
        shift: (C, 3) root mean square, over the image, of the pixels' displacement along x, along y, and by the zoom.
        calls: number of frames.
    """

    first: NDArray[np.uint8] | None
    still: NDArray[np.bool_]
    begun: NDArray[np.bool_]
    shift: Float
    calls: int


class ImageShift(Stateful[ShiftState]):
    """Registers the images of consecutive frames with those of the first one, one camera in every second frame.

    Args:
        sizes: (C, 2) width and height of each camera's mask; None: all are as large as the stack of masks.
    """

    State = ShiftState

    def __init__(self, sizes: NDArray[np.integer] | None = None) -> None:
        self._sizes = sizes
        self._first: NDArray[np.uint8] | None = None
        self._still = np.zeros((0, 0, 0), np.bool_)
        self._begun = np.zeros(0, np.bool_)
        self._shift = np.zeros((0, 3))
        self._calls = 0

    def look(
        self, images: NDArray[np.uint8], masks: NDArray[np.uint8], doubtful: NDArray[np.bool_] | None = None
    ) -> Float:
        """Return (C,) how far each camera's image has moved, as a share of its longer side; NaN if it is unknown.

        Args:
            images: (C, h, w, 3) BGR, of the masks' size or reduced.
            masks: (C, H, W), not 0 where somebody is.
            doubtful: (C,) cameras whose mask may not show the person. A camera's first image is that of its first frame
                without doubt: the person must not be taken for a part of the scene. None: no camera.
        """
        C = len(images)
        if self._first is None:
            self._first = np.zeros((C, _SIZE, _SIZE), np.uint8)
            self._still = np.zeros(self._first.shape, np.bool_)
            self._begun, self._shift, self._calls = np.zeros(C, np.bool_), np.zeros((C, 3)), 0
        for c in np.flatnonzero(~self._begun).tolist():
            image, beside = self._small(c, images, masks)
            box = slice(image.shape[0]), slice(image.shape[1])
            self._first[c][box], self._still[c][box] = image, beside
        self._begun |= True if doubtful is None else ~doubtful
        if self._calls % _PAUSE:
            self._look_at(self._calls // _PAUSE % C, images, masks)
        self._calls += 1
        return np.asarray(np.linalg.norm(self._shift, axis=1) / _SIZE)

    def _small(self, c: int, images: NDArray[np.uint8], masks: NDArray[np.uint8]) -> tuple[Masks, NDArray[np.bool_]]:
        """Return a camera's image (h, w) at low resolution, and where nobody is in it."""
        width, height = masks.shape[:0:-1] if self._sizes is None else self._sizes[c].tolist()
        scale, factor = _SIZE / max(width, height), masks.shape[1] // images.shape[1]
        size = max(1, round(scale * width)), max(1, round(scale * height))
        image = images[c, : height // factor, : width // factor, 1]  # the green channel suffices
        return _resized(image, size), _beside(_resized(masks[c, :height, :width], size))

    def _look_at(self, c: int, images: NDArray[np.uint8], masks: NDArray[np.uint8]) -> None:
        """Measure a camera's shift."""
        assert self._first is not None
        image, still_now = self._small(c, images, masks)
        box = slice(image.shape[0]), slice(image.shape[1])
        first, now = _details(self._first[c][box]), _details(image)
        if still_now.mean() < _FREE:  # no mask of a person; that of a moved camera shows half of the scene
            still_now[:] = True
        still_first = self._still[c][box]
        still = still_first & still_now
        shift, correlation = _register(first, now, still, np.nan_to_num(self._shift[c]))
        if correlation < _LEAST_CORRELATION:  # a jump is out of the reach of small steps
            shift, correlation = _register(first, now, still, _jump(first * still_first, now * still_now))
        self._shift[c] = shift if correlation >= _LEAST_CORRELATION else np.nan


def shift_between(first: NDArray[np.uint8], image: NDArray[np.uint8], mask: NDArray[np.uint8]) -> float:
    """Return how far an image (h, w, 3) has moved from an image of the empty scene, as :meth:`ImageShift.look` does."""
    shift = ImageShift()
    shift.look(first[None], np.zeros((1, *first.shape[:2]), np.uint8))
    return float(shift.look(image[None], mask[None])[0])


def exchanged_scenes(
    scenes: Sequence[NDArray[np.uint8]], images: NDArray[np.uint8], masks: NDArray[np.uint8]
) -> dict[int, int]:
    """Return the cameras whose image shows another camera's empty scene, and that camera.

    Only cameras whose image does not show their own scene are compared with one another.

    Args:
        scenes: an image (h, w, 3) of the empty scene for each of C cameras.
        images, masks: (C, H, W, 3), (C, H, W), of one frame, each at least as large as its scene.
    """
    seen = [
        (image[: len(scene), : scene.shape[1]], mask[: len(scene), : scene.shape[1]])
        for scene, image, mask in zip(scenes, images, masks, strict=True)
    ]
    other = [c for c, (image, mask) in enumerate(seen) if np.isnan(shift_between(scenes[c], image, mask))]
    found = {}
    for a, b in permutations(other, 2):
        image, mask = seen[a]
        if scenes[a].shape == scenes[b].shape and shift_between(scenes[b], image, mask) <= _SAME_PLACE:
            found[a] = b
    return found


def _resized(image: NDArray[np.uint8], size: tuple[int, int]) -> Masks:
    """Return an image (H, W) at a lower resolution of ``size``, width and height."""
    every = max(1, max(image.shape) // (3 * max(size)))  # the mean of fewer pixels suffices
    return np.asarray(cv2.resize(image[::every, ::every], size, interpolation=cv2.INTER_AREA), np.uint8)


def _details(image: NDArray[np.uint8]) -> Gray:
    """Return the details of an image (h, w)."""
    gray = image.astype(np.float32)
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), _FINE) - cv2.GaussianBlur(gray, (0, 0), _COARSE), np.float32)


def _beside(mask: Masks) -> NDArray[np.bool_]:
    """Return (h, w) where nobody is in a mask at low resolution, with a margin for the details' blur."""
    return np.asarray(cv2.dilate(mask, np.ones((9, 9), np.uint8)) == 0)


def _jump(first: Gray, now: Gray) -> Float:
    """Return the shift (3,), whole pixels with one of :data:`_ZOOMS`, with the largest cross-correlation of two images
    (h, w)."""
    h, w = first.shape
    spectrum, best, found = np.conj(np.fft.rfft2(first)), -np.inf, np.zeros(3)
    for zoom in _ZOOMS:
        from_now = np.array([[zoom, 0.0, (1 - zoom) * (w - 1) / 2], [0.0, zoom, (1 - zoom) * (h - 1) / 2]])
        like_first = cv2.warpAffine(now, from_now, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        correlation = np.fft.irfft2(spectrum * np.fft.rfft2(like_first), first.shape)
        top = correlation.max() / (np.linalg.norm(like_first) + 1e-3)
        if top > best:
            y, x = np.unravel_index(correlation.argmax(), first.shape)
            shift = x - w * (x > w / 2), y - h * (y > h / 2)
            best, found = top, np.array([zoom * shift[0], zoom * shift[1], (zoom - 1) * _radius(h, w)])
    return found


def _radius(h: int, w: int) -> float:
    """Return the root mean square distance of the pixels of an image (h, w) from its middle."""
    return float(np.sqrt((h * h + w * w) / 12))


def _register(first: Gray, now: Gray, still: NDArray[np.bool_], shift: Float) -> tuple[Float, float]:
    """Return the shift (3,) that registers an image with the first one, and the correlation of both.

    The shift is 0 if the images without it differ by hardly more.

    Args:
        first: (h, w).
        now: (h, w).
        still: (h, w), pixels of the first image that count.
        shift: (3,) where to begin, see :class:`ShiftState`.
    """
    h, w = first.shape
    within = np.zeros(still.shape, np.bool_)
    border = int(_COARSE)
    within[border : h - border, border : w - border] = still[border : h - border, border : w - border]
    y, x = np.nonzero(within)
    slope = np.stack([cv2.Sobel(first, cv2.CV_32F, dx, 1 - dx, scale=1 / 8)[y, x] for dx in (1, 0)], axis=-1)
    outwards = np.column_stack([x - (w - 1) / 2, y - (h - 1) / 2]) / _radius(h, w)
    gradient = np.column_stack([slope, (slope * outwards).sum(axis=1)])
    before = first[y, x]

    def places(shift: Float) -> Float:
        return np.asarray(np.stack([x, y]) + shift[:2, None] + shift[2] * outwards.T)

    def seen_by_both(shift: Float) -> NDArray[np.bool_]:
        at_x, at_y = places(shift)
        inside = (at_x >= border) & (at_x <= w - 1 - border) & (at_y >= border) & (at_y <= h - 1 - border)
        return np.asarray(inside)

    def values(seen: NDArray[np.bool_], shift: Float) -> tuple[Gray, Gray]:
        """Return the pixels' values in the first image and in this one."""
        at_x, at_y = places(shift)[:, seen].astype(np.float32)
        return before[seen], np.asarray(cv2.remap(now, at_x, at_y, cv2.INTER_LINEAR), np.float32).ravel()

    correlation, gain = 0.0, np.nan
    for _ in range(_ITERATIONS):
        seen = seen_by_both(shift)
        if seen.sum() < _LEAST_STILL * h * w:
            return shift, 0.0
        reference, moved = values(seen, shift)
        if np.isnan(gain):
            gain = float(np.linalg.norm(moved) / (np.linalg.norm(reference) + 1e-3))
        difference = moved - gain * reference
        noise = _deviation(difference)
        weight = np.clip(1.0 - (difference / (_TUKEY * noise)) ** 2, 0.0, None) ** 2
        norm = float(np.sqrt((weight @ moved**2) * (weight @ reference**2)))
        correlation = float(weight @ (moved * reference)) / (norm + 1e-3)
        A = np.column_stack([gain * gradient[seen], reference])
        weighted = (A * weight[:, None]).T
        *step, change = np.linalg.lstsq(weighted @ A, weighted @ difference, rcond=None)[0]
        shift, gain = shift - step, gain + change
        if np.abs(step).max() < _CONVERGED:
            break
    reference, moved = values(seen, np.zeros(3))
    if _deviation(moved - gain * reference) < _LEAST_RATIO * noise:
        shift = np.zeros(3)
    return shift, correlation


def _deviation(difference: Gray) -> float:
    """Return the standard deviation of a normal distribution with the same median magnitude."""
    return 1.4826 * float(np.median(np.abs(difference))) + 1e-3
