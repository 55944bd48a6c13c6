"""Find a chessboard pattern in an image, with or without markers, by its corners.

A corner between black and white squares is a saddle of the grey levels. Saddles are joined to a lattice, each at the
place that its neighbours predict (Geiger et al. 2012, *Automatic camera and range sensor calibration using a single
shot*). The lattice's place on the board is the one at which the rectified image correlates best with the board's
picture. Markers need not be read one by one, so that squares of ten pixels are enough.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.calibration.boards import Board

Float = NDArray[np.float64]
Ids = NDArray[np.int64]
Grey = NDArray[np.uint8]

#: scales of the search for saddles: smoothing before derivatives, and radius of the ring around a saddle, pixels.
#: The second and third ones are for squares of less than 16 pixels, the last one for blurred images.
SCALES_PX = ((1.0, 3.5), (0.7, 2.3), (0.5, 1.6), (2.0, 6.0))
#: most saddles of an image, the strongest ones; a room has fewer than a thousand
_MOST_SADDLES = 1500
#: samples of the ring
_RING = 24
#: share of the ring's variance that two black and two white quarters explain
_QUARTERS = 0.7
#: seeds that are tried; a neighbour is at most this far from its predicted place, share of the distance
_SEEDS, _OFF = 60, 0.3
#: pixels a square of the rectified image
_PX = 16
#: correlation of the rectified image with the board, that of the markers' bits, and its least lead over another place
_CORRELATION, _BITS, _LEAD = 0.6, 0.4, 0.15
#: fewest points of a view that is used: a pose has six unknowns, and a few points may be wrong
FEWEST_POINTS = 8


def find_lattice(grey: Grey, board: Board) -> tuple[Ids, Float] | None:
    """Return numbers (N,) and pixels (N, 2) of the board's inner corners; None if the board is not found."""
    best: tuple[Ids, Float] | None = None
    for smooth_px, ring_px in SCALES_PX:
        found = _find(grey, board, *saddles(grey, smooth_px, ring_px))
        if found is not None and (best is None or len(found[0]) > len(best[0])):
            best = found
        if best is not None and len(best[0]) == len(board.points):
            break
    if best is None:
        return None
    ids, pixels = best[0], _registered(grey, board, *best)
    ids, pixels = ids[np.isfinite(pixels[:, 0])], pixels[np.isfinite(pixels[:, 0])]
    if len(ids) < 4:
        return None
    points = board.points[ids, :2]
    onto, _ = cv2.findHomography(points, pixels, cv2.LMEDS)
    if onto is None:
        return None
    off = np.linalg.norm(_through(onto, points) - pixels, axis=1)
    beside = _through(onto, points + np.array([board.square_m, 0.0])) - _through(onto, points)
    good = off < _STRAY * np.linalg.norm(beside, axis=1)
    return ids[good], pixels[good]


def _find(grey: Grey, board: Board, points: Float, phases: Float) -> tuple[Ids, Float] | None:
    tried: set[int] = set()
    for _ in range(_SEEDS):
        seed = next((k for k in range(len(points)) if k not in tried), None)
        if seed is None:
            break
        tried.add(seed)
        lattice = _grow(seed, points, phases, max(board.columns, board.rows))
        tried |= set(lattice.values())
        if len(lattice) >= FEWEST_POINTS:
            found = _place(grey, board, {ij: points[k] for ij, k in lattice.items()})
            if found is not None:
                return found
    return None


