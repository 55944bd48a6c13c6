"""Look-up tables of the visual hull: the voxels of each pixel. Built once for a rig and grid, cached on disk."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError, VolumeError
from tk.kernels import hull as kernels
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.volume import VoxelGrid

__all__ = ["MAX_CAMERAS", "HullTables", "default_cache_dir", "load_or_build", "mask_words", "table_key"]

MAX_CAMERAS = 31  # one bit each in a positive int32
_FORMAT = 1  # part of the key: raise it when the tables' meaning changes
_CACHE_BYTES = 1_000_000_000  # maximum size of the folder; the oldest tables are deleted
_BLOCK = 32_768  # voxels projected at a time: the intermediate arrays stay in the processor's cache


@dataclass(frozen=True)
class HullTables:
    """The paper's look-up tables (section 4.1, fig. 2) in compressed rows.

    For C cameras, M words of eight mask pixels a picture, V voxels:

    Attributes:
        row_offsets: (C * M + 1,) int32; word w of camera c owns
            ``entries[row_offsets[c * M + w] : row_offsets[c * M + w + 1]]``.
        entries: (L,) int32, the voxels whose centres project to one of the word's pixels, and which pixel it is, in
            the layout of :func:`tk.kernels.hull.look_up_lists`.
        camera_count: C.
        shape: (nx, ny, nz) of the grid.
    """

    row_offsets: NDArray[np.int32]
    entries: NDArray[np.int32]
    camera_count: int
    shape: tuple[int, int, int]

    @cached_property
    def pixels(self) -> NDArray[np.int32]:
        """(V, C) int32, each voxel's pixel in each camera, -1 outside the image."""
        nz = self.shape[2]
        depth = np.int32(32 * kernels.words_per_column(nz))
        pixels = np.full((self.shape[0] * self.shape[1], nz, self.camera_count), -1, dtype=np.int32)
        words = (len(self.row_offsets) - 1) // self.camera_count
        lengths = np.diff(self.row_offsets).reshape(self.camera_count, words)
        first_pixels = np.arange(words, dtype=np.int32) * np.int32(8)
        for camera in range(self.camera_count):
            entries = self.entries[self.row_offsets[camera * words] : self.row_offsets[(camera + 1) * words]]
            column, z = np.divmod(entries >> 3, depth)
            pixels[column, z, camera] = np.repeat(first_pixels, lengths[camera]) + (entries & 7)
        return pixels.reshape(-1, self.camera_count)

    @cached_property
    def empty_planes(self) -> NDArray[np.uint32]:
        """(2C, W) uint32, the cameras' planes without foreground: voxels outside a camera's image are not carved."""
        planes = np.zeros((kernels.SHARES * self.camera_count, len(self.enough)), dtype=np.uint32)
        for camera, row in enumerate(self.pixels.T):
            planes[kernels.SHARES * camera] = kernels.pack((row < 0).reshape(self.shape))
        return planes

    @cached_property
    def enough(self) -> NDArray[np.uint32]:
        """(W,) uint32, the voxels in at least two images."""
        return kernels.pack(_holders(self.pixels.T).reshape(self.shape) >= 2)


def load_or_build(rig: Rig, grid: VoxelGrid, cache_dir: Path | None = None) -> HullTables:
    """Return the tables of this rig and grid from the cache, or build and cache them.

    Raises:
        VolumeError: no voxel is seen by two cameras.
        ConfigError: more than 31 cameras, or more look-ups than 32-bit offsets reach.
    """
    if len(rig) > MAX_CAMERAS:
        raise ConfigError(f"{len(rig)} cameras: the visual hull takes up to {MAX_CAMERAS}; choose some of them")
    plane = 32 * kernels.words_per_column(grid.shape[2]) * grid.shape[0] * grid.shape[1]
    if plane >= 2**28 or len(rig) * plane >= 2**31:  # 29 bits of an entry, 32 of an offset, less the signs
        raise ConfigError(f"{grid.count} voxels by {len(rig)} cameras are too many look-ups; give fewer voxels")
    path = (cache_dir or default_cache_dir()) / f"hull-{table_key(rig, grid)}.npz"
    tables = _load(path, rig, grid)
    if tables is None:
        tables = _build(rig, grid)
        _save(path, tables)
    return tables


def mask_words(rig: Rig) -> int:
    """Return the number of eight-pixel words of one image."""
    height, width = rig.frame_shape
    return (height * width + 7) // 8


