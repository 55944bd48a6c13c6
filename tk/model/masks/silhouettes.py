"""Silhouettes of one frame in several views: cleaning, scales, and their agreement with a cone body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS, PERSON
from tk.kernels.projection import pack_cameras
from tk.kernels.silhouette import Silhouettes
from tk.model.cameras.camera import Rig
from tk.model.cues.cue import Measured, joined
from tk.model.masks.regions import clean_by_area

Float = NDArray[np.float64]
Masks = NDArray[np.uint8]


# A mask's connected parts smaller than this share of the largest one are removed, and holes smaller than this share of
# it are filled; gaps between limbs are larger. The paper takes its masks as they are.
SPECK_SHARE, HOLE_SHARE = 0.05, 0.004


def clean(mask: Masks) -> Masks:
    """Return a mask (H, W) without specks and small holes, 0 or 255."""
    return clean_by_area(mask >= PERSON, SPECK_SHARE, HOLE_SHARE, relative=True)


@dataclass(frozen=True)
class Pyramid:
    """What the images of a frame show of a person: masks at several scales, a factor of two apart, and for the cues."""

    # (V, H, W) uint8 for each scale, or (F V, H, W) of F frames; scale 0 is the full image. Pixels of other people are
    # `tk.kernels.mask_values.OTHERS`.
    masks: tuple[Masks, ...]
    sizes: tuple[NDArray[np.int32], ...]  # (V, 2) for each scale, width and height of each camera's image
    measured: Measured = field(default_factory=dict)  # of the frame, or of F frames

    @staticmethod
    def of_all(frames: Sequence[Pyramid], scale: int) -> Pyramid:
        """Join one scale of several frames; the others are empty."""
        none = np.zeros((0, 0, 0), np.uint8)
        masks = _one_after_the_other([frame.masks[scale] for frame in frames])
        measured = joined([frame.measured for frame in frames])
        return Pyramid((none,) * scale + (masks,), frames[0].sizes[: scale + 1], measured)


def _one_after_the_other(masks: Sequence[Masks]) -> Masks:
    """Return masks (V, H, W) of F frames as (F V, H, W): without a copy if they already lie so in an array."""
    whole, first, places = masks[0].base, masks[0], [each.ctypes.data for each in masks]
    follow = places == list(range(places[0], places[0] + len(masks) * first.nbytes, first.nbytes))
    if whole is None or not follow or any(each.base is not whole for each in masks):
        return np.concatenate(masks)
    begin = (places[0] - whole.ctypes.data) // first[0].nbytes
    return np.asarray(whole.reshape(-1, *first.shape[1:])[begin : begin + len(masks) * len(first)])


class Views:
    """The cameras of a rig, packed for the kernels.

    Args:
        rig: the cameras.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.cameras = pack_cameras(rig)
        self._cameras32 = self.cameras.astype(np.float32)
        self.sizes = rig.sizes.astype(np.int32)

    def pyramid(self, masks: Masks, scales: int, cleaning: bool, measured: Measured | None = None) -> Pyramid:
        """Return the scales of masks (V, H, W), cleaned if ``cleaning``, and what was measured in the frame."""
        measured = measured or {}
        if scales == 1 and not cleaning:
            return Pyramid((masks,), (self.sizes,), measured)
        # everything happens inside boxes around the people
        crops = [(slice(y, y + h), slice(x, x + w)) for x, y, w, h in map(cv2.boundingRect, masks)]
        shared = any((mask[crop] == OTHERS).any() for mask, crop in zip(masks, crops, strict=True))
        if cleaning:
            cleaned = np.zeros_like(masks)
            for out, mask, crop in zip(cleaned, masks, crops, strict=True):
                if (part := mask[crop]).size:
                    out[crop] = kept = clean(part)
                    if shared:  # a region that others cut off may be small: it is no evidence, not background
                        np.copyto(out[crop], OTHERS, where=(part == OTHERS) | ((part >= PERSON) & (kept == 0)))
            masks = cleaned
        V, H, W = masks.shape
        levels = [masks, *(np.zeros((V, -(-H // 2**k), -(-W // 2**k)), np.uint8) for k in range(1, scales))]
        sizes = [-(-self.sizes // 2**k) for k in range(scales)]
        for v, crop in enumerate(crops):
            if masks[v][crop].size:
                _halve([level[v] for level in levels], crop, shared)
        return Pyramid(tuple(levels), tuple(sizes), measured)

    def at(self, pyramid: Pyramid, scale: int) -> Silhouettes:
        """Return a scale of a pyramid, by its index, as the kernels take it."""
        return Silhouettes(self._cameras32, pyramid.sizes[scale], pyramid.masks[scale], 2.0**scale)


def _halve(levels: Sequence[Masks], crop: tuple[slice, slice], shared: bool) -> None:
    """Fill the coarser ones of a mask's scales, (H, W) and zero before, from the crop that contains the mask.

    ``shared``: there are pixels of other people; each pixel that contains one of them gets their value.
    """
    whole, step = levels[0], 2 ** (len(levels) - 1)
    (top, bottom), (left, right) = ((s.start // step * step, -(-s.stop // step) * step) for s in crop)
    part = whole[top:bottom, left:right]
    below, beside = bottom - top - part.shape[0], right - left - part.shape[1]
    if below or beside:
        part = np.asarray(cv2.copyMakeBorder(part, 0, below, 0, beside, cv2.BORDER_CONSTANT), np.uint8)
    for level in levels[1:]:
        top, left = top // 2, left // 2
        others = _halved(np.uint8(255) * (part == OTHERS)) > 0 if shared else None
        part = _halved(part)
        if others is not None:
            np.copyto(part, OTHERS, where=others)
        place = level[top : top + part.shape[0], left : left + part.shape[1]]
        place[...] = part[: place.shape[0], : place.shape[1]]


def _halved(part: Masks) -> Masks:
    """Return the means (h/2, w/2) of the squares of four pixels."""
    return np.asarray(cv2.resize(part, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
