"""`tk reconstruct`."""

from __future__ import annotations

import time
from pathlib import Path

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter


@click.command(epilog=base.example("tk reconstruct CAPTURE -o hull.h5 --ply hulls --frames 0:3"))
@base.capture_argument
@click.option("-o", "--output", required=True, type=base.PATH, metavar="HULL.h5")
@click.option("--ply", type=base.PATH, metavar="DIR", help="Also write a point cloud (PLY) per frame.")
@click.option("--mesh", type=base.PATH, metavar="DIR", help="Also write a closed mesh (PLY) per frame.")
@base.voxels_option
@base.cameras_option
@base.frames_option
@base.masks_option
@base.resample_option
@base.force_option
@base.config_option
@base.quiet_option
@base.json_option
def reconstruct(
    capture: Path,
    output: Path,
    ply: Path | None,
    mesh: Path | None,
    voxels: int | None,
    cameras: base.Names,
    frames: base.Span,
    masks: str,
    resample: bool | None,
    force: bool,
    config_file: Path | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Reconstruct the coloured surface of the visual hull in every frame of CAPTURE."""
    started = time.perf_counter()
    with ConsoleReporter(quiet, stage="loading") as reporter:
        from tk.io.importers import open_recording
        from tk.run import reconstruction

        settings = base.load_settings(config_file, voxels=voxels, resample=resample)
        reporter.stage(f"opening {capture}")
        opened = open_recording(capture, cameras, masks, settings.resample)
        count = reconstruction.reconstruct(opened, output, settings, reporter, frames, ply, mesh, force)
    if as_json:
        base.print_json(result=str(output), frames=count, seconds=round(time.perf_counter() - started, 3))
    if not quiet:
        click.echo(f"{count} frames in {output}", err=True)
