"""Learn the empty scene of a recording without one, from images whose masks a segmenter has made.

A pixel's scene is known if it was away from the person in one image, or beside the person in two images that agree.
Nearer to the person the segmenter's outline is not trusted. Unknown pixels that the masks of nearly all images cover
are the person's, a trunk that hardly moves for example; other unknown pixels are uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.kernels.scene import learn_scene
from tk.model.masks.background import Images, flicker

Bool = NDArray[np.bool_]

# Pixels within the first share of the person's height around a mask may show the person and are not used; within the
# second share they may be a limb that the segmenter has missed, or a contact shadow.
_NEAR, _MARGIN = 0.007, 0.06
_BESIDE, _AWAY = 1, 2  # weight of a sample in the margin, and beyond it
# Samples agree if no channel differs by more grey levels: three standard deviations of a difference at a noise of 2.3.
_TOLERANCE = 10
# Support of a group that is brighter than the largest group, which then is a shadow: two samples.
_LEAST_LIT = 3
# Least factor of a shadow, and largest difference between the factors of its channels.
_DARKEST, _SPREAD = 0.4, 0.12


@dataclass(frozen=True)
class LearnedScene:
    """The empty scene of all cameras, as far as it is known.

    Attributes:
        plates: (C, H, W, 3) uint8, 0 where it is unknown.
        unknown: (C, H, W), pixels whose scene is unknown.
    """

    plates: Images
    unknown: Bool

    @staticmethod
    def learn(images: Sequence[Images], masks: Sequence[Images], uncertain: Sequence[Bool]) -> LearnedScene:
        """Learn from K frame sets: images (C, H, W, 3), masks (C, H, W) and uncertain pixels (C, H, W)."""
        shape = masks[0].shape
        plates, unknown = np.zeros((*shape, 3), np.uint8), np.ones(shape, np.bool_)
        for c in range(shape[0]):
            weights = np.stack([_weights(m[c], u[c]) for m, u in zip(masks, uncertain, strict=True)])
            clip = np.stack([each[c] for each in images])
            for image, gain in zip(clip, flicker(clip), strict=True):
                cv2.transform(image, np.diag(1 / gain), dst=image)
            plates[c], support = learn_scene(
                clip, weights, tolerance=_TOLERANCE, least=_LEAST_LIT, darkest=_DARKEST, spread=_SPREAD
            )
            unknown[c] = support < _AWAY
        plates[unknown] = 0
        return LearnedScene(plates, unknown)


def _weights(mask: Images, uncertain: Bool) -> Images:
    """Return the weight (H, W) of a sample's pixels."""
    person = ((mask > 0) | uncertain).view(np.uint8)
    near, margin = (round(share * cv2.boundingRect(mask)[3]) for share in (_NEAR, _MARGIN))
    weights = np.full(mask.shape, _AWAY, np.uint8)
    x, y, w, h = cv2.boundingRect(person)
    box = slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin)
    beside, away = (_dilated(person[box], radius) == 0 for radius in (near, margin))
    weights[box] = np.where(away, _AWAY, np.where(beside, _BESIDE, 0))
    return weights


def _dilated(mask: Images, radius: int) -> ArrayLike:
    if radius == 0:
        return mask
    return cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)))
