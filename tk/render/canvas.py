"""Draw on a tile, a scaled part of a camera's image: body, joints, ground truth, text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ExportError, TkError
from tk.io.paths import replacing
from tk.model.body.joints import BONE_ENDS, JOINTS
from tk.model.cameras.camera import Camera
from tk.model.masks.regions import SQUARE3
from tk.render.figure import Figure, Seen
from tk.render.palette import BACKGROUND, BONE, INK, LOST, LOST_BODY, PAPER, TEXT, Color, sigma_colors

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

# Appearance only; no measurement depends on these values.
_FILL = 0.35  # opacity of the body
#: what a view of points shows, as a multiple of their span: the body may be smaller than the person
AROUND = 1.2
#: height of a picture, and of a line of text, in a sheet of pictures, pixels
TILE, LINE = 300, 24
#: fractional bits of OpenCV's drawing coordinates
SUBPIXEL_BITS = 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True)
class View:
    """The part of an image that a tile shows."""

    origin: Float  # (2,) upper left corner in the image, pixels
    scale: float  # tile pixels per image pixel
    # width, height: size of the tile, pixels
    width: int
    height: int

    @staticmethod
    def around(xy: Float, camera: Camera, width: int, height: int) -> View:
        """Return the view of a tile of this size that contains the points (N, 2), inside the image if possible."""
        xy = xy[np.isfinite(xy).all(axis=1)]
        if not len(xy):
            return View.whole(camera, height)
        low, high = xy.min(axis=0), xy.max(axis=0)
        span = np.maximum(high - low, 1.0) * AROUND
        scale = float(min(width / span[0], height / span[1], 4.0))
        size = np.array([width, height]) / scale
        most = np.array([camera.width, camera.height]) - size
        inside = np.clip((low + high) / 2 - size / 2, 0, np.maximum(most, 0)).round()
        return View(np.where(most > 0, inside, most / 2), scale, width, height)

    @staticmethod
    def whole(camera: Camera, height: int) -> View:
        """Return the view of the whole image at this height."""
        return View(np.zeros(2), height / camera.height, round(camera.width * height / camera.height), height)

    def of_size(self, width: float, height: float) -> View:
        """Return the view of the same part of an image that is reduced to a share of its ``width`` and ``height``."""
        return (
            self
            if width == height == 1
            else replace(self, origin=self.origin * (width, height), scale=self.scale / width)
        )

    def cut(self, picture: Image, tile: Image) -> None:
        """Fill ``tile`` (height, width, 3) with its part of an image."""
        reach = self.origin + np.array([self.width, self.height]) / self.scale
        if self.scale <= 1 and (self.origin > -0.5).all() and (reach < np.array(picture.shape[1::-1]) + 0.5).all():
            (left, top), (right, bottom) = self.origin.round().astype(int), reach.round().astype(int)
            # down to half the size, linear interpolation uses every pixel, and takes a tenth of the time
            method = cv2.INTER_LINEAR if self.scale >= 0.5 else cv2.INTER_AREA
            cv2.resize(picture[top:bottom, left:right], (self.width, self.height), tile, interpolation=method)
            return
        shift = 0.5 * self.scale - 0.5 - self.scale * self.origin
        M = np.column_stack([self.scale * np.eye(2), shift])
        cv2.warpAffine(picture, M, (self.width, self.height), tile, cv2.INTER_LINEAR, borderValue=BACKGROUND)

    def place(self, xy: Float) -> Float:
        """Convert pixels of the image (N, 2) to pixels of the tile."""
        return np.asarray((xy + 0.5 - self.origin) * self.scale - 0.5)


def draw_body(tile: Image, view: View, seen: Seen, color: Callable[[str], Color]) -> None:
    """Draw the segments, translucent, with their contours, near ones over far ones; ``color`` is that of a segment."""
    if not seen.solids:
        return
    placed = fixed(view.place(seen.points))
    x, y, width, height = _box(placed, tile)
    if width <= 0 or height <= 0:
        return
    placed -= np.array([x, y], np.int32) << SUBPIXEL_BITS
    # rank of the visible segment in each pixel; near segments have higher ranks
    layer = np.zeros((height, width), np.uint8)
    colors = np.zeros((256, 1, 3), np.uint8)
    rank, drawn = 0, ""
    for segment, begin, end in seen.solids:
        if segment != drawn:
            rank, drawn = rank + 1, segment
            colors[rank] = color(segment)
        cv2.fillConvexPoly(layer, cv2.convexHull(placed[begin:end]), (rank,), cv2.LINE_8, SUBPIXEL_BITS)
    near = cv2.dilate(layer, SQUARE3)
    contour = near != cv2.erode(layer, SQUARE3)
    over, under = cv2.applyColorMap(near, colors), tile[y : y + height, x : x + width]
    cv2.copyTo(cv2.addWeighted(over, _FILL, under, 1 - _FILL, 0), near, under)
    cv2.copyTo(over, contour.view(np.uint8), under)


def dots(figure: Figure, row: int) -> Sequence[Color | None]:
    """Return the colours of the joints in a frame by their standard deviation, or plain without one.

    None stands for a ring: the standard deviation is unknown (NaN).
    """
    lost = figure.lost(row)
    colors: list[Color] = [LOST_BODY if lost else BONE] * len(JOINTS)
    if figure.sigma is None:
        return colors
    sigma_m = figure.sigma[row]
    if not lost:
        colors = sigma_colors(np.nan_to_num(sigma_m)).tolist()
    return [color if known else None for color, known in zip(colors, np.isfinite(sigma_m).tolist(), strict=True)]


def draw_lost(tile: Image) -> None:
    """Draw the border of a frame in which somebody is lost."""
    cv2.rectangle(tile, (0, 0), (tile.shape[1] - 1, tile.shape[0] - 1), LOST, 5)


def draw_joints(tile: Image, xy: Float, colors: Sequence[Color | None], lost: bool = False) -> None:
    """Draw bones as lines and joints in the colours of :func:`dots`; ``xy`` (J, 2) tile pixels."""
    points = fixed(np.nan_to_num(xy))
    seen = np.asarray(np.isfinite(xy).all(axis=1))
    plain = LOST_BODY if lost else BONE
    bones = list(points[BONE_ENDS[seen[BONE_ENDS].all(axis=1)]])
    # the dark outline is drawn without antialiasing, in a quarter of the time
    cv2.polylines(tile, bones, False, INK, 3, cv2.LINE_8, SUBPIXEL_BITS)
    cv2.polylines(tile, bones, False, plain, 1, cv2.LINE_AA, SUBPIXEL_BITS)
    for k in np.flatnonzero(seen):
        dot = colors[int(k)]
        cv2.circle(tile, points[k], 4 << SUBPIXEL_BITS, INK, cv2.FILLED, cv2.LINE_8, SUBPIXEL_BITS)
        color, width = (plain, 1) if dot is None else (dot, cv2.FILLED)
        cv2.circle(tile, points[k], 3 << SUBPIXEL_BITS, color, width, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_truth(tile: Image, xy: Float) -> None:
    """Draw small crosses at the ground-truth joints, ``xy`` (J, 2) tile pixels."""
    for point in np.rint(xy[np.isfinite(xy).all(axis=1)]).astype(int).tolist():
        for color, width in ((INK, 3), (PAPER, 1)):
            cv2.drawMarker(tile, point, color, cv2.MARKER_TILTED_CROSS, 7, width, cv2.LINE_AA)


def fixed(xy: Float) -> NDArray[np.int32]:
    """Convert pixels to OpenCV's fixed-point coordinates."""
    return np.rint(np.clip(xy, -30000, 30000) * (1 << SUBPIXEL_BITS)).astype(np.int32)