def default_cache_dir() -> Path:
    """Return the platform's folder for this program's cached files; it need not exist."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA", "")
    elif sys.platform == "darwin":
        base = os.path.join("~", "Library", "Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME", "")
    return Path(os.path.expanduser(base or os.path.join("~", ".cache"))) / "tk"


def table_key(rig: Rig, grid: VoxelGrid) -> str:
    """Return a hash of the format, the cameras (without their names) and the grid."""
    digest = hashlib.sha256(f"tk-hull {_FORMAT} {sys.byteorder}".encode())
    for camera in rig:
        digest.update(f"{camera.width} {camera.height} {camera.fisheye} {len(camera.distortions)}".encode())
        for numbers in (camera.matrix, camera.distortions, camera.rotation, camera.translation):
            digest.update(np.ascontiguousarray(numbers, dtype="<f8").tobytes())
    digest.update(np.array([*grid.origin, grid.voxel_m, *grid.shape], dtype="<f8").tobytes())
    return digest.hexdigest()[:32]


def _build(rig: Rig, grid: VoxelGrid) -> HullTables:
    width = rig.frame_shape[1]
    pixels = np.empty((len(rig), grid.count), dtype=np.int32)
    starts = range(0, grid.count, _BLOCK)

    def project(start: int) -> None:
        stop = min(start + _BLOCK, grid.count)
        centers = grid.centers(np.arange(start, stop))
        for row, camera in zip(pixels, rig, strict=True):
            row[start:stop] = _pixel_index(camera, centers, width)

    with ThreadPoolExecutor() as pool:  # numpy and OpenCV let go of the interpreter lock
        list(pool.map(project, starts))
    if _holders(pixels).max() < 2:
        raise VolumeError(
            "capture.toml: no two cameras see any of the working volume; "
            "correct center and size in [volume], or the cameras' poses in calibration.toml"
        )
    row_offsets, entries = kernels.look_up_lists(pixels, mask_words(rig), grid.shape[2])
    return HullTables(row_offsets, entries, len(rig), grid.shape)


def _holders(pixels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the number of images that contain each voxel (V,)."""
    holders = np.zeros(pixels.shape[1], dtype=np.uint8)
    for row in pixels:
        holders += row >= 0
    return holders


def _pixel_index(camera: Camera, p_world: NDArray[np.float64], stride: int) -> NDArray[np.int32]:
    """Return the index ``y * stride + x`` (N,) of each point's pixel, -1 outside the camera's image."""
    xy, _ = camera.project(p_world)
    limit = np.array([camera.width - 0.5, camera.height - 0.5])
    inside = np.logical_and((xy >= -0.5).all(axis=1), (xy < limit).all(axis=1))  # NaN is not
    cell = np.floor(np.where(inside[:, None], xy, 0.0) + 0.5).astype(np.int32)
    return np.where(inside, cell[:, 1] * stride + cell[:, 0], -1).astype(np.int32)


def _load(path: Path, rig: Rig, grid: VoxelGrid) -> HullTables | None:
    """Return the tables in this file; None if they are damaged or do not fit (reading verifies zip checksums)."""
    try:
        # our own stream: numpy does not close the stream that it opens if the archive is damaged
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            row_offsets, entries = stored["row_offsets"], stored["entries"]
        os.utime(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    depth = 32 * kernels.words_per_column(grid.shape[2])
    fits = (
        row_offsets.dtype == entries.dtype == np.int32
        and row_offsets.shape == (len(rig) * mask_words(rig) + 1,)
        and entries.ndim == 1
        and row_offsets[0] == 0
        and row_offsets[-1] == len(entries) > 0
        and (np.diff(row_offsets) >= 0).all()
        and entries.min() >= 0
        and entries.max() >> 3 < grid.shape[0] * grid.shape[1] * depth
        and ((entries >> 3) % depth).max() < grid.shape[2]
    )
    return HullTables(row_offsets, entries, len(rig), grid.shape) if fits else None


def _save(path: Path, tables: HullTables) -> None:
    """Write to a temporary name and rename: no reader finds an incomplete file. Failures are ignored."""
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, row_offsets=tables.row_offsets, entries=tables.entries)
        os.replace(temporary, path)
        temporary = None
        _prune(path.parent)
    except OSError:
        pass
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def _prune(folder: Path) -> None:
    """Delete the least recently used tables until the rest fit into the cache's size."""
    total = 0
    for stat, path in sorted(((p.stat(), p) for p in folder.glob("hull-*.npz")), key=lambda e: -e[0].st_mtime):
        total += stat.st_size
        if total > _CACHE_BYTES:
            path.unlink(missing_ok=True)
