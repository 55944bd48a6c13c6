"""`sync.png`: what every camera shows at the same instants, while something moves fast."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.render.canvas import LINE, TILE, text_width, write, write_png
from tk.render.palette import INK, PAPER
from tk.synchronise.looks import GRID_HZ, Look, pictures_at
from tk.synchronise.raw import Recording
from tk.synchronise.ties import Clocks

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

#: most width of a picture, pixels
_MOST_WIDTH = 540
#: instants, and seconds between them and the fastest one
_INSTANTS, _APART_S = 3, 0.3


def fastest_instants(looks: Sequence[Look], clocks: Clocks, span: tuple[float, float]) -> list[float]:
    """Return common times about the instant with the fastest motion in all cameras, seconds."""
    begin = max([span[0], *(clocks.common(c, float(look.times_s[0])) for c, look in enumerate(looks))])
    end = min([span[1], *(clocks.common(c, float(look.times_s[-1])) for c, look in enumerate(looks))])
    if end - begin < 2 * _APART_S:
        middle = (span[0] + span[1]) / 2
        return [middle + (k - _INSTANTS // 2) * min(_APART_S, (span[1] - span[0]) / 4) for k in range(_INSTANTS)]
    clock = np.arange(begin, end, 1 / GRID_HZ)
    total = np.zeros(len(clock))
    for c, look in enumerate(looks):
        at = np.array([clocks.common(c, float(time)) for time in look.middles_s])
        amount = np.sqrt(look.changes.mean(axis=(1, 2)) / np.diff(look.times_s))
        total += np.minimum(np.interp(clock, at, amount / (amount.mean() + 1e-9)), 4.0)
    total = np.convolve(total, np.ones(GRID_HZ // 6), "same")
    inside = (clock > begin + _APART_S) & (clock < end - _APART_S)
    peak = float(clock[np.argmax(np.where(inside, total, -1.0))])
    return [peak + (k - _INSTANTS // 2) * _APART_S for k in range(_INSTANTS)]


def write_sheet(path: Path, recordings: Sequence[Recording], clocks: Clocks, instants: Sequence[float]) -> None:
    """Write a row of pictures, one of each camera, for every instant (common time, seconds).

    Raises:
        CaptureError: the file cannot be written.
        VideoError: an image cannot be decoded.
    """

    def pictures(c: int) -> list[Image]:
        owns = [(at - float(clocks.offsets_s[c])) / float(clocks.rates[c]) for at in instants]
        return pictures_at(recordings[c], owns, TILE)

    with ThreadPoolExecutor(2) as threads:
        columns = list(threads.map(pictures, range(len(recordings))))
    rows = []
    for k, at in enumerate(instants):
        row = np.concatenate([_cut(column[min(k, len(column) - 1)]) for column in columns], axis=1)
        head = np.full((LINE, row.shape[1], 3), PAPER, np.uint8)
        x = 0
        for recording, column, c in zip(recordings, columns, range(len(columns)), strict=True):
            own = (at - float(clocks.offsets_s[c])) / float(clocks.rates[c])
            name = recording.name.encode("ascii", "replace").decode()
            text = f"{name}  {own:.2f} s of its own" + (f"   common time {at:.2f} s" if c == 0 else "")
            width = _cut(column[0]).shape[1]
            size = 0.42 * min(1.0, (width - 12) / max(text_width(text), 1))
            write(head, text, x + 6, LINE - 8, INK, size)
            x += width
        rows += [head, row]
    write_png(path, np.concatenate(rows, axis=0), CaptureError)


def _cut(picture: Image) -> Image:
    """Return the middle of a wide picture, with a border."""
    extra = max(picture.shape[1] - _MOST_WIDTH, 0) // 2
    part = picture[:, extra : picture.shape[1] - extra]
    return np.asarray(cv2.copyMakeBorder(part, 0, 0, 1, 1, cv2.BORDER_CONSTANT, value=PAPER), np.uint8)
