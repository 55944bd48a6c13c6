"""Masks from a segmenter that looks at one picture: where in each picture it is to look, and whose mask is kept.

A network sees little of a small person in a large picture, and takes whom it likes where there are several. The
cameras are calibrated, so they tell it: the subject is who stands in the working volume
(:mod:`tk.model.masks.subject`).

1. Where the segmenter finds people, those of all pictures are brought together, and the one whom most cameras see in
   the volume is the subject. Each camera looks at a square about him or her, also one whose own detector has found
   nobody: from above, say. A segmenter that finds nobody is shown what a picture holds of the volume.
2. A camera's square and mask are held against the visual hull of the others' masks. Where the square does not hold the
   hull or is much too large, or the mask shows somebody else, the camera looks again, at the hull.
3. What is far from the hull of all masks is somebody else.

Nothing passes from frame to frame: a run that is resumed sees the same masks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume
from tk.model.masks.subject import CoarseHull, Patch, Sighting, locate, volume_patch
from tk.segmenters import Finder, Segmenter, probabilities

Images = NDArray[np.uint8]

#: sides of the square about the ball that holds the body, and about the hull: MediaPipe's 1.25 and a little
_BALL_MARGIN, _HULL_MARGIN = 1.25, 1.35
#: a mask with less than this share of the others' hull is of somebody else; such a hull is up to twice as large as the
#: person is (measured: a right mask has 0.4 of it and more)
_LEAST_SHARE = 0.3
#: what is less probable than one half is in doubt from here on
_DOUBT = 0.1
#: a square that is larger than the hull's by this factor wastes the network's pixels
_MUCH = 1.6


class SubjectMasks:
    """Masks of the subject in all pictures of a rig."""

    def __init__(self, segmenter: Segmenter, name: str, rig: Rig, volume: Volume) -> None:
        self._segmenter, self._name = segmenter, name
        self._rig, self._volume = rig, volume
        self._hull = CoarseHull(rig, volume)
        self._whole = [volume_patch(camera, volume) for camera in rig]

    def segment(self, images: Images) -> Images:
        """Pictures (C, H, W, 3) uint8 BGR to masks (C, H, W) uint8, 0 or 255.

        Raises:
            ConfigError: the segmenter gives no probabilities.
        """
        return self.label(images)[0]

    def label(self, images: Images) -> tuple[Images, NDArray[np.bool_]]:
        """The masks, and where they are 0 for what may be the person all the same: (C, H, W) bool."""
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
            if missed or patch.side > _MUCH * better.side or not patch.holds(expected):
                self._look(images, c, better, masks, uncertain)
        subject = self._hull.subject(masks)
        for c in range(len(self._rig)):
            masks[c] = self._hull.only(subject, c, masks[c])
        return masks, uncertain

    def _patches(self, images: Images) -> list[Patch]:
        if not isinstance(self._segmenter, Finder):
            return self._whole
        sightings = []
        for c, whole in enumerate(self._whole):
            found = self._segmenter.find(whole.cut(self._picture(images, c)))
            x, y = (value - (whole.side - 1) / 2 for value in whole.center)  # these are not turned
            moved = [Sighting((s.center[0] + x, s.center[1] + y), (s.top[0] + x, s.top[1] + y), s.score) for s in found]
            sightings.append([s for s in moved if np.isfinite(s.radius)])
        subject = locate(self._rig, self._volume, sightings)
        if subject is None:
            return self._whole
        patches = [subject.patch(camera, _BALL_MARGIN) for camera in self._rig]
        return [patch or whole for patch, whole in zip(patches, self._whole, strict=True)]

    def _look(self, images: Images, c: int, patch: Patch, masks: Images, uncertain: NDArray[np.bool_]) -> None:
        """Put what the segmenter says about a square of a picture into its mask, and what it is not sure of."""
        picture = self._picture(images, c)
        found = patch.paste(probabilities(self._segmenter, self._name, patch.cut(picture)), picture.shape[:2])
        masks[c, : picture.shape[0], : picture.shape[1]] = np.where(found > 0.5, 255, 0)
        uncertain[c, : picture.shape[0], : picture.shape[1]] = (found > _DOUBT) & (found <= 0.5)

    def _picture(self, images: Images, c: int) -> Images:
        """(h, w, 3) without what the packing has added."""
        return images[c, : self._rig[c].height, : self._rig[c].width]
