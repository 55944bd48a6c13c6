"""The world frame: the board on the floor, or the cameras' own orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.calibration.boards import Board
from tk.calibration.bundle import State
from tk.calibration.poses import Pose
from tk.errors import CalibrationError

Float = NDArray[np.float64]

#: largest distance of a board's corners below the floor, and smallest one of a camera above it, metres: a board is bent
#: by some millimetres, a foot of a tripod may stand lower
_NEAR_M = 0.05
#: some board is at least this high, metres; boards that all lie on one table show no floor
_ABOVE_M = 0.4
#: largest median sine of the angle between cameras and the floor
_LEVEL = 0.09
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
        low = [c for c, h in enumerate(_heights(state.boards[floor], state)) if h < _NEAR_M]
        if low:
            raise CalibrationError(
                f"--floor {floor}: {len(low)} of {len(state.cameras)} cameras are below this board; name an instant in "
                "which it lies on the floor, printed side up"
            )
        return World(moved(state, _FLOOR @ state.boards[floor].inverse()), floor, f"the board of instant {floor}")
    tilts = {i: tilt for i, pose in state.boards.items() if (tilt := _floor_tilt(pose, state, board)) is not None}
    if tilts:
        # a tilted board at the edge of the volume may be below all others, too: the cameras are not level above it
        first = min(tilts, key=lambda i: tilts[i])
        placed = moved(state, _FLOOR @ state.boards[first].inverse())
        return World(placed, first, f"the board of instant {first}, recognised as lying on the floor")
    how = "the cameras' orientation; no board lies on the floor for sure: name one with --floor, or use --level"
    return World(_by_cameras(state, board), None, how)


def _heights(floor: Pose, state: State) -> Float:
    """Return (C,) the heights of the cameras above a board, metres."""
    centers = np.array([camera.inverse().translation for camera in state.cameras])
    return -floor.inverse().apply(centers)[:, 2]


def _floor_tilt(pose: Pose, state: State, board: Board) -> float | None:
    """Return how far the cameras are from level above a board, the median sine; None if it is no floor: cameras or
    other boards are below it, or nothing is far above it."""
    if _heights(pose, state).min() < _NEAR_M:
        return None
    inverse = pose.inverse()
    heights = -np.concatenate([inverse.apply(other.apply(board.corners)) for other in state.boards.values()])[:, 2]
    if heights.min() < -_NEAR_M or heights.max() < _ABOVE_M:
        return None
    up = -pose.rotation[:, 2]
    right = np.array([camera.rotation[0] for camera in state.cameras])
    down = np.array([camera.rotation[1] for camera in state.cameras])
    # cameras are mounted upright or sideways; one that looks straight down is level in any case
    tilt = float(np.median(np.minimum(np.abs(right @ up), np.abs(down @ up))))
    return tilt if tilt < _LEVEL else None


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
