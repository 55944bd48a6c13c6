"""Point clouds: PLY files, with Open3D imported only when needed, and the HDF5 file of `tk reconstruct`."""

from __future__ import annotations

import datetime
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk import __version__
from tk.errors import ResultError, unwritable
from tk.io.captures.capture import Capture
from tk.io.paths import Kind, c_name, check_output, looks_like
from tk.io.results.data import HullPoints
from tk.io.results.files import SUFFIXES, SafeFile, is_hdf5_of
from tk.model.cameras.volume import VoxelGrid

HULL_FORMAT = "tk-hull"

PLY = Kind("a PLY file", (".ply",), looks_like(rb"ply\n|ply\r"))

_PLY_VERTICES = """ply
format binary_little_endian 1.0
element vertex 0
property double x
property double y
property double z
property uchar red
property uchar green
property uchar blue
"""
_PLY_FACES = """element face 0
property list uchar uint vertex_indices
"""


def write_ply(path: Path, positions: NDArray[np.floating], colors_rgb: NDArray[np.uint8]) -> None:
    """Write one coloured point cloud.

    Args:
        path: the file; missing folders are created.
        positions: (N, 3) metres; colors_rgb: (N, 3) uint8.

    Raises:
        ResultError: Open3D cannot be loaded, or the file cannot be written.
    """
    open3d = load_open3d(path)
    create_empty_ply(path)
    if len(positions) == 0:
        return
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(np.asarray(positions, np.float64))
    cloud.colors = open3d.utility.Vector3dVector(np.asarray(colors_rgb, np.float64) / 255)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        written = open3d.io.write_point_cloud(c_name(path, ResultError), cloud)
    if not written:
        raise ply_error(path)


def load_open3d(path: Path) -> Any:
    """Return Open3D, to write ``path``.

    Raises:
        ResultError: it cannot be loaded.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ResultError(f"{path}: PLY files need Open3D, which does not load: {error}") from None
    return open3d


def create_empty_ply(path: Path, faces: bool = False) -> None:
    """Write a PLY without points and, if ``faces`` is set, without faces.

    Open3D does not report why it cannot write, and cannot write an empty file.

    Raises:
        ResultError: with the reason.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{path.parent}: cannot be created: {error.strerror}") from None
    try:
        path.write_text(f"{_PLY_VERTICES}{_PLY_FACES if faces else ''}end_header\n", encoding="ascii", newline="\n")
    except OSError as error:
        raise unwritable(path, error) from None


def ply_error(path: Path) -> ResultError:
    """Return the error for a file that Open3D could not finish."""
    return ResultError(f"{path}: cannot be written completely; check the free disk space")


def write_hulls(path: Path, capture: Capture, grid: VoxelGrid, frames: Iterable[tuple[int, HullPoints]]) -> int:
    """Write the surface voxels of many frames in the layout of a result: `/frames`, `/time`, `/hull/…`.

    Args:
        path: the HDF5 file; it replaces an older hull file at the end. If ``frames`` raises, earlier frames are kept.
        capture: the capture of the frames.
        grid: the voxel grid.
        frames: index and surface of each frame.

    Returns:
        The number of frames written.

    Raises:
        ResultError: the file cannot be written, or a file of that name is not a hull file (it is not changed).
    """
    check_hull_path(path)
    temporary = path.with_name(f".{path.name}.tmp")
    count = 0
    try:
        with SafeFile(temporary, "w") as disk:
            file = disk.file
            file.attrs.update(
                {
                    "format": HULL_FORMAT,
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
            voxels = 0
            try:
                for frame, points in frames:
                    stop = voxels + len(points.positions)
                    for dataset, values in ((positions, points.positions), (colors, points.colors)):
                        dataset.resize(stop, axis=0)
                        dataset[voxels:stop] = values
                    for dataset, value in ((index, frame), (seconds, frame / capture.fps)):
                        dataset.resize(count + 1, axis=0)
                        dataset[count] = value
                    offsets.resize(count + 2, axis=0)
                    offsets[count + 1] = stop
                    count, voxels = count + 1, stop
                    disk.flush_to_disk()  # a full disk ends the run here, not after the last frame
            finally:  # Ctrl-C may interrupt a frame
                for dataset, rows in ((positions, voxels), (colors, voxels), (index, count), (seconds, count)):
                    dataset.resize(rows, axis=0)
                offsets.resize(count + 1, axis=0)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise unwritable(path, error) from None
    except BaseException:
        _publish(temporary, path, count)
        raise
    _publish(temporary, path, count)
    return count


def _publish(temporary: Path, path: Path, count: int) -> None:
    if count:
        temporary.replace(path)
    else:  # no frame is finished: an older file stays
        temporary.unlink(missing_ok=True)


def check_hull_path(path: Path, force: bool = True, capture: Path | None = None) -> None:
    """Check that a hull file may be written: not over other files, and over a hull file only with ``force``.

    Raises:
        TkError: with the remedy, see :func:`tk.io.paths.check_output`.
    """
    kind = Kind(f"a {HULL_FORMAT} file", SUFFIXES, lambda found: is_hdf5_of(found, HULL_FORMAT))
    check_output(path, kind, force, capture=capture, error=ResultError)


def ply_path(folder: Path, frame: int) -> Path:
    """Return the path of a frame's point cloud or mesh."""
    return folder / f"{frame:06d}.ply"
