"""Write MOT files: joint angles over time for OpenSim.

Coordinates have the names, the axes and the signs of the full-body model of Rajagopal et al., IEEE Trans. Biomed. Eng.
63 (2016) 2068-2079 (`Rajagopal2016.osim`): rotations Z-X-Y at pelvis, lumbar joint, hip and shoulder, hinges at knee
and elbow. `pelvis_tx`, `ty`, `tz` are the position of that model's pelvis origin, midway between the anterior superior
iliac spines, scaled to the width between the hip centres. Axes as in :mod:`tk.export.trc`; degrees and metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.export.motion import Motion
from tk.model.body.angles import FORWARD_UP_RIGHT, MIRROR
from tk.model.body.rotations import follow_rotations

Float = NDArray[np.float64]

# The model's right hip centre in its pelvis frame (forward, up, right), metres: joint hip_r of Rajagopal2016.osim.
_HIP_IN_PELVIS = np.array([-0.056276, -0.078490, 0.077260])

# Parent, child, and the coordinates for the rotations about Z, X, Y (None: not written; minus: opposite sign).
_TRUNK = (("pelvis", "torso", ("lumbar_extension", "lumbar_bending", "lumbar_rotation")),)
_SIDE = (
    ("pelvis", "thigh", ("hip_flexion", "hip_adduction", "hip_rotation")),
    ("thigh", "calf", ("-knee_angle", None, None)),
    ("calf", "foot", ("ankle_angle", "subtalar_angle", None)),
    ("torso", "upper_arm", ("arm_flex", "arm_add", "arm_rot")),
    ("upper_arm", "forearm", ("elbow_flex", None, None)),
)


def write_mot(motion: Motion, path: Path) -> None:
    """Write the coordinates; unknown frames are omitted, so the times have gaps."""
    columns = coordinates(motion)
    rows = np.flatnonzero(motion.known)
    lines = [
        motion.name,
        "version=1",
        f"nRows={len(rows)}",
        f"nColumns={len(columns) + 1}",
        "inDegrees=yes",
        "endheader",
        "\t".join(("time", *columns)),
    ]
    values = np.column_stack([motion.result.time, *columns.values()])[rows]
    lines += ["\t".join(f"{value:.6f}" for value in row) for row in np.round(values, 6) + 0.0]  # + 0.0: no -0
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def coordinates(motion: Motion) -> dict[str, Float]:
    """Return OpenSim's coordinates, each (F,), degrees; translations of the pelvis in metres."""
    A = FORWARD_UP_RIGHT @ motion.T_world_body.T
    R_pelvis = A @ motion.rotation("pelvis") @ FORWARD_UP_RIGHT.T
    pelvis = _turns(R_pelvis)
    scale = motion.dimensions.hip_half_width / _HIP_IN_PELVIS[2]
    origin = motion.point("pelvis") @ A.T - R_pelvis @ (scale * _HIP_IN_PELVIS * [1.0, 1.0, 0.0])
    found = {name: pelvis[:, k] for k, name in enumerate(("pelvis_tilt", "pelvis_list", "pelvis_rotation"))}
    found |= {f"pelvis_t{axis}": origin[:, k] for k, axis in enumerate("xyz")}
    joints = [(*joint, "") for joint in _TRUNK] + [(*joint, side) for side in ("_r", "_l") for joint in _SIDE]
    for parent, child, names, side in joints:
        above, below = (name if name in ("pelvis", "torso") else name + side for name in (parent, child))
        R = FORWARD_UP_RIGHT @ np.swapaxes(motion.rotation(above), -1, -2) @ motion.rotation(below) @ FORWARD_UP_RIGHT.T
        turns = _turns(MIRROR @ R @ MIRROR if side == "_l" else R)
        for k, name in enumerate(names):
            if name is not None:
                found[name.lstrip("-") + side] = -turns[:, k] if name.startswith("-") else turns[:, k]
    return found


def _turns(R: Float) -> Float:
    """Return angles (F, 3) about Z, X, Y, degrees, without jumps."""
    return np.degrees(follow_rotations("zxy", R))
