"""The body's surface as a sequence of meshes: a folder with a PLY file a frame, named by the source frame.

World frame, metres; the parts of the body are closed meshes that reach into each other, in the colours of the
overlays.
A frame that is not known holds the body before.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tk.errors import ExportError
from tk.export.motion import Motion
from tk.io.mesh import Mesh, write_mesh
from tk.model.body.skeleton import SEGMENTS
from tk.render.figure import figure_of
from tk.render.palette import SEGMENT_COLORS


def write_body_meshes(motion: Motion, folder: Path) -> None:
    """Write a mesh a frame.

    Raises:
        ExportError: the result holds no body.
        ResultError: Open3D cannot be loaded, or a file cannot be written.
    """
    figure = figure_of(motion.result)
    if not figure.solids:
        raise ExportError(f"{motion.result.path}: holds no body, so there is no surface of it; track it again")
    counts = [len(solid.rings) * solid.rings.shape[1] for solid in figure.solids]
    starts = np.cumsum([0, *counts[:-1]])
    faces = [solid.triangles + start for solid, start in zip(figure.solids, starts, strict=True)]
    bgr = [SEGMENT_COLORS[SEGMENTS[solid.segment]] for solid in figure.solids]
    colors = np.repeat(np.array(bgr, np.uint8)[:, ::-1], counts, axis=0)
    triangles = np.concatenate(faces).astype(np.int32)
    for frame, row in zip(motion.frames, motion.held, strict=True):
        write_mesh(folder / f"{frame:06d}.ply", Mesh(figure.placed(int(row)), triangles, colors))
