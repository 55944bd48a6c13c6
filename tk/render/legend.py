"""The strip below an image of a result: frame, time and status, the meaning of the colours, and a bar of all frames."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import Status
from tk.render.canvas import Image, text_width, write
from tk.render.palette import (
    BACKGROUND,
    INK,
    LOST,
    PAPER,
    SIDE_COLORS,
    SIGMA_MOST_M,
    TEXT,
    Color,
    grey,
    of_hue,
    person_color,
    sigma_colors,
)
from tk.render.people import People

# Sizes in pixels: of the text's strip and of the bar below it; of a square of colour and of the gap after an entry.
_STRIP, _BAR = 30, 6
_SQUARE, _SPACE = 10, 12
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
        self._text_width = {False: 0, True: 0}  # of frames in which somebody is lost, or not
        for row in _one_of_each(np.stack([person.status for person in people.results], axis=1)).tolist():
            lost, wide = people.lost(row), text_width(self._text(row), 0.5)
            self._text_width[lost] = max(self._text_width[lost], wide)

    def draw(self, canvas: Image, row: int) -> None:
        """Fill ``canvas`` (LEGEND_HEIGHT, width, 3) for a row of the result."""
        strip, bar = canvas[:_STRIP], canvas[_STRIP:]
        result = self._people.first
        lost = self._people.lost(row)
        strip[...] = LOST if lost else BACKGROUND
        _square(strip, 10, _STATUS_COLORS[Status(result.status[row])])
        write(strip, self._text(row), 26, 20, TEXT, 0.5)
        self._draw_key(strip, 26 + self._text_width[lost] + 2 * _SPACE)
        bar[...] = self._timeline
        now = round((row + 0.5) / len(result) * bar.shape[1])
        bar[:, max(now - 2, 0) : now + 2] = PAPER

    def _text(self, row: int) -> str:
        """Return frame, time and status in words."""
        result, state = self._people.first, self._people.state(row)
        if self._people.lost(row):
            state = "LOST: do not use this pose" if len(self._people) == 1 else f"LOST: {state}"
        # with the digits of the last frame, so that what follows has the same place in all frames
        count = len(str(result.frames[-1]))
        return f"frame {result.frames[row]:{count}}   {result.time[row]:.2f} s   {state}"

    def _draw_key(self, strip: Image, least: int) -> None:
        """Draw the meaning of the colours that are seen, at the right; what begins left of ``least`` is omitted."""
        right = strip.shape[1]
        if self._people.first.sigma is not None:
            most = f"{100 * SIGMA_MOST_M:.0f} cm"
            right -= text_width("joint sigma  0") + text_width(most) + 74 + _SPACE
            if right < least:
                return
            left = write(strip, "joint sigma  0", right, 20) + 6
            strip[10:21, left : left + 60] = sigma_colors(np.linspace(0, SIGMA_MOST_M, 60))[None]
            cv2.rectangle(strip, (left - 1, 9), (left + 60, 21), INK, 1)
            write(strip, most, left + 68, 20)
        entries = _entries(self._people)
        right -= sum(len(colors) * _SQUARE + 5 + text_width(name) + _SPACE for name, colors in entries)
        if right < least:
            return
        for name, colors in entries:
            for color in colors:
                _square(strip, right, color)
                right += _SQUARE
            right = write(strip, name, right + 5, 20) + _SPACE


def _entries(people: People) -> list[tuple[str, tuple[Color, ...]]]:
    """Return the names and colours of what is drawn: the first person's sides, and one colour for each other person."""
    sides = list(SIDE_COLORS.items()) if people.figures[0].solids else []
    return sides + [(f"person {one.person}", (person_color(one.person),)) for one in people.figures[1:]]


def _square(strip: Image, left: int, color: Color) -> None:
    strip[10 : 10 + _SQUARE, left : left + _SQUARE] = color


def _one_of_each(status: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the last row of each combination of statuses (F, P); the last frames have the longest numbers."""
    return np.asarray(len(status) - 1 - np.unique(status[::-1], axis=0, return_index=True)[1])


def _timeline(status: NDArray[np.uint8], width: int) -> Image:
    """Return the status of all frames as colours (1, width, 3), lost frames red."""
    of_status = np.zeros((max(_STATUS_COLORS) + 1, 3), np.uint8)
    for value, color in _STATUS_COLORS.items():
        of_status[value] = color
    line = of_status[status[np.arange(width) * len(status) // width]]
    # a single lost frame of a long recording is narrower than a pixel, but must stay visible
    line[np.flatnonzero(status == Status.LOST) * width // len(status)] = LOST
    return line[None]
