"""Printed boards: their points, and their shapes for printing and rendering.

Coordinates on a board are metres from its upper left corner: x to the right, y down, z into the paper (OpenCV's).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError

Float = NDArray[np.float64]

#: kinds of boards, each with its default number of columns and rows
KINDS = {"charuco": (7, 5), "chessboard": (10, 7), "circles": (4, 11), "aprilgrid": (6, 6)}
#: side of a ChArUco marker, as a share of the square's
_MARKER = 0.75
#: gap between two tags of an AprilGrid, as a share of a tag's side: Kalibr's default
_GAP = 0.3
#: radius of a circle, as a share of the distance between two rows
_RADIUS = 0.36
#: black modules around the bits of an AprilGrid's tag: Kalibr's default
APRIL_BORDER = 2
#: sides that a person can carry and print, metres
_LEAST_M, _MOST_M = 0.004, 0.5
#: most columns or rows
_MOST = 40


@dataclass(frozen=True)
class Shape:
    """A black shape on the white board: a rectangle, or the ellipse that fills it. Metres."""

    x: float
    y: float
    width: float
    height: float
    round: bool = False


@dataclass(frozen=True)
class Board:
    """A board as the user describes it; made by :func:`make_board`."""

    kind: str  # one of KINDS
    columns: int  # of squares (charuco, chessboard), circles in a row, or tags
    rows: int
    square_m: float  # side of a square or a tag; distance between two rows of circles
    marker: float = _MARKER  # charuco: side of a marker, as a share of the square's; aprilgrid: the gap, of the tag's
    dictionary: str = "4x4_50"  # charuco, aprilgrid: the markers
    legacy: bool = False  # charuco: with an even number of rows, as OpenCV before 4.6: the upper left square is white

    @property
    def title(self) -> str:
        """The board in words, for messages."""
        markers = f" of {self.dictionary}" if self.kind in ("charuco", "aprilgrid") else ""
        return f"{self.kind} {self.columns}x{self.rows}{markers}"

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the printed pattern, metres."""
        s = self.square_m
        if self.kind == "aprilgrid":
            return s * (self.columns + (self.columns + 1) * self.marker), s * (
                self.rows + (self.rows + 1) * self.marker
            )
        if self.kind == "circles":
            return s * (2 * self.columns), s * self.rows
        return s * self.columns, s * self.rows

    @cached_property
    def points(self) -> Float:
        """(N, 3) the board's points on the board, metres: what a detector finds, by number."""
        s = self.square_m
        if self.kind == "aprilgrid":
            xy = self._tag_corners.reshape(-1, 2)
        elif self.kind == "circles":
            i, j = np.divmod(np.arange(self.columns * self.rows), self.columns)
            xy = s * (np.stack([2 * j + i % 2, i], axis=1) + 0.5)
        else:
            i, j = np.divmod(np.arange((self.columns - 1) * (self.rows - 1)), self.columns - 1)
            xy = s * np.stack([j + 1.0, i + 1.0], axis=1)
        return np.column_stack([xy, np.zeros(len(xy))])

    @cached_property
    def _tag_corners(self) -> Float:
        """(T, 4, 2) corners of the tags of an AprilGrid, clockwise from the upper left; tag 0 is at the lower left."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        step = 1 + self.marker
        left, top = self.marker + step * column, self.marker + step * (self.rows - 1 - row)
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        return np.asarray(self.square_m * (np.stack([left, top], axis=1)[:, None] + corners))

    @property
    def corners(self) -> Float:
        """(4, 3) corners of the pattern, clockwise from the upper left, metres."""
        width, height = self.size_m
        return np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]], np.float64)

    @property
    def same_when_turned(self) -> bool:
        """Whether the board looks the same after half a turn, so that cameras cannot agree on its corners."""
        return self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0

    @cached_property
    def markers(self) -> Any:
        """OpenCV's dictionary of the markers."""
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionaries()[self.dictionary]))

    @cached_property
    def charuco(self) -> Any:
        """OpenCV's ChArUco board."""
        size = (self.columns, self.rows)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker * self.square_m, self.markers)
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def patterns(self) -> tuple[Board, ...]:
        """The boards that this one may be: versions of OpenCV differ in charuco boards with an even number of rows."""
        if self.kind == "charuco" and self.rows % 2 == 0:
            return self, replace(self, legacy=not self.legacy)
        return (self,)

    def shapes(self) -> list[Shape]:
        """Return the black shapes of the board."""
        s = self.square_m
        if self.kind == "circles":
            r = _RADIUS * s
            return [Shape(x - r, y - r, 2 * r, 2 * r, True) for x, y, _ in self.points.tolist()]
        if self.kind == "aprilgrid":
            found = [shape for t, c in enumerate(self._tag_corners) for shape in self._marker(t, c[0], s, APRIL_BORDER)]
            gap, step = self.marker * s, (1 + self.marker) * s
            dots = [(i, j) for i in range(self.columns + 1) for j in range(self.rows + 1)]
            return found + [Shape(i * step, j * step, gap, gap) for i, j in dots]
        black = {(i, j) for i in range(self.columns) for j in range(self.rows) if (i + j) % 2 == 0}
        found = []
        if self.kind == "charuco":
            black = {(i, j) for i in range(self.columns) for j in range(self.rows)}
            for marker, corners in zip(self.charuco.getIds().ravel(), self.charuco.getObjPoints(), strict=True):
                first = np.asarray(corners)[0, :2]
                black.discard((int(first[0] / s), int(first[1] / s)))
                found += self._marker(int(marker), first, self.marker * s, 1)
        return [Shape(i * s, j * s, s, s) for i, j in sorted(black)] + found

    def _marker(self, number: int, corner: Float, side: float, border: int) -> list[Shape]:
        """Return the black modules of a marker, whole rows of them as one shape."""
        modules = self.markers.markerSize + 2 * border
        bits = cv2.aruco.generateImageMarker(self.markers, number, modules, borderBits=border) == 0
        one, shapes = side / modules, []
        for row in range(modules):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], bits[row], [False]]).astype(int)))
            for start, stop in edges.reshape(-1, 2):
                shapes.append(Shape(corner[0] + start * one, corner[1] + row * one, (stop - start) * one, one))
        return shapes


