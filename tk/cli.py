"""The commands: parse, call, print. Nothing is computed here."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tk import __version__
from tk.commands.base import (
    Commands,
    body_option,
    cameras_option,
    capture_argument,
    causal_option,
    config_option,
    configuration,
    example,
    force_option,
    frame_span,
    frames_option,
    json_option,
    listed,
    masks_option,
    method_option,
    no_report_option,
    preset_option,
    print_json,
    quiet_option,
    resume_option,
    seed_option,
    store_hull_option,
    voxels_option,
    working,
)
from tk.commands.console import Report
from tk.errors import CaptureError, ConfigError, WorkerError

if TYPE_CHECKING:
    from tk.io.captures.capture import Capture
    from tk.run.session import Summary

#: more than half of the frames are lost
EXIT_LOST = 3


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="tk")
def main() -> None:
    """A person's motion out of a few ordinary, calibrated cameras: no markers, no GPU."""


@main.command(
    epilog=example(
        "tk track CAPTURE -o result.h5",
        "tk track CAPTURE -o part.h5 --frames 0:100 --cameras cam1,cam2,cam4",
    )
)
@capture_argument
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="RESULT.h5")
@method_option
@voxels_option
@cameras_option
@frames_option
@seed_option
@masks_option
@click.option(
    "--init-pose",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Start from this rough pose (TOML), or from this folder of 2D keypoints.",
)
@body_option
@causal_option
@resume_option
@force_option
@store_hull_option
@no_report_option
@preset_option
@config_option
@quiet_option
@json_option
def track(
    capture: Path,
    output: Path,
    method: str,
    voxels: int | None,
    cameras: str | None,
    frames: str | None,
    seed: int | None,
    masks: str,
    init_pose: Path | None,
    body: Path | None,
    causal: bool,
    resume: bool,
    force: bool,
    store_hull: bool,
    no_report: bool,
    preset: str | None,
    config_file: Path | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Track the person in CAPTURE and write the pose of every frame to RESULT.h5.

    An overlay video, RESULT.mp4, and a report, RESULT.html, are left beside it.
    """
    span = frame_span(frames)
    with Report(quiet) as report:
        report.stage("loading")
        from tk.io.captures.capture import open_capture
        from tk.io.results.files import check_output
        from tk.run import session  # the heavy imports wait until a command needs them

        config = configuration(config_file, preset, voxels=voxels, seed=seed)
        check_output(output, force, resume)
        report.stage(f"opening {capture}")
        opened = open_capture(capture, listed(cameras), masks)
        summary = session.track(
            opened, output, config, report, method, span, init_pose, resume, store_hull, body, causal, force
        )
        if not no_report:
            _leave_pictures(opened, output, summary, report, quiet)
    _tell(output, summary, quiet, as_json)


def _tell(output: Path, summary: Summary, quiet: bool, as_json: bool) -> None:
    """How a run ended, and the exit code: 1 where somebody stopped it, 3 where most of its frames are lost."""
    rate = summary.tracked_now / summary.seconds if summary.seconds > 0 else 0.0
    if as_json:
        print_json(
            result=str(output),
            frames=summary.frames,
            lost=summary.lost,
            tracked_now=summary.tracked_now,
            seconds=round(summary.seconds, 3),
            frames_per_second=round(rate, 3),
            interrupted=summary.interrupted,
        )
    if summary.frames and not quiet:
        click.echo(f"{summary.frames} frames in {output}, {summary.lost} lost, {rate:.1f} frames/s", err=True)
    if summary.interrupted:
        further = "go on with the same command and --resume" if summary.frames else "no frame was finished"
        click.echo(f"tk: interrupted; {further}", err=True)
        sys.exit(1)
    if summary.mostly_lost:
        click.echo(
            f"tk: {output}: {summary.lost} of {summary.frames} frames are lost; do not use it: check masks, "
            "calibration and working volume",
            err=True,
        )
        sys.exit(EXIT_LOST)


def _leave_pictures(capture: Capture, result: Path, summary: Summary, report: Report, quiet: bool) -> None:
    """The overlay video and the report of a run that has ended."""
    if summary.interrupted or not summary.frames:
        return
    from tk.report.after import leave_pictures

    report.stage("drawing the overlay video and the report")
    files = leave_pictures(capture, result, lambda text: click.echo(f"warning: {text}", err=True))
    if files and not quiet:
        click.echo(f"to look at: {', '.join(str(file) for file in files)}", err=True)


@main.command("import", epilog=example("tk import my_session -o my_capture"))
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="CAPTURE")
@click.option(
    "--units", type=click.Choice(["m", "cm", "mm"]), help="Of the calibration's lengths.  [default: inferred]"
)
@click.option(
    "--trial", metavar="NAME", help="Take the videos with NAME in their path, where there are several trials."
)
def import_(folder: Path, output: Path, units: str | None, trial: str | None) -> None:
    """Make a capture of another tool's project: Pose2Sim, FreeMoCap, Caliscope, Anipose, EasyMocap and others."""
    with working(f"importing {folder}"):
        from tk.io.importers import import_project

        done = import_project(folder, output, units, trial)
    for note in done.notes:
        click.echo(f"note: {note}", err=True)
    click.echo(f"{done.cameras} cameras in {output}; have a look at {output / 'capture.toml'}", err=True)


@main.command(epilog=example("tk reconstruct CAPTURE -o hull.h5 --ply hulls --frames 0:3"))
@capture_argument
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="HULL.h5")
@click.option("--ply", type=click.Path(path_type=Path), metavar="DIR", help="Also write point clouds, a PLY a frame.")
@click.option("--mesh", type=click.Path(path_type=Path), metavar="DIR", help="Also write closed meshes, a PLY a frame.")
@voxels_option
@cameras_option
@frames_option
@masks_option
@force_option
@config_option
@quiet_option
@json_option
def reconstruct(
    capture: Path,
    output: Path,
    ply: Path | None,
    mesh: Path | None,
    voxels: int | None,
    cameras: str | None,
    frames: str | None,
    masks: str,
    force: bool,
    config_file: Path | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Reconstruct the coloured surface of the visual hull in every frame of CAPTURE."""
    span = frame_span(frames)
    started = time.perf_counter()
    with Report(quiet) as report:
        report.stage("loading")
        from tk.io.captures.capture import open_capture
        from tk.run import reconstruction

        config = configuration(config_file, voxels=voxels)
        report.stage(f"opening {capture}")
        opened = open_capture(capture, listed(cameras), masks)
        count = reconstruction.reconstruct(opened, output, config, report, span, ply, mesh, force)
    if as_json:
        print_json(result=str(output), frames=count, seconds=round(time.perf_counter() - started, 3))
    if not quiet:
        click.echo(f"{count} frames in {output}", err=True)


@main.command(epilog=example("tk masks CAPTURE -o masks; tk track CAPTURE -o result.h5 --masks masks"))
@capture_argument
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="DIR")
@click.option("--segmenter", metavar="NAME", help="Which one, where several are installed.")
@cameras_option
@frames_option
@quiet_option
def masks(
    capture: Path, output: Path, segmenter: str | None, cameras: str | None, frames: str | None, quiet: bool
) -> None:
    """Let a segmenter make masks of CAPTURE's videos: DIR/CAMERA/000000.png.

    The person is white. The same command goes on where it was stopped.
    """
    span = frame_span(frames)
    with Report(quiet) as report:
        report.stage("loading")
        from tk.io.captures.capture import open_capture
        from tk.run import mask_folder

        opened = open_capture(capture, listed(cameras), "none")
        written = mask_folder.write_masks(opened, output, report, segmenter, span)
    if not quiet:
        click.echo(f"masks of {written.frames} frames in {output}, {written.now} of them new", err=True)


@main.command(epilog=example("tk inspect CAPTURE -o looks"))
@capture_argument
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DIR", help="Write a sheet of pictures here.")
@cameras_option
@masks_option
@config_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def inspect(
    capture: Path, output: Path | None, cameras: str | None, masks: str, config_file: Path | None, as_json: bool
) -> None:
    """Look at CAPTURE before tracking: masks, cameras that disagree or are late, volume, floor, up."""
    import json

    with working(f"looking at {capture}"):
        from tk.inspection.checks import inspect as look
        from tk.inspection.pictures import write_sheet
        from tk.io.captures.capture import open_capture

        opened = open_capture(capture, listed(cameras), masks)
        found, seen = look(opened, configuration(config_file))
        if output is not None:
            write_sheet(output / "inspect.png", opened, found, seen)
    if output is not None:
        click.echo(f"pictures in {output / 'inspect.png'}", err=True)
    click.echo(json.dumps(found.to_dict(), indent=2, allow_nan=False) if as_json else found.format_table())


@main.command(epilog=example("tk level CAPTURE"))
@capture_argument
@masks_option
@config_option
def level(capture: Path, masks: str, config_file: Path | None) -> None:
    """Find what points up from cameras and person, and write it into CAPTURE/capture.toml."""
    with working(f"looking at {capture}"):
        from tk.inspection.checks import inspect as look
        from tk.inspection.leveling import write_up
        from tk.io.captures.capture import open_capture

        found, _ = look(open_capture(capture, None, masks), configuration(config_file), pictures=0)
        write_up(capture, found.leveling)
    click.echo(f"up = {found.leveling.up} in {capture / 'capture.toml'}: {found.leveling.how}")


@main.command(epilog=example("tk refine CAPTURE result.h5 -o refined.toml"))
@capture_argument
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.h5")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="CALIBRATION.toml")
@click.option("--focal", is_flag=True, help="Refine the focal lengths, too.")
@click.option("--offsets/--no-offsets", default=True, show_default=True, help="Seek the videos' time offsets.")
@click.option(
    "--trust", type=float, default=1.0, show_default=True,
    help="How far off the cameras may be: 1 means some 0.3° and 12 mm in all.",
)  # fmt: skip
@cameras_option
@masks_option
@config_option
@force_option
@quiet_option
def refine(
    capture: Path,
    result: Path,
    output: Path,
    focal: bool,
    offsets: bool,
    trust: float,
    cameras: str | None,
    masks: str,
    config_file: Path | None,
    force: bool,
    quiet: bool,
) -> None:
    """Refine the cameras of CAPTURE, and the time offsets of its videos, by RESULT.h5, which was tracked with them."""
    with Report(quiet) as report:
        report.stage("loading")
        from tk.io.captures.capture import open_capture
        from tk.model.cameras.refinement import RefinementSettings
        from tk.run.refinement import refine_capture

        if output.exists() and not force:
            raise ConfigError(f"{output}: exists already; give another name, or --force")
        how = RefinementSettings(focal=focal, offsets=offsets, trust=trust)
        config = configuration(config_file)
        report.stage(f"opening {capture}")
        opened = open_capture(capture, listed(cameras), masks)
        for warning in opened.warnings:
            report.note(warning)
        report.stage("refining the cameras")
        done = refine_capture(opened, result, output, config, report.note, how)
        for warning in done.warnings:
            report.note(warning)
    click.echo(done.format_table())
    click.echo(f"{done.frames} frames; the new calibration is in {output}", err=True)


@main.command(epilog=example("tk evaluate result.h5 CAPTURE/truth.h5"))
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option(
    "--capture", type=click.Path(path_type=Path), metavar="DIR",
    help="Judge in the pictures, too: pixels and silhouettes.  [default: the folder of TRUTH.h5, if a capture]",
)  # fmt: skip
@click.option("--joints", default="ankle_l,ankle_r", show_default=True, help="Whose distance is told in pixels.")
@masks_option
@json_option
def evaluate(result: Path, truth: Path, capture: Path | None, joints: str, masks: str, as_json: bool) -> None:
    """Compare RESULT.h5 with TRUTH.h5: joint distances, PCK, lost frames, frames/s; pixels and silhouettes by view."""
    seen, note = None, ""
    with working(f"comparing {result} with {truth}"):
        from tk.evaluation.joints import evaluate_files
        from tk.evaluation.views import capture_of, evaluate_views

        found = evaluate_files(result, truth)
        folder = capture or capture_of(truth)
        try:
            seen = evaluate_views(result, truth, folder, listed(joints) or (), masks) if folder else None
        except CaptureError as error:
            if capture is not None:
                raise
            note = f"note: not judged in the pictures: {error}"
    if note:
        click.echo(note, err=True)
    if as_json:
        print_json(**found.to_dict(), **({"views": seen.to_dict()} if seen else {}))
    else:
        click.echo(found.format_table() + (f"\n\n{seen.format_table()}" if seen else ""))


@main.command(epilog=example("tk export walk.h5 --to trc,mot,bvh"))
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.h5")
@click.option(
    "--to", "formats", required=True, metavar="A,B,…",
    help="Formats: trc, mot (OpenSim), c3d, bvh, csv, gltf (.glb), ply (a folder).",
)  # fmt: skip
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="DIR", help="Folder.  [default: beside RESULT.h5]"
)
@click.option("--smoothed", is_flag=True, help="The smoothed copy, with short losses bridged.")
@force_option
def export(result: Path, formats: str, output: Path | None, smoothed: bool, force: bool) -> None:
    """Write RESULT.h5 in formats of other programs: OpenSim, Blender, spreadsheets."""
    with working(f"exporting {result}"):
        from tk.export import export as write

        written = write(result, listed(formats) or (), output, smoothed, force)
    for note in written.notes:
        click.echo(f"note: {note}", err=True)
    for file in written.files:
        click.echo(f"wrote {file}", err=True)


@main.command(epilog=example("tk render result.h5 CAPTURE", "tk render result.h5 --view 3d -o turning.mp4"))
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.h5")
@click.argument("capture", type=click.Path(path_type=Path), required=False)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="OUT.mp4", help="Video.  [default: beside RESULT.h5]"
)
@click.option(
    "--view", type=click.Choice(["overlay", "3d", "hull"]),
    help="Over the pictures; a turning view; the same with the stored hull.  [default: overlay, if CAPTURE is given]",
)  # fmt: skip
@cameras_option
@click.option("--frames", metavar="A:B|A,B,…", help="Frames A to B-1, or single ones.")
@click.option("--png", type=click.Path(path_type=Path), metavar="DIR", help="Contact sheets in the place of a video.")
@click.option("--full", is_flag=True, help="Whole pictures, not the part that holds the person.")
@force_option
def render(
    result: Path,
    capture: Path | None,
    output: Path | None,
    view: str | None,
    cameras: str | None,
    frames: str | None,
    png: Path | None,
    full: bool,
    force: bool,
) -> None:
    """Draw RESULT.h5 as a video: over the pictures of CAPTURE, or in 3D."""
    from tk.render.command import Request
    from tk.render.command import render as draw

    request = Request(view, output, png, frames, listed(cameras), full, force)
    with working("drawing"):
        files = draw(result, capture, request)
    for file in files:
        click.echo(f"wrote {file}", err=True)


@main.command(epilog=example("tk report result.h5 CAPTURE"))
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.h5")
@click.argument("capture", type=click.Path(path_type=Path), required=False)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="PAGE.html", help="Page.  [default: beside RESULT.h5]"
)
@force_option
def report(result: Path, capture: Path | None, output: Path | None, force: bool) -> None:
    """Describe RESULT.h5 in one HTML page that needs no network.

    With CAPTURE it shows pictures, too.
    """
    from tk.report.page import report as write

    with working("writing the report"):
        file = write(result, capture, output, force)
    click.echo(f"wrote {file}", err=True)


@main.command(epilog=example("tk batch recordings/* -o results --workers 4"))
@click.argument("captures", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CAPTURE...")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="FOLDER")
@click.option("--workers", type=int, metavar="N", help="Captures at once on this machine.  [default: half the cores]")
@click.option("--scheduler", metavar="ADDRESS", help="Use the workers of this Dask scheduler: tcp://host:8786.")
@method_option
@voxels_option
@cameras_option
@frames_option
@seed_option
@masks_option
@body_option
@causal_option
@store_hull_option
@no_report_option
@preset_option
@config_option
@quiet_option
def batch(
    captures: tuple[Path, ...],
    output: Path,
    workers: int | None,
    scheduler: str | None,
    method: str,
    voxels: int | None,
    cameras: str | None,
    frames: str | None,
    seed: int | None,
    masks: str,
    body: Path | None,
    causal: bool,
    store_hull: bool,
    no_report: bool,
    preset: str | None,
    config_file: Path | None,
    quiet: bool,
) -> None:
    """Track many captures into FOLDER, with a summary; the same command again goes on where it stopped."""
    from tk.batch import TrackOptions, exit_code, run_batch
    from tk.batch.report import BatchReport

    config = configuration(config_file, preset, voxels=voxels, seed=seed)
    options = TrackOptions(
        method, frame_span(frames), listed(cameras), masks, body and body.resolve(), causal, store_hull, config
    )
    with BatchReport(quiet) as report:
        try:
            outcomes = run_batch(captures, output, options, report, workers, scheduler, not no_report)
        except KeyboardInterrupt:
            click.echo("tk: interrupted; the same command goes on where it stopped", err=True)
            sys.exit(1)
        except WorkerError as error:
            click.echo(f"tk: {error}", err=True)
            sys.exit(1)
    if not quiet:
        click.echo(f"the summary is in {output / 'summary.html'}", err=True)
    sys.exit(exit_code(outcomes))


@main.command(epilog=example("tk view walk.h5 --frame 40"))
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.h5")
@click.argument("capture", type=click.Path(path_type=Path), required=False)
@click.option("--frame", type=int, metavar="N", help="Frame to begin with.  [default: the first]")
@click.option("--screenshot", type=click.Path(path_type=Path), metavar="FILE.png", help="Draw it there, and close.")
def view(result: Path, capture: Path | None, frame: int | None, screenshot: Path | None) -> None:
    """Show RESULT.h5 in a window: body, joints, hull, cameras.

    CAPTURE adds its cameras, where the result has none, and its truth, where it has one.
    """
    from tk.view.window import view as show

    show(result, capture, frame, screenshot)


@main.command(epilog=example("tk demo"))
@click.option("-o", "--output", default="demo.h5", show_default=True, type=click.Path(path_type=Path))
@voxels_option
@resume_option
@force_option
@no_report_option
@quiet_option
def demo(output: Path, voxels: int | None, resume: bool, force: bool, no_report: bool, quiet: bool) -> None:
    """Track the capture that ships with tk and compare the result with its truth."""
    from importlib.resources import as_file, files

    with as_file(files("tk") / "data" / "demo") as folder:
        with Report(quiet) as report:
            report.stage("loading")
            from tk.evaluation.joints import evaluate_files
            from tk.io.captures.capture import open_capture
            from tk.io.results.files import check_output
            from tk.run import session

            check_output(output, force, resume)
            report.stage(f"opening the capture that ships with tk, {folder}")
            config = configuration(None, voxels=voxels)
            capture = open_capture(folder)
            summary = session.track(capture, output, config, report, resume=resume, force=force)
            if not no_report:
                _leave_pictures(capture, output, summary, report, quiet)
        if not summary.interrupted:
            click.echo(evaluate_files(output, folder / "truth.h5").format_table())
            click.echo(f"The result is in {output}. Try it on your own recording: tk track CAPTURE -o RESULT.h5")
        _tell(output, summary, quiet, as_json=False)


@main.command(epilog=example("tk config > settings.toml", "tk config --preset kehl2006"))
@preset_option
@config_option
def config(preset: str | None, config_file: Path | None) -> None:
    """Print all settings with what they mean, as TOML that --config takes."""
    from tk.commands.config_text import annotated_toml

    click.echo(annotated_toml(configuration(config_file, preset)), nl=False)
