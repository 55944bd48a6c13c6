"""Landmarks: joints that a segmenter's network sees in the images, triangulated.

Silhouettes hardly show which way a person faces, nor which of two crossing legs is the left one. Networks that were
trained on photographs see it: faces, feet and the fronts of clothes differ. Their landmarks are some centimetres off,
so they propose poses, and do not move the pose that the silhouettes show.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import JOINTS, LIMBS

Float = NDArray[np.float64]

#: joints of landmarks (..., 12, 3), the left and the right one of each
LANDMARKS = tuple(
    name
    for kind in ("arm", "leg")
    for pair in zip(LIMBS[f"{kind}_l"], LIMBS[f"{kind}_r"], strict=True)
    for name in pair
)
#: their places among the joints
ROWS = np.array([JOINTS.index(name) for name in LANDMARKS])

# Rows of the landmarks of the trunk, where the limbs begin, of the arms and of the legs.
_PARTS = ([0, 1, 6, 7], [2, 3, 4, 5], [8, 9, 10, 11])
# Landmarks belong to a person if their mean is within this distance of the mean of the person's joints, metres: less
# than half the distance of two people who stand side by side.
_SAME_M = 0.3


def of_person(landmarks: Float, joints: Float) -> Float | None:
    """Return the landmarks (12, 3) of a person with joints (J, 3), of those of all people (N, 12, 3), metres, some NaN;
    None if nobody's are near."""
    distance = np.array([np.linalg.norm(np.nanmean(each - joints[ROWS], axis=0)) for each in landmarks if _known(each)])
    if not len(distance) or distance.min() > _SAME_M:
        return None
    return np.array([each for each in landmarks if _known(each)])[int(distance.argmin())]


def contradiction(landmarks: Float, joints: Float) -> Float:
    """Return (...) m by how much joints (..., J, 3) are off a person's landmarks (12, 3): the mean of the trunk, of
    the arms or of the legs, whichever is largest."""
    away = np.linalg.norm(joints[..., ROWS, :] - landmarks, axis=-1)
    return np.asarray(np.max([np.nanmean(away[..., rows], axis=-1) for rows in _PARTS], axis=0))


def _known(landmarks: Float) -> bool:
    """Return whether at least half of the landmarks (12, 3) of each part are known."""
    known = np.asarray(np.isfinite(landmarks).all(axis=-1))
    return all(2 * np.count_nonzero(known[rows]) >= len(rows) for rows in _PARTS)
