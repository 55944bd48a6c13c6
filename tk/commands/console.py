"""What commands print on stderr while they work: the current stage, the progress, and notes.

On a terminal a moving line shows the progress; otherwise plain lines do. The package reports stages and warnings
through the logger "tk", and :class:`ConsoleReporter` prints them.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

if TYPE_CHECKING:
    from tk.batch import Outcome

_LOG = logging.getLogger("tk")

#: longest silence and seconds between two lines of progress if stderr is no terminal. It only decides how many lines a
#: log file gets.
_PERIOD_S = 2.0
#: longest silence in a long stage without a terminal, seconds
_SILENCE_S = 60.0
#: captures named in a batch's line of progress; more would not fit on a line
_NAMED_CAPTURES = 4


class _Notes:
    """Prints notes on stderr."""

    def __init__(self, quiet: bool, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True, highlight=False, soft_wrap=True)
        self._quiet = quiet
        self._bars = self._console.is_terminal and not quiet
        self._live: Progress | None = None

    def note(self, text: str) -> None:
        """Print a line that the user should read."""
        self._console.print(f"note: {text}", style="yellow", markup=False)

    def _show(self, columns: Iterable[ProgressColumn], text: str = "", transient: bool = False, **task: Any) -> None:
        """Replace the moving line."""
        self._stop()
        self._live = Progress(*columns, console=self._console, transient=transient)
        self._live.add_task(text, **task)
        self._live.start()

    def _update(self, **task: Any) -> None:
        if self._live is not None:
            self._live.update(self._live.task_ids[0], **task)

    def _stop(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None


class _TimeLeft(ProgressColumn):
    """Shows the time left of a reporter."""

    def __init__(self, reporter: ConsoleReporter) -> None:
        super().__init__()
        self._reporter = reporter

    def render(self, task: Task) -> Text:
        left = self._reporter.seconds_left()
        return Text("" if left is None else str(timedelta(seconds=round(left))))


class ConsoleReporter(_Notes):
    """The reporter of a command, see :class:`tk.run.reporter.Reporter`; a context manager.

    Without a terminal lines show that a long stage goes on, after two seconds and then ever less often.

    Args:
        quiet: print notes only, no progress.
        console: where to print; stderr by default.
        later: duration of the stages after the last frame, as a multiple of the duration of all frames.
        last: the part of ``later`` of the stages whose progress is not reported.
        stage: the first stage.
        patient: without a terminal, print the first stage only after two seconds.
    """

    def __init__(
        self,
        quiet: bool = False,
        console: Console | None = None,
        later: float = 0.0,
        last: float = 0.0,
        stage: str = "",
        patient: bool = False,
    ) -> None:
        super().__init__(quiet, console)
        self._handler = logging.Handler(logging.INFO)
        self._handler.emit = self._log  # type: ignore[method-assign]
        self._lost = self._count = self._done = self._total = 0
        self._begun = self._started = self._last = time.perf_counter()
        self._later, self._last_stages, self._last_s = later, last, 0.0
        self._end = float("-inf")
        self._stage, self._stage_begun, self._patient = stage, self._begun, patient
        self._closed = threading.Event()

    def __enter__(self) -> ConsoleReporter:
        self._level_before = _LOG.level
        _LOG.addHandler(self._handler)
        _LOG.setLevel(logging.INFO)
        if self._stage and (self._bars or not self._patient):
            self.stage(self._stage)
        if not self._quiet and not self._bars:
            threading.Thread(target=self._show_life, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        _LOG.removeHandler(self._handler)
        _LOG.setLevel(self._level_before)
        self._stop()

    def _log(self, record: logging.LogRecord) -> None:
        """Print a record of the package's log: warnings as notes, everything else as the current stage."""
        (self.note if record.levelno >= logging.WARNING else self.stage)(record.getMessage())

    def _show_life(self) -> None:
        """Print a line after a silence of two seconds, four, eight and so on up to a minute, anew in each stage."""
        stage, silence_s = "", _PERIOD_S
        while not self._closed.wait(_PERIOD_S / 4):
            if self._stage != stage:
                stage, silence_s = self._stage, _PERIOD_S
            if stage and time.perf_counter() - self._last > silence_s:
                self._print(", ".join([f"still {stage}", *self._left()]))
                silence_s = min(2 * silence_s, _SILENCE_S)

    def _print(self, text: str) -> None:
        """Print a line with the time since the begin."""
        self._last = time.perf_counter()
        click.echo(f"[{self._last - self._begun:5.1f} s] {text}", err=True)

    def seconds_left(self) -> float | None:
        """Return how long the command still takes, later stages included; None if unknown."""
        left = self._end - time.perf_counter()
        return left if left > 0 else None

    def _left(self) -> list[str]:
        left = self.seconds_left()
        return [] if left is None else [f"about {left:.0f} s left"]

    def stage(self, text: str) -> None:
        """Show what is being done from now on."""
        self._stage, self._stage_begun = text, time.perf_counter()
        if self._bars:
            columns = (
                SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn(), _TimeLeft(self),
            )  # fmt: skip
            self._show(columns, text, transient=True, total=None)
        elif not self._quiet:
            self._print(text)

    def begin(self, total: int, done: int) -> None:
        """Start counting: ``done`` of ``total`` frames are finished already."""
        self._total, self._done = total, done
        if done:
            self.note(f"{done} of {total} frames are finished already")
        self._started = self._last = time.perf_counter()

    def advance(self, frame: int, estimate: object) -> None:
        """Count a finished frame. The first one is not part of the rate: kernels are compiled before it."""
        self._count += 1
        self._lost += getattr(estimate, "status", "") == "lost"
        if self._quiet:
            return
        now = time.perf_counter()
        made, first = self._done + self._count, self._count == 1
        if first:
            rate = f"first after {now - self._begun:.1f} s"
            self._started, self._stage = now, ""
        else:
            speed = (self._count - 1) / max(now - self._started, 1e-9)
            rate = f"{speed:.1f} frames/s"
            if self._total:
                self._end = now + (self._total - made + self._later * self._total) / speed
                self._last_s = self._last_stages * self._total / speed
        lost = [f"{self._lost} lost"] if self._lost else []
        if not self._bars:
            if first or now - self._last > _PERIOD_S or made == self._total:
                self._last = now
                progress = ", ".join([rate, *self._left(), *lost])
                click.echo(f"frame {frame}: {made}/{self._total}, {progress}", err=True)
            return
        if first:  # the columns fit into 80 characters with the longest texts
            columns = (
                TextColumn("frames"), BarColumn(20), MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"), _TimeLeft(self), TextColumn("{task.fields[lost]}"),
            )  # fmt: skip
            self._show(columns, total=self._total, completed=self._done, rate="", lost="")
        self._update(completed=made, rate=rate, lost="".join(lost))

    def within(self, share: float) -> None:
        """Estimate the time left from the share of the current stage that is done."""
        now = time.perf_counter()
        self._end = now + (now - self._stage_begun) * (1 / share - 1) + self._last_s


