"""The process that makes frames ahead. A command starts it first of all: both processes then import at the same time.

Nothing heavy is imported here.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

from tk.system.machine import cores
from tk.system.processes import Child, start

_START = "import sys; sys.path[:] = sys.argv[1:]; from tk.run.prefetch import serve; serve()"

_ready: list[Child] = []


@contextlib.contextmanager
def started_early() -> Iterator[None]:
    """Start a process that :func:`take` returns inside, if there is a second core; end it if nobody takes it."""
    if cores() > 1 and sys.executable:
        _ready.append(_start())
    try:
        yield
    finally:
        dismiss()


def dismiss() -> None:
    """End a process that was started early and that nobody has taken."""
    while _ready:
        _ready.pop().close()


def take() -> Child:
    """Return a process: the one that was started early, else a new one. It ends when its channel is closed."""
    return _ready.pop() if _ready else _start()


def _start() -> Child:
    return start(_START, sys.path, {**os.environ, "TK_THREADS": _threads()})


def _threads() -> str:
    """Threads of the process's kernels: half the cores, because the tracker should not wait; at most TK_THREADS."""
    asked = os.environ.get("TK_THREADS")
    half = max(cores() // 2, 1)
    return str(min(half, int(asked)) if asked else half)
