"""`tk report`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base


@click.command(epilog=base.example("tk report result.h5 CAPTURE"))
@base.result_argument
@base.optional_capture_argument
@click.option("-o", "--output", type=base.PATH, metavar="PAGE.html", help="Page.  [default: next to RESULT.h5]")
@base.force_option
def report(result: Path, capture: Path | None, output: Path | None, force: bool) -> None:
    """Write an HTML page about RESULT.h5 that needs no network.

    With CAPTURE the page also shows images.
    """
    with base.working("writing the report"):
        from tk.report.page import report as write

        file = write(result, capture, output, force)
    click.echo(f"wrote {file}", err=True)
