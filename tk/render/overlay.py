"""Draw the tracked body over the images of all cameras, to check a result by eye.

Filled outlines show the fitted body (left limbs warm, right limbs cool, trunk and head green), lines and dots its
joints; a dot's colour shows the joint's standard deviation. A result without a body shows joints only. Lost frames are
grey with a red border. People after the first have one colour each. The image of a camera that was left out of a frame
is dark, and its name is red. On contact sheets, white crosses show the ground truth, if the capture has it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.captures.capture import Capture
from tk.io.paths import PNG, check_files
from tk.io.results.data import Result
from tk.io.results.reader import truth_of
from tk.model.cameras.camera import Camera, Rig
from tk.render.canvas import (
    AROUND,
    Image,
    View,
    dots,
    draw_body,
    draw_joints,
    draw_lost,
    draw_truth,
    text_width,
    write,
    write_png,
)
from tk.render.figure import Figure
from tk.render.legend import LEGEND_HEIGHT, Legend
from tk.render.palette import TEXT, Color
from tk.render.people import People
from tk.trackers.bodies import as_tracked

Float = NDArray[np.float64]

# Layout only; no measurement depends on these values.
_GAP, _SHEET_ROWS = 6, 4  # pixels between the tiles of a sheet; frames of a sheet
#: largest width of a video, pixels; smaller images are enlarged up to the second width
WIDEST, _NARROWEST = 1280, 640
_WARNING = (120, 120, 255)  # letters of a lost frame, and of a camera that was left out
_ASPECT = 9 / 16  # largest height of all tiles together, as a share of the largest width


class Overlay:
    """Draws a result over the images of its capture.

    Args:
        capture: the images, of the cameras to show.
        result: the result. Its cameras and time offsets, if it has them, replace those of the capture.
        widest: largest width of a video, pixels.
        full: show whole images in a video, not the part in which the person moves.
    """

    def __init__(self, capture: Capture, result: Result, widest: int = WIDEST, full: bool = False) -> None:
        if not len(result.frames):
            raise ResultError(f"{result.path}: has no frames")
        self.people = People(result.people)
        result = self.people.first
        last = int(result.frames.max())
        if last >= capture.frame_count:
            raise ResultError(
                f"{result.path}: has frame {last}, but {capture.path} ends with frame {capture.frame_count - 1}; "
                "name the capture that was tracked"
            )
        self.capture = _no_wider(as_tracked(capture, result), widest)
        self.rig = self.capture.rig
        self._errors = [e for person in self.people.results if (e := person.silhouette_error) is not None]
        self.grid = Grid.of(self.rig, widest)
        self._canvas = np.full((self.grid.height + LEGEND_HEIGHT, self.grid.width, 3), 24, np.uint8)
        self._legend = Legend(self.people, self.grid.width)
        self._views = [self._steady_view(camera, full) for camera in self.rig]
        self.row_of = {int(frame): row for row, frame in enumerate(result.frames)}
        truth = truth_of(result, capture.truth_file)
        by_frame = () if truth is None else truth.swapaxes(0, 1).reshape(len(result), -1, 3)
        self._truth = dict(zip(result.frames.tolist(), by_frame, strict=False))

    def pictures(self, frames: Sequence[int]) -> Iterator[tuple[int, Sequence[Image]]]:
        """Yield these frames, ascending, and their images (C,); decoding starts immediately."""
        reader = self.capture.some_frames(sorted(set(frames)))
        shapes = [(camera.height, camera.width) for camera in self.rig]

        def taken() -> Iterator[tuple[int, Sequence[Image]]]:
            with reader:
                for frame in reader:
                    yield frame.index, [image[:h, :w] for image, (h, w) in zip(frame.images, shapes, strict=True)]

        return taken()

    def sheet_row(
        self, frame: int, images: Sequence[Image], tile_height: int = 360, full: bool = False, truth: bool = True
    ) -> Image:
        """Return a row of tiles of a frame, one per camera: the part with the person, or the ``full`` images.

        The images (C,) may be smaller than the cameras'.
        """
        row, tiles = self.row_of[frame], []
        people = self._there(row)
        for camera, image in zip(self.rig, images, strict=True):
            view = View.whole(camera, tile_height)
            if not full:
                seen = [figure.seen(row, camera) for figure in self.people.figures]
                body = [person.points[begin:end] for person in seen for _, begin, end in person.solids]
                shown = np.concatenate([*(person.joints for person in seen), *body, *self._true(frame, camera)])
                view = View.around(shown, camera, round(0.75 * tile_height), tile_height)
            tile = np.empty((view.height, view.width, 3), np.uint8)
            self._draw(tile, row, people, camera, image, view)
            for xy in self._true(frame, camera) if truth else ():
                draw_truth(tile, view.place(xy))
            tile[:20] = tile[:20] // 3
            excluded = self._excluded(row, camera)
            color = _WARNING if self.people.lost(row) or excluded else TEXT
            name = f"{camera.name} LEFT OUT" if excluded else camera.name
            write(tile, f"{name}  frame {frame}  {self.people.state(row)}", 6, 14, color)
            tiles.append(tile)
        return joined(tiles, axis=1)

    def _there(self, row: int) -> list[tuple[Figure, Sequence[Color | None]]]:
        """Return the people of whom a joint is known in a frame, and the colours of their joints."""
        return [(figure, dots(figure, row)) for figure in self.people.figures if figure.there(row)]

    def _draw(
        self,
        tile: Image,
        row: int,
        people: Sequence[tuple[Figure, Sequence[Color | None]]],
        camera: Camera,
        image: Image,
        view: View,
    ) -> None:
        """Fill a tile with a camera's image, and draw bodies and joints over it."""
        view.of_size(image.shape[1] / camera.width, image.shape[0] / camera.height).cut(image, tile)
        if self._excluded(row, camera):
            tile[...] = tile // 3
        far = [np.nanmean(np.linalg.norm(figure.joints[row] - camera.center, axis=1)) for figure, _ in people]
        for k in np.argsort(far)[::-1]:
            figure, colors = people[k]
            seen = figure.seen(row, camera)
            draw_body(tile, view, seen, partial(figure.color, row))
            draw_joints(tile, view.place(seen.joints), colors, figure.lost(row))
        if self.people.lost(row):
            draw_lost(tile)

    def _excluded(self, row: int, camera: Camera) -> bool:
        names = self.people.first.meta.residual_cameras
        return camera.name in names and bool(self.people.left_out[row, names.index(camera.name)])

    def _true(self, frame: int, camera: Camera) -> list[Float]:
        return [camera.project(self._truth[frame])[0]] if frame in self._truth else []

    def mosaic(self, frame: int, images: Sequence[Image]) -> Image:
        """Return the images of all cameras in a grid with the legend below, (H, W, 3), H and W even.

        The images (C,) may be smaller than the cameras'. The next call overwrites the image.
        """
        grid, row, canvas = self.grid, self.row_of[frame], self._canvas
        people = self._there(row)
        for c, (camera, image) in enumerate(zip(self.rig, images, strict=True)):
            view = self._views[c]
            y, x = grid.corner(c, (view.height, view.width))
            tile = canvas[y : y + view.height, x : x + view.width]
            self._draw(tile, row, people, camera, image, view)
            self._name(tile, row, camera)
        self._legend.draw(canvas[grid.height :], row)
        return canvas

    def _steady_view(self, camera: Camera, full: bool) -> View:
        """Return the view of a tile that contains the people in all frames that are not lost."""
        width, height = (max(int(size * self.grid.scale), 1) for size in (camera.width, camera.height))
        whole = View(np.zeros(2), self.grid.scale, width, height)
        shown = np.concatenate([person.joints[person.has_pose].reshape(-1, 3) for person in self.people.results])
        points, _ = camera.project(shown)
        if full or not camera.sees(shown).any():
            return whole
        near = View.around(points, camera, width, height)
        return near if near.scale > self.grid.scale else whole

    def _name(self, tile: Image, row: int, camera: Camera) -> None:
        """Write the camera's name and E_S, or that it was left out, into a corner."""
        excluded = self._excluded(row, camera)
        text = f"{camera.name} LEFT OUT" if excluded else camera.name
        names = self.people.first.meta.residual_cameras
        errors = [e[row, names.index(camera.name)] for e in self._errors if camera.name in names]
        known = [f"{100 * error:.0f}" for error in errors if np.isfinite(error)]
        text += f"  E_S {', '.join(known)} %" if known else ""
        label = tile[:18, : text_width(text) + 12]
        label[...] = label // 3
        write(tile, text, 6, 13, _WARNING if excluded else TEXT)


