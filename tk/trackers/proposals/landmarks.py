"""The pose of the landmarks: its joints are nearest to the triangulated landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.model.cues.landmarks import propose as of_landmarks

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]


def propose(finder: ContourFinder, seen: Seen) -> Float:
    """Return one pose (1, D), or none (0, D) if too few landmarks are known."""
    if seen.pyramid.landmarks is None:
        return np.empty((0, len(finder.pose_names)))
    poses = of_landmarks(finder.views.rig, finder.body.skeleton, seen.pyramid.landmarks)
    return finder.settle(seen.pyramid, poses, None, seen.images).states if len(poses) else poses
