"""`tk config`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands.base import config_option, example, load_settings, preset_option


@click.command(epilog=example("tk config > settings.toml", "tk config --preset kehl2006"))
@preset_option
@config_option
def config(preset: str | None, config_file: Path | None) -> None:
    """Print all settings and their meanings as TOML for --config."""
    from tk.commands.config_text import annotated_toml

    click.echo(annotated_toml(load_settings(config_file, preset)), nl=False)
