"""How a batch goes, on stderr: a bar on a terminal, a plain line now and then elsewhere, a line a finished capture."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tk.batch.jobs import DONE, Outcome

_EVERY_S = 5.0
# captures named in a line of progress
_NAMED = 4


class BatchReport:
    """A :class:`tk.batch.BatchReporter`; a context manager.

    Args:
        quiet: only notes, and captures that have ended badly.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._console = console = Console(stderr=True, highlight=False, soft_wrap=True)
        self._running: dict[str, tuple[int, int]] = {}
        self._last = time.monotonic()
        columns = (
            TextColumn("captures"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )  # fmt: skip
        self._bar = Progress(*columns, console=console) if console.is_terminal and not quiet else None
        self._task = self._bar.add_task("", total=None) if self._bar else None

    def __enter__(self) -> BatchReport:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def note(self, text: str) -> None:
        self._console.print(f"note: {text}", style="yellow", markup=False)

    def progress(self, name: str, done: int, total: int) -> None:
        self._running[name] = (done, total)
        if self._bar and self._task is not None:
            self._bar.update(self._task, description=self._told())
        elif not self._quiet and time.monotonic() - self._last > _EVERY_S:
            self._last = time.monotonic()
            self._console.print(self._told(), markup=False)

    def finished(self, name: str, outcome: Outcome, done: int, total: int) -> None:
        self._running.pop(name, None)
        if not self._quiet or outcome.state != DONE or outcome.mostly_lost:
            self._console.print(f"{done}/{total} {name}: {_ending(outcome)}", markup=False)
        if self._bar and self._task is not None:
            self._bar.update(self._task, completed=done, total=total, description=self._told())

    def _told(self) -> str:
        """How far those are that are being tracked."""
        shown = [f"{name} {done}/{total}" for name, (done, total) in list(self._running.items())[:_NAMED]]
        more = len(self._running) - len(shown)
        return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def _ending(outcome: Outcome) -> str:
    if outcome.state != DONE:
        return f"failed: {outcome.failure}"
    parts = [f"{outcome.frames} frames", f"{outcome.lost} lost"]
    if outcome.error_cm is not None:
        parts.append(f"error {outcome.error_cm:.2f} cm")
    if outcome.frames_per_second is not None:
        parts.append(f"{outcome.frames_per_second:.1f} frames/s")
    return ", ".join(parts)
