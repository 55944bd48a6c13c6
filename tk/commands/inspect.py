"""`tk inspect`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands.base import (
    PATH,
    cameras_option,
    capture_argument,
    config_option,
    example,
    json_option,
    load_settings,
    masks_option,
    print_json,
    split_names,
    working,
)


@click.command(epilog=example("tk inspect CAPTURE -o sheets"))
@capture_argument
@click.option("-o", "--output", type=PATH, metavar="DIR", help="Also write a sheet of images to DIR/inspect.png.")
@cameras_option
@masks_option
@config_option
@json_option
def inspect(
    capture: Path, output: Path | None, cameras: str | None, masks: str, config_file: Path | None, as_json: bool
) -> None:
    """Check CAPTURE before tracking: masks, inconsistent or unsynchronised cameras, working volume, floor, up."""
    with working(f"inspecting {capture}"):
        from tk.inspection.checks import inspect as check
        from tk.inspection.pictures import write_sheet
        from tk.io.captures.capture import open_capture

        opened = open_capture(capture, split_names(cameras), masks)
        found, shown = check(opened, load_settings(config_file))
        if output is not None:
            write_sheet(output / "inspect.png", opened, found, shown)
    if output is not None:
        click.echo(f"wrote {output / 'inspect.png'}", err=True)
    if as_json:
        print_json(**found.to_dict())
    else:
        click.echo(found.format_table())
