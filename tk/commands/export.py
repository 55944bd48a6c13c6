"""`tk export`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base


@click.command(epilog=base.example("tk export walk.h5 --to trc,mot,bvh"))
@base.result_argument
@base.names_option(
    "--to", "formats", required=True,
    help="Formats: trc, mot (OpenSim), c3d, bvh, csv, gltf (.glb), ply (a folder); all.",
)  # fmt: skip
@click.option(
    "--bvh-units", type=click.Choice(["m", "cm"]), default="m", show_default=True, help="Unit of lengths in BVH files."
)
@click.option("-o", "--output", type=base.PATH, metavar="DIR", help="Folder.  [default: the folder of RESULT.h5]")
@click.option("--smoothed", is_flag=True, help="Export the smoothed motion, with short losses bridged.")
@base.force_option
def export(result: Path, formats: base.Names, output: Path | None, bvh_units: str, smoothed: bool, force: bool) -> None:
    """Write RESULT.h5 in the formats of other programs: OpenSim, Blender, spreadsheets.

    A format that cannot be written is named at the end, with the remedy; the others are written.
    """
    with base.working(f"exporting {result}"):
        from tk.export import export as write

        written = write(result, formats or (), output, smoothed, force, bvh_units)
    base.print_lines("note: ", written.notes)
    base.print_lines("wrote ", written.files)
    base.print_lines("tk: not written: ", written.failed)
    if written.failed:
        base.exit_with(1)
