"""The overlay video and the report that `tk track` writes next to a result, in one pass over the videos."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from tk.errors import TkError
from tk.io.captures.capture import Capture
from tk.io.paths import check_output
from tk.io.results.reader import read_result
from tk.render.overlay import Overlay
from tk.render.video import VIDEO, check_encoder, video_writer
from tk.report.page import PAGE, build_page, write_page
from tk.report.pictures import choose_rows, embedded, shot
from tk.threads import one_thread

# Width of the video, pixels; most images for a second, and in all. Every run pays the time for it; `tk render` makes a
# video of all images, and a larger one.
_WIDEST, _MOST_PER_S, _MOST = 960, 15.0, 3000


def write_video_and_report(
    capture: Capture,
    result_path: Path,
    warn: Callable[[str], None],
) -> list[Path]:
    """Write RESULT.mp4 and RESULT.html, and return the paths of the files written.

    The result is finished, so an error here must not fail the run: ``warn`` is called with one line.
    """
    try:
        return _write(capture, result_path)
    except TkError as error:
        warn(f"no overlay video and report: {error}")
    except Exception as error:  # a defect of tk; the result itself is complete
        warn(f"no overlay video and report: {type(error).__name__}: {' '.join(str(error).split())}")
    return []


@one_thread()
def _write(capture: Capture, result_path: Path) -> list[Path]:
    video, page = result_path.with_suffix(".mp4"), result_path.with_suffix(".html")
    # in a folder of recordings a video may have the result's name
    for path, kind in ((video, VIDEO), (page, PAGE)):
        check_output(path, kind, force=True, inputs=[result_path], capture=capture.path)
    result = read_result(result_path)
    overlay = Overlay(capture, result, _WIDEST)
    choices = choose_rows(result)
    wanted = {choice.row for choice in choices}
    frames = list(overlay.row_of)
    step = max(math.ceil(capture.fps / _MOST_PER_S - 0.01), -(-len(frames) // _MOST))
    filmed = set(frames[::step])
    pictures = overlay.pictures([frame for frame in frames if frame in filmed or overlay.row_of[frame] in wanted])
    check_encoder()  # slow; decoding has already begun in the background
    shots: dict[int, bytes] = {}
    with video_writer(video, capture.fps / step) as add:
        for frame, images in pictures:
            if frame in filmed:
                add(overlay.mosaic(frame, images))
            row = overlay.row_of[frame]
            if row in wanted:
                shots[row] = shot(overlay, frame, images)
        text = build_page(result, embedded(choices, shots), overlay.rig, capture.truth_file)
    write_page(page, text)
    return [video, page]
