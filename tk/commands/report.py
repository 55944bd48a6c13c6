"""`tk report`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands.base import PATH, example, force_option, optional_capture_argument, result_argument, working


@click.command(epilog=example("tk report result.h5 CAPTURE"))
@result_argument
@optional_capture_argument
@click.option("-o", "--output", type=PATH, metavar="PAGE.html", help="Page.  [default: next to RESULT.h5]")
@force_option
def report(result: Path, capture: Path | None, output: Path | None, force: bool) -> None:
    """Write an HTML page about RESULT.h5 that needs no network.

    With CAPTURE the page also shows images.
    """
    with working("writing the report"):
        from tk.report.page import report as write

        file = write(result, capture, output, force)
    click.echo(f"wrote {file}", err=True)
