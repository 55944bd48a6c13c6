"""Receives the progress of a run."""

from __future__ import annotations

from typing import Protocol

from tk.trackers.protocol import Estimate


class Reporter(Protocol):
    """Receives notes and progress."""

    def note(self, text: str) -> None:
        """Receive a line that the user should read."""
        ...

    def begin(self, total: int, done: int) -> None:
        """Receive the number of frames, 0 if unknown, and how many of them an earlier run has finished."""
        ...

    def advance(self, frame: int, estimate: Estimate | None) -> None:
        """Receive a finished frame; ``estimate`` is None if the run estimates no pose."""
        ...

    def within(self, share: float) -> None:
        """Receive the share of the current stage, after the last frame, that is done."""
        ...


class Silent:
    """A reporter that ignores everything; others derive from it."""

    def note(self, text: str) -> None:
        pass

    def begin(self, total: int, done: int) -> None:
        pass

    def advance(self, frame: int, estimate: Estimate | None) -> None:
        pass

    def within(self, share: float) -> None:
        pass
