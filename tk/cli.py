"""The commands: parse, call, print. Nothing is computed here."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tk import __version__
from tk.errors import CaptureError, ConfigError, TkError

if TYPE_CHECKING:
    from tk.config import Config

# The matrices here are small. A pool of BLAS threads beside Taichi's costs milliseconds for what takes microseconds; it
# has an effect only before NumPy is loaded, and the caller's own setting stands.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_CONSOLE = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def _one_line() -> Iterator[None]:
    """A user's mistake, in the input or in the command, becomes one line and exit code 2."""
    try:
        yield
    except TkError as error:
        click.echo(f"tk: {' '.join(str(error).split())}", err=True)
        raise click.exceptions.Exit(2) from None
    except click.UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # `tk` alone: the help
            raise
        command = error.ctx.command_path if error.ctx else "tk"
        click.echo(f"tk: {' '.join(error.format_message().split())} See {command} --help", err=True)
        raise click.exceptions.Exit(2) from None


class _Commands(click.Group):
    """Reports mistakes as :func:`_one_line` does."""

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with _one_line():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> object:
        with _one_line():
            return super().invoke(ctx)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="tk")
def main() -> None:
    """A person's motion out of a few ordinary, calibrated cameras: no markers, no GPU."""


_capture = click.argument("capture", type=click.Path(path_type=Path))
_cameras = click.option("--cameras", metavar="A,B,…", help="Use these cameras only.")
_frames = click.option("--frames", metavar="A:B", help="Frames A to B-1; either may be left out.")
_masks = click.option(
    "--masks", default="auto", show_default=True, metavar="auto|none|median|DIR",
    help="auto: the capture's masks, else its empty scene, else an installed segmenter; none: not its masks; "
    "median: over the recording, for the empty scene; DIR: a folder of masks.",
)  # fmt: skip
_voxels = click.option("--voxels", type=int, help="Voxels along the working volume's longest side.  [default: 64]")
_config = click.option("--config", "config_file", type=click.Path(path_type=Path), help="Settings, TOML.")
_preset = click.option("--preset", metavar="NAME", help="Settings to begin with: kehl2006, the paper's own; fast.")


@main.command()
@_capture
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="RESULT.h5")
@click.option(
    "--method",
    default="region",
    show_default=True,
    type=click.Choice(["region", "silhouette", "volumetric", "lm"]),
    help="The tracker: region; silhouette and volumetric, the two papers' own; lm, by Levenberg-Marquardt.",
)
@_voxels
@_cameras
@_frames
@click.option("--seed", type=int, help="Of the random generator.  [default: 0]")
@_masks
@click.option("--init-pose", type=click.Path(path_type=Path), metavar="FILE", help="Start from this rough pose (TOML).")
@click.option(
    "--body", type=click.Path(path_type=Path), metavar="FILE", help="The body of a result, or of a TOML file."
)
@click.option("--causal", is_flag=True, help="Leave it at the first pass: no frame knows of those after it.")
@click.option("--resume", is_flag=True, help="Go on where an earlier run of the same command stopped.")
@click.option("--store-hull", is_flag=True, help="Keep the hull's coloured surface in the result.")
@_preset
@_config
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
    store_hull: bool,
    preset: str | None,
    config_file: Path | None,
) -> None:
    """Track the person in CAPTURE and write the pose of every frame to RESULT.h5."""
    from tk import session  # the heavy imports wait until a command needs them
    from tk.io.capture import open_capture

    span = _span(frames)
    config = _configuration(config_file, preset, voxels=voxels, seed=seed)
    opened = open_capture(capture, _names(cameras), masks)
    with _Report() as report:
        summary = session.track(
            opened, output, config, report, method, span, init_pose, resume, store_hull, body, causal
        )
    rate = summary.tracked_now / summary.seconds if summary.seconds > 0 else 0.0
    if summary.frames:
        click.echo(f"{summary.frames} frames in {output}, {summary.lost} lost, {rate:.1f} frames/s", err=True)
    if summary.interrupted:
        further = "go on with the same command and --resume" if summary.frames else "no frame was finished"
        click.echo(f"tk: interrupted; {further}", err=True)
        sys.exit(1)


