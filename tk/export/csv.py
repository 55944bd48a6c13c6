"""CSV, one observation a line: the points, and the joint angles as a clinician reads them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from tk.export.motion import Motion
from tk.model.body.angles import ANGLES, joint_angles


def write_points_csv(motion: Motion, path: Path) -> None:
    """Write ``frame,time,status,point,x,y,z,sigma``: metres, world frame as in the result; blank where not known."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("frame", "time", "status", "point", "x", "y", "z", "sigma"))
        for f in range(len(motion)):
            start = _start(motion, f)
            for p, name in enumerate(motion.point_names):
                place = [f"{value:.6f}" for value in motion.points[f, p]] if motion.known[f] else [""] * 3
                is_told = motion.known[f] and np.isfinite(motion.sigma[f, p])
                writer.writerow((*start, name, *place, f"{motion.sigma[f, p]:.6f}" if is_told else ""))


def write_angles_csv(motion: Motion, path: Path) -> None:
    """Write ``frame,time,status,joint,angle,degrees`` after :data:`tk.model.body.angles.ANGLES`; blank where not
    known."""
    degrees = joint_angles(motion.rotations, motion.T_world_body, motion.segments)
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("frame", "time", "status", "joint", "angle", "degrees"))
        for f in range(len(motion)):
            start = _start(motion, f)
            for angles in ANGLES:
                for name, value in zip(angles.names, degrees[angles.joint][f], strict=True):
                    writer.writerow((*start, angles.joint, name, f"{value:.4f}" if motion.known[f] else ""))


def _start(motion: Motion, f: int) -> tuple[str, str, str]:
    return str(motion.frames[f]), f"{motion.time[f]:.6f}", motion.status_word(f)
