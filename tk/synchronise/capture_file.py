"""Write the capture: a `capture.toml` that refers to the videos."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tomli_w

from tk.errors import CaptureError, unwritable
from tk.io.captures.calibration import Calibration
from tk.io.paths import check_not_input, replacing
from tk.io.toml import load_toml
from tk.synchronise.raw import Recording
from tk.synchronise.ties import Clocks

#: decimals of offsets, seconds, and of rates
_OFFSET_DIGITS, _RATE_DIGITS = 5, 8
#: decimals of `from` and `to`, seconds
_SPAN_DIGITS = 3


def common_span(recordings: Sequence[Recording], clocks: Clocks) -> tuple[float, float]:
    """Return the common time, seconds, at which all cameras have begun, and that of the first last image.

    Raises:
        CaptureError: a camera has no time in common with the others.
    """
    begins = np.array([clocks.common(c, recording.span[0]) for c, recording in enumerate(recordings)])
    ends = np.array([clocks.common(c, float(recording.times_s[-1])) for c, recording in enumerate(recordings)])
    begin, end = float(begins.max()), float(ends.min())
    if begin >= end:
        c = int(begins.argmax()) if (ends > begin).sum() < len(ends) / 2 + 1 else int(ends.argmin())
        rest = [k for k in range(len(recordings)) if k != c]
        raise CaptureError(
            f"{recordings[c].where}: has no time in common with the others: it shows {begins[c]:.1f} s to "
            f"{ends[c]:.1f} s, they {begins[rest].max():.1f} s to {ends[rest].min():.1f} s; leave it out with "
            "--cameras"
        )
    return begin, end


def check_capture(folder: Path, raw: Path, force: bool) -> None:
    """Check that a capture may be written.

    Raises:
        CaptureError, ConfigError: it exists and ``force`` is not given, holds videos of its own, or is RAW itself.
    """
    check_not_input(folder, [raw])
    if folder.exists() and not folder.is_dir():
        raise CaptureError(f"{folder}: is not a folder; name a folder for the capture")
    for part in ("videos", "images", "timestamps"):
        if (folder / part).exists():
            raise CaptureError(f"{folder}: has {part}/ of its own; choose another folder for the capture")
    file = folder / "capture.toml"
    if file.exists() and not force:
        raise CaptureError(f"{file}: exists; choose another folder", hint="or replace its [videos] with --force")
    own, given = folder / "calibration.toml", raw / "calibration.toml"
    if own.exists() and given.exists() and own.read_bytes() != given.read_bytes() and not force:
        raise CaptureError(f"{own}: differs from {given}; delete the wrong one", hint="or replace it with --force")


def write_capture(
    folder: Path,
    recordings: Sequence[Recording],
    clocks: Clocks,
    fps: float | None,
    span: tuple[float, float],
    empty: tuple[float, float] | None,
    calibration: Calibration | None,
) -> None:
    """Write `capture.toml`, and a copy of the calibration. Other keys of an existing `capture.toml` stay.

    Args:
        folder: the capture; made if it does not exist.
        recordings: the cameras.
        clocks: their clocks.
        fps: rate of the capture, 1/s; None: that of the slowest camera.
        span: common time of the first frame and the end, seconds.
        empty: common time of the empty scene, seconds; None without one.
        calibration: of RAW; None without one.

    Raises:
        CaptureError: a file cannot be written.
    """
    file = folder / "capture.toml"
    before = load_toml(file) if file.exists() else {}
    for key in ("fps", "times", "background"):  # what they say, this run decides; own times are the files'
        before.pop(key, None)
    document: dict[str, object] = {key: value for key, value in before.items() if not isinstance(value, dict)}
    unit = 10**_SPAN_DIGITS  # rounded inwards: the first and the last frame have images
    begin, end = math.ceil(span[0] * unit - 1e-6) / unit, math.floor(span[1] * unit + 1e-6) / unit
    document |= {"from": begin, "to": end} | ({} if fps is None else {"fps": fps})
    document |= {key: value for key, value in before.items() if isinstance(value, dict)}
    if empty is not None:
        document["background"] = {"from": round(empty[0], _SPAN_DIGITS), "to": round(empty[1], _SPAN_DIGITS)}
    document["videos"] = {
        recording.name: {
            "path": [_relative(path, folder) for path in recording.paths]
            if len(recording.paths) > 1
            else _relative(recording.paths[0], folder),
            "offset": round(float(clocks.offsets_s[c]), _OFFSET_DIGITS),
            "rate": round(float(clocks.rates[c]), _RATE_DIGITS),
        }
        for c, recording in enumerate(recordings)
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error, CaptureError) from error
    with replacing(file, CaptureError) as part:
        part.write_text(tomli_w.dumps(document), encoding="utf-8")
    target = folder / "calibration.toml"
    if calibration is not None:
        with replacing(target, CaptureError) as part:
            part.write_bytes(calibration.path.read_bytes())


def _relative(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, or absolute if they have no folder in common."""
    real, base = path.resolve(), folder.resolve()
    common = Path(os.path.commonpath([real, base]))
    return os.path.relpath(real, base) if common != Path(common.anchor) else str(real)
