"""The process that decodes and segments ahead: the same frames, its errors at their frame, and nothing left behind."""

from __future__ import annotations

import errno
import gc
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from tests import conftest
from tests.conftest import EVERY_FRAME, FRAMES, QUICK, Silent, Tk, run_clock
from tests.people import write_people
from tests.run.test_session import assert_same
from tk.commands.console import ConsoleReporter
from tk.errors import VideoError, WorkerError
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.captures.film import Film
from tk.io.results.reader import read_result
from tk.run import worker
from tk.run.prefetch import Ahead, Observations, Serial, open_observations
from tk.run.task import Task
from tk.settings import Settings
from tk.system.files import NamelessFile

AHEAD = settings_file.from_toml(QUICK.replace("ahead = 0", "ahead = 2"))
ROOT = Path(__file__).parents[2]
track = partial(conftest.track, method="volumetric")


def arrays(source: Observations, start: int, stop: int) -> list[tuple[int, np.ndarray, np.ndarray, np.ndarray | None]]:
    """Index, images, masks, and what is uncertain."""
    with source:
        return [
            (o.index, o.images.copy(), o.masks.copy(), None if o.uncertain is None else o.uncertain.copy())
            for o, _ in source.frames(start, stop)
        ]


def nobody(text: str) -> None:
    raise AssertionError(text)


