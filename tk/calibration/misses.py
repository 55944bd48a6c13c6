"""Why no board is found in a camera's images: the nearest miss, in one line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.calibration.boards import KINDS, Board, dictionaries, make_board, resized
from tk.calibration.detection import detect
from tk.calibration.footage import Footage
from tk.calibration.lattice import SCALES_PX, saddles

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: markers in an image that are no accident
_FEWEST_MARKERS = 4
#: a standard deviation of grey levels below which an image shows nothing, and a mean below which it is dark
_FLAT, _DARK = 4.0, 18.0
#: images that are searched for other boards
_LIKELY = 4
#: sizes of boards that are tried
_SIZES = range(3, 15)
#: mean distance of markers from their places on a board of the right size, share of a marker's side
_FITS = 0.25
#: boards with markers
_MARKED = ("charuco", "aprilgrid")


def explain_miss(footage: Footage, board: Board, others: Sequence[str] = ()) -> str:
    """Return why a board is found in too few images of a camera, in one line with the remedy.

    Args:
        footage: of the camera.
        board: the board that was searched for.
        others: further cameras without the board.
    """
    also = f" (nor in {', '.join(others)})" if others else ""
    count = len(footage.seen)
    images = f"{len(footage.instants)} images"
    if count:
        head = f"camera {footage.name}: too few views: the board {board.title} is in {count} of {images}{also}"
    else:
        head = f"camera {footage.name}: no board {board.title} in {images}{also}"
    return f"{head}; {_nearest(footage.samples, board)}"


def _nearest(samples: Sequence[Grey], board: Board) -> str:
    if samples and all(float(grey.std()) < _FLAT for grey in samples):
        return "the images are of one colour: is the lens covered, or is this the right file?"
    # images with many corners first: they show a board, if any does
    likely = sorted(samples, key=lambda grey: -len(saddles(grey, *SCALES_PX[0])[0]))[:_LIKELY]
    for look in (_mirrored, _other_board, _blurred):
        for grey in likely if look is not _blurred else samples:
            found = look(grey, board)
            if found:
                return found
    if samples and all(float(grey.mean()) < _DARK for grey in samples):
        return "the images are dark: add light"
    return (
        "show the whole board at ten places and more, its squares 20 pixels wide or more; is it the board that --board "
        "and --size describe?"
    )


def _mirrored(grey: Grey, board: Board) -> str | None:
    flipped = np.ascontiguousarray(grey[:, ::-1])
    if detect(flipped, board) is None:
        return None
    return (
        "a mirrored one is found: print the board unmirrored, or switch off mirroring in the camera (front cameras of "
        "phones mirror their videos)"
    )


def _blurred(grey: Grey, board: Board) -> str | None:
    small = grey
    while min(small.shape) > 2 * max(board.columns, board.rows):  # a square has two pixels: smaller ones show nothing
        small = np.asarray(cv2.pyrDown(small), np.uint8)
        if detect(small, board) is not None:
            return (
                f"one is found at {len(small) / len(grey):.2g} of the images' size: they are blurred or noisy: focus "
                "the camera, hold the board still, add light"
            )
    return None


def _other_board(grey: Grey, board: Board) -> str | None:
    """Return which other board the image shows."""
    marks = _markers(grey, board, board.dictionary) if board.kind in _MARKED else {}
    if len(marks) >= _FEWEST_MARKERS:
        size = _size_of(marks, board)
        if size == (board.columns, board.rows):
            return "its markers are found, but too few of them together: show the whole board, nearer to the camera"
        if size is not None:
            return f"a board {size[0]}x{size[1]} of these markers is found: give --size {size[0]}x{size[1]}"
        return f"markers {min(marks)} to {max(marks)} of {board.dictionary} are found, in other places: give its --size"
    best, most = "", _FEWEST_MARKERS - 1
    for name in dictionaries():
        if name != board.dictionary and name == name.lower() and not name.endswith(("_100", "_250", "_1000")):
            kind = "aprilgrid" if name.startswith("apriltag") else "charuco"
            found = len(_markers(grey, replace(board, kind=kind), name))
            if found > most:
                best, most = name, found
    if best:
        return f"{most} markers of another dictionary are found: give --dictionary {best}"
    for other in _other_patterns(board):
        if detect(grey, other) is not None:
            option = f"--size {other.columns}x{other.rows}"
            return f"a {other.title} is found: give --board {other.kind} {option}"
    return None


def _markers(grey: Grey, board: Board, dictionary: str) -> dict[int, Float]:
    """Return the corners (4, 2) of the markers in an image, by number."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate = 0.3  # other dictionaries must not fit by chance
    found: dict[int, Float] = {}
    for border in (1, 2) if board.kind == "aprilgrid" else (1,):
        parameters.markerBorderBits = border
        detector = cv2.aruco.ArucoDetector(replace(board, dictionary=dictionary).markers, parameters)
        corners, ids, _ = detector.detectMarkers(grey)
        if ids is not None and len(ids) > len(found):
            flat = np.asarray(ids).ravel().tolist()
            found = {i: np.asarray(c, np.float64).reshape(4, 2) for i, c in zip(flat, corners, strict=True)}
    return found


def _size_of(marks: dict[int, Float], board: Board) -> tuple[int, int] | None:
    """Return the columns and rows of the smallest board on which the markers are where they are in the image."""
    fits = []
    centers = {i: corners.mean(axis=0) for i, corners in marks.items()}
    for columns in _SIZES:
        for rows in _SIZES:
            places = _places(resized(board, columns, rows))
            if places is None or not set(marks) <= set(places):
                continue
            onto, _ = cv2.findHomography(
                np.array([places[i] for i in marks]), np.array([centers[i] for i in marks]), cv2.RANSAC, 4.0
            )
            if onto is None:
                continue
            seen = cv2.perspectiveTransform(np.array([[places[i] for i in marks]]), onto)[0]
            side = np.median([np.linalg.norm(corners[0] - corners[1]) for corners in marks.values()])
            error = float(np.mean([np.linalg.norm(seen[k] - centers[i]) for k, i in enumerate(marks)]) / side)
            fits.append((error > _FITS, columns * rows, error, columns, rows))
    if not fits or min(fits)[0]:
        return None
    return min(fits)[3:]


def _places(board: Board) -> dict[int, Float] | None:
    """Return the centres (2,) of a board's markers, by number; None if the dictionary has too few."""
    count = board.columns * board.rows // (1 if board.kind == "aprilgrid" else 2)
    if count > len(board.markers.bytesList):
        return None
    if board.kind == "aprilgrid":
        return dict(enumerate(board.points[:, :2].reshape(-1, 4, 2).mean(axis=1)))
    ids, corners = board.charuco.getIds().ravel(), board.charuco.getObjPoints()
    return {int(i): np.asarray(c, np.float64)[:, :2].mean(axis=0) for i, c in zip(ids, corners, strict=True)}


def _other_patterns(board: Board) -> Iterator[Board]:
    """Yield boards that are often confused with this one."""
    if board.kind == "chessboard":
        # inner corners counted instead of squares, one more or less, sides exchanged
        for columns, rows in ((1, 1), (-1, -1), (0, -1), (-1, 0), (0, 1), (1, 0), (-2, -2)):
            if board.columns + columns >= 3 and board.rows + rows >= 3:
                yield resized(board, board.columns + columns, board.rows + rows)
    if board.kind in ("chessboard", "circles"):
        yield resized(board, board.rows, board.columns)
    yield from (make_board(kind, None, board.square_m) for kind in KINDS if kind != board.kind)
