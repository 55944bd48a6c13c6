"""`tk batch`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from tk.commands import base
from tk.commands.console import BatchConsoleReporter


@click.command(epilog=base.example("tk batch recordings/* -o results --workers 4"))
@click.argument("captures", nargs=-1, required=True, type=base.PATH, metavar="CAPTURE...")
@click.option("-o", "--output", required=True, type=base.PATH, metavar="FOLDER")
@click.option(
    "--workers", type=int, metavar="N",
    help="Captures to track at the same time on this machine.  [default: half the cores]",
)  # fmt: skip
@click.option("--scheduler", metavar="ADDRESS", help="Use the workers of this Dask scheduler: tcp://host:8786.")
@click.option("--dashboard", is_flag=True, help="Serve Dask's page about workers and tasks.")
@base.tracking_options
@base.no_report_option
@base.quiet_option
def batch(
    captures: tuple[Path, ...],
    output: Path,
    workers: int | None,
    scheduler: str | None,
    dashboard: bool,
    no_report: bool,
    quiet: bool,
    **given: Any,
) -> None:
    """Track many captures into FOLDER and write a summary; after an interruption, the same command continues.

    A CAPTURE may be a session: a folder of captures with session.toml.
    """
    from tk.batch import exit_code, run_batch

    options = base.recording_options(**given)
    options = replace(options, body=options.body and options.body.resolve())  # workers may run in other folders
    with BatchConsoleReporter(quiet) as reporter:
        try:
            outcomes = run_batch(captures, output, options, reporter, workers, scheduler, not no_report, dashboard)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command continues") from None
    if not quiet:
        click.echo(f"the summary is in {output / 'summary.html'}", err=True)
    failed = sum(outcome.failed for outcome in outcomes.values())
    base.exit_with(exit_code(outcomes), f"{failed} of {len(outcomes)} captures failed" if failed else "")
