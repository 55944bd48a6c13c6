"""Joint segmentation of several people: which pixels of a frame show which person.

All bodies are rendered at the poses expected in the frame. A pixel of the masks belongs to the person whom it most
likely shows, by three terms: whether the person's body covers the pixel, which body is in front there, and how likely
the pixel's colour is on the part of the body that is nearest. Liu, Stoll, Gall, Seidel and Theobalt (*Markerless motion
capture of interacting characters using multi-view image segmentation*, CVPR 2011, and PAMI 2013) put the same terms
into a graph cut. Each person is then tracked alone, with the pixels of the others as no evidence: there the body may be
hidden, so a part costs nothing, and no contour is searched. Every pixel has one owner, also where two people are nearly
as likely: in an embrace these are the arms, and without them the arms are not found. Somebody who has no body yet is
unknown: pixels far from all bodies, and what has no colour of the bodies beside them.

The owner may be wrong: a forearm that is not where it is expected, in front of another person's trunk, goes to the
trunk. But its colour is likelier on the arm's owner. Such a pixel is in doubt: the person who does not get it pays for
not explaining it, and the person who gets it learns less from its colour. Otherwise the trunk would learn the colours
of the arm, and its pixels would never be in doubt again.

The bodies are where they are expected, and a limb may be elsewhere. Its pixels then belong to the body that happens to
be nearest, so that the limb would never be found again. Therefore a pixel that no body covers is evidence for everybody
in reach.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import COLOR_BINS, MOST_LOG_RATIO
from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.cameras.camera import Rig
from tk.model.cues.landmarks import LEAST_OVERLAP
from tk.model.cues.part_colors import RenderedBody, color_bins, deficit
from tk.model.cues.ray_costs import RayGrid
from tk.model.reduced_images import crop
from tk.trackers.protocol import Frame

Float = NDArray[np.float64]
Single = NDArray[np.float32]
Bool = NDArray[np.bool_]

# Scale of the logistic distributions by which outline and depth of a body differ from those at the expected pose,
# metres. NEAR_M: an outline errs by less with a probability of 0.95.
ERROR_M = 0.04
NEAR_M = 3 * ERROR_M
# How far a pixel may lie from a body to be that person's, metres: a fist at 8 m/s moves so far in a frame at 15 Hz.
REACH_M = 0.5
# Edge of the square over which the evidence of colours is averaged, pixels. The colours around a pixel favour a person
# by MOST_LOG_RATIO at most.
_AVERAGED_PX = 3
# A view shows somebody unknown if a connected region that is not near has this share of a person's area. A fast arm
# that is not where it is expected has 0.05.
STRANGER_SHARE = 0.1
# A network's masks of single people are further evidence: of a pixel, a person's mask is right with this probability.
RIGHT_MASK = 0.95
# Where somebody unknown ends is unknown, too: within this distance of the region, metres: half a trunk, and NEAR_M.
_WIDTH_M = 0.35

# e to this power is a number in float32; its inverse is zero beside 1. The largest probability below 1.
_SURELY, _ALMOST_ONE = np.float32(80), np.nextafter(np.float32(1), np.float32(0))

NOBODY = -1


@dataclass(frozen=True)
class PixelOwners:
    """The owner of each pixel of a frame."""

    grid: RayGrid  # cells of the images, one ray each
    # (V, H, W) the number of a person, or `NOBODY` for somebody unknown; without meaning outside the masks
    owner: NDArray[np.int8]
    people: int  # number of people, also those whose body is unknown
    # (V, h, w) bit k: no body covers the cell, and person k is in reach of it; see `share`
    free: NDArray[np.uint32]
    doubt: Single | None  # (K, V, h, w) of each person, see `Frame`; None without colours

    def share(self, frame: Frame, person: int, unknown: bool = False) -> Frame:
        """Return the observation of a person, with the pixels of others as :data:`~tk.kernels.mask_values.OTHERS`.

        A pixel that no body covers is nobody's for certain. It may show a limb that is in a wrong place, and counts for
        everybody in reach: only the body that will cover it explains it.

        ``unknown``: pixels of somebody unknown may show this person.
        """
        masks = self._masks(frame, (person, NOBODY) if unknown else (person,), person)
        return replace(frame, masks=masks, doubt=None if self.doubt is None else self.doubt[person])

    def unknown(self, frame: Frame) -> Frame:
        """Return the observation of people who are unknown; pixels of known people are
        :data:`~tk.kernels.mask_values.OTHERS`."""
        return replace(frame, masks=self._masks(frame, (NOBODY,)))

    def _masks(self, frame: Frame, kept: Sequence[int], person: int | None = None) -> NDArray[np.uint8]:
        """Return a frame's masks; pixels of other owners than ``kept`` are OTHERS, unless free for a person."""
        masks = frame.masks.copy()
        for mask, owner, free in zip(masks, self.owner, self.free, strict=True):
            x, y, w, h = cv2.boundingRect(mask)  # most of an image is background
            box = slice(y, y + h), slice(x, x + w)
            taken = mask[box] >= PERSON
            for number in kept:
                taken &= owner[box] != number
            if person is not None and free.any():
                own = (free >> np.uint32(person) & np.uint32(1)).astype(np.uint8)
                taken &= enlarged(own, self.grid.step, mask.shape)[box] == 0
            np.copyto(mask[box], OTHERS, where=taken)
        return masks

    def areas(self, masks: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Return (K + 1, V) the number of cells of each person in masks (V, H, W), last those of unknown people."""
        shown, owner = self.grid.sample(masks) >= PERSON, self.grid.sample(self.owner)
        people = (*range(self.people), NOBODY)
        return np.array([np.count_nonzero(shown & (owner == k), axis=(1, 2)) for k in people])


class _Shape(NamedTuple):
    """A body in one view, extended to all cells (h, w) from the nearest cell that it covers."""

    number: int  # the person's, or `NOBODY`
    away: Single  # metres in the image from the body's outline, negative inside
    label: NDArray[np.uint8]  # see `RenderedBody`
    depth: Single  # NaN if it is unknown
    body: RenderedBody | None  # group and colours of the parts; None if they are unknown

    @staticmethod
    def of(number: int, label: NDArray[Any], depth: Single, cell: float, body: RenderedBody | None) -> _Shape:
        """Extend a body that covers some cells; ``cell``: metres along an edge of a cell at a depth of 1."""
        covered = label > 0
        flat = np.flatnonzero(covered)
        outside, nearest = cv2.distanceTransformWithLabels(
            (~covered).view(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        index = np.empty(len(flat) + 1, np.int64)
        index[nearest.ravel()[flat]] = flat
        at = index.take(np.asarray(nearest, np.intp))
        inside = cv2.distanceTransform(covered.view(np.uint8), cv2.DIST_L2, 3)
        metres = np.float32(cell * float(np.median(depth[covered])))
        away = np.where(covered, np.float32(0.5) - inside, outside - np.float32(0.5)) * metres
        return _Shape(number, away, label.ravel().take(at), depth.ravel().take(at), body)


def assign(rig: Rig, grid: RayGrid, bodies: Sequence[RenderedBody | None], frame: Frame) -> PixelOwners:
    """Return the owner of each pixel of the masks.

    Args:
        rig: the cameras.
        grid: the cells.
        bodies: of each person the body, or the hull, on the grid; None if it is unknown where the person is.
        frame: images and masks. Pixels with values below 128 have no owner.
    """
    shown = grid.sample(frame.masks) >= PERSON
    owner = np.full(frame.masks.shape, NOBODY, np.int8)
    free = np.zeros(shown.shape, np.uint32)
    areas = [np.count_nonzero(body.label, axis=(1, 2)) for body in bodies if body is not None]
    least = STRANGER_SHARE * float(np.median(areas)) if areas else 0.0
    claims = _claims(grid, frame, bodies, shown)
    colored = frame.images.size > 0 and any(body is not None and body.log_likelihood is not None for body in bodies)
    bins = color_bins(grid.sample(frame.images)) if colored else None
    doubt = np.zeros((len(bodies), *shown.shape), np.float32) if colored else None
    for v, camera in enumerate(rig):
        cells = _around(shown[v])
        cell = grid.step / float(camera.matrix[0, 0])
        shapes = [
            _Shape.of(k, body.label[v][cells], body.depth[v][cells], cell, body)
            for k, body in enumerate(bodies)
            if body is not None and body.label[v][cells].any()
        ]
        if not shapes:
            continue
        own = {number: claim[v][cells] for number, claim in claims.items()}
        stranger = _stranger(shown[v][cells], shapes, cell, least, own.get(NOBODY))
        view = _View(grid.step, shown[v][cells], [*shapes, *stranger], own)
        pixels = _pixels(cells, grid.step)
        image = crop(frame.images[v], frame.masks.shape[1:], *pixels) if colored else None
        free[v][cells] = view.free()
        owner[v][pixels] = view.owners(frame.masks[v][pixels] >= PERSON, image)
        if bins is not None and doubt is not None:
            for number, one in view.doubt(grid.sample(owner[None, v])[0][cells], bins[v][cells]).items():
                doubt[number, v][cells] = one
    return PixelOwners(grid, owner, len(bodies), free, doubt)


def _claims(grid: RayGrid, frame: Frame, bodies: Sequence[RenderedBody | None], shown: Bool) -> dict[int, Bool]:
    """Return the cells (V, h, w) that a network's masks give to people, by number; to :data:`NOBODY` those of masks
    that belong to no body, and to no other mask.
    """
    if frame.people is None:
        return {}
    bits = grid.sample(frame.people)
    masks = [mask for mask in ((bits >> n & 1 > 0) & shown for n in range(8)) if mask.any()]
    if len(masks) < 2:
        return {}
    whose = matched_bodies(masks, bodies)
    claims = {k: masks[n] for n, k in whose.items()}
    strange = np.zeros(shown.shape, np.bool_)
    for n, mask in enumerate(masks):
        if n not in whose:
            strange |= mask
    known = functools.reduce(np.logical_or, claims.values(), np.zeros(shown.shape, np.bool_))
    return claims | {NOBODY: strange & ~known}


def matched_bodies(masks: Sequence[Bool], bodies: Sequence[RenderedBody | None]) -> dict[int, int]:
    """Return the bodies that masks (V, h, w) belong to, by the numbers of both: each overlaps most with the other."""
    overlap = np.zeros((len(masks), len(bodies)))
    for k, body in enumerate(bodies):
        for n, mask in enumerate(masks if body is not None else ()):
            assert body is not None
            both, either = mask & (body.label > 0), mask | (body.label > 0)
            overlap[n, k] = np.count_nonzero(both) / max(int(np.count_nonzero(either)), 1)
    if not overlap.size:
        return {}
    best = {n: int(np.argmax(overlap[n])) for n in range(len(masks)) if overlap[n].max() >= LEAST_OVERLAP}
    return {n: k for n, k in best.items() if int(np.argmax(overlap[:, k])) == n}


def _stranger(
    shown: Bool, shapes: Sequence[_Shape], cell: float, least: float, strange: Bool | None = None
) -> list[_Shape]:
    """Return somebody unknown, at an unknown depth, if at least ``least`` connected cells of a mask (h, w) are far from
    all shapes, or ``strange``: claimed by a network's mask of somebody unknown."""
    far = shown & (_nearest(shapes) > NEAR_M)
    if strange is not None:
        far |= strange
    if np.count_nonzero(far) < least:
        return []
    _, region, stats, _ = cv2.connectedComponentsWithStats(far.view(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    if not large.any():
        return []
    depth = np.full(shown.shape, np.median([np.median(shape.depth) for shape in shapes]), np.float32)
    away = cv2.distanceTransform((~large[region]).view(np.uint8), cv2.DIST_L2, 3) * (cell * depth[0, 0])
    shape = _Shape.of(NOBODY, (away <= _WIDTH_M).view(np.uint8), depth, cell, None)
    return [shape._replace(depth=np.full_like(depth, np.nan))]


class _View:
    """Decides who owns the pixels of one view, or of a part of it.

    Args:
        step: pixels along an edge of a cell.
        shown: (h, w) bool, cells of the mask.
        shapes: the bodies.
        claims: of people, by number, the cells (h, w) that a network's masks give to them.
    """

    def __init__(self, step: int, shown: Bool, shapes: Sequence[_Shape], claims: Mapping[int, Bool]) -> None:
        self._step, self._shown, self._shapes = step, shown, shapes
        self._visible = _log_visible(shapes)
        # a mask speaks for its person where it is, and against where it is not
        ratio = np.float32(2 * np.log(RIGHT_MASK / (1 - RIGHT_MASK)))
        for shape, visible in zip(shapes, self._visible, strict=True):
            if shape.number in claims:
                visible += ratio * claims[shape.number]

    def free(self) -> NDArray[np.uint32]:
        """Return (h, w) the people in reach, as bits, of the cells that no shape covers."""
        bare = self._shown & (_nearest(self._shapes) > NEAR_M)
        found = np.zeros(bare.shape, np.uint32)
        for shape in self._shapes if bare.any() else ():
            if shape.number != NOBODY:
                found |= (bare & (shape.away <= REACH_M)).astype(np.uint32) << np.uint32(shape.number)
        return found

    def doubt(self, owner: NDArray[np.int8], bins: NDArray[np.int32]) -> dict[int, Single]:
        """Return (h, w) the doubt of each person about the owners (h, w) of cells with colours (h, w), see
        :class:`~tk.trackers.protocol.Frame`. Cells that no body covers have none, see :meth:`free`."""
        covered = self._shown & (_nearest(self._shapes) <= NEAR_M)
        of_owner, likelier = np.full(bins.shape, np.inf, np.float32), {}
        for shape in self._shapes:
            if shape.body is not None and shape.body.log_likelihood is not None:
                np.copyto(of_owner, _log_color(shape, shape.label, bins), where=owner == shape.number)
                of_parts = shape.body.log_likelihood[:-1].max(axis=0)
                likelier[shape.number] = np.where(covered & (shape.away <= REACH_M), of_parts.take(bins), -np.inf)
        found = {n: np.where(owner == n, np.float32(0), deficit(one, of_owner)) for n, one in likelier.items()}
        most = functools.reduce(np.maximum, found.values(), np.zeros(bins.shape, np.float32))
        return {n: np.where(owner == n, most, one) for n, one in found.items()}

    def owners(self, person: Bool, image: NDArray[np.uint8] | None) -> NDArray[np.int8]:
        """Return (H, W) the owners of pixels, by the colours where the bodies alone do not decide.

        Args:
            person: (H, W) bool, the mask.
            image: (H, W, 3) BGR.
        """
        numbers = np.array([shape.number for shape in self._shapes], np.int8)
        near = _nearest(self._shapes) <= REACH_M
        first, lead = _likeliest(self._visible)
        owner = enlarged(np.where(near, numbers[first], np.int8(NOBODY)), self._step, person.shape)
        contested = self._shown & near & (lead < MOST_LOG_RATIO)
        if not contested.any():
            return owner
        cells = _around(contested)
        pixels = _pixels(cells, self._step)
        shown = person[pixels]
        score = [enlarged(one[cells], self._step, shown.shape, cv2.INTER_LINEAR) for one in self._visible]
        if image is not None:
            bins = color_bins(image[pixels])
            labels = [enlarged(shape.label[cells], self._step, shown.shape) for shape in self._shapes]
            colors = [_log_color(s, label, bins) for s, label in zip(self._shapes, labels, strict=True)]
            best = functools.reduce(np.maximum, colors)
            share = np.maximum(_blurred(shown.astype(np.float32)), np.float32(1e-3))
            for one, color in zip(score, colors, strict=True):
                one += _blurred(np.where(shown, np.maximum(color - best, -MOST_LOG_RATIO), np.float32(0))) / share
        where = enlarged(contested[cells].view(np.uint8), self._step, shown.shape) > 0
        np.copyto(owner[pixels], numbers[_likeliest(score)[0]], where=where)
        return owner


def _around(cells: Bool) -> tuple[slice, slice]:
    """Return the rows and the columns of the box around cells (h, w), with a cell on each side."""
    left, top, width, height = cv2.boundingRect(cells.view(np.uint8))
    return slice(max(top - 1, 0), top + height + 1), slice(max(left - 1, 0), left + width + 1)


def _pixels(cells: tuple[slice, slice], step: int) -> tuple[slice, slice]:
    """Return the rows and the columns of the pixels of cells."""
    rows, columns = cells
    return slice(rows.start * step, rows.stop * step), slice(columns.start * step, columns.stop * step)


def _nearest(shapes: Sequence[_Shape]) -> Single:
    return functools.reduce(np.minimum, (shape.away for shape in shapes))


def _blurred(values: Single) -> Single:
    """Return (h, w) the means in the square about each value."""
    return np.asarray(cv2.blur(values, (_AVERAGED_PX, _AVERAGED_PX)))


def _likeliest(scores: Sequence[Single]) -> tuple[NDArray[np.intp], Single]:
    """Return (h, w) the first of the largest of K scores (h, w), and by how much it exceeds the next one."""
    best, index = scores[0], np.zeros(scores[0].shape, np.intp)
    second = np.full_like(best, -np.inf)
    for k, one in enumerate(scores[1:], 1):  # NumPy's argmax over a first axis takes three times as long
        index[one > best] = k
        second = np.maximum(second, np.minimum(best, one))
        best = np.maximum(best, one)
    return index, best - second


def _log_visible(shapes: Sequence[_Shape]) -> list[Single]:
    """Return K times (h, w) the logarithm of the probability that a cell shows each shape: that the shape covers it,
    and that no other one is in front."""
    # NumPy's exp and log take a third of the time of its logaddexp and log1p, whose exactness changes no owner
    odds = [np.exp(np.minimum(shape.away / np.float32(ERROR_M), _SURELY)) for shape in shapes]
    covers = [np.minimum(1 / (1 + one), _ALMOST_ONE) for one in odds]
    total = [-np.log(1 + one) for one in odds]
    for i, one in enumerate(shapes):
        for j, other in enumerate(shapes[:i]):
            # an extended depth is as uncertain as it is far extended
            error = np.float32(ERROR_M) + np.maximum(one.away, 0) + np.maximum(other.away, 0)
            behind = np.minimum((one.depth - other.depth) / error, _SURELY)
            in_front = np.nan_to_num(1 / (1 + np.exp(behind)), nan=0.5)
            total[i] += np.log(1 - covers[j] * (1 - in_front))
            total[j] += np.log(1 - covers[i] * in_front)
    return total


def _log_color(shape: _Shape, label: NDArray[np.uint8], bins: NDArray[np.int32]) -> Single:
    """Return (h, w) the logarithm of the probability of colours if they show a shape: the nearest part of the body, or
    any part.

    Args:
        shape: the shape; all colours are equally likely if its colours are unknown.
        label: (h, w) of the nearest parts.
        bins: (h, w) of the colours.
    """
    body = shape.body
    if body is None or body.log_likelihood is None or body.group is None:
        return np.full(bins.shape, -np.log(COLOR_BINS), np.float32)
    likeliest = np.maximum(body.log_likelihood, body.log_likelihood[-1])
    return likeliest.ravel().take(body.group[label.astype(np.int64) - 1] * COLOR_BINS + bins)


def enlarged(cells: NDArray, step: int, shape: tuple[int, ...], interpolation: int = cv2.INTER_NEAREST) -> NDArray:
    """Return a grid's cells (h, w) as an image of a shape (H, W)."""
    height, width = shape
    full = cv2.resize(cells, (cells.shape[1] * step, cells.shape[0] * step), interpolation=interpolation)
    below, right = max(height - full.shape[0], 0), max(width - full.shape[1], 0)
    if below or right:
        full = cv2.copyMakeBorder(full, 0, below, 0, right, cv2.BORDER_REPLICATE)
    return np.asarray(full[:height, :width])
