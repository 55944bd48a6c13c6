"""Foreground segmentation: which pixels show the person.

The main method is the collinearity test (Mester et al. 2001, extended by Griesser et al. 2005; Kehl & Van Gool 2006,
section 4, use it). :mod:`tk.kernels.background` computes the statistic, :mod:`tk.model.masks.background` learns the
empty scene
and its noise; here is what surrounds them: following gain and noise from frame to frame, finding where to look, and
cleaning up the labels.

The test runs on pictures reduced by two: four pixels together have a quarter of the noise, and a grey sleeve on a grey
floor shows. The full picture then draws the outline. A coarse look at the whole picture, reduced once more, says where
anything differs from the scene; all else happens in the box around that.

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

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.kernels.background import BRIGHT, DARK, GREY, Statistic
from tk.model.masks.background import (
    Images,
    check_clips,
    gain_and_noise,
    learn_scene,
    mean_scene,
    median,
    reduced,
    relative_noise,
    samples,
)
from tk.model.masks.mosaic import Mosaic, doubled
from tk.model.masks.person_boxes import PersonBoxes
from tk.model.masks.regions import (
    beyond_shadows,
    clean_by_area,
    closed,
    enclosed,
    joined,
    trim_rim,
    without_penumbrae,
)
from tk.settings import ForegroundSettings

# "Measured" means: on rendered captures with exact masks and on one real one.

# Pixels of the full picture that are one of the picture that is tested, each way: the sleeves of a grey man over a grey
# floor show, and it takes a quarter of the time.
_REDUCTION = 2

# A further foreground neighbour divides the threshold by 2 to this power. Griesser et al. derive such a term from a
# Markov random field; the value is measured.
_NEIGHBOUR_OCTAVES = 0.5
_ITERATIONS = 3  # updates of the labels under the neighbours' influence

# Plain difference, noise variances, below which a pixel is background whatever its neighbours are. Pure noise gives
# 0.5, with a 99.9 % quantile of 1.03 (χ² with 27 degrees of freedom); the rest is for noise that coding made alike over
# a window.
_DIFFERENCE_MIN = 2.0

# Grey levels. Griesser et al. choose it by hand; here a tenth of a bright window's length, so that windows darker than
# about ten grey levels are compared by their difference.
_DARKNESS_OFFSET = 40.0

# A mean over 3×3 reduced pixels that is brighter than the scene by this many of its noise deviations is foreground, for
# shadows only darken. Four: once in 30 000 pixels by chance, then dropped as a speck.
_BRIGHT = 4.0
_LEAST_NOISE = 0.4  # of such a mean: grey levels, rounded twice, do not tell less
_BRIGHT_STEP = 16  # every so many rows and columns such a mean is taken, to measure its noise

# Variance added to the measured noise, grey levels²: what video coding does to the picture. It rounds small noise away
# in places and then lets it jump; its errors are alike over a window. Measured: more would make cleaner rims, but holes
# in grey clothes before a grey wall. With a single picture for a plate, its coding errors and the light that has
# changed since are alike over a window as well, and no mean takes them away: measured on one real recording.
_NOISE_FLOOR = 0.7
_STILL_NOISE = 15.0

# A label is the edge of a shadow where the statistic is below this share of the plain difference nearby: 0.29 at a
# sharp edge, 0.05 over four reduced pixels of blur (both follow from the statistic).
_PENUMBRA = 0.2
_CORE = 8.0  # thick labels of more than this statistic, noise variances, are no edge of a shadow; measured
_PENUMBRA_REACH = 0.017  # how far from a shadow its edge may reach, share of the picture's height; measured

# Shares of its border by which a region must touch certain foreground. One that no shadow explains; measured. One that
# could be a shadow: a clear majority, for a shadow between two legs touches them on two sides; measured.
_FAINT_ENCLOSURE = 0.2
_ENCLOSURE = 0.6

# A region that could be either is also foreground between parts of the person that are no farther apart than this share
# of the picture's height (a gap of 10 of 480 pixels). Measured.
_BRIDGE = 0.02

# Parts of the person but the largest hold pixels of this statistic, noise variances; measured. Parts are joined over
# gaps of half a forearm by a thin arm: shares of the picture's height, of which a person's is half.
_SEED = 64.0
_GAP = 0.08
_LIMB = 0.025

_RIM_LAYERS = 4  # how deep the rim is searched, pixels: two reduced ones for the window
# The faintest shadow, as a share of the lit scene: a fainter one is the edge of a darker one. As the next three, chosen
# on rendered captures with exact masks; sensitivity not measured.
_SHADOW_MAX = 0.95
# A pixel of the rim stays if it has this share of the largest contrast nearby. 0.5 would be unbiased at a sharp
# outline; less is cautious: a pixel too many swells the hull a little, one too few cuts through it.
_RIM = 0.3
# Smaller connected parts are removed, and smaller holes filled, shares of the image's area (61 and 123 pixels of
# 640×480).
SPECK_AREA, HOLE_AREA = 2e-4, 4e-4


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


class CollinearityForeground:
    """The collinearity test against a learned empty scene. Make it with :meth:`learn`."""

    def __init__(
        self,
        plates: Images,
        relative: NDArray[np.float32],
        sizes: NDArray[np.int_],
        config: ForegroundSettings,
        noise_floor: NDArray[np.floating],
    ) -> None:
        """Plates (C, H, W, 3) uint8, relative noise (C, h, w) of the reduced ones, sizes (C, 2) of (width, height).

        ``noise_floor`` (C,): variance added to each camera's measured noise, grey levels².
        """
        self.config = config
        self.plates = plates
        self._small_plates = reduced(plates, _REDUCTION)
        self._small = np.empty_like(self._small_plates)
        self._small_scenes = np.empty_like(self._small_plates)
        self._noise_floor = noise_floor.astype(np.float32)
        self._plate_samples = samples(self._small_plates).astype(np.float32)
        self._noise_samples = samples(relative[..., None])[:, 0]
        self._plate_sums = _window_sums(self._small_plates).astype(np.float32)
        self._statistic = Statistic(self._small, self._small_scenes, (1.0 / relative).astype(np.float32))
        # of the reduced pictures
        self._height = int(np.median(sizes[:, 1])) // _REDUCTION
        self._look = PersonBoxes(self._small_plates, config.shadow_min, self._height)
        self._speck, self._hole = (
            share * float(np.median(np.prod(sizes, axis=1))) / _REDUCTION**2 for share in (SPECK_AREA, HOLE_AREA)
        )
        self._bridge = 2 * round(_BRIDGE * self._height / 2) + 1
        self._penumbra = 2 * round(_PENUMBRA_REACH * self._height) + 1
        self._gap = max(self._bridge, self._penumbra, 2 * _RIM_LAYERS) + 1  # no filter reaches from box to box

    @classmethod
    def learn(
        cls,
        clips: Sequence[Images],
        frame_shape: tuple[int, int],
        sizes: ArrayLike,
        config: ForegroundSettings | None = None,
    ) -> CollinearityForeground:
        """Learn the empty scene.

        A clip gives the plate and how the noise varies over the picture; of a single picture (T = 1) the noise is taken
        to be even. The noise's level is measured in each frame that is segmented, so a plate need not tell it; with a
        single picture, more is added to it.

        Args:
            clips: one (T, h, w, 3) uint8 a camera.
            frame_shape: (H, W) of the packed pictures.
            sizes: (C, 2) each camera's (width, height), pixels.
            config: thresholds; the defaults when None.

        Raises:
            CaptureError: a clip is missing, empty, or of another size than its camera.
        """
        config = config or ForegroundSettings()
        sizes = np.asarray(sizes, dtype=int).reshape(-1, 2)
        check_clips(clips, frame_shape, sizes)
        plates = np.zeros((len(clips), *frame_shape, 3), np.uint8)
        relative = np.ones((len(clips), *(n // _REDUCTION for n in frame_shape)), np.float32)
        floor = np.array([_STILL_NOISE if len(clip) == 1 else _NOISE_FLOOR for clip in clips])
        for c, (clip, (width, height)) in enumerate(zip(clips, sizes, strict=True)):
            plates[c, :height, :width] = np.clip(mean_scene(clip).round(), 0, 255)
            small_plate, variance = learn_scene(reduced(clip, _REDUCTION))
            noise = relative_noise(small_plate, variance, _NOISE_FLOOR)
            relative[c, : noise.shape[0], : noise.shape[1]] = noise
        return cls(plates, relative, sizes, config, floor)

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255."""
        return self.label(images)[0]

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """Masks (C, H, W) uint8, and where they are 0 for what differs from the scene as a shadow does (C, H, W) bool.

        What differs is looked for about the person, as far as :meth:`segment` looks.
        """
        masks = np.zeros(images.shape[:3], np.uint8)
        uncertain = np.zeros(images.shape[:3], np.bool_)
        reduced(images, _REDUCTION, out=self._small)
        gains, variances = gain_and_noise(samples(self._small), self._plate_samples, self._noise_samples)
        noise = variances + self._noise_floor
        boxes = self._look.boxes(self._small, gains, noise)
        if not boxes.any():
            return masks, uncertain
        mosaic = Mosaic.of(boxes, self._gap)
        for c, gain in enumerate(gains):
            x, y, w, h = boxes[c]
            near = slice(max(y - 1, 0), y + h + 1), slice(max(x - 1, 0), x + w + 1)  # the windows' reach
            if w > 0:
                cv2.transform(self._small_plates[c][near], np.diag(gain), dst=self._small_scenes[c][near])
        self._statistic.measure(
            1.0 / noise,
            self._brightness(gains),
            mosaic.boxes,
            mosaic.corners,
            mosaic.shape,
            darkness_offset=_DARKNESS_OFFSET,
            shadow_min=self.config.shadow_min,
            shadow_max=_SHADOW_MAX,
            difference_min=_DIFFERENCE_MIN,
            threshold=self.config.threshold,
            octaves_per_neighbour=_NEIGHBOUR_OCTAVES,
            iterations=_ITERATIONS,
        )
        decision, doubt = self._decide(mosaic)
        self._outline(images, gains, decision, mosaic, masks)
        full = mosaic.enlarged(_REDUCTION)
        whole = doubled(doubt)
        for c in range(len(images)):
            np.greater(full.part(whole, c), full.crop(masks[c], c), out=full.crop(uncertain[c], c))  # 1 where 0
        return masks, uncertain

    def _brightness(self, gains: NDArray[np.float32]) -> NDArray[np.float32]:
        """(C, 2) sums over a window of how much brighter a picture is than the scene: what is bright, what is usual.

        Noise, and what is left of the gain's error, are as measured all over the picture, most of which is the scene.
        """
        brighter = ((_window_sums(self._small) - self._plate_sums * gains[:, None]) * np.array(GREY, np.float32)).sum(
            axis=2
        )
        usual = median(brighter)
        noise = np.maximum(1.4826 * median(np.abs(brighter - usual[:, None])), 9 * sum(GREY) * _LEAST_NOISE)
        return np.stack([usual + _BRIGHT * noise, usual], axis=1).astype(np.float32)

    def _decide(self, mosaic: Mosaic) -> tuple[Images, Images]:
        """Mosaics of the reduced pictures: where the person is, and where he may be as well, 0 or 1."""
        statistic = self._statistic
        difference, collinearity, shades = statistic.difference, statistic.collinearity, statistic.shades
        seen = difference > 0
        certain = without_penumbrae(statistic.labels.view(np.bool_), difference, collinearity, _PENUMBRA, _CORE)
        certain |= shades == BRIGHT
        unsure = seen & ~certain
        certain |= beyond_shadows(unsure, certain, shades == DARK, self._penumbra, _FAINT_ENCLOSURE)
        unsure &= ~certain
        foreground = certain | enclosed(unsure, certain, _ENCLOSURE)
        foreground |= unsure & closed(foreground, self._bridge)
        person = joined(
            foreground,
            seen,
            collinearity,
            mosaic.corners[:, 0],
            seed=_SEED,
            least=self._speck,
            hole=self._hole,
            reach=_GAP * self._height,
            width=max(round(_LIMB * self._height), 1),
        )
        return person, (seen.view(np.uint8) > person).view(np.uint8)

    def _outline(
        self, images: Images, gains: NDArray[np.float32], decision: Images, mosaic: Mosaic, masks: Images
    ) -> None:
        """Draw the outlines in the full pictures, into ``masks``: the rim goes where it shows the scene."""
        tight = mosaic.tightened(decision, _RIM_LAYERS // _REDUCTION + 1, _RIM_LAYERS)
        small = np.zeros(tight.shape, np.uint8)
        for c in range(len(images)):
            tight.part(small, c)[...] = mosaic.part_of(decision, c, tight.boxes[c])
        full = tight.enlarged(_REDUCTION)
        contrast = np.zeros(full.shape, np.uint8)
        for c, gain in enumerate(gains):
            if full.boxes[c].any():
                scene = cv2.transform(full.crop(self.plates[c], c), np.diag(gain))
                blue, green, red = cv2.split(cv2.absdiff(full.crop(images[c], c), scene, dst=scene))
                cv2.max(cv2.max(blue, green, dst=blue), red, dst=full.part(contrast, c))
        person = trim_rim(doubled(small), contrast, _RIM, _RIM_LAYERS)
        clean = clean_by_area(person, self._speck * _REDUCTION**2, self._hole * _REDUCTION**2)
        for c in range(len(images)):
            full.crop(masks[c], c)[...] = full.part(clean, c)


def _window_sums(images: Images) -> NDArray[np.uint16]:
    """(C, N, 3) sums over 3×3 pixels of pictures (C, h, w, 3), here and there."""
    last = images.shape[1] - 2, images.shape[2] - 2
    parts = [images[:, y : last[0] + y : _BRIGHT_STEP, x : last[1] + x : _BRIGHT_STEP] for y, x in np.ndindex(3, 3)]
    total = parts[0].astype(np.uint16)
    for part in parts[1:]:
        total += part
    return total.reshape(len(images), -1, 3)
