"""Write MOT files: joint angles over time for OpenSim.

Coordinates have the names, the axes and the signs of the full-body model of Rajagopal et al., IEEE Trans. Biomed. Eng.
63 (2016) 2068-2079 (`Rajagopal2016.osim`): rotations Z-X-Y at pelvis, lumbar joint, hip and shoulder, hinges at knee
and elbow. The pelvis position is the midpoint of the hip centres; the origin of that model is elsewhere in the pelvis,
so translations differ by an offset that is constant in the pelvis frame. Axes as in :mod:`tk.export.trc`; degrees and
metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.export.motion import Motion
from tk.model.body.angles import FORWARD_UP_RIGHT
from tk.model.body.rotations import decompose, follow

Float = NDArray[np.float64]

_MIRROR = np.diag([1.0, 1.0, -1.0])

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
    values = np.column_stack([motion.time, *columns.values()])[rows]
    lines += ["\t".join(f"{value:.6f}" for value in row) for row in np.round(values, 6) + 0.0]  # + 0.0: no -0
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def coordinates(motion: Motion) -> dict[str, Float]:
    """Return OpenSim's coordinates, each (F,), degrees; translations of the pelvis in metres."""
    A = FORWARD_UP_RIGHT @ motion.T_world_body.T
    pelvis = _turns(A @ motion.rotation("pelvis") @ FORWARD_UP_RIGHT.T)
    found = {name: pelvis[:, k] for k, name in enumerate(("pelvis_tilt", "pelvis_list", "pelvis_rotation"))}
    found |= {f"pelvis_t{axis}": (motion.point("pelvis") @ A.T)[:, k] for k, axis in enumerate("xyz")}
    joints = [(*joint, "") for joint in _TRUNK] + [(*joint, side) for side in ("_r", "_l") for joint in _SIDE]
    for parent, child, names, side in joints:
        above, below = (name if name in ("pelvis", "torso") else name + side for name in (parent, child))
        R = FORWARD_UP_RIGHT @ np.swapaxes(motion.rotation(above), -1, -2) @ motion.rotation(below) @ FORWARD_UP_RIGHT.T
        turns = _turns(_MIRROR @ R @ _MIRROR if side == "_l" else R)
        for k, name in enumerate(names):
            if name is not None:
                found[name.lstrip("-") + side] = -turns[:, k] if name.startswith("-") else turns[:, k]
    return found


def _turns(R: Float) -> Float:
    """Return angles (F, 3) about Z, X, Y, degrees, without jumps."""
    return np.degrees(follow(decompose("zxy", R)))
