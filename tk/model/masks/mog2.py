"""Segmentation by OpenCV's mixture of Gaussians (MOG2), the alternative to the collinearity test."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.model.masks.background import Images, check_clips
from tk.model.masks.foreground import AREA_MIN
from tk.model.masks.regions import clean_by_area


class Mog2Foreground:
    """One mixture of Gaussians per pixel, learned from the empty scene and then fixed. Shadows are background."""

    def __init__(self, models: Sequence[cv2.BackgroundSubtractorMOG2], sizes: NDArray[np.int_]) -> None:
        self._sizes = sizes
        self._models = tuple(models)

    @classmethod
    def learn(cls, clips: Sequence[Images], frame_shape: tuple[int, int], sizes: ArrayLike) -> Mog2Foreground:
        """Learn the empty scene with OpenCV's default settings; see :meth:`CollinearityForeground.learn`.

        With a single image (T = 1) each pixel has OpenCV's initial variance.
        """
        sizes = np.asarray(sizes, dtype=int).reshape(-1, 2)
        check_clips(clips, frame_shape, sizes)
        models = []
        for clip in clips:
            model = cv2.createBackgroundSubtractorMOG2(history=max(len(clip), 1), detectShadows=True)
            for frame in clip:
                model.apply(np.ascontiguousarray(frame))
            models.append(model)
        return cls(models, sizes)

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """Segment images; see :meth:`Foreground.label`. Pixels are uncertain where OpenCV finds a shadow."""
        masks = np.zeros(images.shape[:3], np.uint8)
        uncertain = np.zeros(images.shape[:3], np.bool_)
        for c, (model, (width, height)) in enumerate(zip(self._models, self._sizes, strict=True)):
            labels = model.apply(np.ascontiguousarray(images[c, :height, :width]), learningRate=0)
            area_min = AREA_MIN * width * height
            masks[c, :height, :width] = clean_by_area(labels == 255, area_min, area_min)
            shadow = labels == model.getShadowValue()
            uncertain[c, :height, :width] = shadow & (masks[c, :height, :width] == 0)
        return masks, uncertain
