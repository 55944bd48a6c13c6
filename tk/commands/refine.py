"""`tk refine`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter


@click.command(epilog=base.example("tk refine CAPTURE result.h5 -o refined.toml"))
@base.capture_argument
@base.result_argument
@click.option("-o", "--output", required=True, type=base.PATH, metavar="CALIBRATION.toml")
@click.option("--focal", is_flag=True, help="Also refine the focal lengths.")
@click.option("--offsets/--no-offsets", default=True, show_default=True, help="Estimate the videos' time offsets.")
@click.option(
    "--trust", type=float, default=1.0, show_default=True,
    help="Expected error of the calibration; 1 means about 0.3° and 12 mm.",
)  # fmt: skip
@base.cameras_option
@base.masks_option
@base.config_option
@base.force_option
@base.quiet_option
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
    """Refine the calibration and the time offsets of CAPTURE with RESULT.h5, a result tracked from CAPTURE."""
    with ConsoleReporter(quiet, stage="loading") as reporter:
        from tk.io.importers import open_recording
        from tk.io.results.reader import read_result
        from tk.model.cameras.refinement import RefinementSettings
        from tk.run.refinement import refine_capture

        refinement = RefinementSettings(focal=focal, offsets=offsets, trust=trust)
        settings = base.load_settings(config_file)
        reporter.stage(f"opening {capture}")
        opened = open_recording(capture, cameras, masks, read_result(result).resampled)
        for warning in opened.warnings:
            reporter.note(warning)
        reporter.stage("refining the cameras")
        done = refine_capture(opened, result, output, settings, reporter.note, refinement, force)
        for warning in done.warnings:
            reporter.note(warning)
    click.echo(done.format_table())
    click.echo(f"{done.frames} frames used; the new calibration is in {output}", err=True)
