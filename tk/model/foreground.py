"""Foreground segmentation: which pixels show the person.

The main method is the collinearity test (Mester et al. 2001, extended by Griesser et al. 2005; Kehl & Van Gool 2006,
section 4, use it). :mod:`tk.kernels.background` computes the statistic; here is what surrounds it: learning the empty
scene and its noise, following gain and noise from frame to frame, and cleaning up the labels.

No state passes from one frame to the next, so a run that is resumed gives the same masks. The papers are silent on
three things, which are settled here as follows.

* **Grey clothes.** A cloth of the floor's colour is collinear with the floor, as a shadow is. Shadows are confined to
  the factors that they can have, and a region that could be either is decided by its border: a region mostly bounded by
  certain foreground is part of the person, one mostly bounded by background is a shadow.
* **Penumbrae.** Over the blurred edge of a shadow the window is not collinear. Such labels are thin, and their
  statistic is small against the plain difference next to them; they count as "could be either".
* **The rim.** A 3×3 window fires one pixel outside the outline. A pixel of the rim stays if its own difference reaches
  a given share of the largest one next to it, which is where the outline covers that share of the pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import CaptureError, ConfigError
from tk.kernels.background import STEPS_PER_OCTAVE, Planes

Images = NDArray[np.uint8]

_SQUARE3 = np.ones((3, 3), np.uint8)
_SQUARE5 = np.ones((5, 5), np.uint8)
_CROSS3 = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class ForegroundConfig:
    """How the segmentation decides. "Measured" means: on rendered captures with exact masks and on one real one.

    Attributes:
        threshold: statistic that makes a pixel foreground with four of its eight neighbours foreground, in noise
            variances; pure noise gives 0.5. Measured.
        neighbour_octaves: a further foreground neighbour divides the threshold by 2 to this power (Griesser et al.
            derive such a term from a Markov random field; the value is measured).
        iterations: updates of the labels under the neighbours' influence.
        difference_min: plain difference, noise variances, below which a pixel is background whatever its neighbours
            are. Pure noise gives 0.5, with a 99.9 % quantile of 1.03 (χ² with 27 degrees of freedom); the rest is for
            noise that coding made alike over a window.
        darkness_offset: grey levels. Griesser et al. choose it by hand; here a tenth of a bright window's length, so
            that windows darker than about ten grey levels are compared by their difference.
        shadow_min: the darkest shadow, as a share of the lit plate. Measured: 0.76 under two lamps; a shadow that is
            darker is taken for the person, which the other cameras put right, while a hole in one mask cuts through the
            visual hull.
        noise_floor: variance added to the measured noise, grey levels²: what video coding does to the picture. It
            rounds small noise away in places and then lets it jump; its errors are alike over a window. Measured: more
            would make cleaner rims, but holes in grey clothes before a grey wall.
        relative_noise_floor: least noise variance of a pixel, as a share of its picture's. As above.
        jitter_px: unsteadiness of camera and coding, pixels: adds noise where the plate has contrast. Measured.
        penumbra: a thin label is the edge of a shadow where the statistic is below this share of the plain difference
            nearby. 0.29 at a sharp edge, 0.05 over four pixels of blur (both follow from the statistic).
        enclosure: share of its border by which a region must touch certain foreground to become foreground. The
            majority, for want of a better reason.
        bridge: a region that could be either is also foreground between parts of the person that are no farther apart
            than this share of the picture's height (a gap of 10 of 480 pixels). Measured.
        rim: share of coverage from which a rim pixel stays; 0.5 is unbiased, less is cautious: a
            pixel too many swells the hull a little, one too few cuts through it.
        rim_layers: how deep the rim is searched, pixels: one for the window, one for blur.
        speck_area: smaller foreground components go, share of the picture's area (61 pixels of 640×480). Measured.
        hole_area: smaller holes are filled, share of the picture's area (123 pixels of 640×480). Measured.
    """

    threshold: float = 3.0
    neighbour_octaves: float = 0.5
    iterations: int = 3
    difference_min: float = 2.0
    darkness_offset: float = 40.0
    shadow_min: float = 0.7
    noise_floor: float = 1.5
    relative_noise_floor: float = 0.5
    jitter_px: float = 0.04
    penumbra: float = 0.15
    enclosure: float = 0.5
    bridge: float = 0.02
    rim: float = 0.4
    rim_layers: int = 2
    speck_area: float = 2e-4
    hole_area: float = 4e-4

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"foreground.{field.name} = {value}: must be a finite number, 0 or more")
        for name in ("threshold", "difference_min", "darkness_offset", "noise_floor", "penumbra"):
            if getattr(self, name) == 0:
                raise ConfigError(f"foreground.{name} = 0: must be positive")
        for name in ("shadow_min", "relative_noise_floor", "penumbra", "enclosure", "rim"):
            if getattr(self, name) > 1:
                raise ConfigError(f"foreground.{name} = {getattr(self, name)}: a share, at most 1")
        if self.shadow_min == 0:
            raise ConfigError("foreground.shadow_min = 0: must be positive (1 switches the tolerance of shadows off)")


class Foreground(Protocol):
    """What a tracker asks of a segmentation."""

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255."""
        ...


