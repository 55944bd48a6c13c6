"""`tk masks`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter


@click.command(epilog=base.example("tk masks CAPTURE -o masks; tk track CAPTURE -o result.h5 --masks masks"))
@base.capture_argument
@click.option("-o", "--output", required=True, type=base.PATH, metavar="DIR")
@click.option("--segmenter", metavar="NAME", help="Segmenter to use, if several are installed.")
@base.cameras_option
@base.frames_option
@base.quiet_option
def masks(
    capture: Path, output: Path, segmenter: str | None, cameras: base.Names, frames: base.Span, quiet: bool
) -> None:
    """Segment the videos of CAPTURE with a neural network and write masks to DIR/CAMERA/000000.png.

    People are white. After an interruption, the same command continues.
    """
    with ConsoleReporter(quiet, stage="loading") as reporter:
        from tk.io.importers import open_recording
        from tk.run import mask_folder

        opened = open_recording(capture, cameras, "none")
        written = mask_folder.write_masks(opened, output, reporter, segmenter, frames)
    if not quiet:
        click.echo(f"masks of {written.frames} frames in {output}, {written.now} of them new", err=True)