class BatchConsoleReporter(_Notes):
    """The reporter of a batch, see :class:`tk.batch.BatchReporter`; a context manager.

    Args:
        quiet: print only notes and captures that failed or are mostly lost.
    """

    def __init__(self, quiet: bool = False) -> None:
        super().__init__(quiet)
        self._running: dict[str, tuple[int, int]] = {}
        self._last = time.monotonic()

    def __enter__(self) -> BatchConsoleReporter:
        if self._bars:
            columns = (
                TextColumn("captures"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
                TextColumn("{task.description}"),
            )  # fmt: skip
            self._show(columns, total=None)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def progress(self, name: str, done: int, total: int) -> None:
        """Show how many frames of a capture are finished."""
        self._running[name] = (done, total)
        self._update(description=self._running_captures())
        if not self._bars and not self._quiet and time.monotonic() - self._last > _PERIOD_S:
            self._last = time.monotonic()
            self._console.print(self._running_captures(), markup=False)

    def finished(self, name: str, outcome: Outcome, done: int, total: int) -> None:
        """Print how a capture ended, a line each."""
        self._running.pop(name, None)
        if not self._quiet or outcome.failed or outcome.mostly_lost:
            self._console.print(f"{done}/{total} {name}: {_summary_of(outcome)}", markup=False)
        self._update(completed=done, total=total, description=self._running_captures())

    def _running_captures(self) -> str:
        """Return the progress of the captures that are being tracked."""
        shown = [f"{name} {done}/{total}" for name, (done, total) in list(self._running.items())[:_NAMED_CAPTURES]]
        more = len(self._running) - len(shown)
        return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def _summary_of(outcome: Outcome) -> str:
    if outcome.failed:
        return f"failed: {outcome.failure}"
    parts = [f"{outcome.frames} frames", f"{outcome.lost} lost"]
    if outcome.error_cm is not None:
        parts.append(f"error {outcome.error_cm:.2f} cm")
    if outcome.frames_per_second is not None:
        parts.append(f"{outcome.frames_per_second:.1f} frames/s")
    return ", ".join(parts)
