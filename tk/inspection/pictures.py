"""The sheet of `tk inspect`: masks and the hull of the other cameras, the working volume, the up direction."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.inspection.results import Inspection, Sample
from tk.io.captures.capture import Capture
from tk.kernels.mask_values import PERSON
from tk.model.cameras.camera import Camera
from tk.model.cameras.up import up_vector
from tk.render.canvas import LINE, TILE, text_width, write, write_png
from tk.render.overlay import joined
from tk.render.palette import INK, LOST, PAPER, VOLUME, of_hue

Image = NDArray[np.uint8]
Float = NDArray[np.float64]

#: width of a column of a terminal, pixels
_COLUMN = 9
_MASK, _HULL, _UP = of_hue(120.0), of_hue(300.0), of_hue(45.0)
_LEGEND = (
    ("mask", _MASK),
    ("hull of the others (coarse)", _HULL),
    ("mask outside the hull", LOST),
    ("volume", VOLUME),
    ("up", _UP),
)


def write_sheet(path: Path, capture: Capture, inspection: Inspection, samples: Sequence[Sample]) -> None:
    """Write the sheet as a PNG: one row per frame, one column per camera, the findings above.

    Raises:
        CaptureError: the file cannot be written.
    """
    cameras = range(len(capture.rig))
    rows = [joined([_tile(capture, inspection, frame, c) for c in cameras], axis=1) for frame in samples]
    width = max([row.shape[1] for row in rows], default=900)
    write_png(path, joined([_text(inspection, width), *rows], axis=0), CaptureError)


def _text(inspection: Inspection, width: int) -> Image:
    last = len(inspection.notes) + max(len(inspection.findings), 1)
    lines = [(line, INK) for line in inspection.format_table().split("\n")[:-last]]
    lines += [(line, LOST) for line in inspection.findings] or [("No problems found.", of_hue(120.0, 0.4))]
    lines += [(f"note: {line}", INK) for line in inspection.notes]
    wrapped = [(part, color) for line, color in lines for part in _wrapped(line, width - 20)]
    image = np.full(((len(wrapped) + 2) * LINE, width, 3), 255, np.uint8)
    for i, (line, color) in enumerate(wrapped):
        _columns(image, line, (i + 1) * LINE, color)
    x, y = 10, (len(wrapped) + 1) * LINE
    for name, color in _LEGEND:
        cv2.line(image, (x, y - 5), (x + 24, y - 5), color, 3, cv2.LINE_AA)
        x = write(image, name, x + 30, y, INK) + 20
    return image


def _wrapped(line: str, most: int) -> list[str]:
    """Return a line of the table as it is; other lines in parts of at most ``most`` pixels.

    OpenCV's letters are ASCII.
    """
    for sign, ascii in (("—", "-"), ("°", " deg"), ("±", "+/-")):
        line = line.replace(sign, ascii)
    parts = [""]
    for word in line.split(" "):
        if "  " not in line and text_width(parts[-1] + word) >= most:
            parts.append("  ")
        parts[-1] += word + " "
    return [part.rstrip() for part in parts]


def _columns(image: Image, line: str, y: int, color: tuple[int, int, int]) -> None:
    """Write a line; cells, which two spaces or more separate, end in the same column as on a terminal."""
    cells = list(re.finditer(r"\S+(?: \S+)*", line))
    for cell in cells:
        first = cell is cells[0]
        left = 10 if first else 10 + _COLUMN * cell.end() - text_width(cell[0])
        write(image, cell[0], left, y, color)


def _tile(capture: Capture, inspection: Inspection, frame: Sample, c: int) -> Image:
    camera = capture.rig[c]
    picture = frame.images[c, : camera.height, : camera.width].copy()
    mask = (frame.masks[c, : camera.height, : camera.width] >= PERSON).astype(np.uint8)
    thick = max(1, round(camera.height / 240))
    if frame.hulls is not None:
        hull = np.repeat(np.repeat(frame.hulls[c].astype(np.uint8), frame.step, 0), frame.step, 1)
        hull = np.pad(hull, [(0, max(0, n - m)) for n, m in zip(mask.shape, hull.shape, strict=True)])
        hull = np.ascontiguousarray(hull[: camera.height, : camera.width])
        outside = (mask > 0) & (hull == 0)
        picture[outside] = (0.4 * picture[outside] + 0.6 * np.array(LOST)).astype(np.uint8)
        _outline(picture, hull, _HULL, thick)
    _outline(picture, mask, _MASK, thick)
    volume = capture.volume
    corners = np.array(np.meshgrid(*zip(volume.lower, volume.upper, strict=True), indexing="ij")).reshape(3, 8).T
    for i in range(8):
        for bit in (1, 2, 4):
            if not i & bit:
                _segment(picture, camera, corners[i], corners[i | bit], VOLUME, thick)
    up = up_vector(inspection.leveling.up)
    foot = np.array(volume.center)
    if np.isfinite(inspection.leveling.floor_m):
        foot = foot + up * (inspection.leveling.floor_m - foot @ up)
    _segment(picture, camera, foot, foot + up, _UP, 2 * thick)
    scale = TILE / camera.height
    tile = cv2.resize(picture, (round(camera.width * scale), TILE), interpolation=cv2.INTER_AREA)
    report = inspection.cameras[c]
    name = f"{camera.name}  frame {frame.index}"
    cv2.rectangle(tile, (0, 0), (text_width(name, 0.5) + 14, 24), INK, cv2.FILLED)
    write(tile, name, 7, 17, PAPER, 0.5)
    if report.verdict:
        cv2.rectangle(tile, (0, 0), (tile.shape[1] - 1, TILE - 1), LOST, 4)
    return np.asarray(tile, np.uint8)


def _outline(picture: Image, mask: Image, color: tuple[int, int, int], thick: int) -> None:
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, color, thick, cv2.LINE_AA)


def _segment(
    picture: Image, camera: Camera, a: Float, b: Float, color: tuple[int, int, int], thick: int, steps: int = 24
) -> None:
    """Draw a line of the world as the camera sees it; the lens may bend it."""
    pixels, _ = camera.project(a + np.linspace(0, 1, steps)[:, None] * (b - a))
    for p, q in pairwise(pixels):
        if np.isfinite(p).all() and np.isfinite(q).all() and max(np.abs(p).max(), np.abs(q).max()) < 1e5:
            start, end = (int(p[0]), int(p[1])), (int(q[0]), int(q[1]))
            cv2.line(picture, start, end, color, thick, cv2.LINE_AA)
