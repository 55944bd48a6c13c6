"""`tk render`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import click

from tk.commands import base
from tk.errors import ConfigError, ResultError


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
    cameras: str | None,
    frames: str | None,
    png: Path | None,
    full: bool,
    force: bool,
) -> None:
    """Draw RESULT.h5 as a video: over the images of CAPTURE, or in 3D."""
    with base.working("drawing"):
        from tk.threads import one_thread

        with one_thread():
            files = _render(result, capture, output, view, base.split_names(cameras), frames, png, full, force)
    for file in files:
        click.echo(f"wrote {file}", err=True)


def _render(
    result_path: Path,
    capture_path: Path | None,
    output: Path | None,
    view: str | None,
    cameras: Sequence[str] | None,
    frames: str | None,
    png: Path | None,
    full: bool,
    force: bool,
) -> list[Path]:
    """Write the files and return their paths."""
    from tk.io.captures.capture import open_capture
    from tk.io.paths import check_not_input, check_output
    from tk.io.results.reader import read_result
    from tk.render.overlay import Overlay, choose_frames, write_sheets
    from tk.render.scene import Scene
    from tk.render.video import VIDEO, check_encoder, video_writer

    result = read_result(result_path)
    if not any(map(len, result.people)):
        raise ResultError(f"{result_path}: has no frames")
    chosen = _parse_frames(frames, result.aligned()[0].frames.tolist())
    view = view or ("overlay" if capture_path else "3d")
    capture = None if capture_path is None else open_capture(capture_path, cameras, "none", result.resampled)
    if png is not None:
        if view != "overlay" or capture is None:
            raise ConfigError("--png: contact sheets need images; give RESULT.h5 CAPTURE and no other --view")
        check_not_input(png, [result_path], capture_path)
        return write_sheets(Overlay(capture, result), png, chosen, full=full)
    output = output or result_path.with_name(result_path.stem + (".mp4" if view == "overlay" else f"-{view}.mp4"))
    check_output(output, VIDEO, force, [result_path], capture_path)
    check_encoder()
    if view != "overlay":
        scene = Scene(result, capture.rig if capture and not result.cameras else None, hull=view == "hull")
        rows = scene.rows(chosen)
        with video_writer(output, result.meta.fps) as add:
            for row in rows:
                add(scene.picture(row))
    elif capture is None:
        raise ConfigError(f"--view overlay: needs the images: tk render {result_path} CAPTURE")
    else:
        overlay = Overlay(capture, result, full=full)
        shown = choose_frames(overlay.people[0], chosen, len(overlay.row_of))
        with video_writer(output, capture.fps) as add:
            for frame, images in overlay.pictures(shown):
                add(overlay.mosaic(frame, images))
    return [output]


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
