"""Write C3D files, the format of motion laboratories, with points and segment rotations. It needs ezc3d.

World frame of the result, millimetres. A point's residual is its standard deviation in whole millimetres, at most 127;
0 if the result has none. In unknown frames the residual is -1 and the coordinates are 0, the format's mark of a missing
point. ROTATION is each segment's 4×4 transform to the world; in unknown frames its reliability is -1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tk.export.motion import Motion
from tk.model.body.joints import SEGMENT_ORIGIN

# The residual is a signed byte: ezc3d would wrap 256 to 0, a point without error.
_MOST_RESIDUAL = 127


def write_c3d(motion: Motion, path: Path) -> None:
    """Write the joints, the points of the feet and the segments."""
    import ezc3d

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
