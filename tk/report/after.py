"""What `tk track` leaves beside a result: the overlay video and the report, made in one pass over the pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tk.errors import ExportError, TkError
from tk.io.captures.capture import Capture
from tk.io.results.writer import read_result
from tk.render.overlay import Overlay
from tk.render.video import check_encoder, video_writer
from tk.render.video import made_here as is_our_video
from tk.report.page import build_page, write_page
from tk.report.page import made_here as is_our_page
from tk.report.pictures import choose_rows, embedded, shot
from tk.threads import one_thread

# Of the video. Every run pays for it: `tk render` makes a larger one for who wants to look closely.
_WIDEST = 960


def leave_pictures(
    capture: Capture,
    result_path: Path,
    warn: Callable[[str], None],
) -> list[Path]:
    """Write RESULT.mp4 and RESULT.html; the files that are there now.

    The result is finished, and nothing that goes wrong here may cost it: ``warn`` hears of it in one line.
    """
    try:
        return _write(capture, result_path)
    except KeyboardInterrupt:
        warn("the overlay video and the report are left out: interrupted; the result is complete")
    except TkError as error:
        warn(f"the overlay video and the report are left out: {error}")
    except Exception as error:  # a defect of ours; the run itself is done and right
        warn(f"the overlay video and the report are left out: {type(error).__name__}: {' '.join(str(error).split())}")
    return []


@one_thread()
def _write(capture: Capture, result_path: Path) -> list[Path]:
    video, page = result_path.with_suffix(".mp4"), result_path.with_suffix(".html")
    # a folder of recordings may hold a video of the result's name
    for path, ours in ((video, is_our_video), (page, is_our_page)):
        if path.exists() and not ours(path):
            raise ExportError(f"{path} was not made by tk and is not replaced; name the result otherwise")
    result = read_result(result_path)
    overlay = Overlay(capture, result, _WIDEST)
    choices = choose_rows(result)
    wanted = {choice.row for choice in choices}
    pictures = overlay.pictures(overlay.chosen(count=len(result)))
    check_encoder()  # takes its time, and decoding has begun
    shots: dict[int, bytes] = {}
    with video_writer(video, capture.fps) as add:
        for frame, images in pictures:
            add(overlay.mosaic(frame, images))
            row = overlay.row_of[frame]
            if row in wanted:
                shots[row] = shot(overlay, frame, images)
        text = build_page(result, embedded(choices, shots), overlay.rig)
    write_page(page, text)
    return [video, page]
