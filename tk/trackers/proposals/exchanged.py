"""Exchanged limbs, and the opposite heading: poses that silhouettes hardly distinguish from the present one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.model.body.limb_candidates import exchanged, pairs, turned

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]


def propose(finder: ContourFinder, seen: Seen, pose: Float, levels: Sequence[int] | None = None) -> Float:
    """Return the pose (D,) with exchanged arms, with exchanged legs, and with the opposite heading, (3, D).

    Args:
        finder, seen: the tracker, and what the frame shows.
        pose: the present pose.
        levels: scales at which they settle; None: as in a limb search.
    """
    poses = np.concatenate([exchanged(pose, pairs(finder.limbs)), turned(pose, finder.limbs)[None]])
    return finder.settle(seen.pyramid, poses, levels or (finder.search_level,), seen.images).states
