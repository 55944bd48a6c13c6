"""What a command tells a person on stderr while it works: what it is doing, how far it is, and what is worth knowing.

On a terminal a line that moves; elsewhere plain lines. The package says what it is doing through the logger "tk", as
any library does; :class:`Report` shows it.
"""

from __future__ import annotations

import logging
import time
from types import TracebackType

import click
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

_LOG = logging.getLogger("tk")


class Report(logging.Handler):
    """The reporter of a command, see :class:`tk.run.session.Reporter`; a context manager.

    Args:
        quiet: only notes and errors are told, no progress.
        console: where to; stderr by default.
    """

    #: off a terminal, seconds between two lines of progress
    every_s = 2.0

    def __init__(self, quiet: bool = False, console: Console | None = None) -> None:
        super().__init__(logging.INFO)
        self._quiet = quiet
        self._console = console or Console(stderr=True, highlight=False, soft_wrap=True)
        self._live: Progress | None = None
        self._lost = self._count = self._done = self._total = 0
        self._begun = self._started = self._last = time.perf_counter()

    def __enter__(self) -> Report:
        self._level_before = _LOG.level
        _LOG.addHandler(self)
        _LOG.setLevel(logging.INFO)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _LOG.removeHandler(self)
        _LOG.setLevel(self._level_before)
        self._stop()

    def emit(self, record: logging.LogRecord) -> None:
        """A line of the package's log: warnings are notes, what is below them says what is being done."""
        if record.levelno >= logging.WARNING:
            self.note(record.getMessage())
        else:
            self.stage(record.getMessage())

    def note(self, text: str) -> None:
        """A line worth reading."""
        self._console.print(f"note: {text}", style="yellow", markup=False)

    def stage(self, text: str) -> None:
        """What is being done from now on."""
        if self._quiet:
            return
        if not self._console.is_terminal:
            click.echo(f"[{time.perf_counter() - self._begun:5.1f} s] {text}", err=True)
            return
        self._stop()
        self._live = Progress(
            SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn(),
            console=self._console, transient=True,
        )  # fmt: skip
        self._live.add_task(text, total=None)
        self._live.start()

    def begin(self, total: int, done: int) -> None:
        """``total`` frames are to be made, ``done`` of which are there."""
        self._total, self._done = total, done
        if done:
            self.note(f"{done} of {total} frames are there already")
        self._started = self._last = time.perf_counter()

    def advance(self, frame: int, estimate: object) -> None:
        """A frame is finished. The first one is waited for: kernels are compiled, the person is found."""
        self._count += 1
        self._lost += getattr(estimate, "status", "") == "lost"
        if self._quiet:
            return
        now = time.perf_counter()
        made = self._done + self._count
        if self._count == 1:
            rate, left = f"first after {now - self._begun:.1f} s", ""
            self._started = self._last = now
        else:
            speed = (self._count - 1) / max(now - self._started, 1e-9)
            rate = f"{speed:.1f} frames/s"
            left = f"{(self._total - made) / speed:.0f} s left" if made < self._total else ""
        lost = f"{self._lost} lost" if self._lost else ""
        if self._console.is_terminal:
            if self._count == 1:
                self._start_bar()
            assert self._live is not None
            self._live.update(self._live.task_ids[0], completed=made, rate=rate, lost=lost)
        elif self._count == 1 or now - self._last > self.every_s or made == self._total:
            self._last = now
            told = ", ".join(part for part in (rate, left, lost) if part)
            click.echo(f"frame {frame}: {made}/{self._total}, {told}", err=True)

    def _start_bar(self) -> None:
        self._stop()
        # narrow enough for 80 columns with all that may stand in it
        columns = (
            TextColumn("frames"), BarColumn(20), MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"), TimeRemainingColumn(), TextColumn("{task.fields[lost]}"),
        )  # fmt: skip
        self._live = Progress(*columns, console=self._console)
        self._live.add_task("", total=self._total, completed=self._done, rate="", lost="")
        self._live.start()

    def _stop(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None
