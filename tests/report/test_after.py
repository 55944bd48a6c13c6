"""What `tk track` leaves beside a result, and that it never costs the result."""

from __future__ import annotations

from pathlib import Path

import av
import pytest

from tests.conftest import Tk
from tk.errors import ExportError
from tk.io.captures.capture import open_capture
from tk.render.video import made_here as is_our_video
from tk.report import after
from tk.report.after import write_video_and_report
from tk.report.page import made_here as is_our_page


def test_track_writes_a_video_and_a_report(tk: Tk, tiny: Path, quick: Path, tmp_path: Path) -> None:
    ran = tk("track", tiny, "-o", tmp_path / "r.h5", "--config", quick, "--frames", "1:3", "--causal", pictures=True)
    assert ran.code == 0
    assert f"wrote {tmp_path / 'r.mp4'}, {tmp_path / 'r.html'}" in ran.err.splitlines()
    assert {path.name for path in tmp_path.iterdir()} == {"r.h5", "r.mp4", "r.html"}
    assert is_our_video(tmp_path / "r.mp4") and is_our_page(tmp_path / "r.html")


def test_video_of_a_long_recording_has_its_duration_and_some_of_its_images(
    complete: Path, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = tmp_path / "r.h5"
    result.write_bytes(complete.read_bytes())
    monkeypatch.setattr(after, "_MOST", 5)
    write_video_and_report(open_capture(tiny), result, pytest.fail)
    with av.open(str(tmp_path / "r.mp4")) as video:
        stream = video.streams.video[0]
        assert stream.frames == 5  # 14 frames, every third one
        assert stream.average_rate == 5  # 15 Hz


def test_files_of_other_programs_are_not_replaced(complete: Path, tiny: Path, tmp_path: Path) -> None:
    result = tmp_path / "walk.h5"
    result.write_bytes(complete.read_bytes())
    capture = open_capture(tiny)
    warnings: list[str] = []
    for name in ("walk.mp4", "walk.html"):
        (tmp_path / name).write_bytes(b"a recording of mine")
        assert write_video_and_report(capture, result, warnings.append) == []
        warning = warnings[-1]
        assert f"{name}: exists and is not a" in warning and "\n" not in warning
        assert (tmp_path / name).read_bytes() == b"a recording of mine"
        (tmp_path / name).unlink()
        assert [path.name for path in tmp_path.iterdir()] == ["walk.h5"]
    files = write_video_and_report(capture, result, warnings.append)
    assert [file.name for file in files] == ["walk.mp4", "walk.html"]
    files[1].write_text(files[1].read_text(encoding="utf-8") + "<!-- -->", encoding="utf-8")
    assert write_video_and_report(capture, result, warnings.append) == files and len(warnings) == 2, (
        "its own are replaced"
    )
    assert "<!-- -->" not in files[1].read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "error",
    [ExportError("no encoder here"), RuntimeError("a defect\nof ours"), OSError(28, "full")],
)
def test_failure_is_one_warning_line(
    error: BaseException, complete: Path, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    result = tmp_path / "walk.h5"
    result.write_bytes(complete.read_bytes())
    before = result.read_bytes()
    for name in ("check_encoder", "shot", "build_page"):
        with monkeypatch.context() as patched:
            patched.setattr(after, name, fail)
            warnings: list[str] = []
            write_video_and_report(open_capture(tiny), result, warnings.append)
        (warning,) = warnings
        assert "no overlay video and report: " in warning and "\n" not in warning
        assert result.read_bytes() == before
        assert {path.name for path in tmp_path.iterdir()} <= {"walk.h5", "walk.mp4"}
