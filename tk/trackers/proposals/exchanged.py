"""Exchanged limbs: poses that silhouettes hardly distinguish from the present one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.model.body.limb_candidates import exchanged_limbs, pairs

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]


def propose(finder: ContourFinder, seen: Seen, pose: Float) -> Float:
    """Return the pose (D,) with exchanged arms, and with exchanged legs, (2, D)."""
    poses = exchanged_limbs(pose, pairs(finder.limbs))
    return finder.settle(seen.pyramid, poses, (finder.search_level,), seen.images).states
