"""The world frame: the board on the floor, or the cameras' own orientation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.calibration.boards import Board
from tk.calibration.bundle import State
from tk.calibration.poses import Pose, exp
from tk.errors import CalibrationError

Float = NDArray[np.float64]

#: largest distance of a board's corners below the floor, metres: a board is bent by some millimetres, a foot of a
#: tripod may stand lower
_BELOW_M = 0.04
#: lowest camera above the floor, metres
_LOWEST_M = 0.05
#: boards on the floor agree in its normal within this, degrees
_FLAT_DEG = 3.0
#: z of the world is up, out of the printed side: OpenCV's board has z into the paper
_FLOOR = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


@dataclass(frozen=True)
class World:
    """The world frame.

    Attributes:
        state: the estimate in this world.
        floor: the instant whose board lies on the floor; None if there is none.
        how: how the frame was found, in words.
    """

    state: State
    floor: int | None
    how: str


def place_world(state: State, board: Board, floor: int | None) -> World:
    """Return the estimate in the world of the board on the floor: its upper left corner is the origin, x points along
    its upper edge, z up.

    Args:
        state: the estimate in any frame.
        board: the board.
        floor: the instant in which it lies on the floor; None: recognise it.

    Raises:
        CalibrationError: the named instant has no board, or cameras would be below the floor.
    """
    if floor is not None:
        if floor not in state.boards:
            near = min(state.boards, key=lambda i: abs(i - floor))
            raise CalibrationError(
                f"--floor {floor}: no camera finds a sharp board at this instant; the nearest one is {near}"
            )
        low = [c for c, h in enumerate(_heights(state.boards[floor], state)) if h < _LOWEST_M]
        if low:
            raise CalibrationError(
                f"--floor {floor}: {len(low)} cameras are below this board; name an instant in which it lies on the "
                "floor, printed side up"
            )
        return World(moved(state, _FLOOR @ state.boards[floor].inverse()), floor, f"the board of instant {floor}")
    candidates = [i for i, pose in state.boards.items() if _is_floor(pose, state, board)]
    if candidates:
        first = min(candidates)
        placed = moved(state, _FLOOR @ state.boards[first].inverse())
        return World(placed, first, f"the board of instant {first}, recognised as lying on the floor")
    return World(_by_cameras(state, board), None, "the cameras' orientation; no board lies on the floor")


def _heights(floor: Pose, state: State) -> Float:
    """Return (C,) the heights of the cameras above a board, metres."""
    centers = np.array([camera.inverse().translation for camera in state.cameras])
    return -floor.inverse().apply(centers)[:, 2]


def _is_floor(pose: Pose, state: State, board: Board) -> bool:
    """Return whether all cameras and all other boards are above a board's plane."""
    if _heights(pose, state).min() < _LOWEST_M:
        return False
    inverse = pose.inverse()
    others = np.concatenate([inverse.apply(other.apply(board.corners)) for other in state.boards.values()])
    heights = -others[:, 2]
    span = np.ptp(heights)
    # a board that is lifted by hand is above others; one alone, or all in one plane, tells nothing
    return bool(heights.min() > -_BELOW_M and span > 0.3 and _level_enough(pose, state))


def _level_enough(pose: Pose, state: State) -> bool:
    """Return whether cameras are less than 60° from level above this floor: people mount them upright or sideways."""
    up = -pose.rotation[:, 2]
    forward = np.array([camera.rotation[2] for camera in state.cameras])
    right = np.array([camera.rotation[0] for camera in state.cameras])
    down = np.array([camera.rotation[1] for camera in state.cameras])
    level = np.minimum(np.abs(right @ up), np.abs(down @ up))
    return bool(np.median(level) < 0.35 and np.median(forward @ up) < 0.35)


def _by_cameras(state: State, board: Board) -> State:
    """Return the estimate with z along the direction that is perpendicular to the cameras' horizontal axes, the
    lowest point of any board at z = 0."""
    right = np.array([camera.rotation[0] for camera in state.cameras])
    down = np.array([camera.rotation[1] for camera in state.cameras])
    up = np.linalg.eigh(right.T @ right + 1e-3 * np.eye(3))[1][:, 0]
    up *= -np.sign((down @ up).mean() or -1.0)
    x = right[0] - (right[0] @ up) * up
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(up, x), up])
    centers = np.array([camera.inverse().translation for camera in state.cameras]) @ turn.T
    corners = np.concatenate([pose.apply(board.corners) for pose in state.boards.values()]) @ turn.T
    middle = np.append(centers[:, :2].mean(axis=0), corners[:, 2].min())
    return moved(state, Pose(turn, -middle))


def moved(state: State, motion: Pose) -> State:
    """Return the estimate in another world frame; ``motion`` leads from the old one to the new one."""
    back = motion.inverse()
    cameras = tuple(camera @ back for camera in state.cameras)
    return State(state.lenses, cameras, {i: motion @ pose for i, pose in state.boards.items()})


def below_floor(names: Sequence[str], state: State) -> list[str]:
    """Return the cameras that are below the floor."""
    heights: Mapping[str, float] = {
        name: float(camera.inverse().translation[2]) for name, camera in zip(names, state.cameras, strict=True)
    }
    return [name for name, height in heights.items() if height < _LOWEST_M]


__all__ = ["World", "below_floor", "exp", "moved", "place_world"]
