"""The overlay video and the report that `tk track` writes next to a result, from images that the run has kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tk.errors import TkError
from tk.io.captures.capture import Capture
from tk.io.captures.clip import Image
from tk.io.captures.film import Film, filmed
from tk.io.paths import check_output
from tk.io.results.reader import read_result
from tk.render.overlay import Overlay, sizes_shown
from tk.render.video import VIDEO, check_encoder, video_writer
from tk.report.page import PAGE, build_page, write_page
from tk.report.pictures import choose_rows, embedded, shot
from tk.threads import one_thread

# Width of the video, pixels. Every run pays the time for it; `tk render` makes a larger video of all images.
_WIDEST = 960


def film_for(capture: Capture, result_path: Path) -> Film | None:
    """Return a film for the images that :func:`write_video_and_report` shows; None if it finds no place."""
    return Film.in_folder(result_path.absolute().parent, sizes_shown(capture, _WIDEST), capture.late_frames)


def write_video_and_report(
    capture: Capture, result_path: Path, warn: Callable[[str], None], film: Film | None = None
) -> list[Path]:
    """Write RESULT.mp4 and RESULT.html, and return the paths of the files written.

    The images are those of the run's ``film``, from :func:`film_for`. Without a complete one the capture's are decoded.
    The result is finished, so an error here must not fail the run: ``warn`` is called with one line.
    """
    try:
        return _write(capture, result_path, film)
    except TkError as error:
        warn(f"no overlay video and report: {error}")
    except Exception as error:  # a defect of tk; the result itself is complete
        warn(f"no overlay video and report: {type(error).__name__}: {' '.join(str(error).split())}")
    return []


@one_thread()
def _write(capture: Capture, result_path: Path, film: Film | None) -> list[Path]:
    video, page = result_path.with_suffix(".mp4"), result_path.with_suffix(".html")
    # in a folder of recordings a video may have the result's name
    for path, kind in ((video, VIDEO), (page, PAGE)):
        check_output(path, kind, force=True, inputs=[result_path], capture=capture.path)
    result = read_result(result_path)
    overlay = Overlay(capture, result, _WIDEST)
    frames, pictures = _pictures(overlay, capture, film)
    choices = choose_rows(result, frames)
    wanted = {choice.row for choice in choices}
    check_encoder()  # slow; decoding has already begun in the background
    shots: dict[int, bytes] = {}
    with video_writer(video, capture.fps / frames.step) as add:
        for frame, images in pictures:
            add(overlay.mosaic(frame, images))
            row = overlay.row_of[frame]
            if row in wanted:
                shots[row] = shot(overlay, frame, images)
        text = build_page(result, embedded(choices, shots), overlay.rig, capture.truth_file)
    write_page(page, text)
    return [video, page]


def _pictures(
    overlay: Overlay, capture: Capture, film: Film | None
) -> tuple[range, Iterator[tuple[int, Sequence[Image]]]]:
    """Return the frames of the video, also such that the result has not, and those that it has with their images."""
    if film is not None and film.late_frames == overlay.capture.late_frames:
        shown, kept = [frame for frame in film.frames if frame in overlay.row_of], film.places()
        if shown and kept.keys() >= set(shown):
            return film.frames, film.images(shown)
    frames = filmed(min(overlay.row_of), max(overlay.row_of) + 1, capture.fps)
    return frames, overlay.pictures([frame for frame in frames if frame in overlay.row_of])
