"""`tk view`."""

from __future__ import annotations

from pathlib import Path

import click

from tk.commands import base
from tk.errors import ConfigError, ResultError


@click.command(epilog=base.example("tk view walk.h5 --frame 40"))
@base.result_argument
@base.optional_capture_argument
@click.option("--frame", type=int, metavar="N", help="Frame to show first.  [default: the first]")
@click.option("--screenshot", type=base.PATH, metavar="FILE.png", help="Write an image of the frame, and close.")
@base.force_option
def view(result: Path, capture: Path | None, frame: int | None, screenshot: Path | None, force: bool) -> None:
    """Show RESULT.h5 in a window: bodies, joints, hull, cameras. Keys move through time and switch parts on and off.

    CAPTURE adds its cameras, if the result has none, and its ground truth, if it has one.
    """
    from tk.io.captures.capture import open_capture
    from tk.io.paths import PNG, check_output
    from tk.io.results.reader import read_result, truth_of
    from tk.render.people import People
    from tk.view.contents import Contents
    from tk.view.window import Window, require_display

    people = People(read_result(result).people)
    loaded = people.first
    if not len(loaded):
        raise ResultError(f"{result}: has no frames")
    known = loaded.frames.tolist()
    if frame is not None and frame not in known:
        raise ConfigError(f"--frame {frame}: the result has frames {min(known)} to {max(known)}")
    if screenshot is not None:
        check_output(screenshot, PNG, force, [result], capture)
    rig = loaded.cameras.rig if loaded.cameras else None
    truth = None
    if capture is not None:
        opened = open_capture(capture, None, "none", loaded.resampled)
        rig, truth = rig or opened.rig, truth_of(loaded, opened.truth_file)
    require_display()
    window, row = Window(Contents(people, rig, truth)), 0 if frame is None else known.index(frame)
    if screenshot is not None:
        window.save(row, screenshot)
    else:
        window.run(row)
