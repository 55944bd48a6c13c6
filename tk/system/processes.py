"""A second Python process, and the channel to it.

Linux: a socket, which carries descriptors of files, too. Elsewhere: two pipes, and files go by their names.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import select
import socket
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from tk.system import portable
from tk.system.files import NamelessFile

_SIZE = struct.Struct("<Q")  # bytes of a message, before it
_MOST_FILES = 8  # in a message


class _Stream(Protocol):
    """What carries bytes, and files beside them."""

    def write(self, data: bytes, files: Sequence[NamelessFile]) -> None: ...

    def read(self, size: int) -> bytes: ...

    def describe(self, file: NamelessFile) -> str: ...

    def open(self, described: str) -> NamelessFile: ...

    def waiting(self) -> bool: ...

    def close(self) -> None: ...


class Channel:
    """One end of the connection of two processes. A :class:`NamelessFile` in a message arrives open."""

    def __init__(self, stream: _Stream) -> None:
        self._stream = stream

    def send(self, message: object) -> None:
        """Send a message; EOFError if the other end is closed."""
        data = io.BytesIO()
        pickler = _Pickler(data, self._stream)
        pickler.dump(message)
        try:
            self._stream.write(_SIZE.pack(data.tell()) + data.getvalue(), pickler.files)
        except OSError:
            raise EOFError from None

    def receive(self) -> Any:
        """Return the next message; EOFError if the other end is closed."""
        (size,) = _SIZE.unpack(self._exactly(_SIZE.size))
        return _Unpickler(io.BytesIO(self._exactly(size)), self._stream).load()

    def _exactly(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            try:
                part = self._stream.read(size - len(data))
            except OSError:
                part = b""
            if not part:
                raise EOFError
            data += part
        return bytes(data)

    def waiting(self) -> bool:
        """Return whether :meth:`receive` need not wait; False where the system cannot tell."""
        return self._stream.waiting()

    def close(self) -> None:
        """Close this end. Closing twice is fine."""
        self._stream.close()


class _Pickler(pickle.Pickler):
    def __init__(self, data: io.BytesIO, stream: _Stream) -> None:
        super().__init__(data)
        self._stream = stream
        self.files: list[NamelessFile] = []

    def persistent_id(self, item: object) -> str | None:
        if not isinstance(item, NamelessFile):
            return None
        self.files.append(item)
        return self._stream.describe(item)


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: io.BytesIO, stream: _Stream) -> None:
        super().__init__(data)
        self._stream = stream

    def persistent_load(self, described: str) -> NamelessFile:
        return self._stream.open(described)


class _Socket:
    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._handles: deque[int] = deque()  # that have arrived, in the order of the message

    def write(self, data: bytes, files: Sequence[NamelessFile]) -> None:
        sent = socket.send_fds(self._end, [data], [file.handle for file in files]) if files else 0
        self._end.sendall(data[sent:])

    def read(self, size: int) -> bytes:
        data, handles, _, _ = socket.recv_fds(self._end, size, _MOST_FILES)
        self._handles.extend(handles)
        return data

    def describe(self, file: NamelessFile) -> str:
        return ""

    def open(self, described: str) -> NamelessFile:
        return NamelessFile(self._handles.popleft())

    def waiting(self) -> bool:
        return bool(select.select([self._end], [], [], 0)[0])

    def close(self) -> None:
        self._end.close()


class _Pipes:
    def __init__(self, source: io.FileIO, sink: io.FileIO) -> None:
        self._source, self._sink = source, sink
        self._kept: list[NamelessFile] = []  # until the other process has opened them

    def write(self, data: bytes, files: Sequence[NamelessFile]) -> None:
        rest = memoryview(data)
        while len(rest):
            rest = rest[self._sink.write(rest) :]

    def read(self, size: int) -> bytes:
        return self._source.read(size) or b""

    def describe(self, file: NamelessFile) -> str:
        self._kept.append(file)
        return str(file.path)

    def open(self, described: str) -> NamelessFile:
        return NamelessFile.of(Path(described))

    def waiting(self) -> bool:
        return False  # Windows cannot tell

    def close(self) -> None:
        for pipe in (self._sink, self._source):
            with contextlib.suppress(OSError):
                pipe.close()


@dataclass(frozen=True)
class Child:
    """A process that this one has started, and this end of the channel to it."""

    process: subprocess.Popen[bytes]
    channel: Channel

    def close(self) -> None:
        """End the process at once."""
        self.channel.close()
        self.process.kill()
        self.process.wait()


def start(code: str, arguments: Sequence[str], environment: Mapping[str, str]) -> Child:
    """Start a Python process, which gets its end of the channel by :func:`parent`. Ctrl-C is for this process only.

    Raises:
        OSError: the system starts no further process.
    """
    command = [sys.executable, "-c", code, *arguments]

    def run(source: Any, sink: int) -> subprocess.Popen[bytes]:
        group = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)  # Windows has no sessions
        return subprocess.Popen(
            command, bufsize=0, env=environment, stdin=source, stdout=sink, start_new_session=True, creationflags=group
        )

    if portable():
        process = run(subprocess.PIPE, subprocess.PIPE)
        assert isinstance(process.stdin, io.FileIO) and isinstance(process.stdout, io.FileIO)
        return Child(process, Channel(_Pipes(process.stdout, process.stdin)))
    ours, theirs = socket.socketpair()
    with theirs:
        return Child(run(theirs, subprocess.DEVNULL), Channel(_Socket(ours)))


def parent() -> Channel:
    """Return the end of the channel to the process that has started this one. Call it once, before any output."""
    source, sink = os.dup(0), os.dup(1)
    with open(os.devnull, "r+b", buffering=0) as nowhere:  # what libraries print must not get into the channel
        for stream in (0, 1):
            os.dup2(nowhere.fileno(), stream)
    if portable():
        return Channel(_Pipes(io.FileIO(source, "r"), io.FileIO(sink, "w")))
    os.close(sink)
    return Channel(_Socket(socket.socket(fileno=source)))
