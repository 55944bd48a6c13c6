"""Point clouds and meshes: PLY files, and the HDF5 file of `tk reconstruct`."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk import __version__
from tk.errors import ResultError, unwritable
from tk.io.captures.capture import Capture
from tk.io.paths import Kind, check_output, looks_like
from tk.io.results.data import HullPoints
from tk.io.results.files import SUFFIXES, SafeFile, is_hdf5_of
from tk.model.cameras.volume import VoxelGrid

HULL_FORMAT = "tk-hull"

PLY = Kind("a PLY file", (".ply",), looks_like(rb"ply\n|ply\r"))

#: datasets of a hull file: shape of a row and type
_HULL_ROWS = {
    "frames": ((), "i8"), "time": ((), "f8"), "hull/offsets": ((), "i8"),
    "hull/positions": ((3,), "f4"), "hull/colors": ((3,), "u1"),
}  # fmt: skip


def write_ply(path: Path, positions: ArrayLike, colors: NDArray[np.uint8], triangles: ArrayLike | None = None) -> None:
    """Write coloured points, or a mesh, as binary PLY; missing folders are created.

    Args:
        path: the file.
        positions: (N, 3) metres.
        colors: (N, 3) RGB.
        triangles: (M, 3) indices of the corners; None for points without faces.

    Raises:
        ResultError: the file cannot be written.
    """
    points = np.empty(len(colors), [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    points["xyz"], points["rgb"] = positions, colors
    channels = ("double x", "double y", "double z", "uchar red", "uchar green", "uchar blue")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {channel}" for channel in channels]
    content = points.tobytes()
    if triangles is not None:
        corners = np.asarray(triangles)
        faces = np.empty(len(corners), [("count", "u1"), ("corners", "<u4", 3)])
        faces["count"], faces["corners"] = 3, corners
        header += [f"element face {len(faces)}", "property list uchar uint vertex_indices"]
        content += faces.tobytes()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes("\n".join([*header, "end_header\n"]).encode() + content)
    except OSError as error:
        raise unwritable(path, error) from None


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
    count = voxels = 0
    try:
        with SafeFile(temporary, "w") as disk:
            disk.file.attrs.update(
                {
                    "format": HULL_FORMAT,
                    "format_version": 1,
                    "fps": capture.fps,
                    "units": "m",
                    "up": capture.up,
                    "capture": capture.name,
                    "voxel_m": grid.voxel_m,
                    "software": f"tk-mocap {__version__}",
                    "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
                }
            )
            data = {
                name: disk.file.create_dataset(
                    name, (0, *shape), dtype, maxshape=(None, *shape), chunks=(16384, 3) if shape else True
                )
                for name, (shape, dtype) in _HULL_ROWS.items()
            }
            data["hull/offsets"].resize(1, axis=0)
            try:
                for frame, points in frames:
                    stop = voxels + len(points.positions)
                    rows: tuple[Any, ...] = ([frame], [frame / capture.fps], [stop], points.positions, points.colors)
                    for dataset, values in zip(data.values(), rows, strict=True):
                        dataset.resize(len(dataset) + len(values), axis=0)
                        dataset[len(dataset) - len(values) :] = values
                    count, voxels = count + 1, stop
                    disk.flush_to_disk()  # a full disk ends the run here, not after the last frame
            finally:  # Ctrl-C may interrupt a frame
                for dataset, length in zip(data.values(), (count, count, count + 1, voxels, voxels), strict=True):
                    dataset.resize(length, axis=0)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise unwritable(path, error) from None
    finally:
        if count and temporary.exists():
            temporary.replace(path)
        temporary.unlink(missing_ok=True)  # no frame is finished: an older file stays
    return count


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
