"""The other segmentation: OpenCV's mixture of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.model.masks.background import Images, check_clips
from tk.model.masks.foreground import HOLE_AREA, SPECK_AREA
from tk.model.masks.regions import clean_by_area
from tk.settings import ForegroundSettings


class Mog2Foreground:
    """OpenCV's mixture of Gaussians (MOG2) a pixel, learned from the clips and then frozen; its shadows are dropped."""

    def __init__(
        self, models: Sequence[cv2.BackgroundSubtractorMOG2], sizes: NDArray[np.int_], config: ForegroundSettings
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
        config: ForegroundSettings | None = None,
    ) -> Mog2Foreground:
        """Learn the empty scene; arguments and errors as :meth:`CollinearityForeground.learn`.

        Of ``config`` only the areas of specks and holes matter; OpenCV's defaults hold otherwise. A plate (T = 1)
        leaves each pixel with OpenCV's initial variance.
        """
        sizes = np.asarray(sizes, dtype=int).reshape(-1, 2)
        check_clips(clips, frame_shape, sizes)
        models = []
        for clip in clips:
            model = cv2.createBackgroundSubtractorMOG2(history=max(len(clip), 1), detectShadows=True)
            for frame in clip:
                model.apply(np.ascontiguousarray(frame))
            models.append(model)
        return cls(models, sizes, config or ForegroundSettings())

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255."""
        return self.label(images)[0]

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """Masks (C, H, W) uint8, and where OpenCV says shadow (C, H, W) bool."""
        masks = np.zeros(images.shape[:3], np.uint8)
        uncertain = np.zeros(images.shape[:3], np.bool_)
        for c, (model, (width, height)) in enumerate(zip(self._models, self.sizes, strict=True)):
            labels = model.apply(np.ascontiguousarray(images[c, :height, :width]), learningRate=0)
            area = width * height
            masks[c, :height, :width] = clean_by_area(labels == 255, SPECK_AREA * area, HOLE_AREA * area)
            shadow = labels == model.getShadowValue()
            uncertain[c, :height, :width] = shadow & (masks[c, :height, :width] == 0)
        return masks, uncertain
