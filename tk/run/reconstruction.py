"""Visual hulls of a whole capture: `tk reconstruct`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tk.errors import ConfigError, ResultError
from tk.io.captures.capture import Capture
from tk.io.mesh import hull_mesh
from tk.io.paths import check_files
from tk.io.point_cloud import PLY, check_hull_path, ply_path, write_hulls, write_ply
from tk.io.results.data import HullPoints
from tk.model.cameras.volume import VoxelGrid
from tk.model.hull.hull import VisualHull
from tk.run.plan import choose_frames
from tk.run.reporter import Reporter
from tk.run.segmentation import make_labeller
from tk.run.task import Task
from tk.settings import Settings


def reconstruct(
    capture: Capture,
    output: Path,
    config: Settings,
    reporter: Reporter,
    frames: tuple[int, int | None] = (0, None),
    ply: Path | None = None,
    mesh: Path | None = None,
    force: bool = False,
) -> int:
    """Write the coloured surface voxels of every frame.

    Args:
        capture: what to reconstruct.
        output: HDF5 file with `/frames`, `/time` and `/hull` as in a result.
        config: settings of the segmentation and the resolution.
        reporter: who hears of the progress.
        frames: first frame and the one to stop before (None: the last).
        ply: folder for a point cloud a frame, PLY.
        mesh: folder for a closed mesh of the hull's surface a frame, PLY; needs Open3D.
        force: replace files that exist.

    Returns:
        Frames written.

    Raises:
        TkError: bad input; every frame finished before it is in the file.
    """
    check_hull_path(output, force, capture.path)
    for warning in capture.warnings:
        reporter.note(warning)
    start, stop = choose_frames(capture, frames, reporter.note)
    if ply is not None and mesh is not None and ply.resolve() == mesh.resolve():
        raise ConfigError(f"{ply}: is the folder of point clouds and of meshes; give each a folder of its own")
    for folder in (ply, mesh):
        if folder is not None:
            files = [ply_path(folder, frame) for frame in range(start, stop)]
            check_files(folder, files, PLY, force, capture=capture.path, error=ResultError)
    label = make_labeller(Task.of(capture, config), reporter.note)
    hull = VisualHull(capture.rig, VoxelGrid.cover(capture.volume, config.voxels))
    reporter.begin(stop - start, 0)

    def hulls() -> Iterator[tuple[int, HullPoints]]:
        with capture.frames(start, stop) as reader:
            for frame in reader:
                hull.update(label(frame).masks)
                points = HullPoints.of(hull.surface(frame.images))
                if ply is not None:
                    write_ply(ply_path(ply, frame.index), points.positions, points.colors)
                if mesh is not None:
                    surface = hull_mesh(hull.occupancy, hull.grid, points)
                    write_ply(ply_path(mesh, frame.index), surface.vertices, surface.colors, surface.triangles)
                yield frame.index, points
                reporter.advance(frame.index, None)

    return write_hulls(output, capture, hull.grid, hulls())
