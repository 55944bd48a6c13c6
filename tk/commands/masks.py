"""`tk masks`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands.base import (
    PATH,
    cameras_option,
    capture_argument,
    example,
    frames_option,
    parse_frames,
    quiet_option,
    split_names,
)
from tk.commands.console import ConsoleReporter


@click.command(epilog=example("tk masks CAPTURE -o masks; tk track CAPTURE -o result.h5 --masks masks"))
@capture_argument
@click.option("-o", "--output", required=True, type=PATH, metavar="DIR")
@click.option("--segmenter", metavar="NAME", help="Segmenter to use, if several are installed.")
@cameras_option
@frames_option
@quiet_option
def masks(
    capture: Path, output: Path, segmenter: str | None, cameras: str | None, frames: str | None, quiet: bool
) -> None:
    """Segment the videos of CAPTURE with a neural network and write masks to DIR/CAMERA/000000.png.

    The person is white. After an interruption, the same command continues.
    """
    span = parse_frames(frames)
    with ConsoleReporter(quiet) as reporter:
        reporter.stage("loading")
        from tk.io.captures.capture import open_capture
        from tk.run import mask_folder

        opened = open_capture(capture, split_names(cameras), "none")
        written = mask_folder.write_masks(opened, output, reporter, segmenter, span)
    if not quiet:
        click.echo(f"masks of {written.frames} frames in {output}, {written.now} of them new", err=True)
