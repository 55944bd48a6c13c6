"""Cameras that show nothing, stand still while the others see movement, or have been moved or zoomed; masks of other
images."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import PERSON
from tk.model.masks.image_shift import ImageShift, ShiftState
from tk.model.reduced_images import every
from tk.model.stateful import Stateful

# Rows of an image that are compared, approximately.
_ROWS = 64
# An image is blank if the standard deviation of its grey levels is below this: above the sensor's noise.
_BLANK_LEVELS = 3.0
# Two images are the same if at most this share of the pixels differs by more than this many levels, which covers what
# the coding of a still video changes.
_SAME_LEVELS, _SAME_SHARE = 6, 0.001
# Change of another camera's mask, as a share of its area, that shows movement.
_MOVED = 0.15

# A camera has been moved if its image has, by more than this share of its longer side: 0.3° with a lens of 60°, or a
# zoom by 1.4 %. The images of the correct cameras of fifteen captures seem to move by 0.15 %, because of shadows.
MOST_SHIFT = 0.005

# Something moves in the images of a camera if at least this share of the pixels differs by more than this many levels:
# the first is a quarter of a small person, the second more than the noise of 24 frames.
_MOVED_LEVELS, _MOVED_SHARE = 40, 0.005
# Least probability that an image changes more where its mask changes than beside the masks.
_FOLLOWS = 0.87

Sampled = tuple[NDArray[np.int16], NDArray[np.bool_], NDArray[np.bool_]]
"""Images (C, h, w, 3) and masks (C, h, w) of a frame, every some pixels, and which of these each camera has."""

MOVED = "moved"  #: the fault of a camera that has been moved or zoomed since the first frame


@dataclass(frozen=True)
class HealthState:
    """What is known of C cameras.

    Attributes:
        references: (C, h, w) grey, of the reference frame of each camera; None before the first frame.
        masks: (C, C, h, w) at the reference frame of camera c, those of all.
        shift: of the images.
    """

    references: NDArray[np.uint8] | None
    masks: NDArray[np.bool_] | None
    shift: ShiftState


class _Look(NamedTuple):
    """What is seen of a frame.

    Attributes:
        shown, small: (C, h, w) every some pixels of the images, and of the masks.
        inside: (C, h, w) which of them a camera has, if some cameras are smaller.
        moved: see :class:`ImageHealth`.
        given: whether there are images.
    """

    shown: NDArray[np.uint8]
    small: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    moved: NDArray[np.float64]
    given: bool


class ImageHealth(Stateful[HealthState]):
    """Checks the images of consecutive frames.

    An unchanged image is normal while nobody moves. So each camera keeps a reference: its last image that differed from
    the one before, with the masks of all cameras in that frame. The camera is frozen if its image still equals the
    reference, at least half of the other images have changed since, and most of these show that the person has moved.

    The still parts of the image of a camera that stands firm stay where they are, see
    :class:`~tk.model.masks.image_shift.ImageShift`.

    Args:
        sizes: (C, 2) width and height of each camera's mask; None: all are as large as the stack of masks.

    Attributes:
        moved: (C,) by which share of its longer side each image has moved since the first frame; NaN if it is unknown.
            None before the first frame.
    """

    State = HealthState

    def __init__(self, sizes: NDArray[np.integer] | None = None) -> None:
        self._sizes = sizes
        self._references: NDArray[np.uint8] | None = None
        self._masks: NDArray[np.bool_] | None = None
        self._shift = ImageShift(sizes)
        self.moved: NDArray[np.float64] | None = None

    def look(
        self, images: NDArray[np.uint8], masks: NDArray[np.uint8], doubtful: NDArray[np.bool_] | None = None
    ) -> list[str | None]:
        """Return for each camera its fault, one of :data:`IMAGE_FAULTS`, or None.

        Args:
            images: (C, h, w, 3) BGR, of the masks' size or reduced; if it is empty, frozen cameras are found from the
                masks alone.
            masks: (C, H, W), 128 and more where the person is.
            doubtful: (C,) cameras whose mask may not show the person; None: none.
        """
        C = len(masks)
        small = _thinned(masks, masks) >= PERSON
        given = images.size > 0
        # the green channel suffices
        shown = _thinned(images, masks)[..., 1].copy() if given else small * np.uint8(255)
        self.moved = moved = self._shift.look(images, masks, doubtful) if given else np.full(C, np.nan)
        look = _Look(shown, small, _inside(self._sizes, masks), moved, given)
        faulty = {name: measure(self, look) for name, (_, measure) in IMAGE_FAULTS.items()}
        return [next((name for name, cameras in faulty.items() if cameras[c]), None) for c in range(C)]

    def _blank(self, look: _Look) -> NDArray[np.bool_]:
        """Return (C,) cameras whose image has one colour."""
        deviation = [shown[inside].std() for shown, inside in zip(look.shown, look.inside, strict=True)]
        return look.given & (np.array(deviation) < _BLANK_LEVELS)

    def _has_moved(self, look: _Look) -> NDArray[np.bool_]:
        """Return (C,) cameras whose image is elsewhere than in the first frame."""
        return np.asarray(look.moved > MOST_SHIFT)

    def _frozen(self, look: _Look) -> NDArray[np.bool_]:
        """Return (C,) cameras whose image stands still while the others see movement; take the others for
        references."""
        C, found = len(look.shown), np.zeros(len(look.shown), np.bool_)
        if self._references is None or self._masks is None or self._references.shape != look.shown.shape:
            self._references, self._masks = look.shown, np.repeat(look.small[None], C, axis=0)
            return found
        differs = cv2.absdiff(look.shown, self._references) > _SAME_LEVELS
        still = differs.sum(axis=(1, 2)) <= _SAME_SHARE * look.inside.sum(axis=(1, 2))
        for c in range(C):
            if not still[c]:
                self._references[c], self._masks[c] = look.shown[c], look.small
            elif look.small[c].any():  # a mask without anybody cannot move
                now = [_changed(self._masks[c][k], look.small[k]) > _MOVED for k in range(C) if k != c and not still[k]]
                found[c] = 2 * len(now) >= C - 1 and np.mean(now) > 0.5
        return found


#: faults of an image by their names, the first that applies counts: text for the user, and the measure, which returns
#: (C,) the cameras that have it
IMAGE_FAULTS: Mapping[str, tuple[str, Callable[[ImageHealth, _Look], NDArray[np.bool_]]]] = {
    "blank": ("shows nothing", ImageHealth._blank),
    MOVED: ("has been moved or zoomed since the first frame", ImageHealth._has_moved),
    "frozen": ("stands still", ImageHealth._frozen),
}


def sampled(images: NDArray[np.uint8], masks: NDArray[np.uint8], sizes: NDArray[np.integer] | None = None) -> Sampled:
    """Return what :func:`mask_contradiction` needs of a frame: images (C, h, w, 3), of the masks' size or reduced, and
    masks (C, H, W); ``sizes`` as of :class:`ImageHealth`."""
    return _thinned(images, masks).astype(np.int16), _thinned(masks, masks) >= PERSON, _inside(sizes, masks)


def _thinned(images: NDArray[np.uint8], masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return images (C, h, w, ...) at every some pixels of the masks (C, H, W)."""
    return every(images, masks.shape[1:], max(1, masks.shape[1] // _ROWS))


def _inside(sizes: NDArray[np.integer] | None, masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return (C, h, w) which of the pixels of :func:`_thinned` belong to cameras of these sizes (C, 2)."""
    C, height, width = masks.shape
    if sizes is None:
        sizes = np.full((C, 2), (width, height))
    step = max(1, height // _ROWS)
    y, x = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
    return np.asarray((y[:, None] < sizes[:, 1, None, None]) & (x < sizes[:, 0, None, None]))


def mask_contradiction(pairs: Iterable[tuple[Sampled, Sampled]]) -> str | None:
    """Return why masks do not belong to their images, or None if nothing contradicts it.

    An outline moves with the person, so an image changes where its mask changes. The measure is the probability that it
    changes more there than beside the masks (the statistic of Mann and Whitney), in the median over the cameras.

    Args:
        pairs: of frames about a third of a second apart; empty images and empty masks are not compared.
    """
    follows, stands = defaultdict[int, list[NDArray[np.float64]]](list), True  # by camera
    moved, share = np.zeros(0, bool), np.zeros(0)  # (C, h, w) pixels whose image changes, and (C,) their share
    for (image, mask, inside), (later_image, later_mask, _) in pairs:
        if not image.size:
            continue
        differs = np.abs(image - later_image).max(axis=3)
        moved = differs > _MOVED_LEVELS if not moved.size else moved | (differs > _MOVED_LEVELS)
        share = moved.sum(axis=(1, 2)) / inside.sum(axis=(1, 2))
        stands &= bool((mask == later_mask).all())
        for c, (levels, before, now) in enumerate(zip(differs, mask, later_mask, strict=True)):
            near = cv2.dilate(levels, np.ones((3, 3), np.uint8))  # an outline may lie some pixels off
            beside = np.sort(near[inside[c] & ~(before | now)])
            if len(beside) and before.any() and now.any() and _changed(before, now) > _MOVED:
                changed = near[before != now]
                rank = np.searchsorted(beside, changed, "left") + np.searchsorted(beside, changed, "right")
                follows[c].append(rank / (2 * len(beside)))
    if len(share) and stands and np.median(share) > _MOVED_SHARE:
        return "the masks never change, but the images do: the masks do not show who moves"
    if follows and np.median([np.concatenate(ranks).mean() for ranks in follows.values()]) < _FOLLOWS:
        return "the images do not change where the masks change: the masks belong to other frames or to other videos"
    return None


def _changed(before: NDArray[np.bool_], now: NDArray[np.bool_]) -> float:
    """Return the share of a mask that has changed."""
    return float(np.count_nonzero(before != now)) / max(int(before.sum()), int(now.sum()), 1)


def described(first: int, last: int, count: int) -> str:
    """Return a text like "frame 12", "frames 30 to 74", "12 of the frames 30 to 74"."""
    if count == 1:
        return f"frame {first}"
    if last - first + 1 == count:
        return f"frames {first} to {last}"
    return f"{count} of the frames {first} to {last}"
