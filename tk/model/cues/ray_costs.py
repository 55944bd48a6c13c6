"""How a frame contradicts poses, on a grid of rays, for every part of the body that a ray could hit.

A ray through the mask that hits no part has a mismatch of 1, and so has a ray that hits a part outside the mask; half
of that where the mask is uncertain. A ray through the mask that hits a part has the mismatch of its colour with that
part. On another person a ray has none, unless its colour is in doubt there: then it has the mismatch of its colour with
the other person, or with the part that it hits, whichever is less. The mismatch of a pose is the share of the person's
rays, mean over the views: without colours E_S of the paper (eq. 12).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import COLOR_BINS
from tk.kernels.mask_values import OTHERS, PERSON
from tk.kernels.projection import pack_cameras
from tk.kernels.raycast import Cast, Rays, cast, costs
from tk.model.body.cone_body import COLOR_GROUPS, ConeBody
from tk.model.cameras.camera import Rig
from tk.model.cues.cue import Cue
from tk.model.cues.part_colors import PartColors
from tk.model.reduced_images import every

Float = NDArray[np.float64]

# Cost of what may be right or wrong: a part on an uncertain pixel outside the mask (a shadow, or clothes of the
# background's colour), or on a colour that certainly belongs to another part.
UNCERTAIN_COST = 0.5
# Negative logarithm of the likelihood for a mismatch of 1 in a view. With four views 0.004 is then one nat. The
# probabilities of choices that follow are right or too cautious (docs/experiments.md).
VIEW_NATS = 60.0
# The mismatch of a view is divided by the number of the person's rays. Where others hide most of the person, the
# divisor is at least this share of the largest number in any view, so that a hand beside a back counts less than a
# person.
LEAST_SEEN = 0.25
# Steps of a packed doubt: what is left of 16 bits beside the bin of a colour.
_DOUBT_STEPS = (np.iinfo(np.uint16).max + 1) // COLOR_BINS - 1


def pixel_rays(rig: Rig, step: int = 1) -> NDArray[np.float32]:
    """Return viewing directions (V, H, W, 3) of every ``step``-th pixel, world frame; zero outside smaller images."""
    height, width = rig.frame_shape
    offset = step // 2
    ys, xs = np.arange(offset, height, step), np.arange(offset, width, step)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2).astype(np.float64)
    rays = np.zeros((len(rig), len(ys) * len(xs), 3), np.float32)
    for out, camera in zip(rays, rig, strict=True):
        inside = (grid[:, 0] < camera.width) & (grid[:, 1] < camera.height)
        out[inside] = camera.rays(grid[inside])
    return rays.reshape(len(rig), len(ys), len(xs), 3)


class RayGrid:
    """Every ``step``-th pixel of a rig's images.

    Args:
        rig: the cameras.
        rows: number of rays along an image's height, approximately.
    """

    def __init__(self, rig: Rig, rows: int) -> None:
        self.rig = rig
        self.step: int = max(1, round(rig.frame_shape[0] / rows))
        self.rays = pixel_rays(rig, self.step)
        self.packed = Rays(pack_cameras(rig).astype(np.float32), self.step, self.rays)

    def sample(self, images: NDArray) -> NDArray:
        """Return the grid's pixels (V, h, w, ...) of masks (V, H, W), or of images (V, H, W, ...), which may be
        reduced."""
        return every(images, self.rig.frame_shape, self.step)

    def nearest(self, finer: RayGrid, cells: NDArray) -> NDArray:
        """Return values (V, h, w) of the squares of a finer grid of the same cameras at the rays of this one."""
        rows, columns = (
            np.minimum((self.step // 2 + self.step * np.arange(count)) // finer.step, limit - 1)
            for count, limit in zip(self.rays.shape[1:3], cells.shape[1:], strict=True)
        )
        return cells[:, rows[:, None], columns]

    def render(self, body: ConeBody, poses: Float) -> Cast:
        """Return the parts of the body that the rays meet at poses (B, D): labels and depths (B, V, h, w)."""
        free = np.zeros((*self.rays.shape[:3], 2), np.float32)
        return cast(body.arrays, self.packed, free, poses)[1]


@dataclass(frozen=True)
class Evidence:
    """What one frame shows on one grid of rays.

    Attributes:
        grid: rays of the V views.
        person: (V, h, w) bool, the mask.
        others: (V, h, w) bool, pixels of other people, where a body is no missing area; None if there are none.
        rays: (V, h, w, G + 1) float32, mismatch of each ray, see :mod:`tk.kernels.raycast`.
        bins: (V, h, w) bin of each ray's colour; None without colours.
        cues: what else was measured of the person in the frame.
        doubt: (V, h, w) of the owners of the pixels, see :class:`~tk.trackers.protocol.Frame`; None without doubt.
    """

    grid: RayGrid
    person: NDArray[np.bool_]
    rays: NDArray[np.float32]
    bins: NDArray[np.int32] | None
    others: NDArray[np.bool_] | None = None
    cues: Sequence[Cue] = ()
    doubt: NDArray[np.float32] | None = None

    @staticmethod
    def of(
        grid: RayGrid,
        masks: NDArray[np.uint8],
        uncertain: NDArray[np.bool_] | None = None,
        bins: NDArray[np.int32] | None = None,
        colors: PartColors | None = None,
        cues: Sequence[Cue] = (),
        doubt: NDArray[np.float32] | None = None,
    ) -> Evidence:
        """Return the evidence of masks (V, H, W), uncertain pixels, the bins (V, h, w) of the rays' colours, the
        learned colours of the parts, other cues, and the doubt (V, h, w) of the rays."""
        sampled = np.ascontiguousarray(grid.sample(masks))
        person, others = sampled >= PERSON, sampled == OTHERS
        outside = np.ones(person.shape, np.float32)
        if uncertain is not None:
            outside[grid.sample(uncertain)] = UNCERTAIN_COST
        shared = bool(others.any())
        if shared:
            outside[others] = 0.0
        rays = np.empty((*person.shape, len(COLOR_GROUPS) + 1), np.float32)
        rays[..., 0] = person
        rays[..., 1:] = np.where(person, 0.0, outside)[..., None]
        if bins is not None and colors is not None and colors.known:
            on_person = np.flatnonzero(person)  # several times as fast as a mask as an index
            of_colors = colors.mismatch.take(bins.ravel().take(on_person), axis=0)
            rays.reshape(-1, rays.shape[-1])[on_person, 1:] = UNCERTAIN_COST * of_colors
            if shared and doubt is not None:
                of_other, of_colors = doubt[others][:, None], colors.mismatch.take(bins[others], axis=0)
                rays[others, :1] = UNCERTAIN_COST * of_other
                rays[others, 1:] = UNCERTAIN_COST * np.minimum(of_other, of_colors)
        return Evidence(grid, person, rays, bins, others if shared else None, cues, doubt)

    def packed_colors(self) -> NDArray[np.uint16] | None:
        """Return (V, h, w) colours and doubt of the rays through the masks, in 16 bits, see :func:`unpacked`; None
        without colours."""
        if self.bins is None:
            return None
        packed = self.bins.astype(np.uint16)
        if self.doubt is not None:
            packed += COLOR_BINS * np.rint(_DOUBT_STEPS * self.doubt).astype(np.uint16)
        return np.where(self.person if self.others is None else self.person | self.others, packed, np.uint16(0))

    def mismatch(
        self,
        body: ConeBody,
        poses: Float,
        drawn: NDArray[np.int32] | None = None,
        before: Cast | None = None,
        most_outside: float = np.inf,
    ) -> Float:
        """Return (B,) the share of the rays that contradict poses (B, D), mean over the views that see anybody; inf if
        none does.

        ``drawn``, ``before`` and ``most_outside`` as in :func:`tk.kernels.raycast.costs`.
        """
        total = costs(body.arrays, self.grid.packed, self.rays, poses, drawn, before, most_outside)
        return mean_of_views(self.shares(total))

    def cost(
        self,
        body: ConeBody,
        poses: Float,
        drawn: NDArray[np.int32] | None = None,
        before: Cast | None = None,
        most_outside: float = np.inf,
    ) -> Float:
        """Return (B,) the negative logarithm of the likelihood at poses (B, D), nats, up to a constant of the frame;
        arguments as for :meth:`mismatch`."""
        return self.cost_of(self.mismatch(body, poses, drawn, before, most_outside), poses)

    def cost_of(self, mismatch: Float, poses: Float) -> Float:
        """Return :meth:`cost` of poses (B, D) with a :meth:`mismatch` (B,). The cues are asked only where it is finite:
        of the candidates of a limb most are refused."""
        cost = np.asarray(VIEW_NATS * max(int(np.count_nonzero(self._seen)), 1) * mismatch)
        finite = np.isfinite(cost)
        if self.cues and finite.any():
            cost[finite] += sum(cue.cost(poses[finite]) for cue in self.cues)
        return cost

    def cast(self, body: ConeBody, poses: Float, drawn: NDArray[np.int32] | None = None) -> tuple[Float, Cast]:
        """Return the :meth:`mismatch` (B,) of poses, and the parts that the rays meet."""
        total, met = cast(body.arrays, self.grid.packed, self.rays, poses, drawn)
        return mean_of_views(self.shares(total)), met

    def shares(self, total: Float) -> Float:
        """Return sums of mismatches (B, V) as shares of the person's rays; NaN where a view sees nobody."""
        seen = self._seen
        return np.where(seen > 0, total / np.maximum(seen, 1), np.nan)

    @cached_property
    def _seen(self) -> NDArray[np.float64]:
        """(V,) the person's area in each view, rays."""
        return _areas(self.person, self.others)

    def residual(self, label: NDArray[np.uint8]) -> Float:
        """Return (V, 2) missing and surplus area of a rendered body, labels (V, h, w), see :func:`residual_of`."""
        return residual_of(label > 0, self.person, self.others)

    def mismatch_of_parts(self, body: ConeBody, label: NDArray[np.uint8]) -> tuple[Float, NDArray[np.int64]]:
        """Return the summed mismatch (P,) and the number (P,) of the rays that hit each part, labels (V, h, w).

        Views that see nobody do not count.
        """
        met = (label > 0) & np.asarray(self.person.any(axis=(1, 2)))[:, None, None]
        part = label[met].astype(np.int64) - 1
        cost = self.rays[met, body.color_group[part] + 1]
        parts = len(body.parts)
        total, count = np.bincount(part, cost, parts), np.bincount(part, minlength=parts)
        return total.astype(np.float64), count.astype(np.int64)

    def hidden(self, label: NDArray[np.uint8]) -> float:
        """Return the share of the rays that meet a body, labels (V, h, w), on pixels of other people."""
        if self.others is None:
            return 0.0
        return float(np.count_nonzero(self.others & (label > 0))) / max(int(np.count_nonzero(label)), 1)

    def surplus(self, label: NDArray[np.uint8]) -> float:
        """Return the surplus area, mean over the views; labels (V, h, w)."""
        return float(mean_of_views(self.residual(label)[None, :, 1])[0])


