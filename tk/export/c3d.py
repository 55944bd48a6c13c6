"""Write C3D files, the format of motion laboratories, with points and segment rotations; see https://www.c3d.org.

World frame of the result, millimetres. A point's residual is its standard deviation in whole millimetres, at most 127;
0 where it is unknown. It is written in both bytes of the fourth word, because readers disagree: the format has it in
the lower one, ezc3d up to 1.7 in the upper one, where the format has a mask of cameras. In unknown frames the word is
-1 and the coordinates are 0, the format's mark of a missing point. ROTATION, an extension, is each segment's 4×4
transform to the world; in unknown frames it is NaN and its reliability -1.

Frames have their numbers in the recording, from 1: in the parameters TRIAL:ACTUAL_START_FIELD and ACTUAL_END_FIELD,
whose numbers have 32 bits, and in the header, whose numbers have 16 bits; it counts from 1 if they do not fit. A file
of more than 65,535 frames has no rotations: ezc3d reads all frames of such a file only if points are its only data.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tk.export.motion import Motion
from tk.model.body.joints import SEGMENT_ORIGIN

_BOTH_BYTES = 257  # the factor that repeats a byte
_BLOCK = 512  # bytes
_MOST = np.iinfo(np.uint16).max  # numbers of frames and of blocks
_MOST_SIGNED = np.iinfo(np.int16).max  # numbers of blocks that all readers take, because some read them as signed
_MOST_PARAMETERS = np.iinfo(np.uint8).max  # blocks
# The first bytes of the header and of the parameters; the last byte means little-endian numbers.
_HEADER_KEY, _PARAMETER_KEY, _PROCESSOR = b"\2P", b"\1P", 84


def write_c3d(motion: Motion, path: Path) -> str | None:
    """Write the joints, the points of the feet and the segments.

    Returns:
        A note if the segments are omitted.
    """
    count, first, used = len(motion), int(motion.result.frames[0]) + 1, len(motion.point_names)
    groups = {
        "POINT": {
            "USED": _integer(used),
            "FRAMES": _integer(min(count, _MOST)),
            "SCALE": _float(-1.0),  # negative: coordinates are 32-bit floats
            "RATE": _float(motion.fps),
            "UNITS": _texts(["mm"]),
            "LABELS": _texts(motion.point_names),
        },
        "ANALOG": {"USED": _integer(0), "GEN_SCALE": _float(1.0), "RATE": _float(0.0)},
        "TRIAL": {"ACTUAL_START_FIELD": _long(first), "ACTUAL_END_FIELD": _long(first + count - 1)},
    }
    data = {"POINT": _points(motion)}
    if is_long := count > _MOST:
        groups["POINT"]["LONG_FRAMES"] = _float(count)
    else:
        rotations = _rotations(motion)
        groups["ROTATION"] = {
            "USED": _integer(len(motion.segments)),
            "RATIO": _integer(1),
            "RATE": _float(motion.fps),
            "LABELS": _texts(motion.segments),
        }
        # readers that do not know rotations expect nothing after the points
        fits = len(rotations) < _BLOCK * (_MOST_SIGNED - _MOST_PARAMETERS)
        data = {"ROTATION": rotations, **data} if fits else {**data, "ROTATION": rotations}
        data = {name: values + bytes(-len(values) % _BLOCK) for name, values in data.items()}
    for name in data:
        groups[name]["DATA_START"] = _integer(0)
    starts, start = {}, 2 + len(_section(groups)) // _BLOCK
    for name, values in data.items():
        groups[name]["DATA_START"], starts[name] = _integer(start), start
        start += len(values) // _BLOCK
    begin = first if first + count - 1 <= _MOST else 1
    end = min(begin + count - 1, _MOST)
    header = struct.pack("<HHHHHfHHf", used, 0, begin, end, 0, -1.0, starts["POINT"], 0, motion.fps)
    path.write_bytes(b"".join([(_HEADER_KEY + header).ljust(_BLOCK, b"\0"), _section(groups), *data.values()]))
    return f"the segments' transforms are omitted: beside them, readers find only {_MOST} frames" if is_long else None


def _points(motion: Motion) -> bytes:
    """Return x, y, z and the residual, by frame and point."""
    values = np.empty((len(motion), len(motion.point_names), 4), "<f4")
    values[..., :3] = 1000.0 * motion.points
    values[..., 3] = _BOTH_BYTES * np.round(1000.0 * np.nan_to_num(motion.sigma)).clip(max=np.iinfo(np.int8).max)
    values[~motion.known] = (0.0, 0.0, 0.0, -1.0)
    return values.tobytes()


def _rotations(motion: Motion) -> bytes:
    """Return the transform, column by column, and the reliability by frame and segment."""
    values = np.zeros((len(motion), len(motion.segments), 17), "<f4")
    for column in range(3):
        values[..., 4 * column : 4 * column + 3] = motion.rotations[..., column]
    for s, name in enumerate(motion.segments):
        values[:, s, 12:15] = 1000.0 * motion.point(SEGMENT_ORIGIN[name])
    values[..., 15] = 1.0
    values[~motion.known] = np.nan
    values[~motion.known, :, 16] = -1.0
    return values.tobytes()


def _section(groups: dict[str, dict[str, bytes]]) -> bytes:
    """Return the blocks of the parameters, by group and name."""
    entries = b""
    for number, (group, parameters) in enumerate(groups.items(), 1):
        entries += struct.pack("<bb", len(group), -number) + group.encode() + struct.pack("<HB", 3, 0)
        for name, value in parameters.items():
            # the way to the next entry, and no description
            entries += struct.pack("<bb", len(name), number) + name.encode() + struct.pack("<H", len(value) + 3)
            entries += value + b"\0"
    blocks = -(-(4 + len(entries) + 2) // _BLOCK)
    return (_PARAMETER_KEY + bytes([blocks, _PROCESSOR]) + entries).ljust(blocks * _BLOCK, b"\0")


def _integer(number: int) -> bytes:
    """Return a parameter of 16 bits: type, number of dimensions, value."""
    return struct.pack("<bBH", 2, 0, number)


def _long(number: int) -> bytes:
    """Return a parameter of two numbers of 16 bits, the lower bits first."""
    return struct.pack("<bBBI", 2, 1, 2, number)


def _float(number: float) -> bytes:
    return struct.pack("<bBf", 4, 0, number)


def _texts(texts: Sequence[str]) -> bytes:
    width = max(map(len, texts))
    return struct.pack("<bBBB", -1, 2, width, len(texts)) + b"".join(text.encode().ljust(width) for text in texts)
