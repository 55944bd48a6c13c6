"""The progress of a command on a terminal of 80 columns, and without a terminal."""

from __future__ import annotations

import errno
import io
import logging
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from tk.commands.base import errors_in_one_line
from tk.commands.console import ConsoleReporter


def terminal() -> Console:
    return Console(
        file=io.StringIO(), force_terminal=True, width=80, height=20, legacy_windows=False, color_system=None
    )


def shown(console: Console) -> str:
    """Return the printed text without cursor codes."""
    assert isinstance(console.file, io.StringIO)
    return re.sub(r"\x1b\[[?\d;]*\w", "\n", console.file.getvalue())


def test_longest_progress_bar_fits_80_columns() -> None:
    console = terminal()
    with ConsoleReporter(console=console) as reporter:
        reporter.begin(12000, 9000)
        for frame in range(9000, 10500):
            reporter.advance(frame, SimpleNamespace(status="lost"))
        assert reporter._live is not None
        task = reporter._live.tasks[0]
        task.fields["rate"] = "123.4 frames/s"
        reporter._end = time.perf_counter() + 12
        reporter._live.refresh()
    last = next(line for line in reversed(re.split(r"[\r\n]+", shown(console))) if line.strip())
    assert len(last) <= 80
    assert "10500/12000" in last and "1500 lost" in last
    assert "0:00:12" in last, last
    assert "…" not in last


def test_terminal_shows_stages_and_progress() -> None:
    console = terminal()
    with ConsoleReporter(console=console) as reporter:
        reporter.stage("finding the person")
        assert reporter._live is not None and reporter._live.tasks[0].description == "finding the person"
        reporter.begin(2, 0)
        logging.getLogger("tk.run.session").info("fitting the body")
        assert reporter._live.tasks[0].description == "fitting the body"
        reporter.advance(0, None)
        assert (reporter._live.tasks[0].completed, reporter._live.tasks[0].total) == (1, 2)
        reporter.advance(1, None)
        logging.getLogger("tk.run.session").info("second pass")
        assert reporter._live.tasks[0].description == "second pass"
    assert "finding the person" in shown(console) and "2/2" in shown(console)
    assert reporter._live is None


def test_log_of_the_package_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    log = logging.getLogger("tk.run.session")
    before = logging.getLogger("tk").level, list(logging.getLogger("tk").handlers)
    with ConsoleReporter():
        log.info("finding the person")
        log.warning("a camera is dark")
    with ConsoleReporter(quiet=True):
        log.info("hidden")
        log.warning("shown")
    log.info("nobody listens")
    lines = capfd.readouterr().err.splitlines()
    assert lines[0].startswith("[") and lines[0].endswith(" s] finding the person")
    assert lines[1:] == ["note: a camera is dark", "note: shown"]
    assert (logging.getLogger("tk").level, list(logging.getLogger("tk").handlers)) == before


def test_time_left_includes_later_stages() -> None:
    with ConsoleReporter(console=terminal(), later=2.0) as reporter:
        reporter.begin(10, 0)
        assert reporter.seconds_left() is None
        begin = time.perf_counter()
        for frame in range(5):
            reporter.advance(frame, None)
            time.sleep(0.02)
        left, each = reporter.seconds_left(), (time.perf_counter() - begin) / 5
        assert left is not None
        assert 0.5 * 25 * each < left < 1.5 * 25 * each, "five frames and twice ten"


def test_time_left_follows_from_the_share_of_a_stage_that_is_done() -> None:
    with ConsoleReporter(console=terminal()) as reporter:
        begin = time.perf_counter()
        reporter.stage("second pass")
        time.sleep(0.05)
        reporter.within(0.2)
        left, passed = reporter.seconds_left(), time.perf_counter() - begin
        assert left is not None
        assert 0.5 * 4 * passed < left <= 4 * passed, "a fifth is done"


def test_long_stage_shows_that_it_goes_on(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    clock = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: 10 * clock())  # ten times as fast
    with ConsoleReporter() as reporter, ConsoleReporter(quiet=True) as quiet:
        for each in (reporter, quiet):
            each.stage("compiling")
        time.sleep(2.0)
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) >= 3 and lines[0].endswith("] compiling")
    assert all(line.endswith("] still compiling") for line in lines[1:])
    at = [float(line[1:].split()[0]) for line in lines]
    assert np.all(np.diff(at) >= [2.0 * 2**k for k in range(len(lines) - 1)]), "each silence is twice as long"


def test_folder_that_must_not_be_read_ends_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, errors_in_one_line():
        raise PermissionError(errno.EACCES, "Permission denied", "locked")
    assert ended.value.code == 2 and capsys.readouterr().err == "tk: locked: Permission denied\n"
    with pytest.raises(PermissionError), errors_in_one_line():  # of no path
        raise PermissionError(errno.EPERM, "Operation not permitted")
