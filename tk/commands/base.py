"""What several commands share: options, settings, and error messages in one line."""

from __future__ import annotations

import errno
import io
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from tk.commands.console import ConsoleReporter
from tk.errors import ConfigError, TkError
from tk.system.signals import request_as_interrupt

if TYPE_CHECKING:
    from tk.run.task import Choice, RecordingOptions
    from tk.settings import Settings


#: errors of the system about a path that no file can have, or that this user may not use; its first use fails
_UNUSABLE = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM)
#: characters of such a path that a message shows
_SHOWN = 100


def exit_with(code: int, line: str = "") -> NoReturn:
    """End the command with this exit code, after a line on stderr if there is one."""
    if line:
        click.echo(f"tk: {line}", err=True)
    raise SystemExit(code) from None


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Print a user's mistake as one line and exit with 2; with 1 after an interruption or if a disk is full."""
    try:
        with request_as_interrupt():
            yield
    except TkError as error:
        exit_with(error.exit_code, error.line)
    except OSError as error:
        if error.errno not in _UNUSABLE or error.filename is None:
            raise
        exit_with(2, f"{str(error.filename)[:_SHOWN]}: {error.strerror}")
    except KeyboardInterrupt as reason:
        exit_with(1, f"interrupted{f'; {reason}' if str(reason) else ''}")
    except click.UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # `tk` alone prints the help
            raise
        command = error.ctx.command_path if error.ctx else "tk"
        exit_with(2, f"{' '.join(error.format_message().split())} See {command} --help")


class Commands(click.Group):
    """A group of commands that reports mistakes as :func:`errors_in_one_line` does."""

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):  # characters outside its encoding, as in a path, are escaped
                stream.reconfigure(errors="backslashreplace")
        with errors_in_one_line():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> object:
        with errors_in_one_line():
            return super().invoke(ctx)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List each command with the whole first sentence of its help; click itself would cut it off."""
        shown = sorted((name, command) for name, command in self.commands.items() if not command.hidden)
        rows = [(name, command.get_short_help_str(limit=1000)) for name, command in shown]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def working(stage: str) -> ConsoleReporter:
    """Return a reporter that shows that work without countable frames goes on."""
    return ConsoleReporter(stage=stage, patient=True)


def print_json(**values: object) -> None:
    """Print values as a JSON object on stdout."""
    click.echo(json.dumps(values, indent=2, allow_nan=False))


def print_lines(prefix: str, lines: Iterable[object]) -> None:
    """Print lines on stderr, each after the prefix."""
    for line in lines:
        click.echo(f"{prefix}{line}", err=True)


def example(*lines: str) -> str:
    """Return the epilogue of a command's help."""
    return "\b\n" + "\n".join(["Example:" if len(lines) == 1 else "Examples:", *(f"  {line}" for line in lines)])


#: names of cameras or joints; None if the option is not given
Names = tuple[str, ...] | None
#: first frame, and the one after the last; None: to the end
Span = tuple[int, int | None]


def _split(ctx: click.Context, option: click.Parameter, names: str | None) -> Names:
    """Return the names in ``A,B,…``; None if the option is not given."""
    if names is None:
        return None
    if not (given := tuple(name.strip() for name in names.split(",") if name.strip())):
        raise ConfigError(f"{option.opts[0]} {names!r}: give names, with commas between them")
    return given


def _span(ctx: click.Context, option: click.Parameter, frames: str | None) -> Span:
    """Return (A, B) from ``A:B``; (0, None), all frames, from None."""
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


def _people(ctx: click.Context, option: click.Parameter, people: str) -> Choice:
    """Return who is tracked."""
    from tk.run.task import parse_choice

    return parse_choice(people)


PATH = click.Path(path_type=Path)

