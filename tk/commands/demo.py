"""`tk demo`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter
from tk.commands.track import draw_video_and_report, end, later_stages
from tk.errors import ConfigError


@click.command(epilog=base.example("tk demo"))
@click.option("-o", "--output", type=base.PATH, help="Result; with --raw a folder.  [default: demo.h5; demo-raw]")
@click.option(
    "--raw", is_flag=True,
    help="Begin with raw videos: synchronise, calibrate and track what five cameras recorded.",
)  # fmt: skip
@base.voxels_option
@base.resume_option
@base.force_option
@base.no_report_option
@base.quiet_option
def demo(
    output: Path | None, raw: bool, voxels: int | None, resume: bool, force: bool, no_report: bool, quiet: bool
) -> None:
    """Track the capture that ships with tk and compare the result with its ground truth."""
    if raw:
        from tk.commands.demo_raw import run_raw

        if voxels is not None or resume:
            raise ConfigError("--voxels, --resume: have no meaning with --raw")
        run_raw(output or Path("demo-raw"), force, quiet, no_report)
        return
    output = output or Path("demo.h5")
    from importlib.resources import as_file, files

    with as_file(files("tk") / "data" / "demo") as folder:
        with ConsoleReporter(quiet, None, *later_stages(causal=False, no_report=no_report), "loading") as reporter:
            from tk.evaluation.joints import evaluate_files
            from tk.io.captures.capture import open_capture
            from tk.io.results.files import check_result_path
            from tk.report.after import film_for
            from tk.run import session
            from tk.run.task import RecordingOptions

            check_result_path(output, force, resume)
            reporter.stage(f"opening the capture that ships with tk, {folder}")
            options = RecordingOptions(base.load_settings(None, voxels=voxels))
            capture = open_capture(folder)
            film = None if no_report else film_for(capture, output)
            summary = session.track(capture, output, options, reporter, resume, force, film)
            if not no_report:
                draw_video_and_report(capture, output, summary, reporter, quiet, film)
        if not summary.interrupted:
            click.echo(evaluate_files(output, folder / "truth.h5").format_table())
            click.echo(f"The result is in {output}. Try your own recording: tk track CAPTURE -o RESULT.h5")
        end(output, summary, quiet, as_json=False)
