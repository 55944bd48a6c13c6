"""A cone body as arrays, and its parts placed in the world: what the kernels of contours and of overlap share."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.kinematics import load_rotation, load_translation
from tk.kernels.runtime import ti
from tk.kernels.vectors import product, times

# Nearer than this to a camera nothing is projected, metres.
NEAREST_M = 0.1
# Which parts may hide another is told by the bits of a number.
MOST_PARTS = 64


class ConeArrays(NamedTuple):
    """A cone body as plain arrays (D degrees of freedom, P parts, Q curves), all of one real type.

    Attributes:
        axis, point: (D, 3) twists in the zero configuration.
        prismatic, parent: (D,) int32.
        part_kind: (P,) int32, CONE or ELLIPSOID.
        part_shape: (P, 4) a, b, h, m.
        part_frame: (P, 12) 3×4 transform from the part to the zero configuration.
        part_dof: (P,) int32 the last degree of freedom above each part.
        part_limb: (P,) int32 parts of one limb never make each other's edges ambiguous.
        curve_part, curve_kind: (Q,) int32.
    """

    axis: NDArray
    point: NDArray
    prismatic: NDArray[np.int32]
    parent: NDArray[np.int32]
    part_kind: NDArray[np.int32]
    part_shape: NDArray
    part_frame: NDArray
    part_dof: NDArray[np.int32]
    part_limb: NDArray[np.int32]
    curve_part: NDArray[np.int32]
    curve_kind: NDArray[np.int32]


@ti.func
def shape_of(part_shape: ti.template(), p: int):
    return ti.Vector([part_shape[p, i] for i in ti.static(range(4))])


@ti.func
def place_part(frames: ti.template(), part_dof: ti.template(), part_frame: ti.template(), b: int, p: int):
    """Rotation and translation from part p to the world at pose b."""
    R0 = ti.Matrix([[part_frame[p, 4 * i + j] for j in ti.static(range(3))] for i in ti.static(range(3))])
    t0 = ti.Vector([part_frame[p, 4 * i + 3] for i in ti.static(range(3))])
    R = load_rotation(frames, b, part_dof[p])
    return product(R, R0), times(R, t0) + load_translation(frames, b, part_dof[p])


@ti.func
def keep(placed: ti.template(), b: int, p: int, R, t):
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            placed[b, p, 4 * i + j] = R[i, j]
        placed[b, p, 4 * i + 3] = t[i]
