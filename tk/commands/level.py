"""`tk level`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands.base import capture_argument, config_option, example, load_settings, masks_option, working


@click.command(epilog=example("tk level CAPTURE"))
@capture_argument
@masks_option
@config_option
def level(capture: Path, masks: str, config_file: Path | None) -> None:
    """Estimate the up direction from cameras and person, and write it to CAPTURE/capture.toml."""
    with working(f"inspecting {capture}"):
        from tk.inspection.checks import inspect as check
        from tk.inspection.leveling import write_up
        from tk.io.captures.capture import open_capture

        found, _ = check(open_capture(capture, None, masks), load_settings(config_file), pictures=0)
        write_up(capture, found.leveling)
    click.echo(f"up = {found.leveling.up} in {capture / 'capture.toml'}: {found.leveling.how}")
