"""A cone body as arrays, and its parts placed in the world: shared by the kernels of contours and of rays."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.columns import PAIR, SCALAR, TRANSFORM, columns
from tk.kernels.kinematics import carried
from tk.kernels.runtime import ti

# Points nearer to a camera than this are not projected, metres.
NEAREST_M = 0.1
# The parts that may hide a part are the bits of an int64.
MOST_PARTS = 64
# Columns of ``parts``: a, b, h, m of the shape, the 3×4 frame, CONE or ELLIPSOID, the last degree of freedom above the
# part, its limb, its colour group, the last degree of freedom that its contours move.
_SHAPE, PART_FRAME, PART_KIND, PART_DOF, PART_LIMB, PART_GROUP, PART_MOVED, _ = columns(
    PAIR + PAIR, TRANSFORM, SCALAR, SCALAR, SCALAR, SCALAR, SCALAR
)


class ConeArrays(NamedTuple):
    """A cone body as plain arrays (D degrees of freedom, P parts, Q curves), the first two of one real type."""

    tree: NDArray  # (D, 11) of `tk.kernels.kinematics.pack_tree`
    parts: NDArray  # (P, 21) of `pack_parts`
    curves: NDArray[np.int32]  # (Q, 2) int32 part and kind of each curve, see `tk.kernels.cones`


def pack_parts(
    shape: np.ndarray,
    frame: np.ndarray,
    kind: np.ndarray,
    dof: np.ndarray,
    limb: np.ndarray,
    group: np.ndarray,
    moved: np.ndarray,
) -> NDArray:
    """Pack the parts of a body into one array (P, 21), float64.

    Args:
        shape: (P, 4) a, b, h, m.
        frame: (P, 3, 4) transform from the part to the zero configuration.
        kind: (P,) CONE or ELLIPSOID.
        dof: (P,) the last degree of freedom above each part.
        limb: (P,) number of the limb; parts of one limb never make each other's edges ambiguous.
        group: (P,) colour group, from 0.
        moved: (P,) the last degree of freedom that the part's contours move: ``dof``, or one above it.
    """
    return np.column_stack([shape, np.reshape(frame, (-1, 12)), kind, dof, limb, group, moved]).astype(np.float64)


@ti.func
def shape_of(parts: ti.template(), p: int):
    """Return (a, b, h, m) of part p."""
    return ti.Vector([parts[p, i] for i in ti.static(range(4))])


@ti.func
def kind_of(parts: ti.template(), p: int):
    """Return CONE or ELLIPSOID."""
    return ti.cast(parts[p, PART_KIND], ti.i32)


@ti.func
def group_of(parts: ti.template(), p: int):
    """Return the colour group of part p."""
    return ti.cast(parts[p, PART_GROUP], ti.i32)


@ti.func
def place_part(joints: ti.template(), parts: ti.template(), b: int, p: int):
    """Return rotation and translation from part p to the world at pose b."""
    return carried(joints, b, ti.cast(parts[p, PART_DOF], ti.i32), parts, p, PART_FRAME)
