"""`tk level`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base


@click.command(epilog=base.example("tk level CAPTURE"))
@base.capture_argument
@base.masks_option
@base.resample_option
@base.config_option
def level(capture: Path, masks: str, resample: bool | None, config_file: Path | None) -> None:
    """Estimate the up direction from cameras and person, and write it to CAPTURE/capture.toml."""
    with base.working(f"inspecting {capture}"):
        from tk.inspection.checks import inspect as check
        from tk.inspection.leveling import write_up
        from tk.io.importers import open_recording
        from tk.model.cameras.up import shown

        settings = base.load_settings(config_file, resample=resample)
        found, _ = check(open_recording(capture, None, masks, settings.resample), settings, pictures=0)
        write_up(capture, found.leveling)
    click.echo(f"up = {shown(found.leveling.up)} in {capture / 'capture.toml'}: {found.leveling.how}")
