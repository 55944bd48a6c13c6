"""Calibrate cameras with a ChArUco board and write `calibration.toml`: metres, z up, the floor at z = 0.

    python -m scripts.calibrate_cameras --print board.png
    python -m scripts.calibrate_cameras boards --square 0.11 -o CAPTURE/calibration.toml

boards/<camera>/<n>.png (or .jpg): pictures with the same n show the board at the same moment, or where it lies still.
The first n shows it flat on the floor. Some 20 places seen by two cameras and more, and 10 close to each camera, are
enough.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tk.io.captures.pictures import PICTURE_SUFFIXES, picture_number

Float = NDArray[np.float64]
Pose = tuple[Any, Any]
"""Rodrigues vector (3, 1) and translation (3, 1), metres, as OpenCV's `composeRT` takes them."""

SQUARES = (7, 5)
MARKER_SHARE = 0.75  # side of a marker, share of a square's
FEWEST_CORNERS = 8  # of 24: below this a picture of the board is not used
#: metres, range of the side of a square
SQUARES_M = (0.005, 1.0)
#: one focal length, two radial terms: what some ten pictures a camera determine
LENS = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
#: OpenCV's board has z into the paper: the floor's z points up
FLOOR: Pose = (np.array([[np.pi], [0.0], [0.0]]), np.zeros((3, 1)))


def make_board(square_m: float) -> Any:
    """Return the ChArUco board with squares of this side, metres."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.CharucoBoard(SQUARES, square_m, MARKER_SHARE * square_m, dictionary)


def calibrate(folder: Path, square_m: float) -> tuple[dict[str, dict[str, Any]], float]:
    """Return the cameras as tables of `calibration.toml`, and the median error of the corners, pixels.

    Raises:
        ValueError: no camera sees the board on the floor, or a camera shares no picture with the others.
    """
    board = make_board(square_m)
    detector = cv2.aruco.CharucoDetector(board)
    cameras: dict[str, dict[str, Any]] = {}
    seen: dict[tuple[str, int], Sequence[Float]] = {}  # corners on the board (N, 3), in the picture (N, 2)
    for own in sorted(path for path in folder.iterdir() if path.is_dir()):
        for number, file in _pictures(own).items():
            gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            if gray is None:
                raise ValueError(f"{file}: is not a picture that can be decoded")
            corners, ids, _, _ = detector.detectBoard(gray)
            if ids is not None and len(ids) >= FEWEST_CORNERS:
                points, pixels = board.matchImagePoints(corners, ids)
                seen[own.name, number] = points.reshape(-1, 3), pixels.reshape(-1, 2)
        views = [both for (name, _), both in seen.items() if name == own.name]
        if not views:
            raise ValueError(f"{own}: the board is found in none of its pictures")
        points, pixels = ([view[i] for view in views] for i in (0, 1))
        size = gray.shape[::-1]
        _, matrix, distortions, _, _ = cv2.calibrateCamera(points, pixels, size, None, None, flags=LENS)
        cameras[own.name] = {"size": list(size), "matrix": matrix, "distortions": distortions.ravel()}
    if not cameras:
        raise ValueError(f"{folder}: holds no folder of pictures; it needs one a camera")
    floor = min(number for name in cameras for number in _pictures(folder / name))
    if not any((name, floor) in seen for name in cameras):
        raise ValueError(f"no camera finds the board in picture {floor}, on the floor: lay it nearer to a camera")
    seen = {(c, n): both for (c, n), both in seen.items() if n == floor or sum((d, n) in seen for d in cameras) > 1}
    lens = {name: (camera["matrix"], camera["distortions"]) for name, camera in cameras.items()}

    # boards to cameras; from these, picture by picture, cameras (world to camera) and boards (board to world)
    found = {(c, n): cv2.solvePnP(*both, *lens[c])[1:] for (c, n), both in seen.items()}
    poses: dict[str | int, Pose] = {floor: FLOOR}
    for _ in range(len(cameras) + 1):
        for (c, n), pose in found.items():
            if n in poses and c not in poses:
                poses[c] = cv2.composeRT(*_inverse(poses[n]), *pose)[:2]
            elif c in poses and n not in poses:
                poses[n] = cv2.composeRT(*pose, *_inverse(poses[c]))[:2]
    apart = [name for name in cameras if name not in poses]
    if apart:
        raise ValueError(f"{', '.join(apart)}: no picture of the board is shared with the other cameras")
    seen = {(c, n): both for (c, n), both in seen.items() if n in poses}
    free = [key for key in poses if key != floor]

    def residuals(x: Float) -> Float:
        """Distances between projected and detected corners, pixels."""
        now = {floor: FLOOR, **dict(zip(free, x.reshape(-1, 2, 3, 1), strict=True))}
        errors = []
        for (c, n), (points, pixels) in seen.items():
            view = cv2.composeRT(*now[n], *now[c])[:2]
            errors.append(cv2.projectPoints(points, *view, *lens[c])[0].reshape(-1, 2) - pixels)
        return np.concatenate(errors).ravel()

    # soft: a picture in which the board moved counts little
    start = np.ravel([poses[key] for key in free])
    x = least_squares(residuals, start, loss="soft_l1", ftol=1e-5).x
    for key, (rotation, translation) in zip(free, x.reshape(-1, 2, 3), strict=True):
        if isinstance(key, str):
            cameras[key] |= {"name": key, "rotation": rotation, "translation": translation}
    return cameras, float(np.median(np.linalg.norm(residuals(x).reshape(-1, 2), axis=1)))


def _pictures(folder: Path) -> dict[int, Path]:
    """Return the pictures in a folder, by their number."""
    found: dict[int, Path] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in PICTURE_SUFFIXES or file.name.startswith("."):
            continue
        number = picture_number(file)
        if number is None or number in found:
            raise ValueError(f"{file}: needs a number at the end of its name, and one that no other picture has")
        found[number] = file
    return found


def _inverse(pose: Pose) -> Pose:
    rotation, translation = pose
    return -rotation, -cv2.Rodrigues(rotation)[0].T @ translation


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("boards", nargs="?", type=Path, help="folder with a folder of pictures a camera")
    parser.add_argument("--square", type=float, default=0.11, help="side of a printed square, metres: measure it")
    parser.add_argument("--print", type=Path, metavar="PNG", help="write the board to print, and stop")
    parser.add_argument("-o", "--output", type=Path, default=Path("calibration.toml"))
    options = parser.parse_args(arguments)
    if options.print:
        cv2.imwrite(str(options.print), make_board(0.11).generateImage((4200, 3000)))
        return
    if options.boards is None:
        parser.error("give the folder of the pictures, or --print")
    if not SQUARES_M[0] <= options.square <= SQUARES_M[1]:
        sys.exit(
            f"--square {options.square:g}: the side of a square is in metres, {SQUARES_M[0]:g} to {SQUARES_M[1]:g}; "
            "divide millimetres by 1000"
        )
    try:
        cameras, error = calibrate(options.boards, options.square)
    except ValueError as problem:
        sys.exit(str(problem))
    tables: dict[str, Any] = {
        name: {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in camera.items()}
        for name, camera in cameras.items()
    }
    options.output.write_text(tomli_w.dumps({**tables, "metadata": {"units": "m"}}), encoding="utf-8")
    print(f"{options.output}: {len(cameras)} cameras; median error {error:.2f} px (below 1 is good)")


if __name__ == "__main__":
    main()
