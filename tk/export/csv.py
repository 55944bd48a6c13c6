"""Write CSV files with one row per frame: points, and clinical joint angles. Columns are named as by ``to_pandas``."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.export.motion import Motion
from tk.model.body.angles import ANGLES, by_reason, joint_angles


def write_points_csv(motion: Motion, path: Path) -> None:
    """Write ``<point>_x``, ``_y``, ``_z`` and ``<joint>_sigma``: metres, world frame of the result; blank if unknown.

    The points of the feet have no sigma.
    """
    names: list[str] = []
    columns: list[NDArray[np.float64]] = []
    for p, point in enumerate(motion.point_names):
        names += [f"{point}_{axis}" for axis in "xyz"]
        columns += list(motion.points[:, p].T)
        if point in motion.result.meta.joint_names:
            names.append(f"{point}_sigma")
            columns.append(motion.sigma[:, p])
    _write(motion, path, names, columns, decimals=6)


def write_angles_csv(motion: Motion, path: Path) -> str | None:
    """Write ``<joint>_<angle>_deg`` for :data:`tk.model.body.angles.ANGLES`; blank if unknown.

    Returns:
        A note that names the angles that are blank in every frame.
    """
    meta = motion.result.meta
    body = meta.pose_names, motion.result.has_landmarks
    degrees = joint_angles(motion.rotations, motion.T_world_body, motion.segments, *body)
    names = [f"{angles.joint}_{name}_deg" for angles in ANGLES for name in angles.names]
    columns = [column for angles in ANGLES for column in degrees[angles.joint].T]
    _write(motion, path, names, columns, decimals=4)
    blank = {f"{one.joint} {name}": why for one in ANGLES for name, why in one.unmeasured(*body).items()}
    return f"blank: {by_reason(blank)}" if blank else None


def _write(
    motion: Motion, path: Path, names: Sequence[str], columns: Sequence[NDArray[np.float64]], decimals: int
) -> None:
    """Write ``frame,time,status`` and the columns (F,) each; values that are unknown or not finite are blank."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("frame", "time", "status", *names))
        for f, values in enumerate(np.stack(columns, axis=1)):
            is_known = np.isfinite(values) & motion.known[f]
            cells = (f"{x:.{decimals}f}" if known else "" for x, known in zip(values, is_known, strict=True))
            start = (motion.result.frames[f], f"{motion.result.time[f]:.6f}", motion.status_word(f))
            writer.writerow((*start, *cells))
