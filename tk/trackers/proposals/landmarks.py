"""The poses that the landmarks show: the minima of their cost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.model.cues import landmarks
from tk.trackers.proposals.anywhere import FINALISTS, centroid

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]


def propose(finder: ContourFinder, seen: Seen, pose: Float | None = None) -> Float:
    """Return poses (B, D), the likeliest first: at most :data:`FINALISTS`, or one if there is a present pose (D,); none
    if no landmarks are known."""
    pyramid, rig = seen.pyramid, finder.views.rig
    if (marked := pyramid.measured.get(landmarks.NAME)) is None:
        return np.empty((0, len(finder.pose_names)))
    near = centroid(rig, pyramid, seen.frame.index) if pose is None else pose[:3]
    poses = landmarks.propose(rig, finder.body, marked, near)[: FINALISTS if pose is None else 1]
    return finder.settle(pyramid, poses, None, seen.images).states
