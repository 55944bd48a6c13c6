"""`tk batch`."""

from __future__ import annotations

from pathlib import Path

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
@base.people_option
@base.no_report_option
@base.quiet_option
def batch(
    captures: tuple[Path, ...],
    output: Path,
    workers: int | None,
    scheduler: str | None,
    dashboard: bool,
    options: base.TrackingOptions,
    people: str,
    no_report: bool,
    quiet: bool,
) -> None:
    """Track many captures into FOLDER and write a summary; after an interruption, the same command continues."""
    from tk.batch import TrackOptions, exit_code, run_batch
    from tk.run.choice import parse_choice

    parse_choice(people)  # a mistake ends the command before the first capture
    track_options = TrackOptions(
        options.method,
        options.frames,
        options.cameras,
        options.masks,
        options.body and options.body.resolve(),
        options.causal,
        options.store_hull,
        people,
        options.settings(),
    )
    with BatchConsoleReporter(quiet) as reporter:
        try:
            outcomes = run_batch(
                captures, output, track_options, reporter, workers, scheduler, not no_report, dashboard
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command continues") from None
    if not quiet:
        click.echo(f"the summary is in {output / 'summary.html'}", err=True)
    base.exit_with(exit_code(outcomes))
