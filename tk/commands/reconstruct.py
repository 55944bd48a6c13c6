"""`tk reconstruct`."""

from __future__ import annotations

import time
from pathlib import Path

import click

from tk.commands.base import (
    PATH,
    cameras_option,
    capture_argument,
    config_option,
    example,
    force_option,
    frames_option,
    json_option,
    load_settings,
    masks_option,
    parse_frames,
    print_json,
    quiet_option,
    split_names,
    voxels_option,
)
from tk.commands.console import ConsoleReporter


@click.command(epilog=example("tk reconstruct CAPTURE -o hull.h5 --ply hulls --frames 0:3"))
@capture_argument
@click.option("-o", "--output", required=True, type=PATH, metavar="HULL.h5")
@click.option("--ply", type=PATH, metavar="DIR", help="Also write a point cloud (PLY) per frame.")
@click.option("--mesh", type=PATH, metavar="DIR", help="Also write a closed mesh (PLY) per frame.")
@voxels_option
@cameras_option
@frames_option
@masks_option
@force_option
@config_option
@quiet_option
@json_option
def reconstruct(
    capture: Path,
    output: Path,
    ply: Path | None,
    mesh: Path | None,
    voxels: int | None,
    cameras: str | None,
    frames: str | None,
    masks: str,
    force: bool,
    config_file: Path | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Reconstruct the coloured surface of the visual hull in every frame of CAPTURE."""
    span = parse_frames(frames)
    started = time.perf_counter()
    with ConsoleReporter(quiet) as reporter:
        reporter.stage("loading")
        from tk.io.captures.capture import open_capture
        from tk.run import reconstruction

        settings = load_settings(config_file, voxels=voxels)
        reporter.stage(f"opening {capture}")
        opened = open_capture(capture, split_names(cameras), masks)
        count = reconstruction.reconstruct(opened, output, settings, reporter, span, ply, mesh, force)
    if as_json:
        print_json(result=str(output), frames=count, seconds=round(time.perf_counter() - started, 3))
    if not quiet:
        click.echo(f"{count} frames in {output}", err=True)
