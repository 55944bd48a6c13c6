"""Pictures that show nothing of what happens: a camera that is black, or stands still while the others see movement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: about so many rows of a picture are looked at
_ROWS = 64
#: a picture of grey levels that differ by less than this (one standard deviation) shows nothing
_BLANK_LEVELS = 3.0
#: levels that the coding of a still picture may change, and the share of pixels that it may change by more
_SAME_LEVELS, _SAME_SHARE = 6, 0.001
#: a camera's picture is frozen when the masks of the others have changed by this share meanwhile
_MOVED = 0.15

BLANK, FROZEN = "shows nothing", "stands still"


class ImageHealth:
    """Looks at one frame after the other.

    A picture that is as it was is no fault as long as nobody moves. So each camera keeps the last picture that was
    another one, with the masks of all cameras at that moment: where its picture is still that one and at least half of
    the other cameras have gone on, and most of these show that the person has moved, it is frozen.
    """

    def __init__(self) -> None:
        self._pictures: NDArray[np.uint8] | None = None  # (C, h, w) grey, of the reference frame of each camera
        self._masks: NDArray[np.bool_] | None = None  # (C, C, h, w): at camera c's reference frame those of all

    def look(self, images: NDArray[np.uint8], masks: NDArray[np.uint8]) -> list[str | None]:
        """What is the matter with each camera in the next frame: :data:`BLANK`, :data:`FROZEN` or None.

        Args:
            images: (C, H, W, 3) BGR, or without pixels; the masks stand for them then.
            masks: (C, H, W), 128 and more where the person is.
        """
        C = len(masks)
        step = max(1, masks.shape[1] // _ROWS)
        small = masks[:, step // 2 :: step, step // 2 :: step] >= 128
        given = images.size > 0
        # green alone tells as much, and is at hand
        shown = images[:, step // 2 :: step, step // 2 :: step, 1] if given else small * np.uint8(255)
        found: list[str | None] = [None] * C
        if given:
            for c in range(C):
                if shown[c].std() < _BLANK_LEVELS:
                    found[c] = BLANK
        if self._pictures is None or self._masks is None or self._pictures.shape != shown.shape:
            self._pictures, self._masks = shown.copy(), np.repeat(small[None], C, axis=0)
            return found
        differs = np.abs(shown.astype(np.int16) - self._pictures) > _SAME_LEVELS
        still = differs.reshape(C, -1).mean(axis=1) <= _SAME_SHARE
        for c in range(C):
            if not still[c]:
                self._pictures[c], self._masks[c] = shown[c], small
            elif found[c] is None and small[c].any():  # where it shows nobody there is nothing that could move
                others = [_changed(self._masks[c][k], small[k]) > _MOVED for k in range(C) if k != c and not still[k]]
                if 2 * len(others) >= C - 1 and np.mean(others) > 0.5:
                    found[c] = FROZEN
        return found

    def state(self) -> Mapping[str, Any]:
        """What :meth:`restore` needs."""
        if self._pictures is None or self._masks is None:
            return {}
        return {"pictures": self._pictures, "masks": np.packbits(self._masks)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take up what :meth:`state` gave."""
        if "pictures" not in state:
            self._pictures = self._masks = None
            return
        self._pictures = np.array(state["pictures"], np.uint8)
        C, h, w = self._pictures.shape
        bits = np.unpackbits(np.asarray(state["masks"], np.uint8), count=C * C * h * w)
        self._masks = bits.reshape(C, C, h, w).astype(bool)


def _changed(before: NDArray[np.bool_], now: NDArray[np.bool_]) -> float:
    """The share of a mask that is another one now."""
    return float(np.count_nonzero(before != now)) / max(int(before.sum()), int(now.sum()), 1)


def described(first: int, last: int, count: int) -> str:
    """So many frames for people to read: "frame 12", "frames 30 to 74", "12 of the frames 30 to 74"."""
    if count == 1:
        return f"frame {first}"
    if last - first + 1 == count:
        return f"frames {first} to {last}"
    return f"{count} of the frames {first} to {last}"
