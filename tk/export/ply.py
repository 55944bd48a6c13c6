"""Write the body's surface as a folder of meshes: one PLY file per frame, named by the source frame.

World frame, metres. Each part of the body is a closed mesh in the colour of the overlays; neighbouring parts overlap.
An unknown frame repeats the last known body.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tk.errors import ExportError
from tk.export.motion import Motion
from tk.io.point_cloud import ply_path, write_ply
from tk.model.body.skeleton import SEGMENTS
from tk.render.figure import figure_of
from tk.render.palette import SEGMENT_COLORS


def write_body_meshes(motion: Motion, folder: Path) -> None:
    """Write one mesh per frame."""
    figure = figure_of(motion.result)
    if not figure.solids:
        raise ExportError(f"{motion.result.path}: has no body and thus no surface; track the capture again")
    faces = [solid.triangles + start for solid, start in zip(figure.solids, figure.starts[:-1], strict=True)]
    bgr = [SEGMENT_COLORS[SEGMENTS[solid.segment]] for solid in figure.solids]
    colors = np.repeat(np.array(bgr, np.uint8)[:, ::-1], np.diff(figure.starts), axis=0)
    triangles = np.concatenate(faces).astype(np.int32)
    for frame, row in zip(motion.result.frames, motion.held, strict=True):
        write_ply(ply_path(folder, frame), figure.placed(int(row)), colors, triangles)