def saddles(grey: Grey, smooth_px: float, ring_px: float) -> tuple[Float, Float]:
    """Return saddles (N, 2), strongest first, and the angle (N,) in [0, π) towards which each is bright."""
    g = cv2.GaussianBlur(grey, (0, 0), smooth_px).astype(np.float32)
    xx, yy, xy = (cv2.Sobel(g, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1)))
    strength = xy * xy - xx * yy
    top = cv2.dilate(strength, np.ones((5, 5), np.uint8))
    y, x = np.nonzero((strength == top) & (strength > 100.0))
    edge = int(ring_px) + 2
    inside = (x >= edge) & (y >= edge) & (x < grey.shape[1] - edge) & (y < grey.shape[0] - edge)
    x, y = x[inside], y[inside]
    order = np.argsort(-strength[y, x])[:_MOST_SADDLES]
    points = np.stack([x, y], axis=1)[order].astype(np.float64)
    if not len(points):
        return points, np.zeros(0)
    # the saddle between the pixels: where the gradient of the local quadric is zero
    gx, gy = cv2.Sobel(g, cv2.CV_32F, 1, 0, ksize=3) / 8, cv2.Sobel(g, cv2.CV_32F, 0, 1, ksize=3) / 8
    i, j = points[:, 1].astype(int), points[:, 0].astype(int)
    H = np.stack([xx[i, j] / 4, xy[i, j] / 4, xy[i, j] / 4, yy[i, j] / 4], axis=1).reshape(-1, 2, 2).astype(np.float64)
    step = np.linalg.solve(H - 1e-6 * np.eye(2), np.stack([gx[i, j], gy[i, j]], axis=1)[:, :, None])[:, :, 0]
    points -= np.clip(step, -1.0, 1.0)
    angle = 2 * np.pi * np.arange(_RING) / _RING
    ring = points[:, None] + ring_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    values = cv2.remap(g, ring[..., 0].astype(np.float32), ring[..., 1].astype(np.float32), cv2.INTER_LINEAR)
    at = points[:, None].astype(np.float32)
    middle = cv2.remap(g, at[..., 0], at[..., 1], cv2.INTER_LINEAR)[:, 0]
    middle = middle - values.mean(axis=1)
    values = values - values.mean(axis=1, keepdims=True)
    spectrum = np.fft.fft(values, axis=1) / _RING
    # even harmonics only: quarters of a perspective image are no right angles
    energy = (np.abs(spectrum[:, [2, 4, 6]]) ** 2).sum(axis=1) * 2
    good = (energy > _QUARTERS * (values**2).mean(axis=1)) & (np.abs(spectrum[:, 2]) > 4.0)
    good &= 2 * np.abs(spectrum[:, 2]) ** 2 > 0.35 * (values**2).mean(axis=1)
    good &= np.abs(middle) < np.abs(spectrum[:, 2])  # not so on a thin line
    return points[good], (-np.angle(spectrum[good, 2]) / 2) % np.pi


def _apart(a: Float | float, b: Float | float) -> Float:
    """Return the angle between directions without a sign, in [0, π/2]."""
    return np.asarray(np.abs((np.asarray(a) - b + np.pi / 2) % np.pi - np.pi / 2))


def _grow(seed: int, points: Float, phases: Float, most: int) -> dict[tuple[int, int], int]:
    """Return the lattice around a saddle: the number of the saddle at each place (i along x, j along y)."""
    lattice = {(0, 0): seed}
    used = {seed}
    away = points - points[seed]
    far = np.linalg.norm(away, axis=1)
    heading = np.arctan2(away[:, 1], away[:, 0])
    opposite = _apart(phases, phases[seed]) > np.pi / 4
    steps: dict[tuple[int, int], Float] = {}
    # edges lie near 45° from the bright direction; a perspective image turns them
    near = [k for k in np.argsort(far)[1:13] if opposite[k]]
    if not near:
        return lattice
    first = min(near, key=lambda k: far[k] * (1 + 2 * abs(_apart(heading[k], phases[seed]) - np.pi / 4)))
    along = away[first]
    if not abs(_apart(heading[first], phases[seed]) - np.pi / 4) < np.pi / 6:
        return lattice
    side = [
        k for k in near
        if k != first and far[k] < 3 * far[first] and _apart(heading[k], heading[first]) > np.radians(25)
        and abs(_apart(heading[k], phases[seed]) - np.pi / 4) < np.pi / 6
    ]  # fmt: skip
    if not side:
        return lattice
    across = away[min(side, key=lambda k: far[k])]
    if along[0] * across[1] - along[1] * across[0] < 0:
        across = -across
    steps[0, 0] = np.stack([along, across])
    waiting = [(0, 0)]
    while waiting:
        i, j = waiting.pop(0)
        here, basis = points[lattice[i, j]], steps[i, j]
        for axis, sign, place in ((0, 1, (i + 1, j)), (0, -1, (i - 1, j)), (1, 1, (i, j + 1)), (1, -1, (i, j - 1))):
            if place in lattice or max(abs(place[0]), abs(place[1])) > most:
                continue
            step = sign * basis[axis]
            length = np.linalg.norm(step)
            off = np.linalg.norm(points - (here + step), axis=1)
            off[_apart(phases, phases[lattice[i, j]]) < np.pi / 4] = np.inf
            best = int(off.argmin())
            if best in used or off[best] > _OFF * length:
                continue
            lattice[place] = best
            used.add(best)
            found = basis.copy()
            found[axis] = sign * (points[best] - here)
            steps[place] = found
            # the other axis from a finished neighbour, so that the lattice follows perspective
            for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                other = place[0] + di, place[1] + dj
                if other in lattice:
                    found[0 if di else 1] = (di + dj) * (points[lattice[other]] - points[best])
            waiting.append(place)
    return lattice


