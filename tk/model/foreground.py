"""Foreground segmentation: which pixels show the person.

The main method is the collinearity test (Mester et al. 2001, extended by Griesser et al. 2005; Kehl & Van Gool 2006,
section 4, use it). :mod:`tk.kernels.background` computes the statistic; here is what surrounds it: learning the empty
scene and its noise, following gain and noise from frame to frame, and cleaning up the labels.

The test runs on pictures reduced by two: four pixels together have a quarter of the noise, and a grey sleeve on a grey
floor shows. The full picture then draws the outline.

No state passes from one frame to the next, so a run that is resumed gives the same masks. The papers are silent on
five things, which are settled here as follows.

* **Grey clothes.** A cloth of the floor's colour is collinear with the floor, as a shadow is. Shadows are confined to
  the factors that they can have: what is brighter than the scene, averaged over a few pixels, is the person. A region
  that could be either is decided by its border: a region mostly bounded by certain foreground is part of the person,
  one mostly bounded by background is a shadow. What is too faint for a shadow and too far from a darker place to be its
  edge belongs to the person.
* **Penumbrae.** Over the blurred edge of a shadow the window is not collinear. Such labels are thin or weak, and their
  statistic is small against the plain difference next to them; they count as "could be either".
* **Parts.** A hand beyond a sleeve that cannot be seen is joined to the body, for a person is in one piece. Parts that
  are nowhere strong are edges of shadows.
* **The rim.** A window fires outside the outline. A pixel of the rim stays if its own difference reaches a given share
  of the largest one nearby, which is where the outline covers that share of the pixel.
* **The empty scene's noise.** It is measured in every frame, from pixels of which most show the scene.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import CaptureError, ConfigError
from tk.kernels.background import Planes
from tk.model.regions import (
    beyond_shadows,
    clean_by_area,
    closed,
    enclosed,
    joined,
    trim_rim,
    without_penumbrae,
)

Images = NDArray[np.uint8]

_SQUARE3 = np.ones((3, 3), np.uint8)
_LEAST_NOISE = 0.4  # of a mean over 3×3 pixels: grey levels, rounded twice, do not tell less


@dataclass(frozen=True)
class ForegroundConfig:
    """How the segmentation decides. "Measured" means: on rendered captures with exact masks and on one real one.

    Attributes:
        reduction: how many pixels of the full picture are one of the picture that is tested, each way. Two: the sleeves
            of a grey man over a grey floor show, and it takes a quarter of the time.
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
        shadow_max: the faintest shadow, as a share of the lit plate. What is fainter is the edge of a darker one.
            Measured.
        bright: a mean over 3×3 reduced pixels that is brighter than the scene by this many of its noise deviations is
            foreground, for shadows only darken. Four: once in 30 000 pixels by chance, then dropped as a speck.
        noise_floor: variance added to the measured noise, grey levels²: what video coding does to the picture. It
            rounds small noise away in places and then lets it jump; its errors are alike over a window. Measured: more
            would make cleaner rims, but holes in grey clothes before a grey wall.
        still_noise: the same where the plate is a single picture: its coding errors and the light that has changed
            since are alike over a window, and no mean takes them away. Measured on one real recording.
        relative_noise_floor: least noise variance of a pixel, as a share of its picture's. As above.
        jitter_px: unsteadiness of camera and coding, pixels: adds noise where the plate has contrast. Measured.
        penumbra: a label is the edge of a shadow where the statistic is below this share of the plain difference
            nearby. 0.29 at a sharp edge, 0.05 over four reduced pixels of blur (both follow from the statistic).
        core: thick labels of more than this statistic, noise variances, are no edge of a shadow. Measured.
        penumbra_reach: how far from a shadow its edge may reach, share of the picture's height. Measured.
        faint_enclosure: share of its border by which a region that no shadow explains must touch certain foreground.
            Measured.
        enclosure: share of its border by which a region must touch certain foreground to become foreground: a clear
            majority, for a shadow between two legs touches them on two sides. Measured.
        bridge: a region that could be either is also foreground between parts of the person that are no farther apart
            than this share of the picture's height (a gap of 10 of 480 pixels). Measured.
        seed: parts of the person but the largest hold pixels of this statistic, noise variances. Measured.
        gap: parts that are no farther apart than this share of the picture's height are joined. Half a forearm, where a
            person's height is half of the picture's.
        limb: how thick they are joined, share of the picture's height. As above: a thin arm.
        rim: share of the largest contrast nearby from which a rim pixel stays; 0.5 would be unbiased at a sharp
            outline, less is cautious: a pixel too many swells the hull a little, one too few cuts through it.
        rim_layers: how deep the rim is searched, pixels: two reduced ones for the window.
        speck_area: smaller foreground components go, share of the picture's area (61 pixels of 640×480). Measured.
        hole_area: smaller holes are filled, share of the picture's area (123 pixels of 640×480). Measured.
    """

    reduction: int = 2
    threshold: float = 3.0
    neighbour_octaves: float = 0.5
    iterations: int = 3
    difference_min: float = 2.0
    darkness_offset: float = 40.0
    shadow_min: float = 0.7
    shadow_max: float = 0.95
    bright: float = 4.0
    noise_floor: float = 0.7
    still_noise: float = 15.0
    relative_noise_floor: float = 0.5
    jitter_px: float = 0.04
    penumbra: float = 0.2
    core: float = 8.0
    penumbra_reach: float = 0.017
    faint_enclosure: float = 0.2
    enclosure: float = 0.6
    seed: float = 64.0
    bridge: float = 0.02
    rim: float = 0.3
    rim_layers: int = 4
    gap: float = 0.08
    limb: float = 0.025
    speck_area: float = 2e-4
    hole_area: float = 4e-4

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"foreground.{field.name} = {value}: must be a finite number, 0 or more")
        for name in (
            "reduction",
            "threshold",
            "difference_min",
            "darkness_offset",
            "noise_floor",
            "penumbra",
            "core",
            "seed",
        ):
            if getattr(self, name) == 0:
                raise ConfigError(f"foreground.{name} = 0: must be positive")
        for name in (
            "shadow_min",
            "shadow_max",
            "relative_noise_floor",
            "penumbra",
            "enclosure",
            "faint_enclosure",
            "rim",
        ):
            if getattr(self, name) > 1:
                raise ConfigError(f"foreground.{name} = {getattr(self, name)}: a share, at most 1")
        if self.reduction != int(self.reduction):
            raise ConfigError(f"foreground.reduction = {self.reduction}: must be a whole number of pixels, 1 or more")
        if self.shadow_min == 0:
            raise ConfigError("foreground.shadow_min = 0: must be positive (1 switches the tolerance of shadows off)")


class Foreground(Protocol):
    """What a tracker asks of a segmentation."""

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255."""
        ...

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """The masks, and where they are 0 for a shadow that may be the person all the same: (C, H, W) bool.

        A cloth of the floor's colour is darker than the floor where it faces away from the lamp, as a shadow is. One
        camera cannot tell, all of them together can.
        """
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


