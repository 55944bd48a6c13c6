"""Find a board's points in an image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.calibration.boards import APRIL_BORDER, Board
from tk.calibration.lattice import FEWEST_POINTS, find_lattice, sharpened

Float = NDArray[np.float64]
Ids = NDArray[np.int64]
Grey = NDArray[np.uint8]

#: largest root-mean-square distance of a view's points from a plane's image (a homography), as a share of the view's
#: size. Lenses of action cameras bend a board that fills the image by 0.02; points of another board are off by 0.1.
_UNPLANAR = 0.05
#: area of a circle in an image: least, pixels; most, share of the image
_LEAST_BLOB_PX, _MOST_BLOB = 12, 0.02


@dataclass(frozen=True)
class Detection:
    """A board's points in one image."""

    ids: Ids  # (N,) numbers of the points, see Board.points
    pixels: Float  # (N, 2)
    sharpness: float  # slope of edges at the points, share of their contrast a pixel: 0.5 is sharp, below 0.15 blurred


def detect(grey: Grey, board: Board) -> Detection | None:
    """Return the points of a board in a grey image (H, W); None if fewer than :data:`FEWEST_POINTS` are found."""
    found = _FINDERS[board.kind](grey, board)
    if found is None or len(found[0]) < FEWEST_POINTS:
        return None
    ids, pixels = found
    if not _is_planar(board, ids, pixels):
        return None
    return Detection(ids, pixels, _sharpness(grey, pixels))


def _is_planar(board: Board, ids: Ids, pixels: Float) -> bool:
    """Return whether the points are the image of a plane seen from its printed side."""
    onto, _ = cv2.findHomography(board.points[ids, :2], pixels)
    if onto is None:
        return False
    seen = cv2.perspectiveTransform(board.points[ids, None, :2], onto)[:, 0]
    size = np.linalg.norm(np.ptp(pixels, axis=0))
    middle = onto @ [*board.points[ids, :2].mean(axis=0), 1.0]
    right_side = np.linalg.det(onto) * middle[2] > 0
    return bool(right_side and np.sqrt(((seen - pixels) ** 2).sum(axis=1).mean()) < _UNPLANAR * size)


def _sharpness(grey: Grey, pixels: Float) -> float:
    """Return the median over the points of the largest slope near the point, as a share of the contrast there."""
    values = []
    for x, y in np.rint(pixels[:: max(1, len(pixels) // 24)]).astype(int):
        patch = grey[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5].astype(np.float32)
        if min(patch.shape) < 5:
            continue
        across, down = (patch[2:, 1:-1] - patch[:-2, 1:-1]) / 2, (patch[1:-1, 2:] - patch[1:-1, :-2]) / 2
        values.append(float(np.hypot(across, down).max() / max(float(np.ptp(patch)), 1.0)))
    return float(np.median(values)) if values else 0.0


@lru_cache(maxsize=8)
def _charuco_detector(board: Board) -> Any:
    return cv2.aruco.CharucoDetector(board.charuco)


def _charuco(grey: Grey, board: Board) -> tuple[Ids, Float] | None:
    found = find_lattice(grey, board)
    if found is None or len(found[0]) < len(board.points):
        # large squares, or a board that is partly hidden: by its markers
        corners, ids, _, _ = _charuco_detector(board).detectBoard(grey)
        if ids is not None and len(ids) > max(3, 0 if found is None else len(found[0])):
            numbers, pixels = np.asarray(ids).ravel().astype(np.int64), np.asarray(corners, np.float64).reshape(-1, 2)
            found = numbers, _refined(grey, board, numbers, pixels)
    return found


def _refined(grey: Grey, board: Board, ids: Ids, pixels: Float) -> Float:
    """Return corners between black and white quarters, refined."""
    onto, _ = cv2.findHomography(board.points[ids, :2], pixels)
    if onto is None:
        return pixels
    around = board.points[ids, None, :2] + board.square_m * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    seen = cv2.perspectiveTransform(around.reshape(-1, 1, 2), onto).reshape(-1, 3, 2)
    return sharpened(grey, pixels, float(np.linalg.norm(seen[:, 1:] - seen[:, :1], axis=2).min()))


def _chessboard(grey: Grey, board: Board) -> tuple[Ids, Float] | None:
    found = find_lattice(grey, board)
    if found is None or len(found[0]) < len(board.points):  # a part of a chessboard could be anywhere on it
        return None
    return found


def _circles(grey: Grey, board: Board) -> tuple[Ids, Float] | None:
    opencv: Any = cv2  # its stubs lack these classes
    parameters = opencv.SimpleBlobDetector_Params()
    parameters.minArea, parameters.maxArea = _LEAST_BLOB_PX, _MOST_BLOB * grey.size
    parameters.minDistBetweenBlobs = 4
    blobs = opencv.SimpleBlobDetector_create(parameters)
    size = (board.columns, board.rows)
    for flags in (cv2.CALIB_CB_ASYMMETRIC_GRID, cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
        ok, centers = cv2.findCirclesGrid(grey, size, flags=flags, blobDetector=blobs)
        if ok:
            pixels = np.asarray(centers, np.float64).reshape(-1, 2)
            return np.arange(len(pixels)), pixels
    return None


def _tag_detectors(board: Board) -> list[Any]:
    found = []
    for border in (APRIL_BORDER, 1):
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        found.append(cv2.aruco.ArucoDetector(board.markers, parameters))
    return found


def _aprilgrid(grey: Grey, board: Board) -> tuple[Ids, Float] | None:
    tags = board.columns * board.rows
    best: tuple[Ids, Float] | None = None
    for detector in _tag_detectors(board):
        corners, ids, _ = detector.detectMarkers(grey)
        if ids is None:
            continue
        known = [(int(i), np.asarray(c, np.float64).reshape(4, 2)) for i, c in zip(ids.ravel(), corners, strict=True)]
        known = [(i, c) for i, c in known if i < tags]
        if len(known) < 2 or (best is not None and 4 * len(known) <= len(best[0])):
            continue
        # generators of tags differ in which corner is the first: the turn that fits a plane is right
        fits = []
        for turn in range(4):
            numbers = np.concatenate([4 * i + np.arange(4) for i, _ in known])
            pixels = np.concatenate([np.roll(c, turn, axis=0) for _, c in known])
            onto, _ = cv2.findHomography(board.points[numbers, :2], pixels, cv2.RANSAC, 5.0)
            if onto is not None:
                seen = cv2.perspectiveTransform(board.points[numbers, None, :2], onto)[:, 0]
                fits.append((float(np.median(np.linalg.norm(seen - pixels, axis=1))), turn, numbers, pixels))
        if fits:
            _, _, numbers, pixels = min(fits, key=lambda fit: fit[:2])
            best = numbers, _refined(grey, board, numbers, pixels)
    return best


_FINDERS = {"charuco": _charuco, "chessboard": _chessboard, "circles": _circles, "aprilgrid": _aprilgrid}
