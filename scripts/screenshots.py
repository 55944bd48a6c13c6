"""Make the images of the documentation from the result of `tk demo`: docs/demo.png and docs/report.png.

    tk demo -o demo.h5 && python -m scripts.screenshots demo.h5

docs/report.png needs Chromium.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image  # comes with Matplotlib

from scripts.browser import browser_page, find_browser
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_result
from tk.render.overlay import Overlay, joined
from tk.report.page import report

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "tk" / "data" / "demo"
FRAMES = (40, 52)
CAMERAS = ("cam1", "cam2", "cam4", "cam5")
REPORT_FRAME = 40
# colours of the PNG: a third of the bytes without a visible difference
COLOURS = 256


def draw_demo(result: Path, path: Path) -> None:
    """Draw two frames in four of the cameras."""
    overlay = Overlay(open_capture(DEMO, CAMERAS, masks="none"), read_result(result))
    rows = [overlay.sheet_row(frame, images, 330) for frame, images in overlay.pictures(FRAMES)]
    picture = Image.fromarray(joined(rows, axis=0)[..., ::-1])
    picture.quantize(COLOURS, kmeans=5).save(path, optimize=True)


def draw_report(result: Path, path: Path) -> None:
    """Draw the top of the report as a window of 1280×800 shows it."""
    with tempfile.TemporaryDirectory() as folder, browser_page() as page:
        page.open(report(result, DEMO, Path(folder) / "demo.html"))
        page.run(f"report.show({REPORT_FRAME})")
        # wait for two animation frames: one draws, the next shows
        page.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        page.screenshot(path)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, help="result of tk demo")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs", metavar="DIR")
    options = parser.parse_args(arguments)
    draw_demo(options.result, options.output / "demo.png")
    print(options.output / "demo.png")
    if find_browser() is None:
        raise SystemExit("no report.png: Chromium is not installed")
    draw_report(options.result, options.output / "report.png")
    print(options.output / "report.png")


if __name__ == "__main__":
    main()
