"""`tk import`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base


@click.command("import", epilog=base.example("tk import my_session -o my_capture"))
@click.argument("folder", type=base.PATH)
@click.option("-o", "--output", required=True, type=base.PATH, metavar="CAPTURE")
@click.option(
    "--units", type=click.Choice(["m", "cm", "mm"]), help="Unit of lengths in the calibration.  [default: inferred]"
)
@click.option(
    "--scale",
    metavar="CAM1,CAM2=METRES",
    help="Measured distance of two cameras, if the calibration's unit is arbitrary; or metres in one unit.",
)
@click.option("--trial", metavar="NAME", help="Use the videos whose path contains NAME, if there are several trials.")
def import_(folder: Path, output: Path, units: str | None, scale: str | None, trial: str | None) -> None:
    """Convert another tool's project to a capture: Pose2Sim, FreeMoCap, Caliscope, Anipose, EasyMocap and others."""
    with base.working(f"importing {folder}"):
        from tk.io.importers import Wanted, import_project

        done = import_project(folder, output, Wanted(units, trial, scale))
    base.print_lines("note: ", done.notes)
    click.echo(f"{done.cameras} cameras in {output}; check {output / 'capture.toml'}", err=True)
