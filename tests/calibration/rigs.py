"""Cameras around a room, and what they would see of a board: points with noise, without images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.boards import Recipe, make_rig, place_boards
from tk.calibration.boards import Board, make_board
from tk.calibration.detection import FEWEST_POINTS, Detection
from tk.calibration.footage import Footage, Seen
from tk.calibration.poses import Pose
from tk.calibration.rig import Options
from tk.model.cameras.camera import Camera, Rig

Float = NDArray[np.float64]

BOARD = make_board("charuco", None, 0.11)
RECIPE = Recipe(
    ((30, 3.2, 1.4, "phone"), (85, 3.4, 2.0, "webcam"), (150, 3.2, 1.6, "action")),
    size=(800, 600), shared=14, close=6, seed=5,
)  # fmt: skip
RIG = make_rig(RECIPE)
POSES = place_boards(RECIPE, RIG, BOARD)
#: one lens model, to save the time of the choice
QUICK = Options(model="pinhole5")
NOISE_PX = 0.05


def visible(camera: Camera, pose: Pose, board: Board) -> tuple[NDArray[np.int64], Float]:
    """Return the numbers and pixels of the board's points that a camera sees from the printed side."""
    points = pose.apply(board.points)
    pixels, _ = camera.project(points)
    facing = pose.rotation[:, 2] @ (points.mean(axis=0) - camera.center) > 0.2
    inside = np.flatnonzero(camera.sees(points)) if facing else np.zeros(0, np.int64)
    return inside, pixels[inside]


def see(
    camera: Camera, poses: dict[int, Pose], index: int, board: Board = BOARD, noise_px: float = NOISE_PX
) -> Footage:
    """Return a camera's footage of a board in these poses; those close to other cameras are left out."""
    rng = np.random.default_rng(index)
    footage = Footage(camera.name, Path("boards") / camera.name, camera.width, camera.height)
    for instant, pose in poses.items():
        if instant >= 100 and not 100 + 20 * index <= instant < 120 + 20 * index:
            continue
        footage.instants.append(instant)
        ids, pixels = visible(camera, pose, board)
        if len(ids) >= FEWEST_POINTS:
            found = Detection(ids, pixels + noise_px * rng.normal(size=pixels.shape), 0.4)
            outline, _ = camera.project(pose.apply(board.corners))
            footage.seen[instant] = Seen(found, np.nan_to_num(outline), 0.0, b"")
    footage.samples = [np.zeros((60, 80), np.uint8)]
    return footage


def footages(noise_px: float = NOISE_PX) -> list[Footage]:
    """Return the footage of all cameras."""
    return [see(camera, POSES, c, noise_px=noise_px) for c, camera in enumerate(RIG)]


def keep(footage: Footage, *instants: int) -> Footage:
    """Return a footage with the board in these instants only."""
    return replace(footage, seen={i: footage.seen[i] for i in instants if i in footage.seen})


__all__ = ["BOARD", "POSES", "QUICK", "RIG", "Rig", "footages", "keep", "see", "visible"]
