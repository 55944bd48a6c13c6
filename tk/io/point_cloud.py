"""Point clouds and meshes: PLY files, and the HDF5 file of `tk reconstruct`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import ResultError, unwritable
from tk.io.captures.capture import Capture
from tk.io.hdf5_writer import Hdf5Writer, writing
from tk.io.paths import Kind, check_output, looks_like
from tk.io.results.data import HullPoints
from tk.io.results.files import hdf5_kind
from tk.io.results.layout import HULL_CHUNK, create_growing, file_attributes
from tk.model.cameras.volume import VoxelGrid

HULL_FORMAT = "tk-hull"

PLY = Kind("a PLY file", (".ply",), looks_like(rb"ply\n|ply\r"))

#: datasets of a hull file: shape of a row, and type
_HULL_ROWS = {
    "frames": ((), "i8"), "time": ((), "f8"), "hull/offsets": ((), "i8"),
    "hull/positions": ((3,), "f4"), "hull/colors": ((3,), "u1"),
}  # fmt: skip
_SPACE = "make space"


def write_ply(path: Path, positions: ArrayLike, colors: NDArray[np.uint8], triangles: ArrayLike | None = None) -> None:
    """Write coloured points, or a mesh, as binary PLY; missing folders are created.

    Args:
        path: the file.
        positions: (N, 3) metres.
        colors: (N, 3) RGB.
        triangles: (M, 3) indices of the corners; None for points without faces.
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
    """
    check_hull_path(path)
    count = 0
    with writing(path, _SPACE):
        disk = Hdf5Writer(path)
    try:
        with writing(path, _SPACE):
            disk.file.attrs.update(file_attributes(HULL_FORMAT, 1))
            disk.file.attrs.update(fps=capture.fps, up=capture.up, capture=capture.name, voxel_m=grid.voxel_m)
            data = {name: create_growing(disk.file, name, *row, HULL_CHUNK) for name, row in _HULL_ROWS.items()}
            data["hull/offsets"].resize(1, axis=0)
        for frame, points in frames:
            with writing(path, _SPACE):
                stop = len(data["hull/positions"]) + len(points.positions)
                rows: tuple[Any, ...] = ([frame], [frame / capture.fps], [stop], points.positions, points.colors)
                for dataset, values in zip(data.values(), rows, strict=True):
                    dataset.resize(len(dataset) + len(values), axis=0)
                    dataset[len(dataset) - len(values) :] = values
                disk.flush()  # a full disk ends the run here, not after the last frame
            count += 1
    finally:
        with writing(path, _SPACE):
            disk.close(publish=count > 0)  # no frame is finished: an older file stays
    return count


def check_hull_path(path: Path, force: bool = True, capture: Path | None = None) -> None:
    """Check that a hull file may be written: not over other files, and over a hull file only with ``force``."""
    check_output(path, hdf5_kind(HULL_FORMAT), force, capture=capture, error=ResultError)


def ply_path(folder: Path, frame: int) -> Path:
    """Return the path of a frame's point cloud or mesh."""
    return folder / f"{frame:06d}.ply"
