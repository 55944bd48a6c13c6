"""The strip below an image of a result: frame, time and status, the meaning of the colours, and a bar of all frames."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.render.canvas import Image, write
from tk.render.palette import (
    BACKGROUND,
    INK,
    LOST,
    PAPER,
    SEGMENT_COLORS,
    SIGMA_MOST_M,
    TEXT,
    grey,
    of_hue,
    sigma_colors,
)
from tk.render.people import People

# Sizes in pixels: of the text's strip and of the bar below it; of the text of a frame that is lost or not; of the key.
_STRIP, _BAR = 30, 6
_TEXT_WIDTH, _KEY_WIDTH = {False: 280, True: 360}, 330
#: height of the legend, pixels
LEGEND_HEIGHT = _STRIP + _BAR
_STATUS_COLORS = {
    Status.TRACKED: of_hue(150.0, saturation=0.25),
    Status.INITIALISED: of_hue(200.0),
    Status.RECOVERED: of_hue(50.0),
    Status.LOST: LOST,
    Status.SUSPECT: of_hue(30.0),
    Status.ABSENT: grey(0.25),
}


class Legend:
    """The legend of a result, ``width`` pixels wide."""

    def __init__(self, people: People, width: int) -> None:
        self._people = people
        lines = [_timeline(person.status, width) for person in people.results]
        self._timeline = np.concatenate([lines[k * len(lines) // _BAR] for k in range(_BAR)])
        self._keys: dict[bool, Image] = {}

    def draw(self, canvas: Image, row: int) -> None:
        """Fill ``canvas`` (LEGEND_HEIGHT, width, 3) for a row of the result."""
        strip, bar = canvas[:_STRIP], canvas[_STRIP:]
        lost, result = self._people.lost(row), self._people.first
        if lost not in self._keys:
            key = self._keys[lost] = np.full_like(strip, LOST if lost else BACKGROUND)
            if strip.shape[1] > _TEXT_WIDTH[lost] + _KEY_WIDTH:
                _draw_key(key, strip.shape[1] - _KEY_WIDTH + 20, result.sigma is not None)
        strip[...] = self._keys[lost]
        state = self._people.state(row)
        if lost:
            state = "LOST: do not use this pose" if len(self._people) == 1 else f"LOST: {state}"
        text = f"frame {result.frames[row]}   {result.time[row]:.2f} s   {state}"
        write(strip, text, 10, 20, TEXT, 0.5)
        bar[...] = self._timeline
        now = round((row + 0.5) / len(result) * bar.shape[1])
        bar[:, max(now - 2, 0) : now + 2] = PAPER


def _draw_key(strip: Image, left: int, sigma: bool) -> None:
    """Draw the meaning of the colours from ``left`` on."""
    for name, segment in (("left", "forearm_l"), ("right", "upper_arm_r")):
        cv2.rectangle(strip, (left, 10), (left + 10, 20), SEGMENT_COLORS[segment], cv2.FILLED)
        left = write(strip, name, left + 15, 20) + 14
    if not sigma:
        return
    left = write(strip, "joint sigma  0", left + 6, 20) + 6
    ramp = sigma_colors(np.linspace(0, SIGMA_MOST_M, 60))
    strip[10:21, left : left + 60] = ramp[None]
    cv2.rectangle(strip, (left - 1, 9), (left + 60, 21), INK, 1)
    write(strip, f"{100 * SIGMA_MOST_M:.0f} cm", left + 68, 20)


def _timeline(status: NDArray[np.uint8], width: int) -> Image:
    """Return the status of all frames as colours (1, width, 3), lost frames red."""
    of_status = np.zeros((max(_STATUS_COLORS) + 1, 3), np.uint8)
    for value, color in _STATUS_COLORS.items():
        of_status[value] = color
    line = of_status[status[np.arange(width) * len(status) // width]]
    # a single lost frame of a long recording is narrower than a pixel, but must stay visible
    line[np.flatnonzero(status == Status.LOST) * width // len(status)] = LOST
    return line[None]
