"""Write CSV files with one value set per line: points, and clinical joint angles."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from tk.export.motion import Motion
from tk.model.body.angles import ANGLES, by_reason, joint_angles


def write_points_csv(motion: Motion, path: Path) -> None:
    """Write ``frame,time,status,point,x,y,z,sigma``: metres, world frame of the result; blank if unknown."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("frame", "time", "status", "point", "x", "y", "z", "sigma"))
        for f in range(len(motion)):
            start = _start(motion, f)
            for p, name in enumerate(motion.point_names):
                position = [f"{value:.6f}" for value in motion.points[f, p]] if motion.known[f] else [""] * 3
                has_sigma = motion.known[f] and np.isfinite(motion.sigma[f, p])
                writer.writerow((*start, name, *position, f"{motion.sigma[f, p]:.6f}" if has_sigma else ""))


def write_angles_csv(motion: Motion, path: Path) -> str | None:
    """Write ``frame,time,status,joint,angle,degrees`` for :data:`tk.model.body.angles.ANGLES`; blank if unknown.

    Returns:
        A note that names the angles that are blank in every frame.
    """
    meta = motion.result.meta
    body = meta.pose_names, motion.result.has_landmarks
    degrees = joint_angles(motion.rotations, motion.T_world_body, motion.segments, *body)
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("frame", "time", "status", "joint", "angle", "degrees"))
        for f in range(len(motion)):
            start = _start(motion, f)
            for angles in ANGLES:
                for name, value in zip(angles.names, degrees[angles.joint][f], strict=True):
                    is_known = motion.known[f] and np.isfinite(value)
                    writer.writerow((*start, angles.joint, name, f"{value:.4f}" if is_known else ""))
    blank = {f"{one.joint} {name}": why for one in ANGLES for name, why in one.unmeasured(*body).items()}
    return f"blank: {by_reason(blank)}" if blank else None


def _start(motion: Motion, f: int) -> tuple[str, str, str]:
    return str(motion.result.frames[f]), f"{motion.result.time[f]:.6f}", motion.status_word(f)
