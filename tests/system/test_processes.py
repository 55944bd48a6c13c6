"""A second process and its channel, and the signals that end programs, on Linux and on all other systems."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tk.system.files import NamelessFile
from tk.system.processes import Child, start
from tk.system.signals import deferred, how_it_ended, request_as_interrupt

pytestmark = pytest.mark.usefixtures("system")

ECHO = """
import sys
sys.path[:] = sys.argv[1:]
from tk.system.processes import parent
channel = parent()
print("what libraries print")
try:
    while True:
        message = channel.receive()
        if isinstance(message, dict):
            message["file"].write([memoryview(b"theirs")], 4)
            message = sorted(message)
        channel.send(message)
except EOFError:
    raise SystemExit(7)
"""


@pytest.fixture
def child() -> Iterator[Child]:
    started = start(ECHO, sys.path, os.environ)
    yield started
    started.close()


def test_messages_of_any_size_arrive_in_order(child: Child) -> None:
    large = np.arange(1_000_000)
    for message in ("text", 3, None, large):
        child.channel.send(message)
        received = child.channel.receive()
        assert np.array_equal(received, message)
    child.channel.close()
    assert child.process.wait(20) == 7  # the process sees that the channel is closed


def test_file_in_a_message_is_open_in_both_processes(child: Child, tmp_path: Path) -> None:
    file = NamelessFile.in_folder(tmp_path)
    file.write([memoryview(b"our ")], 0)
    child.channel.send({"file": file, "other": NamelessFile.in_memory(10)})
    assert child.channel.receive() == ["file", "other"]
    assert file.read(20, 0) == b"our theirs"
    assert not list(tmp_path.iterdir())


def test_killed_process_is_noticed_and_named(child: Child) -> None:
    child.process.kill()
    with pytest.raises(EOFError):
        child.channel.receive()
    with pytest.raises(EOFError):
        for _ in range(1000):  # the system may take some before it notices
            child.channel.send(b"x" * 100_000)
    assert how_it_ended(child.process.wait()) == "was ended by SIGKILL (out of memory?)"
    assert how_it_ended(3) == "ended with code 3"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_the_end_of_a_block(number: int) -> None:
    reached = False
    with pytest.raises(KeyboardInterrupt), request_as_interrupt(), deferred():
        signal.raise_signal(number)
        reached = True
    assert reached


def test_second_request_to_end_does_not_stop_the_clean_up() -> None:
    before, cleaned = signal.getsignal(signal.SIGTERM), False
    with pytest.raises(KeyboardInterrupt), request_as_interrupt():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGTERM)
            cleaned = True
    assert cleaned and signal.getsignal(signal.SIGTERM) is before
