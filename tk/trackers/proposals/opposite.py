"""The opposite heading: a few views of a person who stands upright hardly show the front."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.model.body.limb_candidates import turned

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]


def propose(finder: ContourFinder, seen: Seen, pose: Float, levels: Sequence[int] | None = None) -> Float:
    """Return the pose (D,) with the opposite heading, (1, D).

    Args:
        finder, seen: the tracker, and what the frame shows.
        pose: the present pose.
        levels: scales at which it settles; None: as in a limb search.
    """
    poses = turned(pose, finder.limbs)[None]
    return finder.settle(seen.pyramid, poses, levels or (finder.search_level,), seen.images).states
