"""Divide a hull into people: connected voxels with several upright columns are several people."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.body.plausibility import EXTENT, STATURE_M
from tk.model.cameras.landmark_agreement import APART_M
from tk.model.cameras.volume import VoxelGrid
from tk.model.hull.coarse import LEAST_LITRES
from tk.model.hull.voxel_table import components

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Near = Sequence[tuple[Float, float]]
"""People of the last frame, or those whom landmarks show: position (3,) m, and volume of the hull, m³, or 0."""

# Volume of a person's hull, litres, at most: of a man of 125 kg, whose hull may be twice as large. Components smaller
# than a head (4 litres) are ignored.
_MOST_LITRES, _SPECK_LITRES = 250.0, 4.0
# A column of the floor plan is part of a trunk if so many metres of it are in the hull: an arm has 0.1 m, the trunk of
# a crouching adult 0.6 m.
_TRUNK_M = 0.5
# Standard deviation of the smoothed floor plan, metres: half of a trunk's depth.
_SMOOTH_M = 0.1
# Radius of a person's column in a block, metres: half the breadth of the shoulders, and a step.
_BODY_M = 0.35
# Two columns are two people if the floor plan between them falls to this share of the lower one.
_SADDLE = 0.7
# Two people in one component have at least this share of the volume that they had apart: more than one of two equals.
_TOGETHER = 0.75
# Most candidates that are compared, by volume: all 2^12 subsets take 10 ms.
MOST = 12


class HullColumns:
    """Voxels of a hull, divided into people.

    Args:
        grid: their grid.
        to_plan: (3, 3) rows: two directions on the floor, and up.
        centers: (N, 3) m, of the voxels.
        flat: (N,) their numbers in the grid.
    """

    def __init__(self, grid: VoxelGrid, to_plan: Float, centers: Float, flat: NDArray[np.int64]) -> None:
        self._grid, self._to_plan, self._centers, self._flat = grid, to_plan, centers, flat

    def people(self, hull: Bool, near: Near) -> list[NDArray[np.int64]]:
        """Return the voxels of each component that may be a person; wide components are split.

        Args:
            hull: (N,) the voxels of the hull.
            near: a component that holds the positions of several is split between them if it is as large as they were
                together.
        """
        dense = np.zeros(self._grid.count, np.bool_)
        dense[self._flat[hull]] = True
        label = components(dense.reshape(self._grid.shape)).reshape(-1)[self._flat]
        order = np.argsort(label, kind="stable")
        sizes = np.bincount(label, minlength=1)
        wholes: list[NDArray[np.int64]] = []
        for whole in np.split(order, np.cumsum(sizes)[:-1])[1:]:
            if len(whole) * self._litres >= _SPECK_LITRES:
                middle = self.trunk(whole)
                # a gap in the masks cuts a person in two; nobody stands above somebody else
                above = [k for k, other in enumerate(wholes) if np.linalg.norm(self.trunk(other) - middle) < APART_M]
                for k in reversed(above):
                    whole = np.concatenate([wholes.pop(k), whole])
                wholes.append(whole)
        parts = [part for whole in wholes for part in self._split(whole, near)]
        return [column for part in parts for column in self._columns(part) if self._plausible(column)]

    @property
    def _litres(self) -> float:
        return 1000 * self._grid.voxel_m**3

    def _plausible(self, part: NDArray[np.int64]) -> bool:
        """Return whether voxels have a person's volume and extent, lying or standing."""
        extent = float(np.ptp(self._centers[part] @ self._to_plan.T, axis=0).max()) + self._grid.voxel_m
        litres = len(part) * self._litres
        return litres >= LEAST_LITRES and EXTENT[0] * STATURE_M[0] <= extent <= EXTENT[1] * STATURE_M[1]

    def _plan(self, part: NDArray[np.int64]) -> tuple[Float, NDArray[np.int64], Float]:
        """Return the floor plan of voxels: metres of hull by cell, the cell (M, 2) of each voxel, and the first cell.

        Cells have the voxels' edge.
        """
        across = self._centers[part] @ self._to_plan[:2].T
        low = across.min(axis=0) - 3 * self._grid.voxel_m
        cell = np.rint((across - low) / self._grid.voxel_m).astype(np.int64)
        plan = np.zeros(cell.max(axis=0) + 4)
        np.add.at(plan, tuple(cell.T), self._grid.voxel_m)
        return plan, cell, low

    def _split(self, part: NDArray[np.int64], near: Near) -> list[NDArray[np.int64]]:
        """Return the voxels of each person in a component: each belongs to the nearest upright column.

        Columns are at the maxima of the floor plan, or at the positions of the people ``near``.
        """
        plan, cell, low = self._plan(part)
        seeds = self._maxima(plan)
        if len(near) > len(seeds):
            at = [self._to_plan[:2] @ position - low for position, _ in near]
            held = [np.linalg.norm(cell * self._grid.voxel_m - place, axis=1).min() < APART_M for place in at]
            expected = sum(volume for (_, volume), holds in zip(near, held, strict=True) if holds)
            if sum(held) > len(seeds) and len(part) * self._litres >= 1000 * _TOGETHER * expected:
                held_at = [place for place, holds in zip(at, held, strict=True) if holds]
                seeds = np.rint(np.array(held_at) / self._grid.voxel_m).astype(np.int64)
        if len(seeds) < 2:
            return [part]
        nearest = np.linalg.norm(cell[:, None] - seeds[None], axis=2).argmin(axis=1)
        return [part[nearest == k] for k in range(len(seeds))]

    def _columns(self, part: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return the voxels about each maximum of the floor plan, if one person cannot have so many; else all.

        Among people who stand close together before few cameras the hull is one block. Which of its columns are people
        is decided by the pixels that they explain.
        """
        if len(part) * self._litres <= _MOST_LITRES:
            return [part]
        plan, cell, _ = self._plan(part)
        seeds = self._maxima(plan, 1.0, self._grid.voxel_m)
        away = np.linalg.norm(cell[:, None] - seeds[None], axis=2) * self._grid.voxel_m
        return [part[near] for near in (away < _BODY_M).T]

    def trunk(self, part: NDArray[np.int64]) -> Float:
        """Return where the tallest column of voxels stands on the floor plan (2,), metres."""
        plan, _, low = self._plan(part)
        smooth = _blurred(plan, _SMOOTH_M / self._grid.voxel_m)
        return np.array(np.unravel_index(smooth.argmax(), plan.shape)) * self._grid.voxel_m + low

    def _maxima(self, plan: Float, saddle: float = _SADDLE, sigma_m: float = _SMOOTH_M) -> NDArray[np.int64]:
        """Return the cells (K, 2) of the people's trunks in a floor plan smoothed by ``sigma_m``, the tallest first.

        At most :data:`MOST`. Between two of them the plan falls to the share ``saddle`` of the lower one.
        """
        edge = self._grid.voxel_m
        smooth = _blurred(plan, sigma_m / edge)
        across = 2 * max(1, round(APART_M / edge)) + 1
        peaks = np.argwhere((smooth == cv2.dilate(smooth, np.ones((across, across)))) & (smooth >= _TRUNK_M))
        peaks = peaks[np.argsort(-smooth[tuple(peaks.T)], kind="stable")]
        kept: list[NDArray[np.int64]] = []
        for peak in peaks:
            height = smooth[tuple(peak)]
            steps = np.linspace(0, 1, 20)[:, None]
            lines = [(peak + steps * (other - peak)).astype(np.float32) for other in kept]
            between = [cv2.remap(smooth, line[:, 1], line[:, 0], cv2.INTER_LINEAR).min() for line in lines]
            if all(lowest <= saddle * height for lowest in between):
                kept.append(peak)
            if len(kept) == MOST:  # masks that are full everywhere have a maximum in every cell
                break
        return np.array(kept).reshape(-1, 2)


def _blurred(plan: Float, sigma: float) -> Float:
    """Return a floor plan smoothed by a Gaussian, cells."""
    across = 2 * int(4 * sigma + 0.5) + 1
    return np.asarray(cv2.GaussianBlur(plan, (across, across), sigma, borderType=cv2.BORDER_REFLECT))