def dictionaries() -> dict[str, str]:
    """Return OpenCV's name of each dictionary of markers, by the name that users give."""
    found = (name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    return {name[5:].lower(): name for name in found}


def make_board(
    kind: str, size: str | None, square_m: float, marker: float | None = None, dictionary: str | None = None
) -> Board:
    """Return a board.

    Args:
        kind: one of :data:`KINDS`.
        size: columns and rows, as "7x5"; None: the default ones of the kind.
        square_m: side of a square, metres.
        marker: side of a marker as a share of the square's (charuco), or gap as a share of the tag's (aprilgrid).
        dictionary: name of the dictionary of markers, as "4x4_50".

    Raises:
        ConfigError: a value is impossible; the message names the option.
    """
    columns, rows = _size(kind, size)
    if not np.isfinite(square_m) or not _LEAST_M <= square_m <= _MOST_M:
        units = [
            (unit, f * square_m) for unit, f in (("mm", 1e-3), ("cm", 1e-2)) if _LEAST_M <= f * square_m <= _MOST_M
        ]
        if units:
            hint = ", or ".join(f"--square {metres:g} if it is in {unit}" for unit, metres in units)
            raise ConfigError(f"--square {square_m:g}: a square of {square_m:g} m; give its side in metres: {hint}")
        raise ConfigError(f"--square {square_m:g}: give the measured side of a square in metres, for example 0.11")
    april = kind == "aprilgrid"
    if marker is None:
        marker = _GAP if april else _MARKER
    if not 0.05 <= marker <= 0.95:
        raise ConfigError(f"--marker {marker:g}: give it as a share of the square's side, for example 0.75")
    name = (dictionary or ("apriltag_36h11" if april else "4x4_50")).lower().removeprefix("dict_")
    if name not in dictionaries():
        raise ConfigError(f"--dictionary {dictionary}: is unknown; give one of {', '.join(sorted(dictionaries()))}")
    board = Board(kind, columns, rows, square_m, marker, name)
    if kind in ("charuco", "aprilgrid"):
        needed, there = columns * rows // (1 if april else 2), len(board.markers.bytesList)
        if needed > there:
            raise ConfigError(f"--dictionary {name}: has {there} markers; the board {columns}x{rows} has {needed}")
    if board.same_when_turned:
        raise ConfigError(
            f"--size {columns}x{rows}: this chessboard looks the same after half a turn; use one with an even number "
            "of squares along one side and an odd one along the other"
        )
    if kind == "circles" and rows % 2 == 0:
        raise ConfigError(f"--size {columns}x{rows}: looks the same after half a turn; use an odd number of rows")
    return board


def _size(kind: str, size: str | None) -> tuple[int, int]:
    if size is None:
        return KINDS[kind]
    match = re.fullmatch(r"\s*(\d{1,4})\s*[x×*]\s*(\d{1,4})\s*", size)
    if match is None or not all(2 <= int(n) <= _MOST for n in match.groups()):
        raise ConfigError(f"--size {size}: give columns and rows of the board's squares, for example 7x5")
    columns, rows = int(match[1]), int(match[2])
    if kind in ("charuco", "chessboard") and min(columns, rows) < 3:
        raise ConfigError(f"--size {size}: a {kind} needs 3 squares along each side, or more")
    return columns, rows


def resized(board: Board, columns: int, rows: int) -> Board:
    """Return the same kind of board with other numbers of columns and rows."""
    return replace(board, columns=columns, rows=rows)
