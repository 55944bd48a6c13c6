"""`tk sync`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tk.commands import base
from tk.commands.console import ConsoleReporter
from tk.errors import ConfigError

if TYPE_CHECKING:
    from tk.synchronise.run import Synchronised


def _offsets(ctx: click.Context, option: click.Parameter, text: str | None) -> dict[str, float] | None:
    """Return the offsets in ``a=0,b=1.37``, seconds by camera; None if the option is not given."""
    if text is None:
        return None
    found: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = part.strip().rpartition("=")
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not (name and equals and math.isfinite(seconds)) or name in found:
            raise ConfigError(f"--offsets {text}: give seconds for each camera once, for example a=0,b=1.37")
        found[name] = seconds
    return found


def _part(ctx: click.Context, option: click.Parameter, text: str | None) -> tuple[float, float] | None:
    """Return the seconds in ``3:8``; None if the option is not given."""
    if text is None:
        return None
    begin, colon, end = text.partition(":")
    try:
        part = float(begin), float(end)
        if not colon or not all(map(math.isfinite, part)) or part[0] >= part[1]:
            raise ValueError
    except ValueError:
        raise ConfigError(f"{option.opts[0]} {text}: give begin and end in seconds, for example 3:8") from None
    return part


@click.command(
    epilog=base.example(
        "tk sync RAW -o CAPTURE",
        "tk sync RAW -o CAPTURE --empty 3:8 --from 10",
        "tk sync RAW -o CAPTURE --offsets a=0,b=1.37",
    )
)
@click.argument("raw", type=base.PATH, metavar="RAW")
@click.option("-o", "--output", type=base.PATH, required=True, metavar="CAPTURE", help="Folder of the capture.")
@base.names_option("--by", help="Use these methods only: sound, flash, person, timecode.")
@click.option("--offsets", metavar="A=0,B=1.37", callback=_offsets, help="Offsets by hand, seconds, of all cameras.")
@click.option("--from", "begin", type=float, metavar="S", help="Begin here: seconds of the first camera's video.")
@click.option("--to", "end", type=float, metavar="S", help="End the capture here.")
@click.option("--empty", metavar="A:B", callback=_part, help="The scene is empty here, seconds.  [default: found]")
@click.option("--fps", type=float, metavar="HZ", help="Rate of the capture.  [default: that of the slowest camera]")
@base.cameras_option
@base.force_option
@base.quiet_option
@base.json_option
def sync(raw: Path, output: Path, **given: Any) -> None:
    """Synchronise the videos in RAW and write CAPTURE, which refers to them: no video is copied or encoded.

    RAW has one video, or one folder of chapters, per camera, and a calibration.toml if there is one already.
    """
    with ConsoleReporter(given["quiet"], stage="reading the videos") as reporter:
        from tk.synchronise.capture_file import check_capture, write_capture
        from tk.synchronise.decide import refused
        from tk.synchronise.raw import read_cameras, read_raw
        from tk.synchronise.run import METHODS, by_hand, synchronise
        from tk.synchronise.sheet import fastest_instants, write_sheet
        from tk.synchronise.text import chosen_span, empty_part, table, to_dict, without_empty
        from tk.threads import one_thread

        methods = given["by"] or METHODS
        for method in methods:
            if method not in METHODS:
                raise ConfigError(f"--by {method}: must be one of {', '.join(METHODS)}")
        fps = given["fps"]
        if fps is not None and not 0.1 <= fps <= 1000:
            raise ConfigError(f"--fps {fps:g}: must be between 0.1 and 1000")
        if None not in (given["begin"], given["end"]) and given["begin"] >= given["end"]:
            raise ConfigError(f"--from {given['begin']:g} --to {given['end']:g}: ends before it begins")
        check_capture(output, raw, given["force"])
        empty_known = (output / "background").is_dir()
        if empty_known and given["empty"]:
            raise ConfigError(f"--empty: {output} has background/ of its own; remove one of them")
        recordings = read_raw(raw, given["cameras"])
        calibration, cameras = read_cameras(raw, recordings)
        with one_thread():
            if given["offsets"] is not None:
                done = by_hand(recordings, given["offsets"], given["begin"])
            else:
                done = synchronise(recordings, cameras, methods, given["begin"], reporter.stage)
            if done.decision.unsure or done.decision.faulty:
                _print(done, given["as_json"])
                raise refused(recordings, done.decision)
            for line in done.decision.notes:
                reporter.note(line)
            span = chosen_span(done, given["begin"], given["end"])
            empty = None if empty_known else empty_part(done, given["empty"])
            span = without_empty(span, empty, given["begin"], given["end"])
        write_capture(output, recordings, done.clocks, fps, span, empty, calibration)
        write_sheet(output / "sync.png", recordings, done.clocks, fastest_instants(done.looks, done.clocks, span))
    fps = fps or done.fps
    if given["as_json"]:
        base.print_json(**to_dict(done), **{"from": span[0], "to": span[1]}, fps=fps, empty=empty)
    else:
        click.echo(table(done))
        scene = "in background/" if empty_known else "none found"
        if empty is not None:
            scene = f"{empty[0]:.2f} s to {empty[1]:.2f} s"
        click.echo(
            f"capture: {span[0]:.2f} s to {span[1]:.2f} s of {recordings[0].name}, {fps:.5g} frames/s; "
            f"empty scene: {scene}"
        )
    click.echo(f"wrote {output / 'capture.toml'} and {output / 'sync.png'}: look at it", err=True)


def _print(done: Synchronised, as_json: bool) -> None:
    from tk.synchronise.text import table, to_dict

    if as_json:
        base.print_json(**to_dict(done))
    else:
        click.echo(table(done))
