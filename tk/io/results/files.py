"""The hidden folder in which a result is written, checks of the output path, and file system errors."""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import shutil
import signal
import threading
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import h5py

from tk.errors import FULL, ConfigError, DiskFullError, ResultBusyError, ResultError
from tk.io.hdf5 import open_hdf5
from tk.io.paths import Kind, check_output
from tk.io.results.schema import FORMAT


class TwinFolder:
    """The hidden folder beside a result in which its two twins are written. A lock on it excludes other runs."""

    def __init__(self, target: Path) -> None:
        self._target = target
        self._folder = target.with_name(f".{target.name}.tmp")
        self._folder.mkdir(exist_ok=True)
        self._handle = os.open(self._folder, os.O_RDONLY)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._handle)
            raise ResultBusyError(
                f"{target}: another run is writing this result; wait for it, or choose another name"
            ) from None
        except OSError:
            pass  # this file system has no locks: a second run is not detected
        for leftover in self._folder.iterdir():  # of a run that was killed
            leftover.unlink()
        self.twin_paths = (self._folder / "0.h5", self._folder / "1.h5")

    def publish(self, twin: Path) -> None:
        """Give this twin the name of the result, in one rename."""
        new = self._folder / "new.h5"
        try:
            os.link(twin, new)
        except FileExistsError:  # left by an earlier rename that failed
            new.unlink()
            os.link(twin, new)
        except OSError:
            shutil.copyfile(twin, new)
        os.replace(new, self._target)

    def close(self) -> None:
        os.close(self._handle)
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> TwinFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# --- files and their errors -------------------------------------------------------------------------------------------


#: exceptions that h5py raises for a full disk, a removed folder or a damaged file
WRITE_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError)


class SafeFile:
    """An HDF5 file for writing, and the file on disk beneath it; a context manager.

    HDF5 (1.10 to 2.0) does not survive a failed write: it can neither flush nor close the file, tries again when the
    process ends, and crashes. HDF5 therefore writes through this object (h5py's driver for file-like objects). After a
    failure, its writes go to memory and succeed, and :meth:`flush_to_disk` and the end of the block raise the error.

    Attributes:
        path: path of the file.
        file: the HDF5 file.
    """

    def __init__(self, path: Path, mode: str) -> None:
        self.path = path
        self._handle = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT | os.O_TRUNC if mode == "w" else 0), 0o666)
        self._memory: io.BytesIO | None = None
        self._error: OSError | None = None
        self._place = 0
        try:
            # libver: newer superblocks have a flag "being written"; a killed process leaves it set, and HDF5 then
            # refuses to open the file
            # rdcc_nbytes: HDF5 would keep 1 MB of each dataset's rows, 110 MB after 36,000 frames
            self.file = h5py.File(self, mode, libver="earliest", rdcc_nbytes=0)
        except BaseException:
            os.close(self._handle)
            raise
        self._closed_at_exit = weakref.finalize(self, self.file.close)  # HDF5 itself would call Python too late

    def flush_to_disk(self) -> None:
        """Write all that HDF5 holds back; raise OSError if a write has failed."""
        self.file.flush()
        if self._error is not None:
            raise self._error

    def __enter__(self) -> SafeFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if not self.file:  # closed already
            return
        self._closed_at_exit()
        os.close(self._handle)
        if kind is None and self._error is not None:
            raise self._error

    # --- called by HDF5 -------------------------------------------------------------------------------------------

    def write(self, data: memoryview) -> int:
        rest = memoryview(data).cast("B")
        try:
            while len(rest) and self._memory is None:  # a disk that becomes full takes a part
                done = os.pwrite(self._handle, rest, self._place)
                rest, self._place = rest[done:], self._place + done
        except OSError as error:
            self._divert(error)
        if self._memory is not None:
            self._memory.seek(self._place)
            self._place += self._memory.write(rest)
        return len(data)

    def truncate(self, size: int) -> None:
        try:
            if self._memory is None:
                os.ftruncate(self._handle, size)
        except OSError as error:
            self._divert(error)
        if self._memory is not None:
            self._memory.truncate(size)

    def readinto(self, buffer: memoryview) -> int:
        if self._memory is None:
            data = os.pread(self._handle, len(buffer), self._place)
        else:
            self._memory.seek(self._place)
            data = self._memory.read(len(buffer))
        buffer[: len(data)] = data
        self._place += len(data)
        return len(data)

    def read(self, size: int) -> bytes:
        buffer = bytearray(size)
        return bytes(buffer[: self.readinto(memoryview(buffer))])

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset += len(self._memory.getbuffer()) if self._memory else os.fstat(self._handle).st_size
        self._place = offset
        return offset

    def tell(self) -> int:
        return self._place

    def flush(self) -> None:
        pass

    def _divert(self, error: OSError) -> None:
        """Continue in memory."""
        self._error = error
        with self.path.open("rb") as file:
            self._memory = io.BytesIO(file.read())


@contextlib.contextmanager
def writing(target: Path) -> Iterator[None]:
    """Convert errors of the system and of HDF5 to a ResultError of one line; handle signals after the block.

    A signal handler that raises an exception, as for Ctrl-C, would interrupt HDF5 in a call of :class:`SafeFile`.
    """
    try:
        with _signals_deferred():
            yield
    except WRITE_ERRORS as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        kind = DiskFullError if getattr(error, "errno", None) in FULL else ResultError
        hint = "make space, then continue with --resume" if kind is DiskFullError else ""
        raise kind(f"{target}: cannot be written: {reason}", hint) from error


@contextlib.contextmanager
def _signals_deferred() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # Python handles signals in the main thread only
        yield
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
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


def is_hdf5_of(path: Path, name: str) -> bool:
    """Return whether a file is HDF5 with this value of the attribute `format`, of any version."""
    try:
        with open_hdf5(path) as file:
            return file.is_format(name)
    except ResultError:
        return False


#: suffixes of tk's HDF5 files
SUFFIXES = (".h5", ".hdf5")
RESULT = Kind(f"a {FORMAT}", SUFFIXES, lambda path: is_hdf5_of(path, FORMAT))


#: for files whose content is checked later
ANY_HDF5 = replace(RESULT, is_one=lambda _: True)


def check_result_path(
    path: Path,
    force: bool,
    resume: bool = False,
    inputs: Sequence[Path | None] = (),
    capture: Path | None = None,
) -> None:
    """Raise an error if a result cannot be written to the path, or if a file exists that must not be replaced.

    Args:
        path: path of the result.
        force: replace an existing result.
        resume: continue an existing result.
        inputs, capture: see :func:`tk.io.paths.check_output`.

    Raises:
        ResultError: the path cannot be used; the message says what to do.
        ConfigError: ``force`` and ``resume`` are both set, or the path is an input.
    """
    if force and resume:
        raise ConfigError("force replaces a result and resume continues it: choose one of them")
    try:
        check_output(path, ANY_HDF5 if resume else RESULT, force or resume, inputs, capture, ResultError)
    except ResultError as error:
        if error.hint:
            error.hint = "continue it with --resume, or replace it with --force"
        raise