def _reduced(images: Images, factor: int) -> Images:
    """(N, H // factor, W // factor, 3): means over squares of pixels."""
    height, width = images.shape[1] // factor, images.shape[2] // factor
    return np.stack([cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in images])


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
        noise_floor: NDArray[np.floating],
    ) -> None:
        """Plates (C, H, W, 3) uint8, relative noise (C, h, w) of the reduced ones, sizes (C, 2) of (width, height).

        ``noise_floor`` (C,): variance added to each camera's measured noise, grey levels².
        """
        self.config = config
        self.plates = plates
        self.sizes = sizes
        self._small_plates = _reduced(plates, config.reduction)
        self._small = np.empty_like(self._small_plates)
        self._small_scenes = np.empty_like(self._small_plates)
        self._noise_floor = noise_floor
        self._weights = (1.0 / relative_noise).astype(np.float32)
        self._plate_samples = _samples(self._small_plates).astype(np.float32)
        self._noise_samples = _samples(relative_noise[..., None].repeat(3, axis=3))[:, 0]
        self._planes = Planes(*self._small.shape[:3])
        self._pool = ThreadPoolExecutor(max_workers=min(len(plates), os.cpu_count() or 1))

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
        to be even. The noise's level is measured in each frame that is segmented, so a plate need not tell it;
        of a single picture, ``still_noise`` is added.

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
        relative = np.ones((len(clips), *(n // config.reduction for n in frame_shape)), np.float32)
        floor = np.array([config.still_noise if len(clip) == 1 else config.noise_floor for clip in clips])
        for c, (clip, (width, height)) in enumerate(zip(clips, sizes, strict=True)):
            plate, _ = _learn_scene(clip)
            plates[c, :height, :width] = np.clip(plate.round(), 0, 255)
            small_plate, variance = _learn_scene(_reduced(clip, config.reduction))
            noise = _relative_noise(small_plate, variance, config)
            relative[c, : noise.shape[0], : noise.shape[1]] = noise
        return cls(plates, relative, sizes, config, floor)

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255."""
        return self.label(images)[0]

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """Masks (C, H, W) uint8, and where they are 0 for what differs from the scene as a shadow does (C, H, W) bool.

        What differs is looked for about the person, as far as :meth:`segment` looks.
        """
        config = self.config
        cameras = range(len(images))
        # OpenCV lets go of the interpreter: cameras run side by side, each with its own memory
        levels = list(self._pool.map(lambda c: self._expose(c, images[c]), cameras))
        self._planes.measure(
            self._small,
            self._small_scenes,
            self._weights,
            (1.0 / (np.array([variance for _, variance in levels]) + self._noise_floor)).astype(np.float32),
            darkness_offset=config.darkness_offset,
            shadow_min=config.shadow_min,
            difference_min=config.difference_min,
        )
        self._planes.relax(config.threshold, config.neighbour_octaves, config.iterations)
        masks = np.zeros(images.shape[:3], np.uint8)
        doubtful = np.zeros(images.shape[:3], np.bool_)
        list(self._pool.map(lambda c: self._draw(images[c], c, levels[c][0], masks[c], doubtful[c]), cameras))
        return masks, doubtful

    def _draw(
        self, image: Images, c: int, gain: NDArray[np.float64], mask: Images, doubtful: NDArray[np.bool_]
    ) -> None:
        """Decide on camera ``c``'s reduced picture; the results in full go to ``mask`` and ``doubtful`` (H, W)."""
        decision, doubt = self._decide(c)
        self._outline(image, c, gain, decision, mask)
        height, width = mask.shape
        whole = cv2.resize(doubt, (width, height), interpolation=cv2.INTER_NEAREST)
        np.greater(whole, mask, out=doubtful)  # 1 where the mask is 0

    def _expose(self, c: int, image: Images) -> tuple[NDArray[np.float64], float]:
        """Reduce camera ``c``'s picture and bring its reduced plate to the same gain; the gain (3,) and the noise."""
        small = self._small[c]
        cv2.resize(image, small.shape[1::-1], dst=small, interpolation=cv2.INTER_AREA)
        gain, variance = _gain_and_noise(_samples(small[None])[0], self._plate_samples[c], self._noise_samples[c])
        cv2.transform(self._small_plates[c], np.diag(gain), dst=self._small_scenes[c])
        return gain, variance

    def _decide(self, c: int) -> tuple[Images, Images]:
        """(h, w) uint8, 0 or 255: which pixels of camera ``c``'s reduced picture show the person; 0 or 1: may do so."""
        config, planes = self.config, self._planes
        mask = np.zeros(self._small.shape[1:3], np.uint8)
        doubt = np.zeros_like(mask)
        height = int(self.sizes[c, 1]) // config.reduction
        area = int(np.prod(self.sizes[c])) / config.reduction**2
        reach = 2 * round(config.bridge * height / 2) + 1
        # the window widens whatever shows the person: what vanishes under erosion is noise
        x, y, w, h = cv2.boundingRect(cv2.erode(planes.labels[c], _SQUARE3))
        if w == 0:
            return mask, doubt
        margin = reach + height // 10  # shows enough of a shadow to tell it from a cloth
        crop = (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))
        difference = np.ascontiguousarray(planes.difference[c][crop])
        collinearity = np.ascontiguousarray(planes.collinearity[c][crop])
        labels = planes.labels[c][crop].view(np.bool_)
        certain, unsure = without_penumbrae(labels, difference, collinearity, config.penumbra, config.core)
        brightness, noise, scene = self._brightness(c)
        bright = unsure & (brightness[crop] > config.bright * noise)
        certain, unsure = certain | bright, unsure & ~bright
        dark = brightness[crop] < (config.shadow_max - 1.0) * scene[crop]
        width = 2 * round(config.penumbra_reach * height) + 1
        faint = beyond_shadows(unsure, certain, dark, width, config.faint_enclosure)
        certain, unsure = certain | faint, unsure & ~faint
        foreground = certain | enclosed(unsure, certain, config.enclosure)
        foreground |= unsure & closed(foreground, reach)
        bar = max(round(config.limb * height), 1)
        foreground = joined(
            foreground, difference > 0, collinearity, config.seed, config.speck_area * area, config.gap * height, bar
        )
        doubt[crop] = (difference > 0) & ~foreground
        mask[crop] = clean_by_area(foreground, config.speck_area * area, config.hole_area * area)
        return mask, doubt

    def _brightness(self, c: int) -> tuple[NDArray[np.float32], float, NDArray[Any]]:
        """Of camera ``c``'s reduced picture: mean over 3×3 pixels less the scene's, its noise, and the scene (h, w)."""
        image, scene = (cv2.cvtColor(p[c], cv2.COLOR_BGR2GRAY) for p in (self._small, self._small_scenes))
        signed = cv2.subtract(image, scene, dtype=cv2.CV_16S)
        brightness = cv2.boxFilter(signed, cv2.CV_32F, (3, 3))
        sample = brightness[2::6, 2::6]  # most of it shows the scene
        median = float(np.median(sample))
        noise = 1.4826 * float(np.median(np.abs(sample - median)))
        return np.subtract(brightness, np.float32(median), dtype=np.float32), max(noise, _LEAST_NOISE), scene

    def _outline(self, image: Images, c: int, gain: NDArray[np.float64], decision: Images, mask: Images) -> None:
        """Draw camera ``c``'s outline in the full picture, into ``mask``: the rim goes where it shows the scene."""
        area = int(np.prod(self.sizes[c]))
        height, width = mask.shape
        whole = cv2.resize(decision, (width, height), interpolation=cv2.INTER_LINEAR)
        x, y, w, h = cv2.boundingRect(whole)
        if w == 0:
            return
        margin = self.config.rim_layers
        crop = (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))
        scene = cv2.transform(self.plates[c][crop], np.diag(gain))
        # the plain mean: a grey level all but leaves out blue
        contrast = np.asarray(cv2.transform(cv2.absdiff(image[crop], scene), np.full((1, 3), 1 / 3)), np.uint8)
        person = trim_rim(whole[crop] > 127, contrast, self.config.rim, self.config.rim_layers)
        mask[crop] = clean_by_area(person, self.config.speck_area * area, self.config.hole_area * area)


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
        return self.label(images)[0]

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """Masks (C, H, W) uint8, and where OpenCV says shadow (C, H, W) bool."""
        masks = np.zeros(images.shape[:3], np.uint8)
        doubtful = np.zeros(images.shape[:3], np.bool_)
        for c, (model, (width, height)) in enumerate(zip(self._models, self.sizes, strict=True)):
            labels = model.apply(np.ascontiguousarray(images[c, :height, :width]), learningRate=0)
            area = width * height
            masks[c, :height, :width] = clean_by_area(
                labels == 255, self.config.speck_area * area, self.config.hole_area * area
            )
            shadow = labels == model.getShadowValue()
            doubtful[c, :height, :width] = shadow & (masks[c, :height, :width] == 0)
        return masks, doubtful
