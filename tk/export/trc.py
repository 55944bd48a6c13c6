"""Write TRC files: points over time for OpenSim (Motion Analysis' "track row column").

Axes are OpenSim's: X forward (the world's x axis), Y up, Z to the right. For a world with z up this is
the rotation by -90° about x: (x, y, z) becomes (x, z, -y). Millimetres. Frames are numbered from 1;
`OrigDataStartFrame` is the number of the first one in the recording, from 1 too.
"""

from __future__ import annotations

from pathlib import Path

from tk.export.motion import Motion
from tk.model.body.angles import FORWARD_UP_RIGHT


def write_trc(motion: Motion, path: Path) -> None:
    """Write the joints and the points of the feet; an unknown frame has blank coordinates."""
    points = 1000.0 * motion.points @ (FORWARD_UP_RIGHT @ motion.T_world_body.T).T
    count, rate = len(motion), f"{motion.fps:.6f}"
    names = motion.point_names
    head = ("DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units")
    original = ("OrigDataRate", "OrigDataStartFrame", "OrigNumFrames")
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{motion.name}.trc",
        "\t".join((*head, *original)),
        "\t".join((rate, rate, str(count), str(len(names)), "mm", rate, str(motion.result.frames[0] + 1), str(count))),
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ"),
        "",
    ]
    for f in range(count):
        # OpenSim ignores one tab at the end of a line: without an extra tab, the last blank would be missing
        cells = [f"{value:.4f}" for value in points[f].ravel()] if motion.known[f] else [""] * (points[f].size + 1)
        lines.append("\t".join((str(f + 1), f"{motion.result.time[f]:.6f}", *cells)))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