@pytest.mark.parametrize(
    ("masks", "image_step", "doubts", "portable"), [("auto", 0, False, "0"), ("none", 2, True, "1")]
)
def test_prefetched_frames_equal_direct_ones(
    tiny: Path, masks: str, image_step: int, doubts: bool, portable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Given masks are not in doubt. Portable: see :mod:`tk.system`."""
    monkeypatch.setenv("TK_PORTABLE", portable)
    capture = open_capture(tiny, masks=masks)
    theirs = arrays(Ahead(Task.of(capture, AHEAD), nobody, image_step), 2, 8)
    ours = arrays(Serial(Task.of(capture, AHEAD), nobody, image_step), 2, 8)
    assert [frame[0] for frame in theirs] == list(range(2, 8))
    assert ours[0][2].any() and (ours[0][1].size > 0) == (image_step > 0)
    for a, b in zip(theirs, ours, strict=True):
        np.testing.assert_array_equal(a[1], b[1], strict=True)
        np.testing.assert_array_equal(a[2], b[2], strict=True)
        assert (a[3] is not None) == (b[3] is not None) == doubts
        if a[3] is not None and b[3] is not None:
            assert a[3].any()
            np.testing.assert_array_equal(a[3], b[3], strict=True)


@pytest.mark.usefixtures("system")
def test_small_images_are_taken_again_with_the_delays_that_a_run_has_found(tiny: Path, tmp_path: Path) -> None:
    capture = open_capture(tiny)
    film = Film.in_folder(tmp_path, [(camera.width, camera.height) for camera in capture.rig], capture.late_frames)
    assert film is not None
    film.frames = range(1, FRAMES, 2)
    delays = [0.0, 0.0, 1 / capture.fps, 0.0]
    with Ahead(Task.of(capture, AHEAD), nobody, film=film) as observations:
        for _ in observations.frames(1, FRAMES):
            pass
        observations.film_again(delays)
    assert film.late_frames == (0, 0, 1, 0) and not list(tmp_path.iterdir())
    shown = dict(film.images(film.frames))
    with capture.some_frames(film.frames) as as_recorded, capture.shifted(delays).some_frames(film.frames) as shifted:
        for before, frame in zip(as_recorded, shifted, strict=True):
            np.testing.assert_array_equal(shown[frame.index], frame.images)
            assert not np.array_equal(before.images[2], frame.images[2])


def test_frames_are_made_here_if_no_memory_can_be_shared(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))

    capture, notes = open_capture(tiny), list[str]()
    monkeypatch.setattr(NamelessFile, "truncate", refuse)
    with open_observations(Task.of(capture, AHEAD), notes.append) as observations:
        assert isinstance(observations, Serial)
    assert notes == [
        "no memory can be shared with another process (File too large): frames are made one after the other"
    ]


def test_held_frames_are_not_overwritten(tiny: Path, tmp_path: Path) -> None:
    """More of them than the ring has slots, some dropped in between, and views after their frame."""
    capture, times = open_capture(tiny), 5
    expected = arrays(Serial(Task.of(capture, AHEAD), nobody), 0, FRAMES)
    for name in ("calibration.toml", "capture.toml"):
        shutil.copy(tiny / name, tmp_path)
    for c, camera in enumerate(capture.rig):
        for kind, layer in (("images", 1), ("masks", 2)):
            (tmp_path / kind / camera.name).mkdir(parents=True)
            for k in range(times * FRAMES):
                image = expected[k % FRAMES][layer][c]
                cv2.imwrite(str(tmp_path / kind / camera.name / f"{k:06d}.png"), image)
    with Ahead(Task.of(open_capture(tmp_path), AHEAD), nobody) as source:
        held = {o.index: o.masks[1:, ::2] for o, _ in source.frames(0, times * FRAMES) if o.index % 4 != 2}
    assert len(held) > 50
    for index, masks in held.items():
        np.testing.assert_array_equal(masks, expected[index % FRAMES][2][1:, ::2])


def test_prefetching_does_not_change_the_result(tiny: Path, tracked: Path, tmp_path: Path) -> None:
    capture = open_capture(tiny)
    track(capture, tmp_path / "r.h5", AHEAD, frames=(0, 2), store_hull=True)
    track(capture, tmp_path / "r.h5", AHEAD, frames=(0, 5), resume=True, store_hull=True)
    assert_same(tmp_path / "r.h5", tracked, slice(0, 5))
    timing = read_result(tmp_path / "r.h5").timing
    work = sum(seconds for stage, seconds in timing.items() if stage not in ("decode", "masks", "total"))
    assert (timing["total"] >= work - 1e-6).all() and (timing["masks"] > 0).all()


def test_notes_of_the_process_are_reported(tmp_path: Path) -> None:
    folder = write_people(tmp_path / "walk", [lambda k: (0.85 * np.cos(k / 2), 0.85 * np.sin(k / 2))], 12)
    notes: list[str] = []
    assert len(arrays(Ahead(Task.of(open_capture(folder, masks="median"), AHEAD), notes.append), 0, 1)) == 1
    assert "the median of 12 frames is taken for the empty scene" in notes[0]


def test_an_error_is_raised_at_its_frame(copy: Path, tmp_path: Path) -> None:
    capture = open_capture(copy)
    broken = sorted((copy / "masks").iterdir())[1] / "000002.png"
    broken.write_bytes(broken.read_bytes()[:40])
    with pytest.raises(VideoError, match=r"000002\.png: is not a picture that can be decoded"):
        track(capture, tmp_path / "r.h5", AHEAD)
    np.testing.assert_array_equal(read_result(tmp_path / "r.h5").frames, np.arange(2))


def test_an_error_while_learning_the_background_is_raised(copy: Path) -> None:
    capture = open_capture(copy, masks="none")
    next((copy / "background").iterdir()).unlink()
    with Ahead(Task.of(capture, AHEAD), nobody) as source, pytest.raises(VideoError, match="has no background"):
        next(source.frames(0, 3))


def test_a_defect_keeps_its_traceback(tiny: Path) -> None:
    no_number: Any = "3"
    with (
        Ahead(Task.of(open_capture(tiny), AHEAD), nobody) as observations,
        pytest.raises(RuntimeError, match="TypeError") as raised,
    ):
        next(observations.frames(0, no_number))
    assert "in _serve" in str(raised.value)


@pytest.mark.usefixtures("system")
def test_a_killed_process_is_reported_in_one_line(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_clock(monkeypatch, EVERY_FRAME)

    class Killer(Silent):
        def advance(self, frame: int, estimate: object) -> None:
            super().advance(frame, estimate)
            if frame == 1:
                started[-1].kill()

    started, start = list[Any](), subprocess.Popen

    def watched(*given: Any, **options: Any) -> Any:
        started.append(start(*given, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", watched)
    killer = Killer()
    with pytest.raises(WorkerError, match=r"tiny: the process .* was ended by SIGKILL \(out of memory\?\); ahead = 0"):
        track(open_capture(tiny), tmp_path / "r.h5", AHEAD, killer)
    done = len(killer.frames)
    assert 2 <= done < FRAMES  # those that lay ready are tracked
    np.testing.assert_array_equal(read_result(tmp_path / "r.h5").frames, np.arange(done))


@pytest.mark.usefixtures("system")
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_no_process_or_memory_remains(tiny: Path) -> None:
    def open_files() -> int:
        gc.collect()
        return len(os.listdir("/proc/self/fd"))

    capture = open_capture(tiny)
    before = open_files()
    with Ahead(Task.of(capture, AHEAD), nobody) as source:
        frames: Iterator[object] = source.frames(0, FRAMES)
        next(frames)
        assert open_files() > before
    assert source._process.returncode == 0  # it ended by itself
    source.close()
    with Ahead(Task.of(capture, AHEAD), nobody) as unused:
        pass
    assert unused._process.returncode is not None
    del source, frames, unused
    assert open_files() == before


@pytest.mark.usefixtures("system")
@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="needs /proc")
def test_the_process_ends_with_the_tracker_and_no_file_remains(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed, the tracker cannot tell it to."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    script = (
        "import os, signal, sys, tk.run.prefetch, tk.settings, tk.io.captures.capture as c\n"
        "capture = c.open_capture(sys.argv[1])\n"
        "source = tk.run.prefetch.Ahead(tk.run.task.Task.of(capture, tk.settings.Settings(ahead=1)), print)\n"
        "frames = source.frames(0, 14); next(frames)\n"
        "print(source._process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", script, tiny], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert ran.returncode == -signal.SIGKILL and ran.stderr == ""  # all ends of its stderr are closed, too
    pid, deadline = int(ran.stdout), time.monotonic() + 20
    while _runs(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _runs(pid) and not list(tmp_path.iterdir())


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_sigterm_ends_the_command_line_like_ctrl_c(
    tk: Tk, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What Ctrl-C does in this process, tests of the session check."""
    advance = ConsoleReporter.advance

    def terminate(reporter: ConsoleReporter, frame: int, estimate: Any) -> None:
        advance(reporter, frame, estimate)
        if frame == 3:
            signal.raise_signal(signal.SIGTERM)

    run_clock(monkeypatch, EVERY_FRAME)
    monkeypatch.setattr(ConsoleReporter, "advance", terminate)
    settings = tmp_path / "s.toml"
    settings.write_text(QUICK.replace("ahead = 0", "ahead = 2"), encoding="utf-8")
    result = tmp_path / "r.h5"
    stopped = tk("track", tiny, "-o", result, "--config", settings)
    assert stopped.code == 1 and stopped.out == "" and "Traceback" not in stopped.err
    assert stopped.err.splitlines()[-1] == "tk: interrupted; continue with the same command and --resume"
    # the masks are for the second pass of the run that goes on
    assert {path.name for path in tmp_path.iterdir()} == {"r.h5", ".r.h5.masks", "s.toml"}
    with h5py.File(result, "r") as file:
        np.testing.assert_array_equal(file["frames"], np.arange(4))


def test_one_core_needs_no_further_process(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = open_capture(tiny)
    assert isinstance(open_observations(Task.of(capture, Settings(ahead=0)), nobody), Serial)
    monkeypatch.setattr("tk.system.machine.cores", lambda: 1)
    assert isinstance(open_observations(Task.of(capture, Settings()), nobody), Serial)
    monkeypatch.setattr("tk.system.machine.cores", lambda: 2)
    with open_observations(Task.of(capture, Settings()), nobody) as source:
        assert isinstance(source, Ahead)


def test_process_that_was_started_early_is_used_once_and_else_ended(tiny: Path) -> None:
    capture = open_capture(tiny)
    expected = arrays(Serial(Task.of(capture, AHEAD), nobody), 0, 2)
    with worker.started_early():
        (early,) = worker._ready
        time.sleep(1.0)  # it prepares
        with Ahead(Task.of(capture, AHEAD), nobody) as source:
            assert source._process is early.process
            found = arrays(source, 0, 2)
        assert not worker._ready
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a[2], b[2], strict=True)
    with worker.started_early():
        (early,) = worker._ready
        assert isinstance(open_observations(Task.of(capture, Settings(ahead=0)), nobody), Serial)
        assert early.process.returncode is not None


def test_the_process_does_without_what_only_trackers_need() -> None:
    """SciPy alone would take it half a second at each start."""
    heavy = "tk.trackers.contour_finder", "scipy", "h5py", "av", "open3d"
    code = f"import sys, tk.run.prefetch; print(*(name for name in {heavy} if name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == []
