"""Masks in the forms that programs write: white on black, one number for the person, or an alpha channel.

Labels of several objects, colours, and photographs of the cut-out person without an alpha channel are refused: they do
not say which pixels show people.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import VideoError
from tk.kernels.mask_values import PERSON

Image = NDArray[np.uint8]

#: a picture whose part that is not black has a smaller share is not judged: the person is hardly in view
_LEAST_SHARE = 0.002
#: channels that differ more are colours; video coding and JPEG colour black and white by less
_COLOR = 48
#: share of the pixels that are not black which may be coloured
_COLORED = 0.02
#: a photograph has more values, and in the middle of the person their 10th and 90th percentiles are farther apart. A
#: mask with soft edges is white there.
_PHOTO_VALUES, _PHOTO_RANGE = 32, 32
#: the middle of the person: this share of the largest distance from the edge, and more
_MIDDLE = 0.6
#: a mask that is white along more of its edges, and not everywhere, is inverted
_INVERTED = 0.9
#: values up to this one are black, in the last two tests
_BLACK = 8


class MaskForm:
    """Converts the pictures of one mask clip, in order.

    The first pictures that show somebody decide about the form of the others: dark pixels are the person only in a clip
    without white ones.
    """

    def __init__(self) -> None:
        self._white = False  # a picture had white pixels on black
        self._person: int | None = None  # the one value that is the person

    def convert(self, picture: NDArray[Any], path: Path) -> Image:
        """Return the mask (H, W), 0 and 255, of a picture as it was decoded: grey or BGR, 8 or 16 bits, or BGRA.

        Raises:
            VideoError: the picture does not say where people are.
        """
        decoded = picture
        if picture.ndim == 3 and picture.shape[2] == 4:
            alpha = picture[..., 3]
            picture = alpha if alpha.min() < alpha.max() or not alpha.any() else picture[..., :3]
        soft = picture.ndim == 2 and decoded.ndim == 3  # an alpha channel is no photograph
        if picture.ndim == 3:
            if not self._white and _is_colored(picture):
                return self._labels(_packed(picture), decoded, path)
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        if self._white:
            return _binary(_to_8_bits(picture))
        if picture.max() == picture.min() < PERSON:
            return np.zeros(picture.shape, np.uint8)
        present = np.flatnonzero(np.bincount(picture.ravel()))
        grey = _to_8_bits(picture)
        if len(present) == 2 and present[0] == 0 and grey.max() < PERSON:
            return self._labels(picture, decoded, path)
        if np.count_nonzero(grey > (_BLACK if grey.max() >= PERSON else 0)) < _LEAST_SHARE * grey.size:
            return _binary(grey)
        if grey.max() < PERSON or (not soft and len(present) > _PHOTO_VALUES and _is_photograph(grey)):
            raise _not_a_mask(decoded, path)
        mask = _binary(grey)
        edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
        if edge.mean() > _INVERTED * 255 and not mask.all():
            raise VideoError(
                f"{path}: is white along its edges: people must be white (255), the rest black (0); invert the masks"
            )
        self._white = True
        return mask

    def _labels(self, labels: NDArray[Any], decoded: NDArray[Any], path: Path) -> Image:
        """Return the mask of labels (H, W) of one object, which is the same in all pictures, on 0."""
        person = labels > 0
        value = int(labels.max())
        if self._person not in (None, value) or person.all() or not (labels[person] == value).all():
            raise _not_a_mask(decoded, path)
        self._person = value
        return person.astype(np.uint8) * np.uint8(255)


def without_palette(picture: NDArray[Any], coded: bytes) -> NDArray[Any]:
    """Return a picture (H, W, C) decoded from a PNG with a palette of colours, in which entry 0 is made black."""
    place = coded.find(b"PLTE")
    is_palette = coded.startswith(b"\x89PNG") and len(coded) > 25 and coded[25] == 3 and place > 0
    if not is_palette or picture.ndim != 3 or not _is_colored(picture[..., :3]):
        return picture
    background = np.frombuffer(coded, np.uint8, 3, place + 4)[::-1]
    picture = picture.copy()
    picture[(picture[..., :3] == background).all(axis=2), :3] = 0
    return picture


def _is_colored(picture: NDArray[Any]) -> bool:
    high, low = picture.max(axis=2), picture.min(axis=2)
    scale = 257 if picture.dtype == np.uint16 else 1
    colored = np.count_nonzero(high - low > _COLOR * scale)
    shown = np.count_nonzero(high > _BLACK * scale)
    return bool(colored > max(_COLORED * shown, _LEAST_SHARE * high.size))


def _is_photograph(grey: Image) -> bool:
    from_edge = cv2.distanceTransform((grey > _BLACK).astype(np.uint8), cv2.DIST_L2, 3)
    low, high = np.percentile(grey[from_edge >= _MIDDLE * from_edge.max()], [10, 90])
    return bool(low < PERSON or high - low > _PHOTO_RANGE)


def _packed(picture: NDArray[Any]) -> NDArray[np.int64]:
    """Return one number for each color (H, W), 0 for black."""
    blue, green, red = (picture[..., c].astype(np.int64) for c in range(3))
    return (blue << 32) + (green << 16) + red


def _to_8_bits(picture: NDArray[Any]) -> Image:
    if picture.dtype == np.uint16 and picture.max() > 255:
        return (picture >> 8).astype(np.uint8)
    return picture.astype(np.uint8, copy=False)


def _binary(grey: Image) -> Image:
    return np.asarray(cv2.threshold(grey, PERSON - 1, 255, cv2.THRESH_BINARY)[1], np.uint8)


def _not_a_mask(picture: NDArray[Any], path: Path) -> VideoError:
    channels = 1 if picture.ndim == 2 else picture.shape[2]
    if channels == 1:
        values = np.unique(picture).tolist()
        kind = f"the values {', '.join(map(str, values))}" if len(values) <= 6 else f"{len(values)} values of grey"
    else:
        kind = "colours" if _is_colored(picture[..., :3]) else "many values"
    return VideoError(
        f"{path}: is no mask: it holds {kind} in {channels} channel{'s' if channels > 1 else ''}, and the largest is "
        f"{picture.max()}; people must be white (255), the rest black (0)"
    )
