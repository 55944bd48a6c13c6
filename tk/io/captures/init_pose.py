"""Reads a rough initial pose that a person wrote down: a small TOML file.

Either joint centres, as many as are known (at least six, three of them not in a line):

    frame = 0                      # optional
    [joints]                       # metres, world frame
    pelvis = [0.1, 0.0, 0.95]
    neck = [0.1, 0.0, 1.5]
    ...

or angles by the names of `/pose`, in degrees, with the place of the pelvis; what is left out is 0:

    [angles]
    torso_x = 0.1                  # metres
    torso_yaw = 90.0
    ...

`[subject] height` (metres) may stand in either.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.captures.capture_toml import given_height
from tk.io.toml import Table, load_toml
from tk.model.body.skeleton import JOINTS
from tk.model.setup import TRANSLATIONS, InitPose

LEAST_JOINTS = 6

# across the line that fits the joints best, root of the sum of squares
LEAST_SPREAD_M = 0.05


def spread_m(joints: Mapping[str, NDArray[np.float64]]) -> float:
    """How far joints lie from the line that fits them best, metres, root of the sum of squares."""
    places = np.array(list(joints.values()))
    return float(np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1])


def read_init_pose(path: str | Path, pose_names: tuple[str, ...]) -> InitPose:
    """Read an initial pose.

    Args:
        path: the TOML file.
        pose_names: (D,) names of the configuration vector; those that are no translation are in degrees.

    Raises:
        CaptureError: the file cannot be read, names an unknown joint or angle, or gives too little.
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; an initial pose is a TOML file with a [joints] or an [angles] table")
    table = Table(load_toml(path, CaptureError), str(path), CaptureError)
    height = given_height(table.table("subject"))
    frame = table.integer("frame", 0) if "frame" in table else None
    if frame is not None and frame < 0:
        table.fail(f"frame = {frame} must not be negative")
    if ("joints" in table) == ("angles" in table):
        raise CaptureError(f"{path}: give either a [joints] or an [angles] table")
    if "joints" in table:
        joints = table.table("joints")
        unknown = sorted(set(joints.values) - set(JOINTS))
        if unknown:
            raise CaptureError(f"{path}: unknown joint {unknown[0]}; known are {', '.join(JOINTS)}")
        found = {name: joints.array(name, (3,)) for name in JOINTS if name in joints}
        if len(found) < LEAST_JOINTS:
            raise CaptureError(f"{path}: {len(found)} joints are too few to place a body; give at least {LEAST_JOINTS}")
        if spread_m(found) < LEAST_SPREAD_M:
            raise CaptureError(f"{path}: [joints] lie on a line, which places no body; give joints of both sides")
        return InitPose(found, {}, frame, height)
    angles = table.table("angles")
    unknown = sorted(set(angles.values) - set(pose_names))
    if unknown:
        raise CaptureError(f"{path}: unknown angle {unknown[0]}; known are {', '.join(pose_names)}")
    values = {name: angles.number(name) for name in pose_names if name in angles}
    if not all(name in values for name in TRANSLATIONS):
        raise CaptureError(
            f"{path}: [angles] must give torso_x, torso_y and torso_z, the place of the pelvis in metres"
        )
    return InitPose({}, {n: v if n in TRANSLATIONS else float(np.radians(v)) for n, v in values.items()}, frame, height)
