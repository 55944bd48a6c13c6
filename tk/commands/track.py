"""`tk track`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter
from tk.run.worker import dismiss, started_early

if TYPE_CHECKING:
    from tk.io.captures.capture import Capture
    from tk.io.captures.film import Film
    from tk.run.session import Summary

#: exit code when more than half of the frames in which the person is present are lost or suspect
EXIT_LOST = 3
# Durations of the second pass and of drawing video and report, as multiples of the duration of the first pass: measured
# on the demo. They change only the time left that is shown.
_SECOND_PASS, _PICTURES = 0.5, 1.0
# Share of lost and suspect frames above which the last line warns.
WARN_SHARE = 0.2


@click.command(
    epilog=base.example(
        "tk track CAPTURE",
        "tk track CAPTURE -o result.h5",
        "tk track CAPTURE -o part.h5 --frames 0:100 --cameras cam1,cam2,cam4",
    )
)
@base.capture_argument
@click.option(
    "-o", "--output", type=base.PATH, metavar="RESULT.h5",
    help="The result.  [default: the name of CAPTURE's folder, in the current folder]",
)  # fmt: skip
@base.tracking_options
@click.option(
    "--init-pose", type=base.PATH, metavar="FILE",
    help="Start from the approximate pose in this TOML file, or from this folder of 2D keypoints.",
)  # fmt: skip
@base.resume_option
@base.force_option
@base.no_report_option
@base.quiet_option
@base.json_option
def track(
    capture: Path,
    output: Path | None,
    resume: bool,
    force: bool,
    no_report: bool,
    quiet: bool,
    as_json: bool,
    causal: bool,
    **given: Any,
) -> None:
    """Track the person or the people in CAPTURE and write the pose of every frame to RESULT.h5.

    An overlay video (RESULT.mp4) and a report (RESULT.html) are written next to it.
    """
    if output is None:
        output = Path(f"{capture.resolve().name}.h5")
        base.print_lines("note: the result is ", [output.absolute()])
    reporter = ConsoleReporter(quiet, None, *later_stages(causal, no_report), "loading")
    with reporter, started_early():
        from tk.io.importers import open_recording
        from tk.io.results.files import check_result_path
        from tk.run import session

        options = base.recording_options(causal=causal, **given)
        if options.settings.ahead == 0:
            dismiss()
        check_result_path(output, force, resume)
        reporter.stage(f"opening {capture}")
        opened = open_recording(capture, options.cameras, options.masks, options.settings.resample)
        continued = resume and output.exists()  # its first frames are no longer there to be kept
        film = None
        if not (no_report or continued):
            from tk.report.after import film_for

            film = film_for(opened, output)
        summary = session.track(opened, output, options, reporter, resume, force, film)
        if not no_report:
            draw_video_and_report(opened, output, summary, reporter, quiet, film)
    end(output, summary, quiet, as_json)


def later_stages(causal: bool, no_report: bool) -> tuple[float, float]:
    """Return the duration of what follows the first pass, and of the pictures, as multiples of its duration."""
    pictures = 0.0 if no_report else _PICTURES
    return (0.0 if causal else _SECOND_PASS) + pictures, pictures


def draw_video_and_report(
    capture: Capture, result: Path, summary: Summary, reporter: ConsoleReporter, quiet: bool, film: Film | None
) -> None:
    """Write the overlay video and the report of a run that was not interrupted."""
    if summary.interrupted or not summary.frames:
        return
    from tk.report.after import write_video_and_report

    reporter.stage("drawing the overlay video and the report")
    try:
        files = write_video_and_report(capture, result, lambda text: click.echo(f"warning: {text}", err=True), film)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{result} is complete; tk render and tk report draw it") from None
    if files and not quiet:
        click.echo(f"wrote {', '.join(str(file) for file in files)}", err=True)


def _expected_error(path: Path) -> list[str]:
    """Return a text with the range of the expected mean error, and the number of frames, beside the suspect ones, in
    which sigma is unknown; [] if it always is."""
    import numpy as np

    from tk.io.results.reader import read_result
    from tk.io.results.status import Status
    from tk.model.body.expected_error import in_cm

    result = read_result(path)
    expected = result.mean_error_range
    if result.sigma is None or expected is None:
        return []
    unknown = np.count_nonzero((result.status < Status.LOST) & np.isnan(result.sigma).all(axis=1))
    beside = f", unknown in {unknown} frames" if unknown else ""
    return [f"expected mean error of the joints {in_cm(expected)} (constant offsets included){beside}"]


def end(output: Path, summary: Summary, quiet: bool, as_json: bool) -> None:
    """Print how a run ended, and exit: with 1 after an interruption, with 3 if most frames are lost or suspect."""
    rate = summary.tracked_now / summary.seconds if summary.seconds > 0 else 0.0
    if as_json:
        base.print_json(
            result=str(output),
            frames=summary.frames,
            lost=summary.lost,
            suspect=summary.suspect,
            absent=summary.frames - summary.present,
            tracked_now=summary.tracked_now,
            seconds=round(summary.seconds, 3),
            frames_per_second=round(rate, 3),
            interrupted=summary.interrupted,
        )
    wrong = summary.lost + summary.suspect
    if summary.frames and not quiet:
        rare = {"suspect": summary.suspect, "absent": summary.frames - summary.present}
        counts = [f"{summary.lost} lost", *(f"{count} {what}" for what, count in rare.items() if count)]
        several = f" of {summary.people} people" if summary.people > 1 else ""
        parts = [f"{summary.frames} frames{several} in {output}", *counts, *_expected_error(output)]
        click.echo(", ".join([*parts, f"tracked in {summary.seconds:.1f} s"]), err=True)
    if summary.interrupted:
        next_step = "continue with the same command and --resume" if summary.frames else "no frame was finished"
        base.exit_with(1, f"interrupted; {next_step}")
    if wrong > WARN_SHARE * summary.present:
        advice = "do not use the result: check" if summary.mostly_lost else "check"
        line = f"{output}: {wrong} of {summary.present} frames are lost or suspect; {advice} masks, calibration and "
        base.exit_with(EXIT_LOST if summary.mostly_lost else 0, f"{line}working volume with tk inspect")
