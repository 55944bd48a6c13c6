"""C3D: points and rotations, the file of motion laboratories, written through ezc3d.

World frame as in the result, millimetres. A point's residual is its standard deviation in whole millimetres
(127 at
most) where the result tells one, else 0. In frames that are not known it is -1, and the coordinates are 0, which is how
the format says that a point is missing; ROTATION, each segment's 4×4 transform to the world, has the reliability -1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tk.errors import ExportError
from tk.export.motion import Motion
from tk.model.body.joints import SEGMENT_ORIGIN

# A byte of a signed word: ezc3d would wrap 256 to 0, which is a point without an error.
_MOST_RESIDUAL = 127


def write_c3d(motion: Motion, path: Path) -> None:
    """Write the joints, the points of the feet, and the segments.

    Raises:
        ExportError: ezc3d is not installed.
    """
    try:
        import ezc3d
    except ImportError:
        raise ExportError("--to c3d needs the package ezc3d: pip install 'tk-mocap[export]'") from None
    file = ezc3d.c3d()
    points = np.ones((4, len(motion.point_names), len(motion)))
    points[:3] = 1000.0 * motion.points.transpose(2, 1, 0)
    points[:3, :, ~motion.known] = np.nan  # ezc3d writes zeros
    residuals = np.round(1000.0 * np.nan_to_num(motion.sigma.T)).clip(max=_MOST_RESIDUAL)
    residuals[:, ~motion.known] = -1.0
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = residuals[None]
    file.add_parameter("POINT", "LABELS", list(motion.point_names))
    file.add_parameter("POINT", "UNITS", ["mm"])
    file.add_parameter("POINT", "RATE", [motion.fps])

    T = np.zeros((4, 4, len(motion.segments), len(motion)))
    T[3, 3] = 1.0
    T[:3, :3] = motion.rotations.transpose(2, 3, 1, 0)
    for s, name in enumerate(motion.segments):
        T[:3, 3, s] = 1000.0 * motion.point(SEGMENT_ORIGIN[name]).T
    T[:, :, :, ~motion.known] = np.nan
    file["data"]["rotations"] = T
    file.add_parameter("ROTATION", "LABELS", list(motion.segments))
    file.add_parameter("ROTATION", "RATE", [motion.fps])
    file.write(str(path))
