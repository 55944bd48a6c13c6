"""`tk render`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tk.commands import base
from tk.errors import ConfigError, ResultError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@click.command(epilog=base.example("tk render result.h5 CAPTURE", "tk render result.h5 --view 3d -o turning.mp4"))
@base.result_argument
@base.optional_capture_argument
@click.option("-o", "--output", type=base.PATH, metavar="OUT.mp4", help="Video.  [default: next to RESULT.h5]")
@click.option(
    "--view", type=click.Choice(["overlay", "3d", "hull"]),
    help="overlay: over the images; 3d: from a virtual camera that turns around the person; hull: 3d with the stored "
    "hull.  [default: overlay with CAPTURE, else 3d]",
)  # fmt: skip
@base.cameras_option
@click.option("--frames", metavar="A:B|A,B,…", help="Frames A to B-1, or single frames.")
@click.option("--png", type=base.PATH, metavar="DIR", help="Write contact sheets instead of a video.")
@click.option("--full", is_flag=True, help="Show whole images, not only the part with the person.")
@base.force_option
def render(
    result: Path,
    capture: Path | None,
    output: Path | None,
    view: str | None,
    cameras: base.Names,
    frames: str | None,
    png: Path | None,
    full: bool,
    force: bool,
) -> None:
    """Draw RESULT.h5 as a video: over the images of CAPTURE, or in 3D."""
    with base.working("drawing"):
        from tk.io.captures.capture import open_capture
        from tk.io.paths import check_output
        from tk.io.results.reader import read_result
        from tk.render.overlay import Overlay, write_sheets
        from tk.render.scene import Scene
        from tk.render.video import VIDEO, check_encoder, video_writer
        from tk.threads import one_thread

        loaded = read_result(result)
        if not any(map(len, loaded.people)):
            raise ResultError(f"{result}: has no frames")
        chosen = _parse_frames(frames, loaded.frames.tolist())
        view = view or ("overlay" if capture else "3d")
        opened = None if capture is None else open_capture(capture, cameras, "none", loaded.resampled)
        if png is not None and (view != "overlay" or opened is None):
            raise ConfigError("--png: contact sheets need images; give RESULT.h5 CAPTURE and no other --view")
        output = output or result.with_name(result.stem + (".mp4" if view == "overlay" else f"-{view}.mp4"))
        if png is None:
            check_output(output, VIDEO, force, [result], capture)
            check_encoder()
        if view == "overlay" and opened is None:
            raise ConfigError(f"--view overlay: needs the images: tk render {result} CAPTURE")
        files, fps = [output], loaded.meta.fps
        images: Iterator[NDArray[np.uint8]] = iter(())
        with one_thread():
            if view != "overlay" or opened is None:
                scene = Scene(loaded, opened.rig if opened and not loaded.cameras else None, hull=view == "hull")
                images = map(scene.picture, scene.rows(chosen))
            else:
                overlay, fps = Overlay(opened, loaded, full=full), opened.fps
                if png is None:
                    shown = overlay.pictures(overlay.people.chosen(chosen))
                    images = (overlay.mosaic(frame, seen) for frame, seen in shown)
                else:
                    files = write_sheets(overlay, png, chosen, full, force)
            if png is None:
                with video_writer(output, fps) as add:
                    for image in images:
                        add(image)
    base.print_lines("wrote ", files)


def _parse_frames(text: str | None, known: Sequence[int]) -> list[int]:
    """Return the frames that ``--frames`` names; [] if it is not given."""
    if text is None:
        return []
    span = re.fullmatch(r"(\d{0,9}):(\d{0,9})", text)
    if span is not None:
        first, stop = int(span[1] or 0), int(span[2] or 10**9)
        chosen = [frame for frame in known if first <= frame < stop]
        if chosen:
            return chosen
        raise ConfigError(f"--frames {text}: not in the result, which has frames {min(known)} to {max(known)}")
    if re.fullmatch(r"\d{1,9}(,\d{1,9})*", text) is None:
        raise ConfigError(f"--frames {text}: give A:B, for example 0:100, or single frames, for example 0,20,40")
    return [int(number) for number in text.split(",")]
