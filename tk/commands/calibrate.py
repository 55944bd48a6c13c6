"""`tk calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter
from tk.errors import CalibrationError, ConfigError

_DEFAULT_OUTPUT = Path("calibration.toml")
#: tk.calibration.boards.KINDS, without its imports
_BOARDS = ("charuco", "chessboard", "circles", "aprilgrid")
#: the options of each way to calibrate, by their Python names
_OF_BOARD = ("board", "size", "marker", "dictionary")
_OF_WAY = {
    "a board": {
        *_OF_BOARD, "square", "model", "instants", "floor", "intrinsics", "page", "cameras", "output", "force", "quiet",
        "as_json",
    },
    "--print": {*_OF_BOARD, "square", "paper", "force", "quiet"},
    "--refine": {"focal", "offsets", "trust", "cameras", "masks", "config_file", "output", "force", "quiet"},
    "--level": {"masks", "resample", "config_file", "quiet"},
}  # fmt: skip


@click.command(
    epilog=base.example(
        "tk calibrate --print board.pdf --paper A3",
        "tk calibrate BOARDS --square 0.055 -o CAPTURE/calibration.toml",
        "tk calibrate CAPTURE --refine result.h5 -o refined.toml",
        "tk calibrate CAPTURE --level",
    )
)
@click.argument("folder", type=base.PATH, required=False, metavar="BOARDS|CAPTURE")
@click.option("-o", "--output", type=base.PATH, metavar="FILE", help="New calibration.  [default: calibration.toml]")
@click.option("--board", type=click.Choice(_BOARDS), default="charuco", show_default=True, help="Kind of board.")
@click.option(
    "--square", type=float, metavar="M", help="Measured side of a square, metres (circles: between two rows)."
)
@click.option("--size", metavar="7x5", help="Columns and rows of squares, circles or tags.  [default: that of --print]")
@click.option(
    "--marker", type=float, metavar="SHARE", help="Marker's side, of a square's; aprilgrid: gap.  [0.75; 0.3]"
)
@click.option("--dictionary", metavar="NAME", help="Markers of the board.  [default: 4x4_50; apriltag_36h11]")
@click.option(
    "--model", type=click.Choice(["pinhole5", "pinhole8", "fisheye"]), help="Lens model.  [default: by held-out views]"
)
@click.option("--instants", type=click.IntRange(3), metavar="N", help="Use N instants at most.  [default: 120]")
@click.option(
    "--floor", type=int, metavar="N", help="Instant in which the board lies on the floor.  [default: recognised]"
)
@click.option("--intrinsics", type=base.PATH, metavar="FILE", help="Take the intrinsics from an earlier calibration.")
@click.option("--report", "page", type=base.PATH, metavar="PAGE.html", help="Page.  [default: next to the calibration]")
@click.option("--print", "sheet", type=base.PATH, metavar="PDF", help="Write the board to print, and stop.")
@click.option(
    "--paper", type=click.Choice(["A4", "A3", "A2", "A1", "A0"]), default="A4", show_default=True, help="For --print."
)
@click.option(
    "--refine", "result", type=base.PATH, metavar="RESULT.h5", help="Refine CAPTURE's calibration by a result."
)
@click.option("--focal", is_flag=True, help="With --refine: also refine the focal lengths.")
@click.option("--offsets/--no-offsets", default=True, show_default=True, help="With --refine: estimate time offsets.")
@click.option(
    "--trust", type=float, default=1.0, show_default=True,
    help="With --refine: expected error of the calibration; 1 means about 0.3° and 12 mm.",
)  # fmt: skip
@click.option("--level", is_flag=True, help="Estimate the up direction from the person, and write it to capture.toml.")
@base.cameras_option
@base.masks_option
@base.resample_option
@base.config_option
@base.force_option
@base.quiet_option
@base.json_option
@click.pass_context
def calibrate(ctx: click.Context, folder: Path | None, **given: Any) -> None:
    """Calibrate cameras with a printed board: BOARDS has a video or a folder of pictures of each camera.

    With --refine or --level, correct the calibration of CAPTURE with a person. Pictures with the same number, or frames
    with the same index, show the same instant.
    """
    names = {"--print": "sheet", "--refine": "result", "--level": "level"}
    asked = [option for option, name in names.items() if given[name]]
    if len(asked) > 1:
        raise ConfigError(f"{' and '.join(asked)}: give one of them")
    way = asked[0] if asked else "a board"
    _check_options(ctx, way)
    if way == "--print":
        _print(given)
        return
    if folder is None:
        raise ConfigError("give the folder BOARDS, or --print board.pdf. See tk calibrate --help")
    {"a board": _calibrate, "--refine": _refine, "--level": _level}[way](folder, given)


def _check_options(ctx: click.Context, way: str) -> None:
    """Raise an error if an option was given that has no meaning."""
    from click.core import ParameterSource

    selecting = {"folder", "sheet", "result", "level"}
    for parameter in ctx.command.params:
        name = parameter.name or ""
        if name not in selecting | _OF_WAY[way] and ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            others = " or ".join(other for other, names in _OF_WAY.items() if name in names)
            raise ConfigError(f"{parameter.opts[0]}: has no meaning with {way}, only with {others}")


def _print(given: dict[str, Any]) -> None:
    from tk.calibration.boards import make_board
    from tk.calibration.sheet import fitted_square_m, write_sheet

    kind = (given["board"], given["size"])
    marks = (given["marker"], given["dictionary"])
    square = given["square"]
    if square is None:
        square = fitted_square_m(*kind, given["paper"], *marks)
    board = make_board(*kind, square, *marks)
    write_sheet(given["sheet"], board, given["paper"], given["force"])
    click.echo(
        f"wrote {given['sheet']}: {board.title}, {1000 * square:g} mm on {given['paper']}; print at 100 %, measure, "
        f"and give it as --square (here {square:g})",
        err=True,
    )


def _calibrate(folder: Path, given: dict[str, Any]) -> None:
    output = given["output"] or _DEFAULT_OUTPUT
    with ConsoleReporter(given["quiet"], stage="loading") as reporter:
        from tk.calibration.boards import make_board
        from tk.calibration.files import check_calibration, read_intrinsics, write_calibration
        from tk.calibration.footage import read_footage
        from tk.calibration.page import PAGE, build_page, summary, write_page
        from tk.calibration.rig import MOST_INSTANTS, Options, calibrate
        from tk.calibration.text import table
        from tk.calibration.verdict import judge
        from tk.io.paths import check_output
        from tk.threads import one_thread

        if given["square"] is None:
            raise ConfigError("give --square: the measured side of a printed square, metres, for example 0.036")
        board = make_board(given["board"], given["size"], given["square"], given["marker"], given["dictionary"])
        page = given["page"] or output.with_suffix(".html")
        check_calibration(output, given["force"], [folder, given["intrinsics"]])
        # the page of a calibration that was not written is replaced
        check_output(page, PAGE, given["force"] or not output.exists(), [folder], error=CalibrationError)
        options = Options(
            given["model"], given["instants"] or MOST_INSTANTS, given["floor"], read_intrinsics(given["intrinsics"])
        )
        footages, board = read_footage(folder, board, given["cameras"], reporter.stage, reporter.note)
        with one_thread():
            done = calibrate(footages, board, options, reporter.stage)
            verdict = judge(done)
        write_page(page, build_page(done, verdict, f"{folder.name}: {output.name}"))
        for line in (*verdict.notes, *(f"{text}" for level, text in verdict.reasons if level < 2)):
            reporter.note(line)
    if given["as_json"]:
        base.print_json(**verdict.to_dict())
    if verdict.level == 2:
        reasons = "; ".join(text for level, text in verdict.reasons if level == 2)
        raise CalibrationError(f"do not use: {reasons}; {output} is not written, see {page}")
    write_calibration(output, done, verdict)
    if not given["as_json"]:
        click.echo(table(verdict))
        click.echo(f"{verdict.word}: {summary(done, verdict)}")
    click.echo(f"wrote {output} and {page}", err=True)


def _refine(folder: Path, given: dict[str, Any]) -> None:
    from tk.commands.refined import refine

    if given["output"] is None:
        raise ConfigError("give -o: the new calibration's file, for example refined.toml")
    refine(
        folder, given["result"], given["output"], given["focal"], given["offsets"], given["trust"], given["cameras"],
        given["masks"], given["config_file"], given["force"], given["quiet"],
    )  # fmt: skip


def _level(folder: Path, given: dict[str, Any]) -> None:
    with base.working(f"inspecting {folder}"):
        from tk.inspection.checks import inspect as check
        from tk.inspection.leveling import write_up
        from tk.io.importers import open_recording
        from tk.model.cameras.up import shown

        settings = base.load_settings(given["config_file"], resample=given["resample"])
        found, _ = check(open_recording(folder, None, given["masks"], settings.resample), settings, pictures=0)
        write_up(folder, found.leveling)
    click.echo(f"up = {shown(found.leveling.up)} in {folder / 'capture.toml'}: {found.leveling.how}")
