"""A cue: a measurement as a term of the cost, beside the silhouettes."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.optim.quadratic import Quadratic

Float = NDArray[np.float64]


class Cue(Protocol):
    """What was measured of one person in a frame, or in B frames, about poses (B, D) of a body.

    Attributes:
        weight: of the cue in the contours' equations.
    """

    weight: float

    def normal(self, poses: Float) -> Quadratic:
        """Return the negative logarithm of the likelihood as a quadratic about each pose, nats."""
        ...

    def cost(self, poses: Float) -> Float:
        """Return (B,) the negative logarithm of the likelihood, nats, up to a constant of the frame."""
        ...

    def variance(self, poses: Float) -> Float:
        """Return (B, J) variance of the joints' positions along an axis, metres², by which the measurement contradicts
        the poses."""
        ...