def write(tile: Image, text: str, left: int, baseline: int, color: Color = TEXT, size: float = 0.42) -> int:
    """Write a line of text (ASCII); return its right end, pixels."""
    cv2.putText(tile, text, (left, baseline), _FONT, size, color, 1, cv2.LINE_AA)
    return left + text_width(text, size)


def write_png(path: Path, image: Image, kind: type[TkError] = ExportError) -> None:
    """Write an image (h, w, 3) BGR, and the folder if there is none."""
    with replacing(path, kind) as part:
        ok, coded = cv2.imencode(".png", image)
        if not ok:
            raise OSError("the image is too large")
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(coded.tobytes())


def text_width(text: str, size: float = 0.42) -> int:
    """Return the width of a line of text, pixels."""
    return int(cv2.getTextSize(text, _FONT, size, 1)[0][0])


def _box(points: NDArray[np.int32], picture: Image) -> tuple[int, int, int, int]:
    """Return x, y, width, height of the box around points (N, 2) of :func:`fixed` with a margin, in the image."""
    x, y, width, height = cv2.boundingRect(points >> SUBPIXEL_BITS)
    left, top = max(x - 2, 0), max(y - 2, 0)
    right, bottom = min(x + width + 3, picture.shape[1]), min(y + height + 3, picture.shape[0])
    return left, top, right - left, bottom - top
