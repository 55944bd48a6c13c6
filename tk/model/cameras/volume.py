"""The working volume and its voxel grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import VolumeError


@dataclass(frozen=True)
class Volume:
    """An axis-aligned box in the world frame, metres: ``center`` (3,) and ``size`` (3,)."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]

    def __post_init__(self) -> None:
        values = np.array([*self.center, *self.size])
        if not np.isfinite(values).all() or min(self.size) <= 0:
            raise VolumeError(f"the working volume is empty: size = {list(self.size)} must be positive metres")

    @property
    def lower(self) -> NDArray[np.float64]:
        return np.array(self.center) - np.array(self.size) / 2

    @property
    def upper(self) -> NDArray[np.float64]:
        return np.array(self.center) + np.array(self.size) / 2


@dataclass(frozen=True)
class VoxelGrid:
    """Cubic voxels that cover a volume. Voxel (i, j, k) is centred at ``origin + voxel_m * (i, j, k)``.

    Attributes:
        origin: (3,) centre of voxel (0, 0, 0), world frame, metres.
        voxel_m: edge length, metres.
        shape: voxels along x, y, z. Flat indices run in C order, z fastest.
    """

    origin: tuple[float, float, float]
    voxel_m: float
    shape: tuple[int, int, int]

    @staticmethod
    def cover(volume: Volume, voxels: int) -> VoxelGrid:
        """Return the grid with ``voxels`` along the volume's longest side, centred on the volume."""
        if voxels < 2:
            raise VolumeError(f"voxels = {voxels}: give at least 2 along the longest side")
        size = np.array(volume.size)
        voxel_m = float(size.max() / voxels)
        shape = np.maximum(np.ceil(size / voxel_m - 1e-9).astype(int), 1)
        origin = np.array(volume.center) - (shape - 1) * voxel_m / 2
        return VoxelGrid(
            (float(origin[0]), float(origin[1]), float(origin[2])),
            voxel_m,
            (int(shape[0]), int(shape[1]), int(shape[2])),
        )

    @property
    def count(self) -> int:
        return int(np.prod(self.shape))

    def within(self, lower: ArrayLike, upper: ArrayLike) -> NDArray[np.int64]:
        """Return the flat indices (N,) of the voxels with centres between two corners (3,), metres."""
        first, last = ((np.asarray(corner) - self.origin) / self.voxel_m for corner in (lower, upper))
        sides = [
            np.arange(max(int(np.ceil(a)), 0), min(int(np.floor(b)) + 1, side))
            for a, b, side in zip(first, last, self.shape, strict=True)
        ]
        return np.ravel_multi_index(np.ix_(*sides), self.shape).ravel()

    def centers(self, flat: NDArray[np.integer] | None = None) -> NDArray[np.float64]:
        """Return (N, 3) centres of the voxels with flat indices (all of them by default), metres."""
        index = np.arange(self.count) if flat is None else np.asarray(flat)
        ijk = np.unravel_index(index, self.shape)
        return np.column_stack([start + self.voxel_m * i for start, i in zip(self.origin, ijk, strict=True)])