@lru_cache(maxsize=32)
def _picture(board: Board, px: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the board at ``px`` pixels a square, and which pixels are bits of markers."""
    fine, scale = 4, 4 * px / board.square_m
    image = np.ones((fine * px * board.rows, fine * px * board.columns), np.float32)
    for shape in board.shapes():
        x0, y0 = round(shape.x * scale), round(shape.y * scale)
        image[y0 : round((shape.y + shape.height) * scale), x0 : round((shape.x + shape.width) * scale)] = 0.0
    small = cv2.resize(image, None, fx=1 / fine, fy=1 / fine, interpolation=cv2.INTER_AREA)
    bits = np.zeros(small.shape, bool)
    if board.kind == "charuco":
        size = board.markers.markerSize
        for corners in board.charuco.getObjPoints():
            first, last = np.asarray(corners)[[0, 2], :2] * px / board.square_m
            border = (last - first) / (size + 2)
            (x0, y0), (x1, y1) = np.rint(first + border).astype(int), np.rint(last - border).astype(int)
            bits[y0:y1, x0:x1] = True
    return np.asarray(small, np.float32), bits


def _correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return the correlation of two samples; 0 if one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0 else 0.0


def _place(grey: Grey, board: Board, lattice: dict[tuple[int, int], Float]) -> tuple[Ids, Float] | None:
    """Return the lattice's corners by their numbers on the board; None if it is no part of this board."""
    places = np.array(list(lattice))
    low, high = places.min(axis=0), places.max(axis=0)
    size = high - low + 1  # corners along x and y
    corners = (board.columns - 1, board.rows - 1)
    turned = size[0] > corners[0] or size[1] > corners[1]
    if (turned and (size[0] > corners[1] or size[1] > corners[0])) or min(size) < 2:
        return None
    pixels = np.array(list(lattice.values()))
    onto, _ = cv2.findHomography((places - low + 1.0) * _PX - 0.5, pixels)
    if onto is None:
        return None
    shape = ((int(size[0]) + 1) * _PX, (int(size[1]) + 1) * _PX)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    flat = cv2.warpPerspective(grey, onto, shape, flags=flags, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    (sharp, bits), found = _picture(board, _PX), []
    picture = cv2.GaussianBlur(sharp, (0, 0), _PX / 20)  # as images of small squares are
    for turn in range(4):
        part = np.ascontiguousarray(np.rot90(flat, turn))
        spare = (np.array(picture.shape) - part.shape) // _PX
        for row, column in np.ndindex(*np.maximum(spare + 1, 0)):
            there = slice(row * _PX, row * _PX + part.shape[0]), slice(column * _PX, column * _PX + part.shape[1])
            if _correlation(picture[there].ravel(), part.ravel()) > _CORRELATION:
                use = bits[there]
                score = _correlation(picture[there][use], part[use]) if use.any() else 1.0
                found.append((score, turn, row, column))
    found.sort(reverse=True)
    if not found or found[0][0] < _BITS or (len(found) > 1 and found[0][0] - found[1][0] < _LEAD):
        return None
    _, turn, row, column = found[0]
    x, y = (places - low).T
    w, h = size
    for _ in range(turn):  # as np.rot90 turns the image
        x, y, w, h = y, w - 1 - x, h, w
    return (row + y) * corners[0] + column + x, pixels


#: half the window in which a corner is registered: share of a square, and most pixels; samples along it
_WINDOW, _WINDOW_PX, _SAMPLES = 0.55, 12.0, 17
#: pixels a square of the board's picture
_FINE_PX = 32
#: blur of an image that the board's picture gets, pixels
_BLUR_PX = 0.8
#: correlation of the image around a corner with the board's picture below which something hides the corner
_ALIKE = 0.85
#: steps of the registration
_STEPS = 6
#: squares larger than this, pixels, are no plane's image within the window because of the lens; their corners are found
#: on their own, away from markers
_LARGE_PX = 64.0
#: largest distance of a corner from the plane's image, share of a square
_STRAY = 0.35


def _registered(grey: Grey, board: Board, ids: Ids, pixels: Float) -> Float:
    """Return the corners (N, 2), each moved so that the board's picture around it fits the image; NaN if it does not.

    In images of small squares a marker's edge is two pixels from the corner. The picture has this edge, too, so it
    does not move the corner.
    """
    points = board.points[ids, :2] / board.square_m
    onto, _ = cv2.findHomography(points, pixels)
    if onto is None:
        return pixels
    sides = []
    for half in np.array([[0.5, 0.0], [0.0, 0.5]]):
        sides.append(
            float(np.median(np.linalg.norm(_through(onto, points + half) - _through(onto, points - half), axis=1)))
        )
    side = min(sides)  # the shorter one of a tilted board
    if side > _LARGE_PX:
        return sharpened(grey, pixels, side)
    picture = cv2.GaussianBlur(_picture(board, _FINE_PX)[0], (0, 0), _BLUR_PX * _FINE_PX / side)
    window = min(_WINDOW, _WINDOW_PX / side)
    offsets = np.linspace(-window, window, _SAMPLES)
    around = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.5 * (np.linalg.norm(around, axis=1) / (0.6 * window)) ** 2)
    there = points[:, None] + around  # (N, K, 2)
    texel = (there * _FINE_PX - 0.5).astype(np.float32)
    wanted = cv2.remap(picture, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    wanted = wanted - (wanted @ weight / weight.sum())[:, None]
    base = _through(onto, there.reshape(-1, 2)).reshape(there.shape) - _through(onto, points)[:, None]
    image = grey.astype(np.float32)
    gx, gy = cv2.Sobel(image, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(image, cv2.CV_32F, 0, 1) / 8
    found = pixels.copy()
    for _ in range(_STEPS):
        at = (base + found[:, None]).astype(np.float32)
        seen, by_x, by_y = (
            cv2.remap(plane, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for plane in (image, gx, gy)
        )
        seen = seen - (seen @ weight / weight.sum())[:, None]
        gain = ((seen * wanted) @ weight) / ((wanted * wanted) @ weight)
        rows = np.stack([by_x, by_y], axis=2)
        A = np.einsum("nka,nkb,k->nab", rows, rows, weight) + 1e-3 * np.eye(2)
        b = np.einsum("nka,nk,k->na", rows, gain[:, None] * wanted - seen, weight)
        step = np.linalg.solve(A, b[:, :, None])[:, :, 0]
        found += np.clip(step, -1.0, 1.0)
    energy = np.sqrt(((seen * seen) @ weight) * ((wanted * wanted) @ weight))
    hidden = ((seen * wanted) @ weight) < _ALIKE * energy
    lost = hidden | (np.linalg.norm(found - pixels, axis=1) > max(2.0, 0.2 * side))
    return np.where(lost[:, None], np.nan, found)


def sharpened(grey: Grey, pixels: Float, side: float) -> Float:
    """Return corners (N, 2) of squares, or tags, with sides of so many pixels, refined by the directions of edges near
    them."""
    half = int(np.clip(0.09 * side, 3, 8))
    done = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-3
    refined = cv2.cornerSubPix(grey, pixels.astype(np.float32)[:, None].copy(), (half, half), (-1, -1), done)[:, 0]
    moved = np.linalg.norm(refined - pixels, axis=1) > half
    return np.where(moved[:, None], pixels, refined).astype(np.float64)


def _through(homography: NDArray[Any], points: NDArray[Any]) -> Float:
    return np.asarray(cv2.perspectiveTransform(points[:, None], homography)[:, 0], np.float64)
