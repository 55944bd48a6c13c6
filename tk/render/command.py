"""What `tk render` does: a video, or contact sheets, of a result."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tk.errors import ConfigError, ResultError
from tk.io.captures.capture import Capture, open_capture
from tk.io.results.writer import Result, read_result
from tk.render.files import check_target
from tk.render.overlay import Overlay, write_sheets
from tk.render.scene import Scene
from tk.render.video import check_encoder, video_writer
from tk.threads import one_thread

VIEWS = ("overlay", "3d", "hull")


@dataclass(frozen=True)
class Request:
    """What is to be drawn.

    Attributes:
        view: one of :data:`VIEWS`; None for the overlay where there is a capture, else the 3D view.
        output: the video; beside the result by default.
        sheets: a folder for contact sheets in the place of a video.
        frames: "A:B" (either may be left out) or "A,B,…", source frames; None for all, or for eight on sheets.
        cameras: names of those that are shown; all by default.
        full: whole pictures, not the part of each that holds the person.
        force: replace a video that exists.
    """

    view: str | None = None
    output: Path | None = None
    sheets: Path | None = None
    frames: str | None = None
    cameras: Sequence[str] | None = None
    full: bool = False
    force: bool = False


@one_thread()
def render(result_path: Path, capture_path: Path | None, request: Request) -> list[Path]:
    """Draw a result; the files that were written.

    Raises:
        TkError: the result or the capture cannot be used, do not belong together, or a file cannot be written.
    """
    result = read_result(result_path)
    if not len(result):
        raise ResultError(f"{result_path}: has no frames")
    frames = _frames(request.frames, result.frames.tolist())
    view = request.view or ("overlay" if capture_path else "3d")
    capture = None if capture_path is None else open_capture(capture_path, request.cameras, masks="none")
    if request.sheets is not None:
        if view != "overlay" or capture is None:
            raise ConfigError(
                "--png: sheets show the pictures of a capture; give RESULT.h5 CAPTURE and no other --view"
            )
        return write_sheets(Overlay(capture, result), request.sheets, frames, full=request.full)
    ending = ".mp4" if view == "overlay" else f"-{view}.mp4"
    output = request.output or result_path.with_name(result_path.stem + ending)
    if output.suffix.lower() != ".mp4":
        raise ConfigError(f"-o {output}: a video is an .mp4; for pictures give --png DIR")
    check_target(output, request.force)
    check_encoder()
    if view == "overlay":
        if capture is None:
            raise ConfigError(f"--view overlay: needs the pictures, too: tk render {result_path} CAPTURE")
        _write_overlay(Overlay(capture, result, full=request.full), frames, output)
    else:
        _write_scene(result, capture, view, frames, output)
    return [output]


def _frames(text: str | None, known: Sequence[int]) -> list[int]:
    """The frames that ``--frames`` asks for; none if it is left out."""
    if text is None:
        return []
    span = re.fullmatch(r"(\d{0,9}):(\d{0,9})", text)
    if span is not None:
        first, stop = int(span[1] or 0), int(span[2] or 10**9)
        chosen = [frame for frame in known if first <= frame < stop]
        if chosen:
            return chosen
        raise ConfigError(f"--frames {text}: the result has no such frames; it has {min(known)} to {max(known)}")
    if re.fullmatch(r"\d{1,9}(,\d{1,9})*", text) is None:
        raise ConfigError(f"--frames {text}: give A:B, for example 0:100, or single frames, for example 0,20,40")
    return [int(number) for number in text.split(",")]


def _write_overlay(overlay: Overlay, frames: Sequence[int], output: Path) -> None:
    chosen = overlay.chosen(frames, len(overlay.figure.frames))
    with video_writer(output, overlay.capture.fps) as add:
        for frame, images in overlay.pictures(chosen):
            add(overlay.mosaic(frame, images))


def _write_scene(result: Result, capture: Capture | None, view: str, frames: Sequence[int], output: Path) -> None:
    scene = Scene(result, capture.rig if capture and not result.cameras else None, hull=view == "hull")
    rows = scene.rows(frames)
    with video_writer(output, result.meta.fps) as add:
        for row in rows:
            add(scene.picture(row))
