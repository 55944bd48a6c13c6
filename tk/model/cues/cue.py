"""A cue: a measurement as a term of the cost, beside the silhouettes.

What was measured of a person in a frame is an array (V, N, K) for each kind of cue, by its name: K numbers of N points
in V views, NaN where they are unknown. Of F frames the arrays are (F, V, N, K).

Costs are in nats. Only the contours' equations have a unit of their own: squared pixels, summed along the contour. They
become nats when they are multiplied by the information of one pixel of contour (:func:`information`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tk.optim.quadratic import Quadratic

Float = NDArray[np.float64]
Measured = Mapping[str, Float]
"""What was measured of a person, by the names of the cues; without those of which nothing is known."""

# Edgels within this length of a contour err together, pixels.
CORRELATION_PX = 10.0
# Standard deviation of an edgel's distance from the contour of a known body, pixels: ragged masks.
EDGE_NOISE_PX = 2.0


def information(noise_px: float) -> float:
    """Return the information of one pixel of contour, 1/px², where edgels have this standard deviation, pixels."""
    return 1.0 / (noise_px**2 * CORRELATION_PX)


#: that of a frame's contours
CONTOUR_INFORMATION = information(EDGE_NOISE_PX)


class Cue(Protocol):
    """What was measured of one person in a frame, or in B frames, about poses (B, D) of a body.

    Attributes:
        weight: factor of :meth:`normal` where it is added to the contours' equations of a frame for a step. These count
            edgels of a segment as independent, but clothes and wrong pieces of a mask displace all of them together.
            Where sigma is computed, this displacement is an unknown, and the factor is 1.
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


def joined(frames: Sequence[Measured]) -> dict[str, Float]:
    """Return what was measured in F frames together."""
    known = {name: values for frame in frames for name, values in frame.items()}
    return {
        name: np.array([frame.get(name, np.full(values.shape, np.nan)) for frame in frames])
        for name, values in known.items()
    }


def in_frames(measured: Measured, rows: int | NDArray[np.int64], used: NDArray[np.bool_] | bool = True) -> Measured:
    """Return what was measured in a row, or in some rows, of several frames, by the views used, (V,) or (rows, V)."""
    kept = np.asarray(used)[..., None, None]
    seen = {name: np.where(kept, values[rows], np.nan) for name, values in measured.items()}
    return {name: values for name, values in seen.items() if np.isfinite(values).any()}
