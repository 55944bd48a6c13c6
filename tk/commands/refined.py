"""`tk calibrate CAPTURE --refine`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter

if TYPE_CHECKING:
    from tk.model.cameras.refinement import Refined

# A delay counts as unknown if its standard deviation exceeds this, frames.
_UNKNOWN_FRAMES = 0.25


def refine(
    capture: Path,
    result: Path,
    output: Path,
    focal: bool,
    offsets: bool,
    trust: float,
    cameras: base.Names,
    masks: str,
    config_file: Path | None,
    force: bool,
    quiet: bool,
) -> None:
    """Refine the calibration and the time offsets of a capture with a result that was tracked from it."""
    with ConsoleReporter(quiet, stage="loading") as reporter:
        from tk.io.importers import open_recording
        from tk.io.results.reader import read_result
        from tk.model.cameras.refinement import RefinementSettings
        from tk.run.refined_calibration import refine_capture

        refinement = RefinementSettings(focal=focal, offsets=offsets, trust=trust)
        settings = base.load_settings(config_file)
        reporter.stage(f"opening {capture}")
        opened = open_recording(capture, cameras, masks, read_result(result).resampled)
        for warning in opened.warnings:
            reporter.note(warning)
        reporter.stage("refining the cameras")
        done = refine_capture(opened, result, output, settings, reporter.note, refinement, force)
        for warning in _warnings(done):
            reporter.note(warning)
    click.echo(_table(done))
    click.echo(f"{done.frame_count} frames used; the new calibration is in {output}", err=True)


def _warnings(r: Refined) -> list[str]:
    """Warnings about unreliable numbers, one line each."""
    lines = []
    if not r.converged:
        lines.append("the cameras still moved in the last round; refine again with the new calibration")
    vague = [name for name, observed in zip(r.rig.names, r.observed, strict=True) if not observed]
    if vague:
        lines.append(
            f"{', '.join(vague)}: the recording does not determine where these cameras are, so they stay near the "
            "calibration; record a person who walks about and turns"
        )
    if (r.offset_sigma_frames > _UNKNOWN_FRAMES).any():
        lines.append("the person moves too little to estimate the time offsets; leave them out, or use faster motion")
    return lines


def _table(r: Refined) -> str:
    """A table with one line a camera."""
    width = max(6, *(len(name) for name in r.rig.names))
    lines = [f"{'camera':<{width}}  turned [deg]      moved [mm]     focal [%]      late [frames]  contours [px]"]
    for c, name in enumerate(r.rig.names):
        pixels = f"{r.before_px[c]:5.2f} → {r.after_px[c]:.2f}"
        lines.append(
            f"{name:<{width}}  {r.turn_deg[c]:5.3f} ±{r.turn_sigma_deg[c]:6.3f}  {1000 * r.move_m[c]:6.1f} "
            f"±{1000 * r.move_sigma_m[c]:5.1f}  {100 * (r.focal[c] - 1):+5.2f} ±{100 * r.focal_sigma[c]:5.2f}  "
            f"{r.offset_frames[c]:+6.2f} ±{r.offset_sigma_frames[c]:5.2f}  {pixels}"
        )
    return "\n".join(lines)
