"""Estimate the up direction and the floor from the orientation of the cameras and the standing person.

Cameras are often mounted upright (:func:`tk.model.cameras.mounting.infer_up`), and the longest axis of a standing
person is vertical. The estimate is the mean of both, weighted by their variances. On five captures in randomly rotated
worlds its error was 1.2° to 2.5°.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.paths import replacing
from tk.io.toml import parse_toml, read_text
from tk.model.cameras.camera import Rig
from tk.model.cameras.mounting import infer_up
from tk.model.cameras.up import UP_AXES, up_text, up_vector

Float = NDArray[np.float64]

# With half and twice each value the findings on walk, fold, rig9, pair and treadmill-slow are the same. The height of
# the floor changes by 4 cm at most, and with twice the first one nobody in rig9 is taken for a standing person.
#: least ratio of the largest two standard deviations of a standing person's voxels; people who crouch have less
_LONG = 1.6
#: standard deviations of the up direction, degrees: from level cameras, from rolled cameras, from a standing person
_LEVEL_DEG, _ROLLED_DEG, _LEANING_DEG = 2.0, 8.0, 1.5
#: if cameras and person differ more, degrees, they are not averaged
_AGREE_DEG = 25.0
#: percentile of the voxels' heights that is the floor; lower voxels come from specks in the masks
_FLOOR_PERCENTILE = 0.5

_UP = re.compile(r"^[ \t]*(up|\"up\"|'up')[ \t]*=[ \t]*(\[[^\]]*\]|\"[^\"\n]*\"|'[^'\n]*')[ \t]*(#[^\n]*)?$", re.M)


@dataclass(frozen=True)
class Leveling:
    """The estimate.

    Attributes:
        up: up direction, as text of :func:`tk.model.cameras.up.up_text`.
        how: how it was estimated, as text.
        floor_m: height of the floor along ``up`` from the world's origin, metres; NaN without a person.
        person: mean longest axis of the person, as text; empty if nobody stands.
    """

    up: str
    how: str
    floor_m: float
    person: str


def find_up(rig: Rig, given: str, hulls: Sequence[Float]) -> Leveling:
    """Estimate the up direction.

    Args:
        rig: the cameras.
        given: the capture's up direction; it decides the sign of the person's axis if the cameras do not.
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
            up, how = (
                person * (1.0 if person @ toward >= 0 else -1.0),
                "along the standing person; the cameras are rolled",
            )
    elif person is not None:
        # weighted by the variances; that of the person grows when the person leans or raises an arm
        deviations = np.array([_degrees(a if a @ person >= 0 else -a, person) for a in axes])
        variance = _LEANING_DEG**2 + float((deviations**2).mean()) / max(len(axes) / 2, 1)
        other = (_LEVEL_DEG if cameras.level else _ROLLED_DEG) ** 2
        up = rough if cameras.up in UP_AXES else _unit(rough / other + person / variance)
        how = f"{cameras.how}; the axis of the person differs by {_degrees(person, rough):.0f}°"
    heights = [float(np.percentile(hull @ up, _FLOOR_PERCENTILE)) for hull in hulls if len(hull)]
    floor_m = float(np.median(heights)) if heights else float("nan")
    return Leveling(up_text(np.round(up, 5)), how, floor_m, "" if person is None else up_text(np.round(person, 3)))


def _long_axis(hull: Float) -> Float | None:
    """Return the longest axis (3,) of points (N, 3), of either sign; None if it is not much longer than the others."""
    if len(hull) < 50:
        return None
    values, vectors = np.linalg.eigh(np.cov(hull.T))
    return np.asarray(vectors[:, 2]) if values[2] > _LONG**2 * values[1] else None


def _mean_direction(axes: Sequence[Float], toward: Float) -> Float:
    """Return the mean of axes without a sign, on the side of ``toward``."""
    mean = np.linalg.eigh(np.mean([np.outer(a, a) for a in axes], axis=0))[1][:, 2]
    return np.asarray(mean * (1.0 if mean @ toward >= 0 else -1.0))


def _unit(v: Float) -> Float:
    return np.asarray(v / np.linalg.norm(v))


def _degrees(a: Float, b: Float) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


def write_up(capture: Path, leveling: Leveling) -> None:
    """Write ``up`` to `capture.toml` with a comment on how it was estimated; the rest of the file stays the same.

    Raises:
        CaptureError: the file cannot be read or written, or is not TOML.
    """
    path = capture / "capture.toml"
    text = read_text(path, CaptureError) if path.exists() else ""
    before = parse_toml(text, str(path))
    value = f'"{leveling.up}"' if leveling.up in UP_AXES else leveling.up
    line = f"up = {value}  # {leveling.how}"
    new = _UP.sub(lambda _: line, text, count=1) if "up" in before else f"{line}\n{text}"
    if parse_toml(new, str(path)) != {**before, **parse_toml(line, str(path))}:
        raise CaptureError(f"{path}: cannot be changed automatically; add {line!r} yourself")
    with replacing(path, CaptureError) as part:
        part.write_text(new, encoding="utf-8")
