"""Joint segmentation of several people: which pixels of a frame show which person.

All bodies are rendered at the poses expected in the frame, and each pixel of the mask goes to a person: by depth where
two bodies cover it, else to the nearest body in the image. Each person is then tracked alone, with the pixels of the
others as no evidence: there the body may be hidden, so a part costs nothing, and no contour is searched (Liu, Stoll,
Gall, Seidel, Theobalt, *Markerless motion capture of interacting characters using multi-view image segmentation*, CVPR
2011, and PAMI 2013, who assign the pixels by a graph cut). Pixels that could show two people are no evidence for
either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import OTHERS
from tk.kernels.raycast import FAR, Cast
from tk.model.cameras.camera import Rig
from tk.model.cues.ray_costs import RayGrid
from tk.trackers.protocol import Observation

Float = NDArray[np.float64]

# How far a pixel may lie from a body to be that person's, metres: a fist at 8 m/s moves so far in a frame at 15 Hz.
# Pixels farther away are no evidence.
REACH_M = 0.5
# A pixel could show either of two people if their distances from it in the image, or their depths, differ by less than
# this, metres: about the thickness of a forearm.
MARGIN_M = 0.08
# A person is tracked again in a frame if this share of the person's pixels has changed owner. Without this, the first
# pass on pair is worse by 0.1 and 0.4 cm, and an arm is lost where the people pass.
CHANGED = 0.05

NOBODY, UNCLEAR = -1, -2


@dataclass(frozen=True)
class PixelOwners:
    """The owner of each cell of a grid over the images.

    Attributes:
        grid: the cells, one ray each.
        owner: (V, h, w) int8, the number of a person, :data:`NOBODY` if nobody is near, or :data:`UNCLEAR`.
        beside: (V, h, w) m, distance from the nearest person, in the image.
    """

    grid: RayGrid
    owner: NDArray[np.int8]
    beside: NDArray[np.float32]

    def share(self, frame: Observation, person: int, unknown: bool) -> Observation:
        """Return the observation of a person, with the pixels of others as :data:`~tk.kernels.mask_values.OTHERS`.

        ``unknown``: it is not known where the person is, so pixels near nobody count as the person's.
        """
        own = (self.owner == person) | (unknown & (self.owner == NOBODY))
        return replace(frame, masks=self._selected(frame.masks, own))

    def _selected(self, masks: NDArray[np.uint8], own: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return the masks (V, H, W), with :data:`~tk.kernels.mask_values.OTHERS` where cells are not own."""
        _, height, width = masks.shape
        selected = np.empty_like(masks)
        for v, cells in enumerate(np.where(own, np.uint8(255), np.uint8(OTHERS))):
            size = (cells.shape[1] * self.grid.step, cells.shape[0] * self.grid.step)
            full = cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST)[:height, :width]
            below, right = height - full.shape[0], width - full.shape[1]
            if below or right:
                full = cv2.copyMakeBorder(full, 0, below, 0, right, cv2.BORDER_REPLICATE)
            _, shown = cv2.threshold(masks[v], 127, 255, cv2.THRESH_BINARY)
            cv2.bitwise_and(shown, full, dst=selected[v])
        return selected

    def changed(self, before: PixelOwners, masks: NDArray[np.uint8], person: int) -> bool:
        """Return whether :data:`CHANGED` of a person's pixels in the masks (V, H, W) have another owner than before."""
        shown = self.grid.sample(masks) >= 128
        now, then = self.owner[shown] == person, before.owner[shown] == person
        return bool(np.count_nonzero(now != then) > CHANGED * int(np.count_nonzero(then)))

    def unexplained(self, masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the masks (V, H, W) without pixels within twice :data:`MARGIN_M` of known people."""
        return np.where(self._selected(masks, self.beside > 2 * MARGIN_M) == 255, np.uint8(255), np.uint8(0))


def assign(rig: Rig, grid: RayGrid, shapes: Sequence[Cast | None]) -> PixelOwners:
    """Return the owner of each cell.

    Args:
        rig: the cameras.
        grid: the cells.
        shapes: of each person the body, or the hull, on the grid; None if it is unknown where the person is.
    """
    V, h, w = grid.rays.shape[:3]
    beside = np.full((len(shapes), V, h, w), np.inf, np.float32)  # distance of a cell from a shape, metres
    depth = np.full((len(shapes), V, h, w), np.inf, np.float32)
    for p, shape in enumerate(shapes):
        for v in range(V) if shape is not None else ():
            assert shape is not None
            covered = shape.label[v] > 0
            if covered.any():
                depth[p, v][covered] = shape.depth[v][covered]
                middle = float(np.median(depth[p, v][covered]))
                beside[p, v] = cv2.distanceTransform((~covered).view(np.uint8), cv2.DIST_L2, 3)
                beside[p, v] *= grid.step * middle / float(rig[v].matrix[0, 0])
    if not shapes:
        return PixelOwners(grid, np.full((V, h, w), NOBODY, np.int8), np.full((V, h, w), np.inf, np.float32))
    who, nearest, second = _two_least(beside)
    owner = np.where(nearest <= REACH_M, who, np.int8(NOBODY))
    if len(shapes) > 1:
        who, front, behind = _two_least(depth)
        both = np.isfinite(behind)
        owner[both] = who[both]
        with np.errstate(invalid="ignore"):  # inf - inf
            owner[np.where(both, behind - front, second - nearest) < MARGIN_M] = UNCLEAR
    return PixelOwners(grid, owner, nearest)


def _two_least(values: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.float32]]:
    """Return the index of the least of values along the first axis, the least and the second."""
    least, second = values[0].copy(), np.full(values.shape[1:], np.inf, np.float32)
    index = np.zeros(values.shape[1:], np.int8)
    for k, value in enumerate(values[1:], 1):
        index[value < least] = k
        second = np.minimum(second, np.maximum(value, least))
        least = np.minimum(least, value)
    return index, least, second


def cast_points(rig: Rig, grid: RayGrid, points: Float, voxel_m: float) -> Cast:
    """Return voxels with centres (N, 3) on the grid, as a :class:`~tk.kernels.raycast.Cast` of one part.

    Args:
        rig: the cameras, in the world of the points.
        grid: rays of the same cameras.
        points: metres.
        voxel_m: edge of a voxel, metres.
    """
    V, h, w = grid.rays.shape[:3]
    depth = np.full((V, h, w), FAR, np.float32)
    for v, camera in enumerate(rig):
        pixels, ahead = camera.project(points)
        seen = camera.sees(points) & (ahead > 0)
        if not seen.any():
            continue
        x, y = np.clip((pixels[seen] // grid.step).astype(np.int64), 0, (w - 1, h - 1)).T
        distance = np.linalg.norm(points[seen] - camera.center, axis=1).astype(np.float32)
        np.minimum.at(depth[v], (y, x), distance)
        cells = voxel_m * camera.matrix[0, 0] / float(np.median(distance)) / grid.step
        width = 2 * max(int(np.ceil(cells / 2)), 1) + 1
        depth[v] = cv2.erode(depth[v], np.ones((width, width), np.uint8))
    return Cast((depth < FAR).astype(np.uint8), depth)