def unpacked(colors: NDArray[np.uint16] | None) -> tuple[NDArray[np.int32] | None, NDArray[np.float32] | None]:
    """Return the bins and the doubt, (V, h, w), of what :meth:`Evidence.packed_colors` has packed."""
    if colors is None:
        return None, None
    doubt, bins = np.divmod(colors, np.uint16(COLOR_BINS))
    return bins.astype(np.int32), doubt.astype(np.float32) / np.float32(_DOUBT_STEPS)


def residual_of(body: NDArray[np.bool_], person: NDArray[np.bool_], others: NDArray[np.bool_] | None = None) -> Float:
    """Return (..., V, 2) missing area (body outside the mask) and surplus area (mask outside the body), as shares of
    the person's pixels in each view; their sum is E_S.

    Args:
        body: (..., V, h, w) pixels that the body covers.
        person: (..., V, h, w) pixels of the mask. A view without any has a residual of NaN.
        others: (..., V, h, w) pixels of other people, which are no missing area.
    """
    seen = _areas(person, others)[..., None]
    covered = np.count_nonzero(body & person, axis=(-2, -1))
    missing = np.count_nonzero(body if others is None else body & ~others, axis=(-2, -1)) - covered
    areas = np.stack([missing, np.count_nonzero(person, axis=(-2, -1)) - covered], axis=-1)
    return np.where(seen > 0, areas / np.maximum(seen, 1), np.nan)


def _areas(person: NDArray[np.bool_], others: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """Return (..., V) the person's area in each view, rays; 0 without the person, else see :data:`LEAST_SEEN`."""
    seen = np.count_nonzero(person, axis=(-2, -1)).astype(np.float64)
    if others is None:
        return seen
    most = seen + np.count_nonzero(others, axis=(-2, -1))
    least = np.minimum(most, LEAST_SEEN * seen.max(axis=-1, keepdims=True))
    return np.where(seen > 0, np.maximum(seen, least), 0.0)


def mean_of_views(cost: Float) -> Float:
    """Return (B,) the mean over the views (B, V) that see anybody; inf if none does."""
    seen = np.isfinite(cost)
    total = np.where(seen, cost, 0.0).sum(axis=1)
    return np.where(seen.any(axis=1), total / np.maximum(seen.sum(axis=1), 1), np.inf)
