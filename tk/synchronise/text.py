"""What `tk sync` prints, and the parts of the recording that become the capture."""

from __future__ import annotations

from typing import Any

import numpy as np

from tk.errors import ConfigError
from tk.synchronise.capture_file import common_span
from tk.synchronise.empty import find_empty
from tk.synchronise.run import Synchronised


def table(done: Synchronised) -> str:
    """Return a line for each camera: offset, drift, method, missing images."""
    rows = [("camera", "offset", "drift", "method", "frames", "dropped")]
    clocks, decision = done.clocks, done.decision
    for c, recording in enumerate(done.recordings):
        sigma = float(clocks.offset_sigma_s[c])
        offset = "not sure"
        if np.isfinite(clocks.offsets_s[c]) and c not in (decision.unsure | decision.faulty):
            offset = f"{_no_minus_zero(clocks.offsets_s[c], 4):+.4f} s"
            if c and np.isfinite(sigma):
                offset += f" ± {1000 * sigma:.1f} ms"
        rows.append(
            (
                recording.name,
                offset,
                _drift(done, c),
                "reference" if c == 0 and c not in decision.unsure else decision.methods[c] or "none",
                str(len(recording.times_s)),
                str(recording.dropped),
            )
        )
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
                     for row in rows)  # fmt: skip


def _drift(done: Synchronised, c: int) -> str:
    sigma = float(done.clocks.rate_sigma[c])
    if c == 0:
        return "0"
    if np.isnan(sigma):
        return "not determined"
    return f"{_no_minus_zero(1e6 * (done.clocks.rates[c] - 1), 0):+.0f} ± {1e6 * sigma:.0f} ppm"


def _no_minus_zero(value: float, digits: int) -> float:
    return round(float(value), digits) + 0.0


def to_dict(done: Synchronised) -> dict[str, Any]:
    """Return the cameras and notes as plain values; None for what is not known."""
    clocks, decision = done.clocks, done.decision

    def known(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    cameras = {}
    for c, recording in enumerate(done.recordings):
        sure = c not in (decision.unsure | decision.faulty)
        rated = bool(np.isfinite(clocks.rate_sigma[c])) and c > 0
        cameras[recording.name] = {
            "sure": sure,
            "offset_s": known(clocks.offsets_s[c]) if sure else None,
            "sigma_s": known(clocks.offset_sigma_s[c]) if sure else None,
            "drift_ppm": 1e6 * (float(clocks.rates[c]) - 1) if rated else None,
            "drift_sigma_ppm": 1e6 * float(clocks.rate_sigma[c]) if rated else None,
            "method": decision.methods[c],
            "frames": len(recording.times_s),
            "dropped": recording.dropped,
            "reason": decision.faulty.get(c, decision.unsure.get(c)),
        }
    return {"cameras": cameras, "notes": list(decision.notes)}


def chosen_span(done: Synchronised, begin: float | None, end: float | None) -> tuple[float, float]:
    """Return the common time at which the capture begins and ends, seconds.

    Raises:
        CaptureError: a camera has no time in common with the others.
        ConfigError: ``begin`` or ``end`` lies outside of what all cameras show.
    """
    first, last = common_span(done.recordings, done.clocks)
    chosen = first if begin is None else begin, last if end is None else end
    for option, value in (("--from", begin), ("--to", end)):
        if value is not None and not first - 1e-3 <= value <= last + 1e-3:
            raise ConfigError(f"{option} {value:g}: {_shown(done, first, last)}")
    if chosen[0] >= chosen[1]:
        raise ConfigError(f"--from {chosen[0]:g} --to {chosen[1]:g}: ends before it begins")
    return chosen


def empty_part(done: Synchronised, given: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the common time of the empty scene, seconds: as given, else as found; None if none is certain.

    Raises:
        ConfigError: the given part lies outside of what all cameras show.
    """
    if given is None:
        return find_empty(done.looks, done.clocks)
    first, last = common_span(done.recordings, done.clocks)
    if given[0] < first - 1e-3 or given[1] > last + 1e-3:
        raise ConfigError(f"--empty {given[0]:g}:{given[1]:g}: {_shown(done, first, last)}")
    return given


def _shown(done: Synchronised, first: float, last: float) -> str:
    """Return the remedy for a time outside of the common time."""
    name = done.recordings[0].name
    return f"all cameras show {first:.2f} s to {last:.2f} s of {name} only; give seconds of {name}'s video in this part"


def without_empty(
    span: tuple[float, float], empty: tuple[float, float] | None, begin: float | None, end: float | None
) -> tuple[float, float]:
    """Return the longer part of the span, after or before the empty scene, unless the user gives begin or end."""
    if empty is None or begin is not None or end is not None:
        return span
    return (empty[1], span[1]) if span[1] - empty[1] >= empty[0] - span[0] else (span[0], empty[0])
