"""The command line: every command is a module of :mod:`tk.commands` and is registered here."""

from __future__ import annotations

import click

from tk import __version__
from tk.commands.base import Commands
from tk.commands.batch import batch
from tk.commands.calibrate import calibrate
from tk.commands.config import config
from tk.commands.demo import demo
from tk.commands.doctor import doctor
from tk.commands.evaluate import evaluate
from tk.commands.export import export
from tk.commands.import_ import import_
from tk.commands.inspect import inspect
from tk.commands.masks import masks
from tk.commands.moved import level, refine
from tk.commands.reconstruct import reconstruct
from tk.commands.render import render
from tk.commands.report import report
from tk.commands.sync import sync
from tk.commands.track import track
from tk.commands.view import view


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="tk")
def main() -> None:
    """Track a person's motion with a few ordinary, calibrated cameras: no markers, no GPU."""


for _command in (
    batch, calibrate, config, demo, doctor, evaluate, export, import_, inspect, level, masks, reconstruct, refine,
    render, report, sync, track, view,
):  # fmt: skip
    main.add_command(_command)
