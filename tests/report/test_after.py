"""What `tk track` leaves beside a result, and that it never costs the result."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

from tests.conftest import QUICK, Tk, track
from tests.io.result_files import revise_result
from tk.errors import ExportError
from tk.io import settings_file
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.film import Film
from tk.io.results.data import UsedCameras
from tk.io.results.reader import read_result
from tk.render.overlay import Overlay
from tk.render.video import made_here as is_our_video
from tk.report import after
from tk.report.after import film_for, write_video_and_report
from tk.report.page import made_here as is_our_page
from tk.run.prefetch import Serial
from tk.run.task import Task


def refuse(*_: object) -> None:
    raise AssertionError("decoded a second time")


def test_track_writes_a_video_and_a_report(
    tk: Tk, tiny: Path, quick: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Overlay, "pictures", refuse)
    ran = tk("track", tiny, "-o", tmp_path / "r.h5", "--config", quick, "--frames", "1:3", "--causal", pictures=True)
    assert ran.code == 0
    assert f"wrote {tmp_path / 'r.mp4'}, {tmp_path / 'r.html'}" in ran.err.splitlines()
    assert {path.name for path in tmp_path.iterdir()} == {"r.h5", "r.mp4", "r.html"}
    assert is_our_video(tmp_path / "r.mp4") and is_our_page(tmp_path / "r.html")


def images_of(video: Path) -> np.ndarray:
    """Return the images of a video, (T, H, W, 3)."""
    with av.open(str(video)) as container:
        return np.array([image.to_ndarray(format="bgr24") for image in container.decode(video=0)], float)


AHEAD = settings_file.from_toml(QUICK.replace("ahead = 0", "ahead = 2"))


def opened(tiny: Path) -> Capture:
    """Return the capture at twice the rate of a video, which therefore shows every second frame and lasts as long."""
    return replace(open_capture(tiny), fps=30.0)


@pytest.fixture(scope="module")
def filmed(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Film]:
    """A result of frames 1 to 6, and its film, of images that another process has decoded. Not to be changed."""
    result, capture = tmp_path_factory.mktemp("film") / "r.h5", opened(tiny)
    film = film_for(capture, result)
    track(capture, result, AHEAD, film=film, frames=(1, 7), causal=True)
    assert film is not None and list(result.parent.iterdir()) == [result]
    return result, film


def test_a_run_keeps_the_images_that_its_video_and_report_show(
    tiny: Path, filmed: tuple[Path, Film], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture, result, film = opened(tiny), Path(shutil.copy(filmed[0], tmp_path)), filmed[1]
    write_video_and_report(capture, result, pytest.fail)
    decoded, page = images_of(tmp_path / "r.mp4"), (tmp_path / "r.html").read_text(encoding="utf-8")
    monkeypatch.setattr(Overlay, "pictures", refuse)
    write_video_and_report(capture, result, pytest.fail, film)
    kept = images_of(tmp_path / "r.mp4")
    assert kept.shape == decoded.shape and len(kept) == 3  # frames 1, 3, 5
    with av.open(str(tmp_path / "r.mp4")) as video:
        assert video.streams.video[0].average_rate == 15
    assert np.abs(kept - decoded).mean() < 3
    again = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert again.count('"jpeg":') == page.count('"jpeg":') > 0


def test_a_resumed_run_has_a_whole_video(tiny: Path, filmed: tuple[Path, Film], tmp_path: Path) -> None:
    capture, result = opened(tiny), Path(shutil.copy(filmed[0], tmp_path))
    film = film_for(capture, result)
    track(capture, result, AHEAD, film=film, frames=(1, 10), causal=True, resume=True)
    write_video_and_report(capture, result, pytest.fail, film)
    assert len(images_of(tmp_path / "r.mp4")) == 5  # frames 1, 3 to 9


def test_a_run_on_a_full_disk_has_a_whole_video(
    tiny: Path, filmed: tuple[Path, Film], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    capture, result, notes = opened(tiny), Path(shutil.copy(filmed[0], tmp_path)), list[str]()
    film = film_for(capture, result)
    assert film is not None
    film.frames = range(1, 7, 2)
    for _ in Serial(Task.of(capture, AHEAD), notes.append, film=film).frames(1, 7):
        pass
    assert ["decoded twice" in note for note in notes] == [True]
    write_video_and_report(capture, result, pytest.fail, film)
    assert len(images_of(tmp_path / "r.mp4")) == 3


def test_images_of_other_delays_than_those_that_the_run_has_found_are_decoded(
    tiny: Path, filmed: tuple[Path, Film], tmp_path: Path
) -> None:
    capture, result, film = opened(tiny), Path(shutil.copy(filmed[0], tmp_path)), filmed[1]
    late = np.array([0, 0, 1, 0]) / capture.fps
    revise_result(result, cameras=UsedCameras(capture.rig, late))
    overlay = Overlay(capture, read_result(result), after._WIDEST)
    _, pictures = after._pictures(overlay, capture, film)
    with capture.frames(2, 4) as recorded:
        first, second = (frame.images.copy() for frame in recorded)
    shown = dict(pictures)[3]
    np.testing.assert_array_equal(shown[2], first[2])
    np.testing.assert_array_equal(shown[1], second[1])


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
    ("name", "error"),
    [
        ("check_encoder", ExportError("no encoder here")),
        ("shot", RuntimeError("a defect\nof ours")),
        ("build_page", OSError(28, "full")),
    ],
)
def test_failure_is_one_warning_line(
    name: str, error: BaseException, complete: Path, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    result = tmp_path / "walk.h5"
    result.write_bytes(complete.read_bytes())
    before = result.read_bytes()
    monkeypatch.setattr(after, name, fail)
    warnings: list[str] = []
    write_video_and_report(open_capture(tiny), result, warnings.append)
    (warning,) = warnings
    assert "no overlay video and report: " in warning and "\n" not in warning
    assert result.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} <= {"walk.h5", "walk.mp4"}