capture_argument = click.argument("capture", type=PATH)
optional_capture_argument = click.argument("capture", type=PATH, required=False)
result_argument = click.argument("result", type=PATH, metavar="RESULT.h5")
names_option = partial(click.option, metavar="A,B,…", callback=_split)
cameras_option = names_option("--cameras", help="Use these cameras only.")
frames_option = click.option("--frames", metavar="A:B", callback=_span, help="Frames A to B-1; A or B may be omitted.")
masks_option = click.option(
    "--masks", default="auto", show_default=True, metavar="auto|none|median|DIR",
    help="auto: the capture's masks, else its empty scene, else an installed segmenter; none: ignore the capture's "
    "masks; median: segment against the median image of the recording; DIR: a folder of masks.",
)  # fmt: skip
voxels_option = click.option("--voxels", type=int, help="Voxels along the longest side of the volume.  [default: 64]")
no_report_option = click.option("--no-report", is_flag=True, help="Write no overlay video and no report.")
config_option = click.option("--config", "config_file", type=PATH, help="Settings file (TOML).")
preset_option = click.option(
    "--preset", metavar="NAME", help="Settings to start from: kehl2006, the volumetric tracker without its limb search."
)
resample_option = click.option(
    "--resample", is_flag=True, default=None, help="Choose images by time stamps: cameras of different rates."
)
resume_option = click.option("--resume", is_flag=True, help="Continue an interrupted run of the same command.")
force_option = click.option("--force", is_flag=True, help="Replace existing output.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Show no progress, only notes and errors.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print the results as JSON on stdout.")


_TRACKING_OPTIONS = (
    click.option(
        "--method", default="region", show_default=True,
        type=click.Choice(["region", "silhouette", "volumetric"]),
        help="Tracker: region; silhouette and volumetric are those of the two papers.",
    ),
    voxels_option,
    cameras_option,
    frames_option,
    click.option("--seed", type=int, help="Seed of the random candidate poses.  [default: 0]"),
    masks_option,
    click.option(
        "--landmarks", type=click.Choice(["auto", "always", "never"]),
        help="Use the joints that a network sees: auto: where silhouettes leave a limb open; always: in all frames; "
        "never.  [default: auto]",
    ),
    click.option("--body", type=PATH, metavar="FILE", help="Use the body of a result (.h5) or of a TOML file."),
    click.option(
        "--people", default="auto", show_default=True, metavar="auto|all|N,M", callback=_people,
        help="Whom to track: auto: one person; all: everybody; N,M: by the numbers of tk inspect.",
    ),
    click.option("--causal", is_flag=True, help="Run the first pass only: no frame depends on later frames."),
    click.option("--store-hull", is_flag=True, help="Store the coloured surface of the visual hull in the result."),
    resample_option,
    preset_option,
    config_option,
)  # fmt: skip


def tracking_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that `tk track` and `tk batch` share to a command, which gives them to
    :func:`recording_options`."""
    for option in reversed(_TRACKING_OPTIONS):
        command = option(command)
    return command


def recording_options(
    config_file: Path | None,
    preset: str | None,
    voxels: int | None,
    seed: int | None,
    resample: bool | None,
    landmarks: str | None,
    **others: Any,
) -> RecordingOptions:
    """Return the options of a run as given on the command line; those that are not settings have the names of
    :class:`tk.run.task.RecordingOptions`.

    Raises:
        ConfigError: the settings cannot be read.
    """
    from tk.run.task import RecordingOptions

    settings = load_settings(config_file, preset, voxels=voxels, seed=seed, resample=resample, landmarks=landmarks)
    return RecordingOptions(settings, **others)


def load_settings(file: Path | None, preset: str | None = None, **overrides: Any) -> Settings:
    """Return the settings of a preset, changed by a file, changed by options that are not None."""
    from tk.io import settings_file
    from tk.settings import Settings

    base = settings_file.preset(preset) if preset else Settings()
    settings = settings_file.read(file, base) if file else base
    return replace(settings, **{name: value for name, value in overrides.items() if value is not None})
