"""The visual hull of a person in a voxel grid, updated from frame to frame (Kehl & Van Gool 2006, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.kernels import hull as kernels
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import VoxelGrid
from tk.model.hull.tables import build_tables, mask_words

__all__ = ["HullSurface", "VisualHull"]


@dataclass(frozen=True)
class HullSurface:
    """The surface voxels of a hull, ascending by flat index (the same order in every run)."""

    voxels: NDArray[np.int32]  # (N,) int32 flat indices into the grid
    positions: NDArray[np.float32]  # (N, 3) float32 voxel centres, world frame, metres
    normals: NDArray[np.float32]  # (N, 3) float32 outward unit normals; zero where undefined (symmetric neighbours)
    colors: NDArray[np.float32]  # (N, 3) float32, 0..255 in the images' channel order (BGR); zero where `seen` is 0
    # (N,) int32, bit c set where camera c sees the voxel frontally and nothing of the hull hides it
    seen: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.voxels)


class VisualHull:
    """A voxel grid carved by silhouettes. It keeps its state: a frame costs only the pixels that changed.

    A voxel is active if its centre projects into at least two images, and to foreground in each of them. A camera
    without foreground does not carve, nor does it see a voxel: it counts as if the volume lay outside its image. (The
    paper is silent about both: its cameras all see the person and the whole volume.)

    Args:
        rig: up to 31 cameras.
        grid: the voxels.

    Attributes:
        used: (C,) bool, the cameras with foreground.

    Raises:
        VolumeError: no voxel is seen by two cameras.
        ConfigError: too many cameras or voxels for 32-bit look-up tables.
    """

    def __init__(self, rig: Rig, grid: VoxelGrid) -> None:
        self.grid = grid
        self._tables = build_tables(rig, grid)
        self._mask_shape = (len(rig), *rig.frame_shape)
        self._pixel_count = int(np.prod(rig.frame_shape))
        self._eyes = ((rig.centers - np.asarray(grid.origin)) / grid.voxel_m).astype(np.float32)
        self._spacing = _sample_spacing(rig, grid)
        self._planes = self._tables.empty_planes.copy()
        self._occupied = np.zeros(self._planes.shape[1], dtype=np.uint32)
        self._previous = np.zeros((len(rig), mask_words(rig)), dtype=np.int64)
        self.used: NDArray[np.bool_] = np.zeros(len(rig), np.bool_)
        self._found = np.empty(grid.count, dtype=np.int32)
        self._clean = True

    def reset(self) -> None:
        """Forget the previous frame: nothing is active."""
        if not self._clean:
            self._planes[:] = self._tables.empty_planes
            self._occupied.fill(0)
            self._previous.fill(0)
            self.used = np.zeros_like(self.used)
            self._clean = True

    def carve(self, masks: NDArray[np.uint8]) -> None:
        """Carve from scratch. ``masks`` (C, H, W) uint8, foreground where not 0."""
        self.reset()
        self.update(masks)

    def update(self, masks: NDArray[np.uint8]) -> None:
        """Carve by the changes since the previous masks; the result equals :meth:`carve`, voxel for voxel.

        Args:
            masks: (C, H, W) uint8 with (H, W) = ``rig.frame_shape``, foreground where not 0.
        """
        tables, words = self._tables, self._as_words(masks)
        self._clean = False
        self.used = np.asarray(words.any(axis=1))
        kernels.carve(
            tables.row_offsets,
            tables.entries,
            self.used,
            tables.enough_in(self.used),
            words,
            self._previous,
            self._planes,
            self._occupied,
        )

    @property
    def occupancy(self) -> NDArray[np.bool_]:
        """(nx, ny, nz) bool, the active voxels; a copy."""
        return kernels.unpack(self._occupied, self.grid.shape)

    def surface(self, images: NDArray[np.uint8] | None = None) -> HullSurface:
        """Return the surface voxels of the current hull.

        Args:
            images: (C, H, W, 3) uint8 BGR of the same frame as the masks; None for no colours.
        """
        channels = (*self._mask_shape, 3)
        if images is not None and (images.shape != channels or images.dtype != np.uint8):
            raise ValueError(f"images are {images.dtype} {images.shape}, expected uint8 {channels}")
        voxels, box = kernels.surface_voxels(self._occupied, self.grid.shape, self._found)
        normals, colors, seen = kernels.shade_surface(
            self._occupied,
            self.grid.shape,
            self._tables.pixels,
            self.used,
            self._eyes,
            self._spacing,
            None if images is None else np.ascontiguousarray(images),
            self._previous.view(np.uint8),
            voxels,
            box,
        )
        return HullSurface(voxels, self.grid.centers(voxels).astype(np.float32), normals, colors, seen)

    def _as_words(self, masks: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Return the masks as int64 words (C, M): a view if aligned, else a zero-padded copy."""
        if masks.shape != self._mask_shape or masks.dtype != np.uint8:
            raise ValueError(f"masks are {masks.dtype} {masks.shape}, expected uint8 {self._mask_shape}")
        flat = np.ascontiguousarray(masks).reshape(len(masks), self._pixel_count)
        if self._pixel_count % 8 == 0:
            words = flat.view(np.int64)
            if words.flags.aligned:
                return words
        words = np.zeros_like(self._previous)
        words.view(np.uint8)[:, : self._pixel_count] = flat
        return words


def _sample_spacing(rig: Rig, grid: VoxelGrid) -> NDArray[np.int32]:
    """Return a third of a voxel's size in each image (C,), at the volume's centre, in whole pixels, at least 1."""
    middle = np.asarray(grid.origin) + grid.voxel_m * (np.asarray(grid.shape) - 1) / 2
    distance = np.maximum(np.linalg.norm(rig.centers - middle, axis=1), grid.voxel_m)
    focal = np.array([camera.matrix[0, 0] for camera in rig])
    return np.maximum(np.rint(focal * grid.voxel_m / distance / 3), 1).astype(np.int32)
