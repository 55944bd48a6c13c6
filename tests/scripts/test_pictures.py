"""The scripts about pictures at a small size: the documentation's pictures, and what pictures cost."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest

from scripts import bench_pictures, screenshots
from scripts.browser import find_browser
from tests.report.conftest import complete_result


@pytest.mark.slow
@pytest.mark.skipif(find_browser() is None, reason="no Chromium is installed (Debian's package: chromium)")
def test_images_of_the_docs_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = complete_result(tmp_path / "demo.h5", screenshots.DEMO, max(screenshots.FRAMES) + 1)
    screenshots.main([str(result), "-o", str(tmp_path)])
    assert capsys.readouterr().out.split() == [str(tmp_path / "demo.png"), str(tmp_path / "report.png")]
    assert cv2.imread(str(tmp_path / "report.png")).shape == (800, 1280, 3)
    demo = cv2.imread(str(tmp_path / "demo.png"))
    assert demo.shape == (2 * 330 + 6, 4 * 248 + 3 * 6, 3)
    assert demo.std() > 30


def test_cost_of_video_and_report_is_measured(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def track(capture: object, output: Path, *_: object, **__: object) -> SimpleNamespace:
        complete_result(output, tiny)
        return SimpleNamespace(frames=14)

    monkeypatch.setattr("tk.run.session.track", track)
    for pictures, files in ((False, {"r.h5"}), (True, {"r.h5", "r.mp4", "r.html"})):
        frames, wall, processor = bench_pictures.run_once(tiny, "auto", None, tmp_path / "r.h5", pictures)
        assert frames == 14 and wall > 0 and processor > 0
        assert {path.name for path in tmp_path.iterdir()} == files
    assert bench_pictures.compared([((5, 8), (4, 6)), ((10, 8), (8, 6)), ((4, 8), (4, 7))]) == (
        "5.0 s (8.0 s of processors), without overlay video and report 4.0 s (6.0 s); "
        "these take 20.0 % of the whole (25.0 % of the processors' time)"
    )
