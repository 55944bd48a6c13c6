"""A superellipsoid body as arrays, and its pieces placed in the world: for the kernels of objective and contours."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.columns import PAIR, SCALAR, TRANSFORM, VECTOR, columns
from tk.kernels.kinematics import carried, rotation_of, translation_of
from tk.kernels.runtime import ti
from tk.kernels.vectors import times

# Columns of ``pieces``: 3×4 frame, a1 a2 a3 ε1 ε2 z_lower z_upper, and the last degree of freedom above.
_FRAME, PIECE_SHAPE, PIECE_DOF, PIECE_NUMBERS = columns(TRANSFORM, VECTOR + PAIR + PAIR, SCALAR)


class PieceArrays(NamedTuple):
    """A superellipsoid body of D degrees of freedom and P pieces, float64."""

    tree: NDArray[np.float64]  # (D, 11) of `tk.kernels.kinematics.pack_tree`
    pieces: NDArray[np.float64]  # (P, 20) of `pack_pieces`


def pack_pieces(frame: np.ndarray, shape: np.ndarray, dof: np.ndarray) -> NDArray[np.float64]:
    """Pack the pieces of a body into one array (P, 20).

    Args:
        frame: (P, 3, 4) transform from the piece to the zero configuration.
        shape: (P, 7) a1 a2 a3 ε1 ε2 z_lower z_upper.
        dof: (P,) last degree of freedom above each piece.
    """
    return np.column_stack([np.reshape(frame, (-1, 12)), shape, dof]).astype(np.float64)


@ti.func
def place_piece(joints: ti.template(), c: int, pieces: ti.template(), i: int):
    """Return rotation and translation from piece i to the world, and centre and radius of a sphere that encloses it."""
    R, t = carried(joints, c, ti.cast(pieces[i, PIECE_DOF], ti.i32), pieces, i, 0)
    low, high = pieces[i, PIECE_SHAPE + 5], pieces[i, PIECE_SHAPE + 6]
    half = 0.5 * (high - low)
    center = t + 0.5 * (low + high) * ti.Vector([R[a, 2] for a in ti.static(range(3))])
    a1, a2 = pieces[i, PIECE_SHAPE], pieces[i, PIECE_SHAPE + 1]
    return R, t, center, ti.sqrt(a1 * a1 + a2 * a2 + half * half)


@ti.func
def to_zero_configuration(pieces: ti.template(), i: int, q):
    """Transform a point from the frame of piece i to the zero configuration, where it is a material point."""
    return times(rotation_of(pieces, i, 0), q) + translation_of(pieces, i, 0)
