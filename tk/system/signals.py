"""Signals that end a program: Ctrl-C, and a request by the system, a cluster or another program.

The request is SIGTERM, on Windows Ctrl-Break, the only one that a program can receive there. Python handles signals in
the main thread only.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

_REQUESTS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGBREAK") if hasattr(signal, name))


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def request_as_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt inside if the process is asked to end, as Ctrl-C does; a second request is ignored."""
    if not _in_main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        ignore_requests()  # the clean-up goes on
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _REQUESTS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Handle Ctrl-C and requests after the block."""
    if not _in_main_thread():
        yield
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, *_REQUESTS)}
    handlers = {number: handler for number, handler in handlers.items() if handler is not None}  # set from Python
    for number in handlers:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for caught in received:
            signal.raise_signal(caught)


def ignore_requests() -> None:
    """Ignore requests to end from now on."""
    for number in _REQUESTS:
        signal.signal(number, signal.SIG_IGN)


def how_it_ended(code: int) -> str:
    """Return how a process with this exit code ended, as a message says it. Windows has no signals that end one."""
    if code >= 0:
        return f"ended with code {code}"
    name = signal.Signals(-code).name
    return f"was ended by {name}{' (out of memory?)' if name == 'SIGKILL' else ''}"
