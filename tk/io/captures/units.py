"""The length unit of a calibration, inferred from the distances between its cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

#: metres in one unit
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}

#: metres, range of the largest distance between two cameras of a motion capture
LEAST_APART_M, MOST_APART_M = 0.5, 30.0

#: metres, typical largest distance; of two possible units the one with the nearer distance, as a ratio, is chosen
TYPICAL_APART_M = 5.0


@dataclass(frozen=True)
class FoundUnit:
    """The unit of a calibration.

    Attributes:
        name: "m", "cm" or "mm".
        note: line for the user about how it was inferred; None if there is nothing to report.
    """

    name: str
    note: str | None = None

    @property
    def metres(self) -> float:
        return UNITS[self.name]


def apart(centers: ArrayLike) -> float:
    """Return the largest distance between two cameras, in the unit of ``centers`` (C, 3)."""
    c = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    return float(np.linalg.norm(c[:, None] - c[None], axis=-1).max(initial=0.0))


def infer_unit(centers: ArrayLike, default: str = "m") -> FoundUnit:
    """Return the unit in which the cameras are 0.5 to 30 m apart.

    Args:
        centers: (C, 3) centres of projection, in the unknown unit.
        default: the unit if no unit is possible, or with fewer than two cameras. There is no note if this unit is
            possible.

    Centimetres and millimetres can both be possible: 1200 is 12 m or 1.2 m. The unit nearer to 5 m is chosen, and the
    note names the other one.
    """
    distance = apart(centers)
    possible = [name for name in UNITS if LEAST_APART_M <= distance * UNITS[name] <= MOST_APART_M]
    if distance == 0.0 or default in possible:
        return FoundUnit(default)
    if not possible:
        return FoundUnit(
            default,
            f"lengths are taken for {default}: the cameras are then up to {distance * UNITS[default]:.3g} m apart; no "
            f"unit makes it {LEAST_APART_M:g} to {MOST_APART_M:g} m",
        )
    name = min(possible, key=lambda unit: abs(math.log(distance * UNITS[unit] / TYPICAL_APART_M)))
    others = [f"in {unit} it would be {distance * UNITS[unit]:.3g} m" for unit in possible if unit != name]
    return FoundUnit(
        name,
        f"lengths are taken for {name}: the cameras are then up to {distance * UNITS[name]:.3g} m apart ("
        + "; ".join([f"in {default} it would be {distance * UNITS[default]:.3g} m", *others])
        + ")",
    )
