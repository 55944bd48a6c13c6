"""Estimate the up direction and the floor from the mounting of the cameras and the standing person.

Cameras are often mounted upright (:func:`tk.model.cameras.mounting.infer_up`), and the longest axis of a standing
person is vertical. If both agree, the estimate is their mean, weighted by their variances. On five captures in randomly
rotated worlds its error was 1.2° to 2.5°. The axis of somebody who lies, sits or rides is not vertical, and cameras may
hang on their side: of two sources that contradict each other neither counts, unless the capture's own up direction
confirms the cameras.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.io.captures.scene import UP_AGREE_DEG
from tk.io.paths import replacing
from tk.io.toml import parse_toml, read_text
from tk.model.cameras.mounting import SNAP_DEG, FoundUp
from tk.model.cameras.up import UP_AXES, shown, up_text, up_vector

Float = NDArray[np.float64]

#: least ratio of the largest two standard deviations of a standing person's voxels; people who crouch have less
_LONG = 1.6
#: standard deviations of the up direction, degrees: from level cameras or a standing person, from rolled cameras
_LEVEL_DEG, _ROLLED_DEG = 2.0, 8.0
#: metres, largest second standard deviation of one person's voxels: several people, or a table, are wider
_WIDE_M = 0.35
#: percentile of the voxels' heights that is the floor; lower voxels come from specks in the masks
_FLOOR_PERCENTILE = 0.5

_UP = re.compile(
    r"^[ \t]*(up|\"up\"|'up')[ \t]*=[ \t]*(\[[^\]]*\]|\"[^\"\n]*\"|'[^'\n]*')[ \t]*(#[^\r\n]*)?(?=\r?$)", re.M
)


@dataclass(frozen=True)
class Leveling:
    """The estimate.

    Attributes:
        up: up direction, as text of :func:`tk.model.cameras.up.up_text`; the given one if it cannot be decided.
        how: how it was estimated, or why it cannot be decided, as text.
        floor_m: height of the floor along ``up`` from the world's origin, metres; NaN without a person.
        person: mean longest axis of the person, as text; empty if nobody stands.
        decided: whether the sources agree.
    """

    up: str
    how: str
    floor_m: float
    person: str
    decided: bool = True


def find_up(cameras: FoundUp, given: str, hulls: Sequence[Float], one_person: bool = True) -> Leveling:
    """Estimate the up direction.

    Args:
        cameras: up direction from the mounting of the cameras.
        given: the capture's up direction.
        hulls: points (N, 3) of the visual hull in some frames, metres.
        one_person: whether the hulls show one person; the axis of several people is not vertical.
    """
    axes = [axis for hull in hulls if one_person and (axis := _long_axis(hull)) is not None]
    toward = up_vector(cameras.up if cameras.sure else given)
    person = _mean_direction(axes, toward) if len(axes) > len(hulls) / 2 else None
    up, how, decided = _decide(cameras, up_vector(given), person, axes)
    heights = [float(np.percentile(hull @ up, _FLOOR_PERCENTILE)) for hull in hulls if len(hull)]
    floor_m = float(np.median(heights)) if heights else float("nan")
    found = given if np.array_equal(up, up_vector(given)) else up_text(np.round(up, 5))
    return Leveling(found, how, floor_m, "" if person is None else up_text(np.round(person, 3)), decided)


def _decide(cameras: FoundUp, given: Float, person: Float | None, axes: Sequence[Float]) -> tuple[Float, str, bool]:
    """Return the up direction (3,), how it was found, and whether the sources decide it.

    Args:
        cameras: up direction from the mounting of the cameras.
        given: (3,) the capture's.
        person: (3,) mean longest axis of the person; None if nobody stands. axes: (3,) of each frame.
    """
    rough = up_vector(cameras.up)
    if person is None:
        if cameras.sure and (cameras.level or _degrees(rough, given) <= SNAP_DEG):
            return rough, cameras.how, True
        why = f"{cameras.how}, and nobody stands alone in view"
        return given, f"it cannot be decided: {why}", False
    from_given = _degrees(person, given)
    if not cameras.sure:
        if from_given <= UP_AGREE_DEG:
            axis = any(np.array_equal(given, up_vector(name)) for name in UP_AXES)
            how = f"as the person stands, {from_given:.0f}° from the capture's; {cameras.how}"
            return (given if axis and from_given <= SNAP_DEG else person), how, True
        return given, f"it cannot be decided: the axis of the person differs by {from_given:.0f}°; {cameras.how}", False
    apart = _degrees(person, rough)
    if apart > UP_AGREE_DEG:
        if _degrees(rough, given) <= UP_AGREE_DEG:
            return rough, f"{cameras.how}; the axis of the person, who may lie or sit, differs by {apart:.0f}°", True
        why = f"the cameras are mounted along {shown(cameras.up)}, the person along {shown(up_text(person.round(5)))}"
        return given, f"it cannot be decided: {why}", False
    # weighted by the variances; that of the person grows when the person leans or raises an arm
    deviations = np.array([_degrees(a if a @ person >= 0 else -a, person) for a in axes])
    variance = _LEVEL_DEG**2 + float((deviations**2).mean()) / max(len(axes) / 2, 1)
    other = (_LEVEL_DEG if cameras.level else _ROLLED_DEG) ** 2
    up = rough if cameras.up in UP_AXES else _unit(rough / other + person / variance)
    return up, f"{cameras.how}; the axis of the person differs by {apart:.0f}°", True


def _long_axis(hull: Float) -> Float | None:
    """Return the longest axis (3,) of points (N, 3), of either sign; None if they are not as long and narrow as a
    person who stands or lies."""
    if len(hull) < 50:
        return None
    values, vectors = np.linalg.eigh(np.cov(hull.T))
    return np.asarray(vectors[:, 2]) if values[2] > _LONG**2 * values[1] and values[1] < _WIDE_M**2 else None


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
        CaptureError: the estimate is not decided, or the file cannot be read or written, or is not TOML.
    """
    path = capture / "capture.toml"
    if not leveling.decided:
        raise CaptureError(f"{path}: up = {shown(leveling.up)} stays: {leveling.how}; write the right one yourself")
    text = read_text(path, CaptureError) if path.exists() else ""
    before = parse_toml(text, str(path))
    value = f'"{leveling.up}"' if leveling.up in UP_AXES else leveling.up
    line = f"up = {value}  # {leveling.how}"
    new = _UP.sub(lambda _: line, text, count=1) if "up" in before else f"{line}\n{text}"
    if parse_toml(new, str(path)) != {**before, **parse_toml(line, str(path))}:
        raise CaptureError(f"{path}: cannot be changed automatically; add {line!r} yourself")
    with replacing(path, CaptureError) as part:
        part.write_text(new, encoding="utf-8", newline="")
