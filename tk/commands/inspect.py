"""`tk inspect`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base
from tk.errors import CaptureError


@click.command(epilog=base.example("tk inspect CAPTURE -o sheets"))
@base.capture_argument
@click.option(
    "-o", "--output", type=base.PATH, metavar="DIR", help="Also write pictures to DIR: inspect.png, people.png."
)
@base.cameras_option
@base.masks_option
@base.resample_option
@base.config_option
@base.force_option
@base.json_option
def inspect(
    capture: Path,
    output: Path | None,
    cameras: base.Names,
    masks: str,
    resample: bool | None,
    config_file: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Check CAPTURE before tracking: masks, inconsistent or unsynchronised cameras, working volume, floor, up."""
    pictures = [] if output is None else [output / "inspect.png", output / "people.png"]
    with base.working(f"inspecting {capture}") as reporter:
        from tk.inspection.checks import inspect as check
        from tk.inspection.floor_plan import floor_plan
        from tk.inspection.pictures import write_sheet
        from tk.io.importers import open_recording
        from tk.io.paths import PNG, check_files
        from tk.render.canvas import write_png
        from tk.run.plan import reduce_images

        if output is not None:
            check_files(output, pictures, PNG, force, capture=capture, error=CaptureError)
        settings = base.load_settings(config_file, resample=resample)
        opened = open_recording(capture, cameras, masks, settings.resample)
        opened = reduce_images(opened, settings.person_pixels)
        found, shown = check(opened, settings, within=reporter.within)
        if output is not None:
            sheet, plan = pictures
            write_sheet(sheet, opened, found, shown)
            write_png(plan, floor_plan(opened, found.people), CaptureError)
            click.echo(f"wrote {sheet} and {plan}", err=True)
    if as_json:
        base.print_json(**found.to_dict())
    else:
        click.echo(found.format_table())
