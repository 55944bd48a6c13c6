"""Look-up tables of the visual hull: the voxels of each pixel. Built once for a rig and grid, in about a second."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError, VolumeError
from tk.kernels import hull as kernels
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.volume import VoxelGrid

MAX_CAMERAS = 31  # one bit each in a positive int32
_BLOCK = 32_768  # voxels projected at a time: the intermediate arrays stay in the processor's cache


@dataclass(frozen=True)
class HullTables:
    """The paper's look-up tables (section 4.1, fig. 2) in compressed rows.

    For C cameras, M words of eight mask pixels an image, V voxels, W words of a packed plane (:mod:`tk.kernels.hull`):
    """

    # (C * M + 1,) int32; word w of camera c owns `entries[row_offsets[c * M + w] : row_offsets[c * M + w + 1]]`
    row_offsets: NDArray[np.int32]
    # (L,) int32, the voxels whose centres project to one of the word's pixels, and which pixel it is, in the layout of
    # `tk.kernels.hull.look_up_lists`
    entries: NDArray[np.int32]
    pixels: NDArray[np.int32]  # (V, C) int32, each voxel's pixel in each camera, -1 outside the image
    # (2C, W) uint32, the cameras' planes without foreground: voxels outside a camera's image are not carved
    empty_planes: NDArray[np.uint32]
    enough: NDArray[np.uint32]  # (W,) uint32, the voxels in at least two images

    def enough_in(self, cameras: NDArray[np.bool_]) -> NDArray[np.uint32]:
        """Return (W,) the voxels in at least two images of some cameras (C,)."""
        if cameras.all():
            return self.enough
        once, twice = np.zeros_like(self.enough), np.zeros_like(self.enough)
        for inside in ~self.empty_planes[:: kernels.SHARES][cameras]:
            twice |= once & inside
            once |= inside
        return twice & self.enough


def build_tables(rig: Rig, grid: VoxelGrid) -> HullTables:
    """Build the tables of this rig and grid.

    Raises:
        VolumeError: no voxel is seen by two cameras.
        ConfigError: more than 31 cameras, or more look-ups than 32-bit offsets reach.
    """
    if len(rig) > MAX_CAMERAS:
        raise ConfigError(f"{len(rig)} cameras: the visual hull takes up to {MAX_CAMERAS}; choose some of them")
    plane = 32 * kernels.words_per_column(grid.shape[2]) * grid.shape[0] * grid.shape[1]
    if plane >= 2**28 or len(rig) * plane >= 2**31:  # 29 bits of an entry, 32 of an offset, less the signs
        raise ConfigError(f"{grid.count} voxels by {len(rig)} cameras are too many look-ups; give fewer voxels")
    width = rig.frame_shape[1]
    pixels = np.empty((len(rig), grid.count), dtype=np.int32)

    def project(start: int) -> None:
        stop = min(start + _BLOCK, grid.count)
        centers = grid.centers(np.arange(start, stop))
        for row, camera in zip(pixels, rig, strict=True):
            row[start:stop] = _pixel_index(camera, centers, width)

    with ThreadPoolExecutor() as pool:  # numpy and OpenCV let go of the interpreter lock
        list(pool.map(project, range(0, grid.count, _BLOCK)))
    inside = (pixels >= 0).reshape(len(rig), *grid.shape)
    enough = np.count_nonzero(inside, axis=0) >= 2
    if not enough.any():
        raise VolumeError(
            "capture.toml: no two cameras see any of the working volume; "
            "correct center and size in [volume], or the cameras' poses in calibration.toml"
        )
    row_offsets, entries = kernels.look_up_lists(pixels, mask_words(rig), grid.shape[2])
    packed = kernels.pack(enough)
    planes = np.zeros((kernels.SHARES * len(rig), len(packed)), dtype=np.uint32)
    planes[:: kernels.SHARES] = [kernels.pack(~held) for held in inside]
    return HullTables(row_offsets, entries, np.ascontiguousarray(pixels.T), planes, packed)


def mask_words(rig: Rig) -> int:
    """Return the number of eight-pixel words of one image."""
    height, width = rig.frame_shape
    return (height * width + 7) // 8


def _pixel_index(camera: Camera, p_world: NDArray[np.float64], stride: int) -> NDArray[np.int32]:
    """Return the index ``y * stride + x`` (N,) of each point's pixel, -1 outside the camera's image."""
    xy, _ = camera.project(p_world)
    limit = np.array([camera.width - 0.5, camera.height - 0.5])
    inside = np.logical_and((xy >= -0.5).all(axis=1), (xy < limit).all(axis=1))  # NaN is not
    cell = np.floor(np.where(inside[:, None], xy, 0.0) + 0.5).astype(np.int32)
    return np.where(inside, cell[:, 1] * stride + cell[:, 0], -1).astype(np.int32)
