"""The page: template, style, scripts and data in one file."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

from tk.io.captures.capture import open_capture
from tk.io.paths import Kind, check_output, replacing
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.model.cameras.camera import Rig
from tk.render.overlay import Overlay
from tk.report.data import describe
from tk.report.pictures import choose_rows, embedded, shot

_SCRIPTS = ("viewer.js", "charts.js", "page.js")
_GENERATOR = '<meta name="generator" content="tk">'


def build_page(
    result: Result, pictures: list[dict[str, Any]], rig: Rig | None = None, truth: Path | None = None
) -> str:
    """Return the page of a result.

    Args:
        result: the result, with at least one frame.
        pictures: images, from :func:`tk.report.pictures.embedded`.
        rig: the cameras, if the result does not have them.
        truth: the ground truth; the file need not exist.
    """
    data, rows = describe(result, rig, truth), result
    shown = [
        {
            **picture,
            "row": picture["row"] // data["step"],
            "frame": int(rows.frames[picture["row"]]),
            "time": float(rows.time[picture["row"]]),
        }
        for picture in pictures
    ]
    data |= {"file": result.path.name, "pictures": shown}
    # "<" could close the script element
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = _read("page.html")
    for mark, content in (
        ("TITLE", html.escape(f"{result.meta.capture}: {result.path.name}")),
        ("STYLE", _read("style.css")),
        ("DATA", text),
        ("SCRIPT", "\n".join(_read(name) for name in _SCRIPTS)),
    ):
        page = page.replace(f"{{{{{mark}}}}}", content, 1)
    return page


def write_page(path: Path, page: str) -> None:
    """Write the page, under a temporary name first."""
    with replacing(path) as part:
        part.write_text(page, encoding="utf-8", errors="replace")  # a path may be no UTF-8


def made_here(path: Path) -> bool:
    """Return whether a file is a report of tk."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return _GENERATOR in file.read(4096)
    except OSError:
        return False


PAGE = Kind("a report of tk", (".html", ".htm"), made_here)


def report(result_path: Path, capture_path: Path | None, output: Path | None, force: bool = False) -> Path:
    """Write the report of a result, and return its path."""
    result = read_result(result_path)
    target = output or result_path.with_suffix(".html")
    check_output(target, PAGE, force, [result_path], capture_path)
    shown: list[dict[str, Any]] = []
    rig = truth = None
    if capture_path is not None:
        overlay = Overlay(open_capture(capture_path, None, "none", result.resampled), result)
        choices, rig, truth = choose_rows(result), overlay.rig, overlay.capture.truth_file
        frames = [int(overlay.people.first.frames[choice.row]) for choice in choices]
        shots = {overlay.row_of[frame]: shot(overlay, frame, images) for frame, images in overlay.pictures(frames)}
        shown = embedded(choices, shots)
    write_page(target, build_page(result, shown, rig, truth))
    return target


def _read(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
