"""Commands that have another name now: they print it and exit with 2. They go with the first release."""

from __future__ import annotations

from typing import Any

import click

from tk.errors import ConfigError

_ANYTHING = {"ignore_unknown_options": True, "allow_extra_args": True, "allow_interspersed_args": False}


def _moved(name: str, now: str) -> click.Command:
    @click.command(name, hidden=True, context_settings=_ANYTHING, add_help_option=False)
    @click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
    def command(**_: Any) -> None:
        raise ConfigError(f"tk {name} is now: {now}")

    return command


refine = _moved("refine", "tk calibrate CAPTURE --refine RESULT.h5 -o CALIBRATION.toml")
level = _moved("level", "tk calibrate CAPTURE --level")