@dataclass(frozen=True)
class Grid:
    """Layout of the images of several cameras; width and height are even, as H.264 requires."""

    columns: int
    scale: float
    cell: tuple[int, int]  # height, width
    width: int
    height: int

    @staticmethod
    def of(rig: Rig, widest: int = WIDEST) -> Grid:
        """Return the grid that shows the images largest."""
        rows, across = rig.frame_shape
        count = len(rig)

        def scale(columns: int) -> float:
            wanted = max(1.0, _NARROWEST / (columns * across))
            return min(widest / (columns * across), _ASPECT * widest / (-(-count // columns) * rows), wanted)

        columns = max(range(1, count + 1), key=lambda n: (scale(n), -n))
        cell = max(int(rows * scale(columns)), 1), max(int(across * scale(columns)), 1)
        width, height = columns * cell[1], -(-count // columns) * cell[0]
        return Grid(columns, scale(columns), cell, width + width % 2, height + height % 2)

    def corner(self, index: int, shape: tuple[int, int]) -> tuple[int, int]:
        """Return the upper left corner (y, x) of a tile of this shape (height, width) in the middle of its cell."""
        row, column = divmod(index, self.columns)
        return (
            row * self.cell[0] + max(self.cell[0] - shape[0], 0) // 2,
            column * self.cell[1] + max(self.cell[1] - shape[1], 0) // 2,
        )


def sizes_shown(capture: Capture, widest: int) -> list[tuple[int, int]]:
    """Return the (C,) width and height at which images are shown in a video of width ``widest``: so large that the
    first subject, standing in the middle of the volume, fills a tile, or the image does."""
    rig = _no_wider(capture, widest).rig
    grid, tall = Grid.of(rig, widest), replace(capture.setup(), rig=rig).person_pixels()
    scales = np.clip(np.maximum(grid.cell[0] / (AROUND * tall), grid.scale), None, 1)
    scales = 1 / np.where(scales < 0.5, np.floor(1 / scales), 1 / scales)  # whole factors are faster
    return [
        (round(camera.width * scale), round(camera.height * scale)) for camera, scale in zip(rig, scales, strict=True)
    ]


def _no_wider(capture: Capture, widest: int) -> Capture:
    """Return a capture whose images are reduced to the width of a video or a little more. No tile is wider, and a
    smaller image takes less time to decode and to cut."""
    return capture.reduced([max(camera.width // widest, 1) for camera in capture.rig])


def joined(tiles: Sequence[Image], axis: int) -> Image:
    """Join tiles horizontally (axis 1) or vertically (axis 0) on white."""
    across = max(tile.shape[1 - axis] for tile in tiles)
    parts: list[Image] = []
    for tile in tiles:
        pad = [(0, 0), (0, 0), (0, 0)]
        pad[1 - axis] = (0, across - tile.shape[1 - axis])
        if parts:
            pad[axis] = (_GAP, 0)
        parts.append(np.pad(tile, pad, constant_values=255))
    return np.concatenate(parts, axis=axis)


def write_sheets(
    overlay: Overlay, folder: Path, frames: Sequence[int] = (), full: bool = False, force: bool = False
) -> list[Path]:
    """Write contact sheets of four frames each as PNG, one column per camera; eight frames by default."""
    chosen = overlay.people.chosen(frames, count=8)
    sheets = [chosen[i : i + _SHEET_ROWS] for i in range(0, len(chosen), _SHEET_ROWS)]
    paths = [folder / f"overlay-{sheet[0]:06d}-{sheet[-1]:06d}.png" for sheet in sheets]
    check_files(folder, paths, PNG, force, [overlay.people.first.path], overlay.capture.path)
    rows = (overlay.sheet_row(frame, images, full=full) for frame, images in overlay.pictures(chosen))
    for path, sheet in zip(paths, sheets, strict=True):
        write_png(path, joined(list(islice(rows, len(sheet))), axis=0))
    return paths