@main.command("import")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="CAPTURE")
@click.option(
    "--units", type=click.Choice(["m", "cm", "mm"]), help="Of the calibration's lengths.  [default: inferred]"
)
@click.option(
    "--trial", metavar="NAME", help="Take the videos with NAME in their path, where there are several trials."
)
def import_(folder: Path, output: Path, units: str | None, trial: str | None) -> None:
    """Make a capture of another tool's project: Pose2Sim, FreeMoCap, Caliscope, Anipose, EasyMocap and others.

    For example: tk import my_session -o my_capture
    """
    from tk.io.importers import import_project

    done = import_project(folder, output, units, trial)
    for note in done.notes:
        click.echo(f"note: {note}", err=True)
    click.echo(f"{done.cameras} cameras in {output}; have a look at {output / 'capture.toml'}", err=True)


@main.command()
@_capture
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="HULL.h5")
@click.option("--ply", type=click.Path(path_type=Path), metavar="DIR", help="Also write a PLY file a frame.")
@_voxels
@_cameras
@_frames
@_masks
@_config
def reconstruct(
    capture: Path,
    output: Path,
    ply: Path | None,
    voxels: int | None,
    cameras: str | None,
    frames: str | None,
    masks: str,
    config_file: Path | None,
) -> None:
    """Reconstruct the coloured surface of the visual hull in every frame of CAPTURE."""
    from tk import reconstruction
    from tk.io.capture import open_capture

    span = _span(frames)
    config = _configuration(config_file, voxels=voxels)
    opened = open_capture(capture, _names(cameras), masks)
    with _Report() as report:
        count = reconstruction.reconstruct(opened, output, config, report, span, ply)
    click.echo(f"{count} frames in {output}", err=True)


@main.command()
@_capture
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="DIR")
@click.option("--segmenter", metavar="NAME", help="Which one, where several are installed.")
@_cameras
@_frames
def masks(capture: Path, output: Path, segmenter: str | None, cameras: str | None, frames: str | None) -> None:
    """Let a segmenter make masks of CAPTURE's videos: DIR/CAMERA/000000.png, the person white.

    The same command goes on where it was stopped. Example: tk masks CAPTURE -o masks; tk track CAPTURE --masks masks
    """
    from tk import mask_folder
    from tk.io.capture import open_capture

    span = _span(frames)
    opened = open_capture(capture, _names(cameras), "none")
    with _Report() as report:
        written = mask_folder.write_masks(opened, output, report, segmenter, span)
    click.echo(f"masks of {written.frames} frames in {output}, {written.now} of them new", err=True)


@main.command()
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option(
    "--capture", type=click.Path(path_type=Path), metavar="DIR",
    help="Judge in the pictures, too: pixels and silhouettes.  [default: the folder of TRUTH.h5, if a capture]",
)  # fmt: skip
@click.option("--joints", default="ankle_l,ankle_r", show_default=True, help="Whose distance is told in pixels.")
@_masks
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def evaluate(result: Path, truth: Path, capture: Path | None, joints: str, masks: str, as_json: bool) -> None:
    """Compare RESULT.h5 with TRUTH.h5: joint distances, PCK, lost frames, frames/s; pixels and silhouettes by view."""
    import json

    from tk.evaluation import evaluate_files
    from tk.view_evaluation import capture_of, evaluate_views

    found = evaluate_files(result, truth)
    folder = capture or capture_of(truth)
    try:
        seen = evaluate_views(result, truth, folder, _names(joints) or (), masks) if folder else None
    except CaptureError as error:
        if capture is not None:
            raise
        click.echo(f"note: not judged in the pictures: {error}", err=True)
        seen = None
    if as_json:
        views = {"views": seen.to_dict()} if seen else {}
        click.echo(json.dumps(found.to_dict() | views, indent=2, allow_nan=False))
    else:
        click.echo(found.format_table() + (f"\n\n{seen.format_table()}" if seen else ""))


