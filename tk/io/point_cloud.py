"""Point clouds: PLY files through Open3D, and `tk reconstruct`'s HDF5 file. Open3D is imported only when it is needed."""

from __future__ import annotations

import datetime
from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from tk import __version__
from tk.errors import ResultError
from tk.io.capture import Capture
from tk.io.result import HullPoints
from tk.model.volume import VoxelGrid


def write_ply(path: Path, positions: NDArray[np.floating], colors_rgb: NDArray[np.uint8]) -> None:
    """Write one coloured point cloud.

    Args:
        path: the file; missing folders are made.
        positions: (N, 3) metres; colors_rgb: (N, 3) uint8.

    Raises:
        ResultError: Open3D cannot be loaded, or the file cannot be written.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ResultError(f"{path}: PLY files need Open3D, which does not load here: {error}") from None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{path.parent}: cannot be made: {error.strerror}") from None
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(np.asarray(positions, np.float64))
    cloud.colors = open3d.utility.Vector3dVector(np.asarray(colors_rgb, np.float64) / 255)
    if not open3d.io.write_point_cloud(str(path), cloud):
        raise ResultError(f"{path}: cannot be written: check the folder's permissions and the space on the disk")


def write_hulls(path: Path, capture: Capture, grid: VoxelGrid, frames: Iterable[tuple[int, HullPoints]]) -> int:
    """Write surface voxels of many frames, ragged, in a result's layout: `/frames`, `/time`, `/hull/…`.

    Args:
        path: the HDF5 file; it replaces an older one when it is complete.
        capture: where the frames come from.
        grid: the voxels.
        frames: frame index and surface of each frame.

    Returns:
        Frames written.

    Raises:
        ResultError: the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        file = h5py.File(temporary, "w")
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error}") from None
    count = 0
    try:
        with file:
            file.attrs.update(
                {
                    "format": "tk-hull",
                    "format_version": 1,
                    "fps": capture.fps,
                    "units": "m",
                    "up": capture.up,
                    "capture": capture.name,
                    "voxel_m": grid.voxel_m,
                    "software": f"tk-mocap {__version__}",
                    "created": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
                }
            )
            group = file.create_group("hull")
            index = file.create_dataset("frames", (0,), np.int64, maxshape=(None,))
            seconds = file.create_dataset("time", (0,), np.float64, maxshape=(None,))
            offsets = group.create_dataset("offsets", (1,), np.int64, maxshape=(None,))
            positions = group.create_dataset("positions", (0, 3), np.float32, maxshape=(None, 3), chunks=(16384, 3))
            colors = group.create_dataset("colors", (0, 3), np.uint8, maxshape=(None, 3), chunks=(16384, 3))
            for frame, points in frames:
                start, stop = len(positions), len(positions) + len(points.positions)
                for dataset, values in ((positions, points.positions), (colors, points.colors)):
                    dataset.resize(stop, axis=0)
                    dataset[start:stop] = values
                count += 1
                for dataset, value in ((index, frame), (seconds, frame / capture.fps)):
                    dataset.resize(count, axis=0)
                    dataset[-1] = value
                offsets.resize(count + 1, axis=0)
                offsets[-1] = stop
        temporary.replace(path)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return count
