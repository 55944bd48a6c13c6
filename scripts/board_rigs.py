"""Calibrate generated rigs with a rendered board, and compare with the truth.

python -m scripts.board_rigs                 # the three rigs to develop on
python -m scripts.board_rigs --report        # the three rigs to report
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.boards import Recipe, render_boards, true_world
from tk.calibration.boards import Board, make_board
from tk.calibration.footage import read_footage
from tk.calibration.poses import angle_deg
from tk.calibration.rig import Options, calibrate
from tk.calibration.verdict import Verdict, judge, person_points
from tk.model.cameras.camera import Rig

Float = NDArray[np.float64]

_RING4 = ((38, 3.7, 1.3), (128, 3.9, 1.95), (221, 3.75, 1.55), (312, 3.55, 2.15))
_RING5 = (*_RING4, (160, 0.6, 3.4))
_RING8 = tuple((20 + 45 * k, 3.6 + 0.1 * (k % 4), (1.2, 2.1, 1.6, 2.3)[k % 4]) for k in range(8))


def _rig(places: Sequence[tuple[float, float, float]], lenses: Sequence[str], seed: int) -> Recipe:
    return Recipe(tuple((*place, lenses[k % len(lenses)]) for k, place in enumerate(places)), seed=seed)


DEVELOPMENT = {
    "dev4": _rig(_RING4, ["action", "phone"], 1),
    "dev5": _rig(_RING5, ["action wide", "webcam", "action"], 2),
    "dev8": _rig(_RING8, ["phone", "action wide"], 3),
    "dev4 rational": _rig(_RING4, ["rational"], 4),
}
REPORT = {
    "report4": _rig(_RING4, ["action", "action", "webcam", "action wide"], 11),
    "report5": _rig(_RING5, ["action wide", "action"], 12),
    "report8": _rig(_RING8, ["action", "phone", "webcam", "action wide"], 13),
}


#: sides of squares: boards of about 0.8 m
_SQUARES_M = {"charuco": 0.11, "chessboard": 0.08, "circles": 0.07, "aprilgrid": 0.09}


@dataclass(frozen=True)
class Errors:
    """Differences from the truth, after the rigid motion that aligns the cameras: the largest of all cameras.

    Attributes:
        place_mm, turn_deg, focal_percent: centres, directions and focal lengths of the cameras.
        person_mm: root-mean-square error of points triangulated from their true pixels.
    """

    place_mm: float
    turn_deg: float
    focal_percent: float
    person_mm: float


def compare(found: Rig, true: Rig) -> Errors:
    """Return the errors of a calibration."""
    # the rotation between the worlds, from all cameras' rotations; then the translation
    u, _, vt = np.linalg.svd(sum(a.rotation.T @ b.rotation for a, b in zip(true, found, strict=True)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt  # found world to true world
    shift = true.centers.mean(axis=0) - turn @ found.centers.mean(axis=0)
    place = np.linalg.norm(found.centers @ turn.T + shift - true.centers, axis=1).max()
    turns = max(angle_deg(a.rotation @ turn.T, b.rotation) for a, b in zip(found, true, strict=True))
    focal = max(abs(a.matrix[0, 0] / b.matrix[0, 0] - 1) for a, b in zip(found, true, strict=True))
    return Errors(1000 * float(place), float(turns), 100 * float(focal), 1000 * _triangulated(found, true))


def _triangulated(found: Rig, true: Rig) -> float:
    points = person_points(true)
    A, b = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for camera, other in zip(true, found, strict=True):
        use = camera.sees(points)
        pixels, _ = camera.project(points)
        rays = np.zeros((len(points), 3))
        rays[use] = other.rays(pixels[use])
        across = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) * use[:, None, None]
        A += across
        b += across @ other.center
    there = np.linalg.solve(A, b[:, :, None])[:, :, 0]
    u, _, vt = np.linalg.svd((points - points.mean(axis=0)).T @ (there - there.mean(axis=0)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    off = (there - there.mean(axis=0)) @ turn.T - (points - points.mean(axis=0))
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def run(recipe: Recipe, board: Board, folder: Path) -> tuple[Errors, Verdict, float]:
    """Render (unless it was done before), calibrate, and return the errors, the verdict and the seconds."""
    if not any(folder.glob("*/*.png")):
        rig = render_boards(folder, recipe, board)
    else:
        from scripts.synthetic.boards import make_rig

        rig = make_rig(recipe)
    begun = time.perf_counter()
    done = calibrate(*read_footage(folder, board, None, lambda _: None), Options(), lambda _: None)
    seconds = time.perf_counter() - begun
    return compare(done.rig, true_world(rig, recipe, board)), judge(done), seconds


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--report", action="store_true", help="the rigs to report, not those to develop on")
    parser.add_argument("--only", help="one rig")
    parser.add_argument("--board", default="charuco", help="kind of board")
    parser.add_argument("--keep", type=Path, help="folder for the pictures; they are used again if they are there")
    options = parser.parse_args(arguments)
    board = make_board(
        options.board, None, {"charuco": 0.11, "chessboard": 0.08, "circles": 0.07, "aprilgrid": 0.09}[options.board]
    )
    print("| rig | cameras | mm | ° | f, % | person, mm | expected, mm | ratio | px | verdict | s |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name, recipe in (REPORT if options.report else DEVELOPMENT).items():
        if options.only in (None, name):
            with tempfile.TemporaryDirectory() as temporary:
                folder = (options.keep or Path(temporary)) / f"{name}-{options.board}"
                errors, verdict, seconds = run(recipe, board, folder)
            worst = max(one.rms_px for one in verdict.cameras)
            print(
                f"| {name} | {len(recipe.cameras)} | {errors.place_mm:.2f} | {errors.turn_deg:.3f} | "
                f"{errors.focal_percent:.3f} | {errors.person_mm:.3f} | {1000 * verdict.error_m:.3f} | "
                f"{errors.person_mm / (1000 * verdict.error_m):.2f} | {worst:.2f} | "
                f"{verdict.word} | {seconds:.0f} |",
                flush=True,
            )
            for _, text in verdict.reasons:
                print("  ", text)
            for one in verdict.cameras:
                print("  ", one)


if __name__ == "__main__":
    main()