def median_plate(frames: Sequence[Images], sizes: ArrayLike) -> tuple[Images, ...]:
    """An empty scene from a recording without one: the median over frames that are spread over it.

    It holds where the person covers a pixel in less than half of the frames.

    Args:
        frames: pictures (C, H, W, 3) uint8, a few dozen.
        sizes: (C, 2) each camera's (width, height), pixels.

    Returns:
        one clip (1, h, w, 3) a camera, as ``learn`` takes them.
    """
    if not frames:
        raise CaptureError("no frames to take a background from: the recording is empty")
    plates = []
    for c, (width, height) in enumerate(np.asarray(sizes, dtype=int)):
        stack = np.stack([frame[c, :height, :width] for frame in frames])
        plates.append(np.median(stack, axis=0).round().astype(np.uint8)[None])
    return tuple(plates)


def _check_clips(clips: Sequence[Images], frame_shape: tuple[int, int], sizes: NDArray[np.int_]) -> None:
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


def _samples(images: NDArray[Any]) -> NDArray[Any]:
    """(C, 3, N) pixels on a coarse grid: about thirty rows."""
    step = max(min(images.shape[1:3]) // 30, 1)
    grid = images[:, step // 2 :: step, step // 2 :: step]
    return np.ascontiguousarray(np.moveaxis(grid, -1, 1)).reshape(len(images), 3, -1)


def _gain_and_noise(
    image: NDArray[np.uint8], plate: NDArray[np.float32], relative: NDArray[np.float32]
) -> tuple[NDArray[np.float64], float]:
    """A picture's gain against the plate and its noise, from samples of which most show the empty scene.

    Args:
        image, plate: (3, N) grey levels.
        relative: (N,) relative noise variance.

    Returns:
        gain (3,) and noise variance, grey levels²; gain 1 and variance 0 where too little can be seen.
    """
    low, high = np.minimum(image, plate).min(axis=0), np.maximum(image, plate).max(axis=0)
    usable = (low > 20) & (high < 245)  # neither drowned in noise nor saturated
    if np.count_nonzero(usable) < 64:
        return np.ones(3), 0.0
    a, b = image[:, usable].astype(np.float32), plate[:, usable]
    scale = 1.0 / np.sqrt(relative[usable])
    residual = np.abs(a - np.median(a / b, axis=1, keepdims=True) * b).max(axis=0) * scale
    # twice: the person and the shadow inflate the first median, and lie outside three times it
    inlier = residual <= 3 * np.median(residual)
    inlier = residual <= 3 * np.median(residual[inlier])
    a, b = a[:, inlier], b[:, inlier]
    gain = np.einsum("cn,cn->c", a, b) / np.einsum("cn,cn->c", b, b)
    variance = np.mean(np.square((a - gain[:, None] * b) * scale[inlier]))
    return gain.astype(np.float64), float(variance)


def _learn_scene(clip: Images) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Mean and temporal variance (h, w, 3) of a clip of the empty scene, flicker taken off; no variance for T = 1."""
    reference = clip[0].astype(np.float32)
    if len(clip) == 1:
        return reference, None
    total = np.zeros_like(reference)
    squares = np.zeros_like(reference)
    sample = _samples(clip)
    ones = np.ones(sample.shape[2], np.float32)
    for frame, pixels in zip(clip, sample, strict=True):
        gain, _ = _gain_and_noise(pixels, sample[0].astype(np.float32), ones)
        # sums of differences from the first frame: no cancellation in float32
        difference = frame / gain.astype(np.float32) - reference
        total += difference
        squares += difference * difference
    mean = total / len(clip)
    variance = (squares - total * mean) / (len(clip) - 1)
    return reference + mean, np.maximum(variance, 0)


def _box_mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
    mean = cv2.boxFilter(values, cv2.CV_32F, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(mean, dtype=np.float32)


def _relative_noise(
    plate: NDArray[np.float32], variance: NDArray[np.float32] | None, config: ForegroundConfig
) -> NDArray[np.float32]:
    """(h, w) noise variance of each window as a multiple of the picture's level."""
    floor = config.noise_floor
    level, window = floor, np.full(plate.shape[:2], floor, np.float32)
    if variance is not None:
        window = _box_mean(variance).mean(axis=2)
        median = float(np.median(window))
        window = np.maximum(window, config.relative_noise_floor * median) + floor
        level = median + floor
    contrast = np.maximum(_box_mean(plate * plate) - _box_mean(plate) ** 2, 0).mean(axis=2)
    return ((window + config.jitter_px**2 * contrast) / level).astype(np.float32)


class CollinearityForeground:
    """The collinearity test against a learned empty scene. Make it with :meth:`learn`."""

    def __init__(
        self,
        plates: Images,
        relative_noise: NDArray[np.float32],
        sizes: NDArray[np.int_],
        config: ForegroundConfig,
    ) -> None:
        """Plates (C, H, W, 3) uint8, relative noise variances (C, H, W), sizes (C, 2) of (width, height)."""
        self.config = config
        self.plates = plates
        self.sizes = sizes
        self._weights = (1.0 / relative_noise).astype(np.float32)
        self._plate_samples = _samples(plates).astype(np.float32)
        self._noise_samples = _samples(relative_noise[..., None].repeat(3, axis=3))[:, 0]
        self._planes = Planes(*plates.shape[:3])

    @classmethod
    def learn(
        cls,
        clips: Sequence[Images],
        frame_shape: tuple[int, int],
        sizes: ArrayLike,
        config: ForegroundConfig | None = None,
    ) -> CollinearityForeground:
        """Learn the empty scene.

        A clip gives the plate and how the noise varies over the picture; of a single picture (T = 1) the noise is taken
        to be even. The noise's level is measured in each frame that is segmented, so a plate need not tell it.

        Args:
            clips: one (T, h, w, 3) uint8 a camera.
            frame_shape: (H, W) of the packed pictures.
            sizes: (C, 2) each camera's (width, height), pixels.
            config: thresholds; the defaults when None.

        Raises:
            CaptureError: a clip is missing, empty, or of another size than its camera.
        """
        config = config or ForegroundConfig()
        sizes = np.asarray(sizes, dtype=int).reshape(-1, 2)
        _check_clips(clips, frame_shape, sizes)
        plates = np.zeros((len(clips), *frame_shape, 3), np.uint8)
        relative = np.ones((len(clips), *frame_shape), np.float32)
        for c, (clip, (width, height)) in enumerate(zip(clips, sizes, strict=True)):
            plate, variance = _learn_scene(clip)
            plates[c, :height, :width] = np.clip(plate.round(), 0, 255)
            relative[c, :height, :width] = _relative_noise(plate, variance, config)
        return cls(plates, relative, sizes, config)

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255."""
        config = self.config
        scenes = np.empty_like(self.plates)
        precision = np.empty(len(images), np.float32)
        for c, sample in enumerate(_samples(images)):
            gain, variance = _gain_and_noise(sample, self._plate_samples[c], self._noise_samples[c])
            cv2.transform(self.plates[c], np.diag(gain), dst=scenes[c])
            precision[c] = 1.0 / (variance + config.noise_floor)
        self._planes.measure(
            images,
            scenes,
            self._weights,
            precision,
            darkness_offset=config.darkness_offset,
            shadow_min=config.shadow_min,
            difference_min=config.difference_min,
        )
        self._planes.relax(config.threshold, config.neighbour_octaves, config.iterations)
        masks = np.zeros(images.shape[:3], np.uint8)
        for c in range(len(images)):
            self._clean(c, images[c], scenes[c], masks[c])
        return masks

    def _clean(self, c: int, image: Images, scene: Images, mask: Images) -> None:
        """Settle what could be either, trim the rim, drop specks and fill holes of camera ``c``, into ``mask``."""
        area = int(np.prod(self.sizes[c]))
        reach = 2 * round(self.config.bridge * self.sizes[c, 1] / 2) + 1
        # the window widens whatever shows the person by two pixels: what vanishes under erosion is noise
        x, y, width, height = cv2.boundingRect(cv2.erode(self._planes.labels[c], _SQUARE5))
        if width == 0:
            return
        margin = reach + int(self.sizes[c, 1]) // 10  # shows enough of a shadow to tell it from a cloth
        crop = (slice(max(y - margin, 0), y + height + margin), slice(max(x - margin, 0), x + width + margin))
        difference = np.ascontiguousarray(self._planes.difference[c][crop])
        collinearity = self._planes.collinearity[c][crop]
        labels = self._planes.labels[c][crop].view(np.bool_)
        certain, unsure = _without_penumbrae(labels, difference, collinearity, self.config.penumbra)
        foreground = certain | _enclosed(unsure, certain, self.config.enclosure)
        foreground |= unsure & _closed(foreground, reach)
        contrast = np.asarray(cv2.transform(cv2.absdiff(image[crop], scene[crop]), np.full((1, 3), 1 / 3)), np.uint8)
        foreground = _trim_rim(foreground, contrast, self.config.rim, self.config.rim_layers)
        mask[crop] = _clean_by_area(foreground, self.config.speck_area * area, self.config.hole_area * area)


Mask = NDArray[np.bool_]


def _without_penumbrae(labels: Mask, difference: Images, collinearity: Images, penumbra: float) -> tuple[Mask, Mask]:
    """Split what differs from the scene into certain foreground and what may be a shadow (both (h, w) bool)."""
    core = cv2.morphologyEx(labels.view(np.uint8), cv2.MORPH_OPEN, _SQUARE5).view(np.bool_)
    levels = round(-STEPS_PER_OCTAVE * np.log2(penumbra))
    blurred = cv2.add(collinearity, levels) < cv2.dilate(difference, _SQUARE5)
    certain = labels & (core | ~blurred)
    return certain, (difference > 0) & ~certain


def _enclosed(unsure: Mask, certain: Mask, share: float) -> Mask:
    """The 4-connected regions of ``unsure`` whose border touches ``certain`` more than the share allows."""
    count, regions = cv2.connectedComponents(unsure.view(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    background = (~(unsure | certain)).view(np.uint8)
    outside = cv2.dilate(background, _CROSS3, borderType=cv2.BORDER_CONSTANT, borderValue=1).view(np.bool_)
    inside = cv2.dilate(certain.view(np.uint8), _CROSS3).view(np.bool_)
    touching_outside = np.bincount(regions[unsure & outside], minlength=count)
    touching_inside = np.bincount(regions[unsure & inside], minlength=count)
    chosen = touching_inside > share * (touching_inside + touching_outside)
    chosen[0] = False
    return chosen[regions]


def _closed(mask: Mask, size: int) -> Mask:
    """Morphological closing with a square of this size, as if nothing lay outside."""
    framed = cv2.copyMakeBorder(mask.view(np.uint8), size, size, size, size, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    return np.ascontiguousarray(closed[size:-size, size:-size]).view(np.bool_)


def _clean_by_area(mask: Mask, speck: float, hole: float) -> Images:
    """Drop foreground (8-connected) of less than ``speck`` pixels, fill holes (4-connected) of less than ``hole``.

    Works on outlines, which are short, not on regions: Pick's theorem turns the polygon through the outline's pixel
    centres into a count of pixels. The outline of a hole runs on the foreground around it. What lies inside an outline
    goes with it.

    Returns:
        (h, w) uint8, 0 or 255.
    """
    clean = mask.view(np.uint8) * np.uint8(255)
    contours, hierarchy = cv2.findContours(clean, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    specks = []
    for contour, (_, _, _, parent) in zip(contours, hierarchy[0] if len(contours) else (), strict=True):
        area, half_length = cv2.contourArea(contour), len(contour) / 2
        if parent < 0 and area + half_length + 1 < speck:
            specks.append(contour)
        elif parent >= 0 and area - half_length + 1 < hole:
            cv2.drawContours(clean, [contour], -1, 255, cv2.FILLED)
    if specks:
        cv2.drawContours(clean, specks, -1, 0, cv2.FILLED)
    return clean


def _trim_rim(mask: Mask, contrast: Images, share: float, layers: int) -> Mask:
    """Take pixels off the outline whose contrast is less than a share of the largest in their 3×3 neighbourhood."""
    weak = contrast < share * cv2.dilate(contrast, _SQUARE3)
    for _ in range(layers):
        inside = cv2.erode(mask.view(np.uint8), _SQUARE3, borderValue=1).view(np.bool_)
        mask = mask & (inside | ~weak)
    return mask


class Mog2Foreground:
    """OpenCV's mixture of Gaussians (MOG2) a pixel, learned from the clips and then frozen; its shadows are dropped."""

    def __init__(
        self, models: Sequence[cv2.BackgroundSubtractorMOG2], sizes: NDArray[np.int_], config: ForegroundConfig
    ):
        self.config = config
        self.sizes = sizes
        self._models = tuple(models)

    @classmethod
    def learn(
        cls,
        clips: Sequence[Images],
        frame_shape: tuple[int, int],
        sizes: ArrayLike,
        config: ForegroundConfig | None = None,
    ) -> Mog2Foreground:
        """Learn the empty scene; arguments and errors as :meth:`CollinearityForeground.learn`.

        Of ``config`` only the areas of specks and holes matter; OpenCV's defaults hold otherwise. A plate (T = 1)
        leaves each pixel with OpenCV's initial variance.
        """
        sizes = np.asarray(sizes, dtype=int).reshape(-1, 2)
        _check_clips(clips, frame_shape, sizes)
        models = []
        for clip in clips:
            model = cv2.createBackgroundSubtractorMOG2(history=max(len(clip), 1), detectShadows=True)
            for frame in clip:
                model.apply(np.ascontiguousarray(frame))
            models.append(model)
        return cls(models, sizes, config or ForegroundConfig())

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255."""
        masks = np.zeros(images.shape[:3], np.uint8)
        for c, (model, (width, height)) in enumerate(zip(self._models, self.sizes, strict=True)):
            labels = model.apply(np.ascontiguousarray(images[c, :height, :width]), learningRate=0)
            area = width * height
            masks[c, :height, :width] = _clean_by_area(
                labels == 255, self.config.speck_area * area, self.config.hole_area * area
            )
        return masks