@main.command()
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.h5")
@click.option(
    "--to", "formats", required=True, metavar="A,B,…", help="Formats: trc, mot (OpenSim), c3d, bvh, csv, gltf (.glb)."
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="DIR", help="Folder.  [default: beside RESULT.h5]"
)
@click.option("--smoothed", is_flag=True, help="The smoothed copy, with short losses bridged.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
def export(result: Path, formats: str, output: Path | None, smoothed: bool, force: bool) -> None:
    """Write RESULT.h5 in formats of other programs. Example: tk export walk.h5 --to trc,mot,bvh"""
    from tk.io.export import export as write

    written = write(result, _names(formats) or (), output, smoothed, force)
    for note in written.notes:
        click.echo(f"note: {note}", err=True)
    for file in written.files:
        click.echo(f"wrote {file}", err=True)


@main.command()
@click.option("-o", "--output", default="demo.h5", show_default=True, type=click.Path(path_type=Path))
@_voxels
def demo(output: Path, voxels: int | None) -> None:
    """Track the capture that ships with tk and compare the result with its truth."""
    from importlib.resources import as_file, files

    from tk import session
    from tk.evaluation import evaluate_files
    from tk.io.capture import open_capture

    with as_file(files("tk") / "data" / "demo") as folder:
        click.echo(f"tracking the capture that ships with tk: {folder}", err=True)
        with _Report() as report:
            summary = session.track(open_capture(folder), output, _configuration(None, voxels=voxels), report)
        if summary.interrupted:
            sys.exit(1)
        click.echo(evaluate_files(output, folder / "truth.h5").format_table())
    click.echo(f"The result is in {output}. Try it on your own recording: tk track CAPTURE -o RESULT.h5")


def _names(cameras: str | None) -> tuple[str, ...] | None:
    return tuple(name.strip() for name in cameras.split(",") if name.strip()) if cameras else None


def _span(frames: str | None) -> tuple[int, int | None]:
    """``A:B`` as (A, B)."""
    if frames is None:
        return 0, None
    first, colon, last = frames.partition(":")
    try:
        start, stop = int(first) if first else 0, int(last) if last else None
        if not colon or start < 0 or (stop is not None and stop <= start):
            raise ValueError
    except ValueError:
        raise ConfigError(f"--frames {frames}: give A:B with 0 ≤ A < B, for example 0:100") from None
    return start, stop


def _configuration(file: Path | None, preset: str | None = None, **overrides: Any) -> Config:
    from dataclasses import replace

    from tk.config import Config

    base = Config.preset(preset) if preset else Config()
    config = Config.read(file, base) if file else base
    return replace(config, **{name: value for name, value in overrides.items() if value is not None})


class _Report:
    """Progress on stderr: a bar on a terminal, a plain line every few seconds elsewhere."""

    every_s = 2.0

    def __init__(self) -> None:
        self._bar: Progress | None = None
        self._lost = 0
        self._count = self._done = self._total = 0
        self._started = self._last = time.perf_counter()

    def __enter__(self) -> _Report:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def note(self, text: str) -> None:
        _CONSOLE.print(f"note: {text}", style="yellow", markup=False)

    def begin(self, total: int, done: int) -> None:
        self._total, self._done = total, done
        if done:
            self.note(f"{done} of {total} frames are there already")
        if _CONSOLE.is_terminal:
            columns = (
                TextColumn("tracking"), BarColumn(), MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"), TimeRemainingColumn(), TextColumn("{task.fields[lost]}"),
            )  # fmt: skip
            self._bar = Progress(*columns, console=_CONSOLE)
            self._task = self._bar.add_task("", total=total, completed=done, rate="", lost="")
            self._bar.start()
        self._started = self._last = time.perf_counter()

    def advance(self, frame: int, estimate: object) -> None:
        self._count += 1
        self._lost += getattr(estimate, "status", "") == "lost"
        now = time.perf_counter()
        rate = f"{self._count / max(now - self._started, 1e-9):.1f} frames/s"
        lost = f"{self._lost} lost" if self._lost else ""
        if self._bar is not None:
            self._bar.update(self._task, advance=1, rate=rate, lost=lost)
        elif now - self._last > self.every_s or self._done + self._count == self._total:
            self._last = now
            click.echo(f"frame {frame}: {self._done + self._count}/{self._total}, {rate} {lost}".rstrip(), err=True)
