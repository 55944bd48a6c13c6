"""What points up, and where the floor is: from how the cameras are mounted and how the person stands.

Two witnesses. People mount cameras upright (:func:`tk.model.cameras.mounting.infer_up`), and a person who stands is
long in one
direction. Their mean is weighed by how far off each of them is. Measured on five captures with worlds turned at random:
1.2° to 2.5° off.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.toml import parse_toml, read_text
from tk.model.cameras.camera import Rig
from tk.model.cameras.mounting import infer_up
from tk.model.cameras.up import UP_AXES, up_text, up_vector

Float = NDArray[np.float64]

#: a standing person's length is this many times the next largest extent (of standard deviations)
_LONG = 1.6
#: how far off the witnesses are, degrees: cameras that are level, cameras that are not, a person who stands
_LEVEL_DEG, _ROLLED_DEG, _LEANS_DEG = 2.0, 8.0, 1.5
#: witnesses that are farther apart than this do not speak of the same, degrees
_AGREE_DEG = 25.0
#: the share of a hull that may lie below the floor: voxels that specks in the masks have left
_BELOW = 0.5


@dataclass(frozen=True)
class Leveling:
    """What was found.

    Attributes:
        up: what points up, as :func:`tk.model.cameras.up.up_text` tells it.
        how: how it was found.
        floor_m: the floor's height along ``up`` from the world's origin, metres; NaN where nobody stands.
        person: the person's mean long direction as a text; empty where nobody stands.
    """

    up: str
    how: str
    floor_m: float
    person: str


def find_up(rig: Rig, given: str, hulls: Sequence[Float]) -> Leveling:
    """What points up.

    Args:
        rig: the cameras.
        given: what the capture says, which decides which way the person's long direction points if the cameras do not.
        hulls: points (N, 3) of the person in some frames, metres.
    """
    cameras = infer_up(rig)
    rough = up_vector(cameras.up)
    axes = [axis for hull in hulls if (axis := _long_axis(hull)) is not None]
    person = _mean_direction(axes, rough) if axes else None
    up, how = rough, cameras.how
    if person is not None and _degrees(person, rough) > _AGREE_DEG:
        # cameras may be mounted sideways; a person who stands in most of the frames stands upright
        if not cameras.level and len(axes) > len(hulls) / 2:
            toward = up_vector(given)
            up, how = person * (1.0 if person @ toward >= 0 else -1.0), "how the person stands; the cameras are rolled"
    elif person is not None:
        # the mean by the witnesses' variances; a person leans, and raises an arm
        apart = np.array([_degrees(a if a @ person >= 0 else -a, person) for a in axes])
        variance = _LEANS_DEG**2 + float((apart**2).mean()) / max(len(axes) / 2, 1)
        other = (_LEVEL_DEG if cameras.level else _ROLLED_DEG) ** 2
        up = rough if cameras.up in UP_AXES else _unit(rough / other + person / variance)
        how = f"{cameras.how}; the person, by length, is {_degrees(person, rough):.0f}° from it"
    heights = [float(np.percentile(hull @ up, _BELOW)) for hull in hulls if len(hull)]
    floor_m = float(np.median(heights)) if heights else float("nan")
    return Leveling(up_text(np.round(up, 5)), how, floor_m, "" if person is None else up_text(np.round(person, 3)))


def _long_axis(hull: Float) -> Float | None:
    """(3,) the direction in which points (N, 3) are long, of either sign; None where they are not."""
    if len(hull) < 50:
        return None
    values, vectors = np.linalg.eigh(np.cov(hull.T))
    return np.asarray(vectors[:, 2]) if values[2] > _LONG**2 * values[1] else None


def _mean_direction(axes: Sequence[Float], toward: Float) -> Float:
    """The mean of directions without a sign, on the side of ``toward``."""
    mean = np.linalg.eigh(np.mean([np.outer(a, a) for a in axes], axis=0))[1][:, 2]
    return np.asarray(mean * (1.0 if mean @ toward >= 0 else -1.0))


def _unit(v: Float) -> Float:
    return np.asarray(v / np.linalg.norm(v))


def _degrees(a: Float, b: Float) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


def write_up(capture: Path, leveling: Leveling) -> None:
    """Write ``up`` into `capture.toml`, with a comment that says how it was found; all else there stays as it is.

    Raises:
        CaptureError: the file cannot be read or written, or is not TOML.
    """
    path = capture / "capture.toml"
    text = read_text(path, CaptureError) if path.exists() else ""
    parse_toml(text, str(path))
    value = f'"{leveling.up}"' if leveling.up in UP_AXES else leveling.up
    line = f"up = {value}  # {leveling.how}"
    head, table, rest = _split_at_first_table(text)
    old = re.compile(r"^[ \t]*(up|\"up\"|'up')[ \t]*=[ \t]*(\[[^\]]*\]|\"[^\"\n]*\"|'[^'\n]*')[ \t]*(#[^\n]*)?$", re.M)
    if old.search(head):
        head = old.sub(lambda _: line, head, count=1)
    else:
        head = f"{head.rstrip()}\n{line}\n".lstrip() + ("\n" if table else "")
    new = head + table + rest
    if parse_toml(new, str(path)).get("up") is None:
        raise CaptureError(f"{path}: is written in a way that cannot be changed here; add {line!r} yourself")
    try:
        draft = path.with_suffix(".toml.new")
        draft.write_text(new, encoding="utf-8")
        draft.replace(path)
    except OSError as reason:
        raise CaptureError(f"{path}: cannot be written ({reason.strerror or reason})") from None


def _split_at_first_table(text: str) -> tuple[str, str, str]:
    found = re.search(r"^[ \t]*\[", text, re.M)
    # an array over several lines may begin a line with a bracket, too: it is closed before any table's name
    while found is not None and not re.match(r"[ \t]*\[\[?[A-Za-z0-9_\"'. -]+\]\]?[ \t]*(#.*)?$", _line(text, found)):
        found = re.compile(r"^[ \t]*\[", re.M).search(text, found.end())
    if found is None:
        return text, "", ""
    return text[: found.start()], text[found.start() :], ""


def _line(text: str, found: re.Match[str]) -> str:
    return text[found.start() :].split("\n", 1)[0]
