"""A superellipsoid body as arrays, as the kernels of the objective and of its contours take it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Columns of ``pieces``, after the 3×4 frame: a1 a2 a3 ε1 ε2 z_lower z_upper, and the last degree of freedom above.
PIECE_SHAPE, PIECE_DOF, PIECE_NUMBERS = 12, 19, 20


class PieceArrays(NamedTuple):
    """A superellipsoid body of D degrees of freedom and P pieces, float64.

    Attributes:
        tree: (D, 11) of :func:`tk.kernels.kinematics.pack_tree`.
        pieces: (P, 20) of :func:`pack_pieces`.
    """

    tree: NDArray[np.float64]
    pieces: NDArray[np.float64]


def pack_pieces(frame: np.ndarray, shape: np.ndarray, dof: np.ndarray) -> NDArray[np.float64]:
    """Pack the pieces of a body into one array (P, 20).

    Args:
        frame: (P, 3, 4) transform from the piece to the zero configuration.
        shape: (P, 7) a1 a2 a3 ε1 ε2 z_lower z_upper.
        dof: (P,) last degree of freedom above each piece.
    """
    return np.column_stack([np.reshape(frame, (-1, 12)), shape, dof]).astype(np.float64)
