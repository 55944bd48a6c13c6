"""The process that makes frames ahead. A command starts it first of all: both processes then import at the same time.

Nothing heavy is imported here.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

_START = "import sys; sys.path[:] = sys.argv[2:]; from tk.run.prefetch import serve; serve(int(sys.argv[1]))"


@dataclass(frozen=True)
class Worker:
    """A started process, and this end of the socket to it."""

    process: subprocess.Popen[bytes]
    end: socket.socket

    @staticmethod
    def start() -> Worker:
        """Start a process. It ends when the other end of its socket is closed."""
        ours, theirs = socket.socketpair()
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-c", _START, str(theirs.fileno()), *sys.path],
                env={**os.environ, "TK_THREADS": _threads()},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                start_new_session=True,  # Ctrl-C is for the tracker, which then ends this process
            )
        return Worker(process, ours)

    def close(self) -> None:
        """End the process at once."""
        self.end.close()
        self.process.kill()
        self.process.wait()


_ready: list[Worker] = []


@contextlib.contextmanager
def started_early() -> Iterator[None]:
    """Start a process that :func:`take` returns inside, if there is a second core; end it if nobody takes it."""
    if cores() > 1 and sys.executable:
        _ready.append(Worker.start())
    try:
        yield
    finally:
        dismiss()


def dismiss() -> None:
    """End a process that was started early and that nobody has taken."""
    while _ready:
        _ready.pop().close()


def take() -> Worker:
    """Return a process: the one that was started early, else a new one."""
    return _ready.pop() if _ready else Worker.start()


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _threads() -> str:
    """Threads of the process's kernels: half the cores, because the tracker should not wait; at most TK_THREADS."""
    asked = os.environ.get("TK_THREADS")
    half = max(cores() // 2, 1)
    return str(min(half, int(asked)) if asked else half)
