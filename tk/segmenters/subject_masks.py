"""Masks of the subject in all cameras, from a segmenter that works on single images.

A network is inaccurate for a small person in a large image, and may segment any person if there are several. The
calibration solves both: the subject is the person in the working volume (:mod:`tk.model.masks.subject`).

1. If the segmenter detects people, the detections of all cameras are combined, and the person in the volume with most
   cameras is the subject. In every camera, also without a detection (from above, for example), the segmenter gets the
   square around the subject. Without any detection it gets the part of the image that shows the volume.
2. Each camera's square and mask are compared with the visual hull of the other cameras' masks. If the square does not
   contain the hull or is much too large, or the mask shows another person, the segmenter gets the square around the
   hull.
3. Parts of masks far from the hull of all masks belong to other people and are removed.

No state is kept between frames, so a resumed run sees the same masks.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume
from tk.model.hull.coarse import CoarseHull
from tk.model.masks.subject import Patch, Sighting, locate, volume_patch
from tk.segmenters import Finder, Segmenter, probabilities

Images = NDArray[np.uint8]

#: side of the square, relative to the ball around the body (MediaPipe's 1.25) and to the hull (slightly more)
_BALL_MARGIN, _HULL_MARGIN = 1.25, 1.35
#: a mask that covers a smaller share of the others' hull shows another person. The hull is up to twice as large as the
#: person; correct masks cover 0.4 and more (measured).
_LEAST_SHARE = 0.3
#: pixels with a probability from here to 0.5 are uncertain; chosen on recordings with people, sensitivity not measured
_UNCERTAIN = 0.1
#: a square larger than the hull's by this factor wastes the network's pixels; sensitivity not measured
_TOO_LARGE = 1.6


class SubjectMasks:
    """Segments the subject in the images of a rig."""

    def __init__(self, segmenter: Segmenter, name: str, rig: Rig, volume: Volume) -> None:
        self._segmenter, self._name = segmenter, name
        self._rig, self._volume = rig, volume
        self._hull = CoarseHull(rig, volume)
        self._whole = [volume_patch(camera, volume) for camera in rig]

    def segment(self, images: Images) -> Images:
        """Return the masks (C, H, W) uint8, 0 or 255, of images (C, H, W, 3) uint8 BGR.

        Raises:
            ConfigError: the segmenter does not return probabilities.
        """
        return self.label(images)[0]

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """Return the masks, and their uncertain pixels (C, H, W) bool, where the mask is 0."""
        masks = np.zeros(images.shape[:3], np.uint8)
        uncertain = np.zeros(images.shape[:3], np.bool_)
        patches = self._patches(images)
        for c, patch in enumerate(patches):
            self._look(images, c, patch, masks, uncertain)
        for c, patch in enumerate(patches):
            others = self._hull.subject(masks, but=c)
            expected = self._hull.points(others, c)
            if len(expected) == 0:
                continue
            better = Patch.about(expected, _HULL_MARGIN, patch.angle)
            missed = self._hull.share(others, c, masks[c]) < _LEAST_SHARE
            if missed or patch.side > _TOO_LARGE * better.side or not patch.holds(expected):
                self._look(images, c, better, masks, uncertain)
        subject = self._hull.subject(masks)
        for c in range(len(self._rig)):
            masks[c] = self._hull.only(subject, c, masks[c])
        return masks, uncertain

    def only_subject(self, masks: Images) -> Images:
        """Return masks (C, H, W) without parts far from the hull of all masks; other people, for example."""
        if all(cv2.connectedComponents(mask)[0] <= 2 for mask in masks):  # the scene and one part
            return masks
        subject = self._hull.subject(masks)
        return np.stack([self._hull.only(subject, c, mask) for c, mask in enumerate(masks)])

    def _patches(self, images: Images) -> list[Patch]:
        if not isinstance(self._segmenter, Finder):
            return self._whole
        sightings = []
        for c, whole in enumerate(self._whole):
            found = self._segmenter.find(whole.cut(self._picture(images, c)))
            x, y = (value - (whole.side - 1) / 2 for value in whole.center)  # whole patches are not rotated
            moved = [Sighting((s.center[0] + x, s.center[1] + y), (s.top[0] + x, s.top[1] + y), s.score) for s in found]
            sightings.append([s for s in moved if np.isfinite(s.radius)])
        subject = locate(self._rig, self._volume, sightings)
        if subject is None:
            return self._whole
        patches = [subject.patch(camera, _BALL_MARGIN) for camera in self._rig]
        return [patch or whole for patch, whole in zip(patches, self._whole, strict=True)]

    def _look(self, images: Images, c: int, patch: Patch, masks: Images, uncertain: NDArray[np.bool_]) -> None:
        """Segment a square of an image into its mask and its uncertain pixels."""
        picture = self._picture(images, c)
        found = patch.paste(probabilities(self._segmenter, self._name, patch.cut(picture)), picture.shape[:2])
        masks[c, : picture.shape[0], : picture.shape[1]] = np.where(found > 0.5, 255, 0)
        uncertain[c, : picture.shape[0], : picture.shape[1]] = (found > _UNCERTAIN) & (found <= 0.5)

    def _picture(self, images: Images, c: int) -> Images:
        """Return the image (h, w, 3) of a camera without padding."""
        return images[c, : self._rig[c].height, : self._rig[c].width]
