"""What a frame shows along a grid of rays, as the cost of every part that a ray could meet.

A ray through the person that meets no part costs 1, and so does one that meets a part outside the mask; half of that
where the mask is in doubt. A ray through the person that meets a part costs what its colour tells against that part.
Costs are told as a share of the person's rays, averaged over the views: without colours this is E_S of the silhouette
paper (eq. 12).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.kernels.raycast import Cast, cast
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.camera import Rig
from tk.model.cues.part_colors import GROUPS, PartColors, color_bins
from tk.model.masks.silhouettes import pack_rig, pixel_rays

Float = NDArray[np.float64]

# What a colour that surely belongs to another part costs, beside a ray that meets nothing: colours err more than masks.
COLOR_COST = 0.4
# What a part costs where the mask is 0 but in doubt (a shadow, or cloth of the scene's colour).
DOUBT_COST = 0.5


class RayGrid:
    """Every ``step``-th pixel of a rig's pictures.

    Args:
        rig: the cameras.
        rows: about so many rays to a picture's height.
    """

    def __init__(self, rig: Rig, rows: int) -> None:
        self.step = max(1, round(rig.frame_shape[0] / rows))
        self.rays = pixel_rays(rig, self.step)
        self.cameras = pack_rig(rig).astype(np.float32)

    def sample(self, pictures: NDArray) -> NDArray:
        """The grid's pixels (V, h, w, ...) of pictures (V, H, W, ...)."""
        offset = self.step // 2
        return pictures[:, offset :: self.step, offset :: self.step]


@dataclass(frozen=True)
class Evidence:
    """One frame on one grid.

    Attributes:
        grid: where it was looked at.
        person: (V, h, w) bool.
        cost: (V, h, w, G + 1) float32, see :mod:`tk.kernels.raycast`.
        bins: (V, h, w) the colours' bins; None without colours.
    """

    grid: RayGrid
    person: NDArray[np.bool_]
    cost: NDArray[np.float32]
    bins: NDArray[np.int32] | None

    @staticmethod
    def of(
        grid: RayGrid,
        masks: NDArray[np.uint8],
        uncertain: NDArray[np.bool_] | None = None,
        images: NDArray[np.uint8] | None = None,
        colors: PartColors | None = None,
    ) -> Evidence:
        """From masks (V, H, W), where they are in doubt, and the images with what is known of the parts' colours."""
        person = grid.sample(masks) >= 128
        outside = np.ones(person.shape, np.float32)
        if uncertain is not None:
            outside[grid.sample(uncertain)] = DOUBT_COST
        cost = np.empty((*person.shape, len(GROUPS) + 1), np.float32)
        cost[..., 0] = person
        cost[..., 1:] = np.where(person, 0.0, outside)[..., None]
        bins = None if images is None or images.size == 0 else color_bins(grid.sample(images))
        if bins is not None and colors is not None and colors.known:
            cost[person, 1:] = COLOR_COST * colors.mismatch[bins[person]]
        return Evidence(grid, person, cost, bins)

    def cast(
        self,
        body: ConeBody,
        group: NDArray[np.int32],
        poses: Float,
        drawn: NDArray[np.int32] | None = None,
        before: Cast | None = None,
        export: bool = False,
        most_outside: float = np.inf,
    ) -> tuple[Float, Cast | None]:
        """(B, V) cost of poses (B, D) by view, NaN where a view sees nobody; and with ``export`` what the rays meet.

        ``drawn``, ``before`` and ``most_outside`` as :func:`tk.kernels.raycast.cast` has them.
        """
        grid = self.grid
        total, met = cast(
            body.arrays,
            group,
            grid.cameras,
            grid.step,
            grid.rays,
            self.cost,
            poses,
            drawn,
            before,
            export,
            most_outside,
        )
        seen = np.count_nonzero(self.person, axis=(1, 2))
        return np.where(seen > 0, total / np.maximum(seen, 1), np.nan), met

    def residual(self, label: NDArray[np.uint8]) -> Float:
        """Return (V, 2) missing and surplus area of a rendered body, labels (V, h, w), see :func:`residual_of`."""
        return residual_of(label > 0, self.person)

    def cost_of_parts(self, group: NDArray[np.int32], label: NDArray[np.uint8]) -> tuple[Float, NDArray[np.int64]]:
        """What the rays that meet each part cost in all, (P,), and how many they are, (P,); labels (V, h, w).

        Views that see nobody do not count.
        """
        met = (label > 0) & np.asarray(self.person.any(axis=(1, 2)))[:, None, None]
        part = label[met].astype(np.int64) - 1
        cost = self.cost[met, group[part] + 1]
        total, count = np.bincount(part, cost, len(group)), np.bincount(part, minlength=len(group))
        return total.astype(np.float64), count.astype(np.int64)

    def unmet(self, label: NDArray[np.uint8]) -> float:
        """The share of the person's rays that meet no part, averaged over the views; labels (V, h, w)."""
        missed = np.count_nonzero(self.person & (label == 0), axis=(1, 2))
        seen = np.count_nonzero(self.person, axis=(1, 2))
        return float(mean_of_views(np.where(seen > 0, missed / np.maximum(seen, 1), np.nan)[None])[0])


def residual_of(body: NDArray[np.bool_], person: NDArray[np.bool_]) -> Float:
    """Return (V, 2) missing area (body outside the mask) and surplus area (mask outside the body), as shares of the
    person's pixels in each view; their sum is E_S.

    Args:
        body: (V, h, w) pixels that the body covers.
        person: (V, h, w) pixels of the mask. A view without any has a residual of NaN.
    """
    areas = np.stack([np.count_nonzero(area, axis=(1, 2)) for area in (body & ~person, person & ~body)], axis=1)
    seen = np.count_nonzero(person, axis=(1, 2))[:, None]
    return np.where(seen > 0, areas / np.maximum(seen, 1), np.nan)


def mean_of_views(cost: Float) -> Float:
    """(B,) the mean over the views (B, V) that see somebody; inf where none does."""
    seen = np.isfinite(cost)
    total = np.where(seen, cost, 0.0).sum(axis=1)
    return np.where(seen.any(axis=1), total / np.maximum(seen.sum(axis=1), 1), np.inf)
