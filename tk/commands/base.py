"""What the commands of :mod:`tk.cli` share: mistakes told in a line, options that several take, and what they mean."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tk.commands.console import Report
from tk.errors import ConfigError, TkError

if TYPE_CHECKING:
    from tk.settings import Settings


@contextmanager
def one_line() -> Iterator[None]:
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


@contextmanager
def working(on: str) -> Iterator[None]:
    """On a terminal, that something is done which has no frames to count."""
    with Report(quiet=not sys.stderr.isatty()) as report:
        report.stage(on)
        yield


class Commands(click.Group):
    """Reports mistakes as :func:`one_line` does."""

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with one_line():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> object:
        with one_line():
            return super().invoke(ctx)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Each command with the whole first sentence of its help; click's own cuts it off."""
        rows = [(name, command.get_short_help_str(limit=1000)) for name, command in sorted(self.commands.items())]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def example(*lines: str) -> str:
    """What a command's help ends with."""
    return "\b\n" + "\n".join(["Example:" if len(lines) == 1 else "Examples:", *(f"  {line}" for line in lines)])


capture_argument = click.argument("capture", type=click.Path(path_type=Path))
cameras_option = click.option("--cameras", metavar="A,B,…", help="Use these cameras only.")
frames_option = click.option("--frames", metavar="A:B", help="Frames A to B-1; either may be left out.")
masks_option = click.option(
    "--masks", default="auto", show_default=True, metavar="auto|none|median|DIR",
    help="auto: the capture's masks, else its empty scene, else an installed segmenter; none: not its masks; "
    "median: over the recording, for the empty scene; DIR: a folder of masks.",
)  # fmt: skip
voxels_option = click.option(
    "--voxels", type=int, help="Voxels along the working volume's longest side.  [default: 64]"
)
no_report_option = click.option("--no-report", is_flag=True, help="Leave out the overlay video and the report.")
config_option = click.option("--config", "config_file", type=click.Path(path_type=Path), help="Settings, TOML.")
preset_option = click.option("--preset", metavar="NAME", help="Settings to begin with: kehl2006, the paper's own.")
resume_option = click.option("--resume", is_flag=True, help="Go on where an earlier run of the same command stopped.")
force_option = click.option("--force", is_flag=True, help="Replace what exists under the output's name.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="No progress: only notes and errors.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print a summary for scripts on stdout.")
method_option = click.option(
    "--method",
    default="region",
    show_default=True,
    type=click.Choice(["region", "silhouette", "volumetric"]),
    help="The tracker: region; silhouette and volumetric, the two papers' own.",
)
seed_option = click.option("--seed", type=int, help="Of the random generator.  [default: 0]")
body_option = click.option(
    "--body", type=click.Path(path_type=Path), metavar="FILE", help="The body of a result, or of a TOML file."
)
causal_option = click.option(
    "--causal", is_flag=True, help="Leave it at the first pass: no frame knows of those after it."
)
store_hull_option = click.option("--store-hull", is_flag=True, help="Keep the hull's coloured surface in the result.")


def print_json(**values: object) -> None:
    import json

    click.echo(json.dumps(values, indent=2, allow_nan=False))


def listed(cameras: str | None) -> tuple[str, ...] | None:
    return tuple(name.strip() for name in cameras.split(",") if name.strip()) if cameras else None


def frame_span(frames: str | None) -> tuple[int, int | None]:
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


def configuration(file: Path | None, preset: str | None = None, **overrides: Any) -> Settings:
    from dataclasses import replace

    from tk.settings import Settings

    base = Settings.preset(preset) if preset else Settings()
    config = Settings.read(file, base) if file else base
    return replace(config, **{name: value for name, value in overrides.items() if value is not None})
