"""Foreground segmentation against the empty scene: which pixels show the person.

The method is the collinearity test of Mester et al. (2001), extended by Griesser et al. (2005) and used in Kehl & Van
Gool (2006), section 4. :mod:`tk.kernels.background` computes the statistic and :mod:`tk.model.masks.background` learns
the empty scene and its noise. This module follows gain and noise from frame to frame and cleans the labels.

The test runs on images reduced by two, in which noise is a quarter; the full image then gives the outline. Everything
happens inside a box around the person (:mod:`tk.model.masks.person_boxes`).

No state passes from one frame to the next, so a resumed run gives the same masks. The papers leave four points open:

* **Grey clothes.** Cloth of the floor's colour is collinear with the floor, as a shadow is. The factor of a shadow is
  therefore limited to [``shadow_min``, 1], and pixels brighter than the scene are foreground. A region that may be
  cloth or shadow is decided by its border: if most of it touches certain foreground, the region is foreground.
* **Penumbrae.** At the blurred edge of a shadow the window is not collinear. Such labels are thin or weak, and their
  statistic is small relative to the plain difference nearby. They are treated as "cloth or shadow".
* **The rim.** A 3×3 window also responds outside the outline. A pixel of the rim is kept if its own difference reaches
  a given share of the largest difference nearby.
* **The noise of the empty scene** is measured in every frame, from pixels most of which show the scene. Images with
  much noise are averaged before the test, because noise hides limbs whose colour is near the scene's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.kernels.background import GREY, Statistic
from tk.model.masks.background import (
    Images,
    check_clips,
    gain_and_noise,
    learn_scene,
    mean_scene,
    reduced,
    relative_noise,
    samples,
)
from tk.model.masks.learned_scene import LearnedScene
from tk.model.masks.mosaic import Mosaic, doubled
from tk.model.masks.person_boxes import PersonBoxes
from tk.model.masks.regions import (
    clean_by_area,
    closed,
    enclosed,
    person_parts,
    shadow_evidence,
    trim_rim,
    without_penumbrae,
)
from tk.settings import ForegroundSettings
from tk.system.machine import cores

# The constants below were chosen on rendered captures with exact masks and on one real capture.

# Side of the square of pixels that is one pixel of the reduced image.
_REDUCTION = 2

# Images with more noise (variance of a reduced pixel, grey levels²) are averaged over 3×3 reduced pixels before the
# test.
_NOISY = 40.0

# Plain difference, in noise variances, below which a pixel is background whatever its neighbours are. Noise alone gives
# a mean of 0.5 and a 99.9 % quantile of 1.03 (chi-square with 27 degrees of freedom, over 54); the remaining factor is
# for coding noise, which is correlated within a window.
_DIFFERENCE_MIN = 2.0

# Constant component added to both vectors, grey levels (Griesser et al., chosen by hand there, too): windows darker
# than about ten grey levels are compared by their difference.
_DARKNESS_OFFSET = 40.0

# A mean over 3×3 reduced pixels that is brighter than the scene by this many standard deviations of its noise is
# foreground, because shadows only darken. Four: by chance once in 30,000 pixels.
_BRIGHT_DEVIATIONS = 4.0
# Brightest light relative to a learned scene, which may lie in the person's own shadow; there being brighter is no sign
# of the person.
_LIGHT = 1.5
_BRIGHT_STEP = 16  # rows and columns from one such mean to the next, where its noise is measured; affects speed only

# Variance added to the measured noise, grey levels², for video coding: coding removes small noise in places, and its
# errors are correlated within a window.
_NOISE_FLOOR = 0.7
# The same with a single image of the empty scene, whose own coding errors and later changes of the light are not
# averaged out. Chosen on one real capture.
_STILL_NOISE = 15.0

# A label is the edge of a shadow if the statistic is below this share of the plain difference nearby. The statistic
# gives 0.29 at a sharp edge and 0.05 over a blur of four reduced pixels.
_PENUMBRA = 0.2
# Thick labels with a larger statistic than this, in noise variances, are no edge of a shadow.
_CORE = 8.0

# Pixels that may be cloth or shadow are decided by the scene's structure where this shows either with a probability of
# 0.99: logarithm of the odds.
_SURE = 4.6
# Another region that may be cloth or shadow is foreground if it touches certain foreground with more than this share of
# its border: a clear majority, because a shadow between two legs touches them on two sides.
_ENCLOSURE = 0.6
# Such a region is also foreground in gaps of the person up to this width, as a share of the image height (10 of 480
# pixels).
_BRIDGE = 0.02

# Parts of the person other than the largest need pixels of this statistic, in noise variances.
_SEED = 64.0

_RIM_LAYERS = 4  # depth of the rim, full pixels: two reduced pixels, the reach of a window and one for the reduction
# A pixel of the rim is kept if it has this share of the largest contrast nearby. 0.5 is unbiased at a sharp outline;
# less is cautious, because a pixel too many makes the hull a little larger and one too few cuts through it.
_RIM = 0.3
# Smaller connected parts are removed and smaller holes filled, share of the image area (61 pixels of 640×480).
AREA_MIN = 2e-4


class Foreground(Protocol):
    """A segmentation method."""

    def label(self, images: Images, halved: Images | None = None) -> tuple[Images, NDArray[np.bool_]]:
        """Segment images (C, H, W, 3) uint8 BGR; ``halved``: the same reduced by two, if they are there.

        Returns:
            Masks (C, H, W) uint8, 0 or 255; and uncertain pixels (C, H, W) bool: pixels of mask 0 that may be a shadow
            or cloth of the floor's colour. One camera cannot decide that, several together can.
        """
        ...


@dataclass(frozen=True)
class Prior:
    """What is known beforehand of the pixels of reduced images, for those whose scene is unknown.

    Attributes:
        person, possible: (C, h, w) 0 or 1, whether a pixel contains pixels of the person, and such that may be.
    """

    person: Images
    possible: Images

    @classmethod
    def of(cls, masks: Images, uncertain: NDArray[np.bool_]) -> Prior:
        """Reduce masks and uncertain pixels (C, H, W)."""
        return cls(_any(masks), _any(uncertain))


@dataclass(frozen=True)
class _Scene:
    """The empty scene in reduced images.

    Attributes:
        plates: (C, h, w, 3).
        samples: (C, 3, N), pixels on a coarse grid.
        sums: (C, M, 3), sums over windows.
        person_boxes: finds the boxes around the person.
    """

    plates: Images
    samples: NDArray[np.float32]
    sums: NDArray[np.float32]
    person_boxes: PersonBoxes

    @classmethod
    def of(cls, plates: Images, shadow_min: float, height: int) -> _Scene:
        """Arguments as of :class:`~tk.model.masks.person_boxes.PersonBoxes`."""
        sample, sums = samples(plates).astype(np.float32), _window_sums(plates).astype(np.float32)
        return cls(plates, sample, sums, PersonBoxes(plates, shadow_min, height))


class CollinearityForeground:
    """The collinearity test against a learned empty scene. Create it with :meth:`learn`."""

    def __init__(
        self,
        plates: Images,
        relative: NDArray[np.float32],
        sizes: NDArray[np.int_],
        config: ForegroundSettings,
        noise_floor: NDArray[np.floating],
        learned: LearnedScene | None = None,
    ) -> None:
        """Prepare buffers.

        Args:
            plates: (C, H, W, 3) uint8, the empty scene.
            relative: (C, h, w), noise variance of the reduced image relative to its level.
            sizes: (C, 2), each camera's (width, height) in pixels.
            config: thresholds.
            noise_floor: (C,), variance added to each camera's measured noise, grey levels².
            learned: the scene of the plates, if parts of it are unknown.
        """
        self.config = config
        self._learned = learned is not None
        self._unknown = self._small_unknown = None
        if learned is not None and learned.unknown.any():
            self._unknown = learned.unknown.view(np.uint8)
            self._small_unknown = _any(learned.unknown)
        self.plates, self._sizes = plates, sizes
        self._height = int(np.median(sizes[:, 1])) // _REDUCTION
        self._scene = _Scene.of(reduced(plates, _REDUCTION), config.shadow_min, self._height)
        self._small = np.empty_like(self._scene.plates)
        self._windows = _windows_inside(sizes // _REDUCTION, self._small.shape[1:3])
        self._small_scenes = np.empty_like(self._scene.plates)
        self._noise_floor = noise_floor.astype(np.float32)
        self._noise_samples = samples(relative[..., None])[:, 0]
        self._statistic = Statistic(self._small, self._small_scenes, (1.0 / relative).astype(np.float32))
        self._area_min = AREA_MIN * float(np.median(np.prod(sizes, axis=1)))  # full pixels
        self._bridge = 2 * round(_BRIDGE * self._height / 2) + 1  # reduced pixels
        self._gap = max(self._bridge, 2 * _RIM_LAYERS) + 1  # no filter reaches from one box to the next

    @classmethod
    def learn(
        cls,
        clips: Sequence[Images],
        frame_shape: tuple[int, int],
        sizes: ArrayLike,
        config: ForegroundSettings | None = None,
    ) -> CollinearityForeground:
        """Learn the empty scene.

        A clip gives the plate and the distribution of noise over the image. With a single image (T = 1) noise is taken
        to be even. The level of noise is measured in each segmented frame.

        Args:
            clips: one (T, h, w, 3) uint8 per camera.
            frame_shape: (H, W) of the packed images.
            sizes: (C, 2), each camera's (width, height) in pixels.
            config: thresholds; the defaults if None.

        Raises:
            CaptureError: a clip is missing or empty, or its size is not its camera's.
        """
        config = config or ForegroundSettings()
        sizes = np.asarray(sizes, dtype=int).reshape(-1, 2)
        check_clips(clips, frame_shape, sizes)
        plates = np.zeros((len(clips), *frame_shape, 3), np.uint8)
        relative = np.ones((len(clips), *(n // _REDUCTION for n in frame_shape)), np.float32)
        floor = np.array([_STILL_NOISE if len(clip) == 1 else _NOISE_FLOOR for clip in clips])

        def take(c: int) -> None:
            clip, (width, height) = clips[c], sizes[c]
            plates[c, :height, :width] = np.clip(mean_scene(clip).round(), 0, 255)
            small_plate, variance = learn_scene(reduced(clip, _REDUCTION))
            noise = relative_noise(small_plate, variance, _NOISE_FLOOR)
            relative[c, : noise.shape[0], : noise.shape[1]] = noise

        with ThreadPoolExecutor(min(cores(), len(clips))) as threads:
            deque(threads.map(take, range(len(clips))), maxlen=0)
        return cls(plates, relative, sizes, config, floor)

    @classmethod
    def of_learned(
        cls, scene: LearnedScene, sizes: ArrayLike, config: ForegroundSettings | None = None
    ) -> CollinearityForeground:
        """Segment against a scene that is known in parts; arguments as of :meth:`learn`."""
        small = reduced(scene.plates, _REDUCTION).astype(np.float32)
        relative = np.stack([relative_noise(plate, None, _NOISE_FLOOR) for plate in small])
        floor = np.full(len(small), _NOISE_FLOOR)
        return cls(scene.plates, relative, np.asarray(sizes, dtype=int), config or ForegroundSettings(), floor, scene)

    def label(
        self,
        images: Images,
        halved: Images | None = None,
        prior: Prior | None = None,
    ) -> tuple[Images, NDArray[np.bool_]]:
        """Segment images; see :meth:`Foreground.label`. Pixels are uncertain only inside the person's box.

        Args:
            images: (C, H, W, 3).
            halved: the same reduced by two, if they are there.
            prior: taken over where a learned scene is unknown.
        """
        masks = np.zeros(images.shape[:3], np.uint8)
        uncertain = np.zeros(images.shape[:3], np.bool_)
        if halved is None:
            reduced(images, _REDUCTION, out=self._small)
        else:
            self._small[...] = halved
        scene = self._scene
        gains, variances = gain_and_noise(samples(self._small), scene.samples, self._noise_samples)
        if (noisy := variances > _NOISY).any():
            scene = self._averaged(noisy)
            gains, variances = gain_and_noise(samples(self._small), scene.samples, self._noise_samples)
        noise = variances + self._noise_floor
        boxes = scene.person_boxes.boxes(self._small, gains, noise)
        if not boxes.any():
            return masks, uncertain
        mosaic = Mosaic.of(boxes, self._gap)
        for c, gain in enumerate(gains):
            x, y, w, h = boxes[c]
            near = slice(max(y - 1, 0), y + h + 1), slice(max(x - 1, 0), x + w + 1)  # windows reach a pixel further
            if w > 0:
                lit = self._small_scenes[c][near]
                cv2.transform(scene.plates[c][near], np.diag(gain), dst=lit)
                if self._small_unknown is not None:  # nothing differs there, in windows that reach there either
                    cv2.copyTo(self._small[c][near], self._small_unknown[c][near], lit)
        self._statistic.measure(
            1.0 / noise,
            self._bright_sums(scene, gains),
            mosaic.boxes,
            mosaic.corners,
            mosaic.shape,
            darkness_offset=_DARKNESS_OFFSET,
            shadow_min=self.config.shadow_min,
            light_max=_LIGHT if self._learned else 1.0,
            difference_min=_DIFFERENCE_MIN,
            threshold=self.config.threshold,
        )
        person, doubt = self._decide(mosaic, prior, noise)
        self._outline(images, gains, person, mosaic, masks)
        full = mosaic.enlarged(_REDUCTION)
        whole = doubled(doubt)
        for c in range(len(images)):
            np.greater(full.part(whole, c), full.crop(masks[c], c), out=full.crop(uncertain[c], c))
            width, height = self._sizes[c].tolist()
            for layer in (masks[c], uncertain[c]):
                if width % _REDUCTION:  # a last column that is in no square shows what the one before shows
                    layer[:, width - 1] = layer[:, width - 2]
                if height % _REDUCTION:
                    layer[height - 1] = layer[height - 2]
        return masks, uncertain

    def _averaged(self, noisy: NDArray[np.bool_]) -> _Scene:
        """Average the reduced images of the noisy cameras (C,), and return the scene with the same cameras averaged."""
        plates = self._scene.plates.copy()
        for c in np.flatnonzero(noisy).tolist():
            for images in (self._small, plates):
                cv2.blur(images[c], (3, 3), dst=images[c])
        return _Scene.of(plates, self.config.shadow_min, self._height)

    def _bright_sums(self, scene: _Scene, gains: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (C,) the least sum over a window, image minus scene, that makes its pixel foreground.

        The noise of these sums is measured over the whole image of the camera, most of which shows the scene.
        """
        differences = _window_sums(self._small) - scene.sums * gains[:, None]
        brighter = (differences * np.array(GREY, np.float32)).sum(axis=2)
        least = np.empty(len(brighter), np.float32)
        for c, inside in enumerate(self._windows):
            own = brighter[c, inside]
            middle = np.median(own)
            deviation = 1.4826 * np.median(np.abs(own - middle))  # of a normal distribution
            least[c] = middle + _BRIGHT_DEVIATIONS * deviation
        return least

    def _decide(self, mosaic: Mosaic, prior: Prior | None, noise: NDArray[np.float32]) -> tuple[Images, Images]:
        """Return mosaics of reduced images, 0 or 1: the person, and the uncertain pixels; ``noise``: (C,) variances."""
        statistic = self._statistic
        difference, collinearity = statistic.difference, statistic.collinearity
        seen = difference > 0
        certain = without_penumbrae(statistic.labels, difference, collinearity, _PENUMBRA, _CORE)
        if not self._learned:
            certain |= statistic.bright.view(np.bool_)
        unknown = np.zeros_like(seen)
        if self._small_unknown is not None and prior is not None:
            unknown, shown, possible = (
                _gathered(mosaic, each) for each in (self._small_unknown, prior.person, prior.possible)
            )
            np.copyto(certain, shown, where=unknown)
            np.copyto(collinearity, 255, where=unknown & shown)
            np.copyto(seen, shown | possible, where=unknown)
        unsure = seen & ~certain
        pixels = np.flatnonzero(unsure & ~unknown)
        evidence = self._shadow_evidence(mosaic, pixels, noise)
        np.put(certain, pixels[evidence < -_SURE], True)
        np.put(unsure, pixels[np.abs(evidence) > _SURE], False)
        foreground = certain | enclosed(unsure, certain, _ENCLOSURE)
        foreground |= unsure & closed(foreground, self._bridge)
        area_min = self._area_min / _REDUCTION**2
        person = person_parts(foreground, collinearity, mosaic.corners[:, 0], _SEED, area_min)
        return person, (seen.view(np.uint8) > person).view(np.uint8)

    def _shadow_evidence(
        self, mosaic: Mosaic, pixels: NDArray[np.intp], noise: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return (N,) by how much likelier each pixel of a mosaic, flat indices (N,), is a shadow than cloth, see
        :func:`~tk.model.masks.regions.shadow_evidence`; ``noise``: (C,) variances."""
        y, x = np.divmod(pixels, mosaic.shape[1])
        camera = np.searchsorted(mosaic.corners[:, 0], x, side="right") - 1
        left, top = (mosaic.boxes[:, :2] - mosaic.corners).T
        _, height, width, _ = self._small.shape
        at = (camera * height + y + top[camera]) * width + x + left[camera]
        weights = np.array(GREY, np.float32) / sum(GREY)
        image, scene = (of.reshape(-1, 3).take(at, axis=0) @ weights for of in (self._small, self._small_scenes))
        variance = (noise * (weights**2).sum()).astype(np.float32)[camera]
        return shadow_evidence(image, scene, pixels, mosaic.shape, variance, self.config.shadow_min, self._bridge)

    def _outline(
        self, images: Images, gains: NDArray[np.float32], person: Images, mosaic: Mosaic, masks: Images
    ) -> None:
        """Draw the person's outline in the full images into ``masks``; rim pixels that show the scene are removed."""
        tight = mosaic.tightened(person, _RIM_LAYERS // _REDUCTION + 1, _RIM_LAYERS)
        small = np.zeros(tight.shape, np.uint8)
        for c in range(len(images)):
            tight.part(small, c)[...] = mosaic.part_of(person, c, tight.boxes[c])
        full = tight.enlarged(_REDUCTION)
        contrast = np.zeros(full.shape, np.uint8)
        for c, gain in enumerate(gains):
            if full.boxes[c].any():
                scene = cv2.transform(full.crop(self.plates[c], c), np.diag(gain))
                blue, green, red = cv2.split(cv2.absdiff(full.crop(images[c], c), scene, dst=scene))
                cv2.max(cv2.max(blue, green, dst=blue), red, dst=full.part(contrast, c))
        whole = doubled(small)
        unknown = None if self._unknown is None else _gathered(full, self._unknown)
        if unknown is not None:
            contrast[unknown] = 0  # it says nothing there
        trimmed = trim_rim(whole, contrast, _RIM, _RIM_LAYERS)
        if unknown is not None:
            trimmed |= unknown & whole.view(np.bool_)  # no rim
        clean = clean_by_area(trimmed, self._area_min, self._area_min)
        for c in range(len(images)):
            full.crop(masks[c], c)[...] = full.part(clean, c)


def _window_sums(images: Images) -> NDArray[np.uint16]:
    """Return (C, N, 3) sums over 3×3 pixels of images (C, h, w, 3), at every :data:`_BRIGHT_STEP`-th row and column."""
    last = images.shape[1] - 2, images.shape[2] - 2
    parts = [images[:, y : last[0] + y : _BRIGHT_STEP, x : last[1] + x : _BRIGHT_STEP] for y, x in np.ndindex(3, 3)]
    total = parts[0].astype(np.uint16)
    for part in parts[1:]:
        total += part
    return total.reshape(len(images), -1, 3)


def _windows_inside(sizes: NDArray[np.int_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return (C, N) which windows of :func:`_window_sums`, of images of ``shape`` (h, w), are inside the images of
    cameras of these sizes (C, 2)."""
    y, x = (np.arange(0, side - 2, _BRIGHT_STEP) + 2 for side in shape)
    inside = (y[:, None] < sizes[:, 1, None, None]) & (x < sizes[:, 0, None, None])
    return np.asarray(inside.reshape(len(sizes), -1))


def _gathered(mosaic: Mosaic, images: Images) -> NDArray[np.bool_]:
    """Return images (C, h, w) as a mosaic, false between the boxes."""
    gathered = np.zeros(mosaic.shape, np.uint8)
    for c, image in enumerate(images):
        mosaic.part(gathered, c)[...] = mosaic.crop(image, c)
    return gathered.view(np.bool_)


def _any(pixels: Images | NDArray[np.bool_]) -> Images:
    """Return (C, h, w) 0 or 1, which reduced pixels contain a pixel of (C, H, W)."""
    h, w = (n // _REDUCTION * _REDUCTION for n in pixels.shape[1:])
    every = pixels[:, :h, :w].view(np.uint8)
    return np.minimum(every[:, ::2, ::2] | every[:, 1::2, ::2] | every[:, ::2, 1::2] | every[:, 1::2, 1::2], 1)
