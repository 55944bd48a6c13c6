"""`tk config`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base


@click.command(epilog=base.example("tk config > settings.toml", "tk config --preset kehl2006"))
@base.preset_option
@base.config_option
def config(preset: str | None, config_file: Path | None) -> None:
    """Print all settings and their meanings as TOML for --config."""
    from tk.commands.config_text import annotated_toml

    click.echo(annotated_toml(base.load_settings(config_file, preset)), nl=False)
