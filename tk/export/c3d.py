"""Write C3D files, the format of motion laboratories, with points and segment rotations. It needs ezc3d.

World frame of the result, millimetres. A point's residual is its standard deviation in whole millimetres, at most 127;
0 if the result has none. In unknown frames the residual is -1 and the coordinates are 0, the format's mark of a missing
point. ROTATION is each segment's 4×4 transform to the world; in unknown frames its reliability is -1.
"""

from __future__ import annotations

import os
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tk.export.motion import Motion
from tk.model.body.joints import SEGMENT_ORIGIN

# The residual is a signed byte: ezc3d would wrap 256 to 0, a point without error.
_MOST_RESIDUAL = 127
# Of the format: bytes in a block, the place of the first data block's number in the header, the largest number that all
# readers take, because some read it as signed.
_BLOCK, _HEADER_DATA_START, _LAST_BLOCK = 512, 16, 32767


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
    path.write_bytes(_rotations_first(_bytes_of(file)))


def _bytes_of(file: Any) -> bytearray:
    """Return the bytes that ezc3d writes. It does not report a full disk, so it writes to memory."""
    handle = os.memfd_create("c3d")
    with os.fdopen(handle, "rb") as memory, tempfile.TemporaryDirectory() as folder:
        link = Path(folder, "memory.c3d")  # ezc3d adds the suffix where it is missing
        link.symlink_to(f"/proc/self/fd/{handle}")
        file.write(str(link))
        return bytearray(memory.read())


def _rotations_first(data: bytearray) -> bytes:
    """Return a file of ezc3d with the data sections of points and rotations exchanged.

    Readers that do not know rotations expect nothing after the points, and warn of bytes that are left over.
    """
    places = _parameters(data)
    begins = [places[group, "DATA_START"] for group in ("POINT", "ROTATION")]
    first, second = (struct.unpack_from("<H", data, begin)[0] for begin in begins)
    points, rotations = data[_BLOCK * (first - 1) : _BLOCK * (second - 1)], data[_BLOCK * (second - 1) :]
    rotations += bytes(-len(rotations) % _BLOCK)
    start = first + len(rotations) // _BLOCK
    if start > _LAST_BLOCK:
        return bytes(data)
    for place, block in ((begins[0], start), (begins[1], first), (_HEADER_DATA_START, start)):
        struct.pack_into("<H", data, place, block)
    return bytes(data[: _BLOCK * (first - 1)] + rotations + points)


def _parameters(data: bytearray) -> dict[tuple[str, str], int]:
    """Return the place of the value of each scalar parameter, by the names of its group and its own."""
    names: dict[int, str] = {}
    found: dict[tuple[int, str], int] = {}
    at = _BLOCK * (data[0] - 1) + 4
    while data[at]:
        length, group = struct.unpack_from("bb", data, at)
        end = at + 2 + abs(length)  # negative: locked
        name, following = data[at + 2 : end].decode(), struct.unpack_from("<H", data, end)[0]
        if group < 0:
            names[-group] = name
        else:
            found[group, name] = end + 4  # after the offset, the type and the number of dimensions
        if not following:
            break
        at = end + following
    return {(names[group], name): place for (group, name), place in found.items()}
