"""What a command shows while it works: on a terminal of 80 columns, and elsewhere."""

from __future__ import annotations

import io
import logging
import re
from types import SimpleNamespace

import pytest
from rich.console import Console

from tk.commands.console import Report


def terminal() -> Console:
    return Console(
        file=io.StringIO(), force_terminal=True, width=80, height=20, legacy_windows=False, color_system=None
    )


def shown(console: Console) -> str:
    """What was printed, without the codes that move the cursor."""
    assert isinstance(console.file, io.StringIO)
    return re.sub(r"\x1b\[[?\d;]*\w", "\n", console.file.getvalue())


def test_the_bar_with_all_that_may_stand_in_it_fits_80_columns() -> None:
    console = terminal()
    with Report(console=console) as report:
        report.begin(12000, 9000)
        for frame in range(9000, 10500):
            report.advance(frame, SimpleNamespace(status="lost"))
        assert report._live is not None
        task = report._live.tasks[0]
        task.fields["rate"] = "123.4 frames/s"
        report._live.refresh()
    last = next(line for line in reversed(re.split(r"[\r\n]+", shown(console))) if line.strip())
    assert len(last) <= 80
    assert "10500/12000" in last and "1500 lost" in last
    assert "0:00:" in last, last  # how long it will still take
    assert "…" not in last


def test_a_terminal_shows_what_is_being_done_before_the_first_frame() -> None:
    console = terminal()
    with Report(console=console) as report:
        report.stage("finding the person")
        assert report._live is not None and report._live.tasks[0].description == "finding the person"
        report.begin(2, 0)
        logging.getLogger("tk.run.session").info("fitting the body")
        assert report._live.tasks[0].description == "fitting the body"
        report.advance(0, None)
        assert (report._live.tasks[0].completed, report._live.tasks[0].total) == (1, 2)
        report.advance(1, None)
        logging.getLogger("tk.run.session").info("second pass")
        assert report._live.tasks[0].description == "second pass"
    assert "finding the person" in shown(console) and "2/2" in shown(console)
    assert report._live is None


def test_the_packages_log_is_told(capfd: pytest.CaptureFixture[str]) -> None:
    log = logging.getLogger("tk.run.session")
    before = logging.getLogger("tk").level, list(logging.getLogger("tk").handlers)
    with Report():
        log.info("finding the person")
        log.warning("a camera is dark")
    with Report(quiet=True):
        log.info("not told")
        log.warning("told")
    log.info("nobody listens")
    lines = capfd.readouterr().err.splitlines()
    assert lines[0].startswith("[") and lines[0].endswith(" s] finding the person")
    assert lines[1:] == ["note: a camera is dark", "note: told"]
    assert (logging.getLogger("tk").level, list(logging.getLogger("tk").handlers)) == before
