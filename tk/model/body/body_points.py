"""Points of the body that a network's landmarks mark: joints of the limbs, the face, the feet.

A row of the table is written for the left side; the right one is its mirror image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.joints import LIMBS, ROWS, SEGMENTS, side_of

Float = NDArray[np.float64]

# Points of the face where MediaPipe's network marks them, as shares of the stature: below the crown, in front of the
# line from C7/T1 to the crown, and to the side. Medians of triangulated landmarks of six real people and two rendered
# ones, most of whom differ by less than 0.01. The network marks ears 3 cm in front of the ear hole, which is at (0.076,
# 0.006, 0.043) (ANSUR II survey, Gordon et al. 2014, means of men and women).
_FACE = {"nose": (0.078, 0.074, 0.0), "eye": (0.063, 0.054, 0.016), "ear": (0.077, 0.024, 0.031)}

# Where MediaPipe's network marks a joint, off the joint's centre: forward, outward, up, shares of the stature. Of other
# joints they are within 2 cm.
_MARKED = {"hip": (0.017, 0.0, -0.019), "shoulder": (0.004, -0.009, 0.006), "ankle": (0.007, 0.0, 0.010)}
# Heel and toe in front of the ankle's centre, shares of the foot's length: as in tk.model.body.cone_body.
_HEEL, _TOE = -0.2, 0.8


@dataclass(frozen=True)
class BodyPoint:
    """A point that is fixed to a segment."""

    segment: str
    place: Callable[[BodyDimensions], Float]  # (3,) in the zero configuration, body frame, metres


def _face(name: str, side: float) -> BodyPoint:
    below, front, beside = _FACE[name]

    def place(d: BodyDimensions) -> Float:
        return ROWS["head_top"].place(d) + d.stature * np.array([front, side * beside, -below])

    return BodyPoint("head", place)


def sole_offset(name: str, dimensions: BodyDimensions) -> Float:
    """Return the vector (3,) from the ankle to heel or toe, standing body: forward, left, up, metres; (N, 3) of N
    bodies, dimensions (N, 1)."""
    forward, _, up = np.eye(3)
    share = _HEEL if name.startswith("heel") else _TOE
    return np.asarray(share * dimensions.foot * forward - dimensions.ankle_height * up)


def _foot(name: str, side: str) -> BodyPoint:
    ankle = ROWS[LIMBS["leg" + side][2]].place
    return BodyPoint("foot" + side, lambda d: ankle(d) + sole_offset(name, d))


def _joint(name: str) -> BodyPoint:
    row = ROWS[name]
    front, beside, up = _MARKED.get(row.kind, (0.0, 0.0, 0.0))
    side = 1.0 if side_of(name) == "_l" else -1.0

    def place(d: BodyDimensions) -> Float:
        return row.place(d) + d.stature * np.array([front, side * beside, up])

    return BodyPoint(row.carrier, place)


def _table() -> dict[str, BodyPoint]:
    points = {"nose": _face("nose", 0.0)}
    for name in ("eye", "ear"):
        points |= {name + "_l": _face(name, 1.0), name + "_r": _face(name, -1.0)}
    for limb in ("arm", "leg"):
        for pair in zip(LIMBS[limb + "_l"], LIMBS[limb + "_r"], strict=True):
            points |= {name: _joint(name) for name in pair}
    for name in ("heel", "toe"):
        points |= {name + side: _foot(name, side) for side in ("_l", "_r")}
    return points


#: the points by name
POINTS = _table()
#: names of the landmarks, in the order of all arrays of landmarks
LANDMARKS = tuple(POINTS)
#: landmarks of a segmenter that does not name them: shoulders, elbows, wrists, hips, knees, ankles
JOINT_LANDMARKS = tuple(
    name
    for kind in ("arm", "leg")
    for pair in zip(LIMBS[f"{kind}_l"], LIMBS[f"{kind}_r"], strict=True)
    for name in pair
)
#: (L,) index of the segment that carries each point
SEGMENT = np.array([SEGMENTS.index(point.segment) for point in POINTS.values()], np.int32)


def places(d: BodyDimensions) -> Float:
    """Return the points (L, 3) in the zero configuration, body frame, metres; (N, L, 3) of N bodies, dimensions
    (N, 1)."""
    return np.stack(np.broadcast_arrays(*(point.place(d) for point in POINTS.values())), axis=-2)
