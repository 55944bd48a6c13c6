"""Choose the frames that a report shows images of, and make the images."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.io.results.data import Result
from tk.render.overlay import Overlay

# Frames with the largest and with a typical E_S; width of an image with all cameras, pixels; JPEG quality. Appearance
# and size of the page only: five images have about 0.5 MB.
_WORST, _TYPICAL = 3, 2
_WIDTH = 1400
_QUALITY = 80


@dataclass(frozen=True)
class Choice:
    """A row of the result, and the reason to show it."""

    row: int
    why: str


def choose_rows(result: Result, frames: range | None = None) -> list[Choice]:
    """Return the first frame in which anybody is lost, the worst and typical frames; without E_S, frames spread over
    the result. Only ``frames``, by default all, are chosen."""
    people = result.people
    count = len(people[0])
    there = [np.isfinite(person.joints).any(axis=(1, 2)) for person in people]
    lost = np.any([~person.has_pose & known for person, known in zip(people, there, strict=True)], axis=0)
    error = np.full(count, np.nan)
    by_view = np.concatenate([np.zeros((count, 0)), *(e for p in people if (e := p.silhouette_error) is not None)], 1)
    shown = np.ones(count, np.bool_) if frames is None else np.isin(people[0].frames, frames)
    lost &= shown
    known = np.isfinite(by_view).any(axis=1) & shown
    error[known] = np.nanmean(by_view[known], axis=1)
    chosen: dict[int, str] = {}
    spacing = max(2, count // 20)

    def take(order: NDArray[np.int64], why: str, most: int) -> None:
        for row in order.tolist():
            if most == 0:
                return
            if np.isfinite(error[row]) and all(abs(row - other) >= spacing for other in chosen):
                chosen[row] = f"{why}: mean E_S {100 * error[row]:.0f} %"
                most -= 1

    if lost.any():
        chosen[int(np.argmax(lost))] = "first lost frame"
    good = np.flatnonzero(~lost)
    if np.isfinite(error[good]).any():
        take(good[np.argsort(-np.nan_to_num(error[good], nan=-1.0), kind="stable")], "among the worst", _WORST)
        middle = float(np.nanmedian(error[good]))
        take(good[np.argsort(np.abs(error[good] - middle), kind="stable")], "typical", _TYPICAL)
    else:
        rows = np.flatnonzero(shown)
        for row in rows[np.unique(np.linspace(0, len(rows) - 1, _WORST + _TYPICAL).astype(int))].tolist():
            chosen.setdefault(row, "spread over the recording")
    return [Choice(row, why) for row, why in chosen.items()]


def shot(overlay: Overlay, frame: int, images: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return a JPEG of a frame with the people in all cameras."""
    height = int(np.clip(_WIDTH / (0.75 * len(overlay.rig)), 160, 300))
    _, data = cv2.imencode(
        ".jpg", overlay.sheet_row(frame, images, height, truth=False), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    )
    return data.tobytes()


def embedded(choices: list[Choice], shots: Mapping[int, bytes]) -> list[dict[str, Any]]:
    """Return the images for the page in the order of the choices; ``shots`` are JPEGs by row."""
    return [
        {"row": choice.row, "why": choice.why, "jpeg": base64.b64encode(shots[choice.row]).decode("ascii")}
        for choice in choices
        if choice.row in shots
    ]
