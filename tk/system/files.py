"""Files without a name, locks, and names of files that are open.

Windows neither removes nor replaces a file while a program has it open, unless the program has permitted it.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import shutil
import tempfile
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path

from tk.system import LINUX, WINDOWS, portable

if LINUX:
    import fcntl

#: name of the lock in a locked folder, except on Linux
LOCK = ".lock"

#: seconds for which a file that another program reads is waited for
BUSY_S = 5.0
_RETRY_S = 0.05
#: flags of a file whose name goes with its last user; O_TEMPORARY is known to Windows only
_OPEN = os.O_RDWR | getattr(os, "O_BINARY", 0) | getattr(os, "O_TEMPORARY", 0)


class NamelessFile:
    """A file that goes with the last process that has it open, even with a killed one.

    Linux: it has no name. Elsewhere: it has one until a second process has opened it, or :meth:`hide`.

    Attributes:
        handle: its descriptor, closed with the object.
        path: its name; None if it has none.
    """

    def __init__(self, handle: int, path: Path | None = None) -> None:
        self.handle, self.path = handle, path
        self._lock = threading.Lock()
        weakref.finalize(self, _close, handle, path)

    @staticmethod
    def in_folder(folder: str | os.PathLike[str]) -> NamelessFile:
        """Return a new, empty file on the disk of a folder; OSError if there can be none."""
        if portable():
            path = Path(folder, f".tk-{os.urandom(16).hex()}")
            return NamelessFile(os.open(path, _OPEN | os.O_CREAT | os.O_EXCL, 0o600), path)
        with tempfile.TemporaryFile(dir=folder) as file:
            return NamelessFile(os.dup(file.fileno()))

    @staticmethod
    def in_memory(size: int) -> NamelessFile:
        """Return a new file of ``size`` bytes, 0, which the system need not write to a disk; OSError if there is
        none."""
        file = NamelessFile.in_folder(tempfile.gettempdir()) if portable() else NamelessFile(os.memfd_create("tk"))
        file.truncate(size)
        return file

    @staticmethod
    def of(path: Path) -> NamelessFile:
        """Open the file of another process by its name, and remove the name."""
        file = NamelessFile(os.open(path, _OPEN), path)
        file.hide()
        return file

    def hide(self) -> None:
        """Remove the name: nobody else will open the file."""
        if self.path is not None:
            with contextlib.suppress(OSError):
                os.unlink(self.path)
            self.path = None

    def size(self) -> int:
        """Return the number of bytes."""
        return os.fstat(self.handle).st_size

    def truncate(self, size: int) -> None:
        """Set the number of bytes; OSError if there is no room."""
        os.ftruncate(self.handle, size)

    def read(self, size: int, place: int) -> bytes:
        """Return at most ``size`` bytes from ``place`` on."""
        if not portable():
            return os.pread(self.handle, size, place)
        with self._lock:
            os.lseek(self.handle, place, os.SEEK_SET)
            return os.read(self.handle, size)

    def write(self, parts: Sequence[memoryview], place: int) -> int:
        """Write at ``place``; return the number of bytes written, fewer than given if the disk becomes full."""
        if not portable():
            return os.pwritev(self.handle, parts, place)
        with self._lock:
            os.lseek(self.handle, place, os.SEEK_SET)
            return sum(os.write(self.handle, part) for part in parts)

    def map(self) -> mmap.mmap:
        """Return the file's bytes as memory, which lasts longer than this object."""
        return mmap.mmap(self.handle, self.size())


def _close(handle: int, path: Path | None) -> None:
    os.close(handle)
    if path is not None:
        with contextlib.suppress(OSError):
            os.unlink(path)


def give_back(memory: mmap.mmap, start: int, size: int) -> None:
    """Let the system have a part of a mapped :class:`NamelessFile`, whose bytes become 0 or stay.

    Only Linux can. Elsewhere, the system may write the part to the disk of temporary files.
    """
    if not portable():
        memory.madvise(mmap.MADV_REMOVE, start, size)


def locked(folder: Path, busy: Exception) -> contextlib.AbstractContextManager[None]:
    """Lock a folder; raise ``busy`` if another process has locked it. The lock ends with the process.

    Some file systems have no locks; nothing is locked there.
    """
    return (_sqlite_lock if portable() else _folder_lock)(folder, busy)


@contextlib.contextmanager
def _folder_lock(folder: Path, busy: Exception) -> Iterator[None]:
    handle, close = os.open(folder, os.O_RDONLY), os.close  # at the interpreter's end, `os` may go first
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise busy from None
        except OSError:
            pass
        yield
    finally:
        close(handle)


@contextlib.contextmanager
def _sqlite_lock(folder: Path, busy: Exception) -> Iterator[None]:
    """Lock a file in the folder by an empty transaction: only SQLite's locks are in Python on all systems."""
    import sqlite3  # 5 ms, which Linux need not spend

    file = folder / LOCK
    lock = sqlite3.connect(file, timeout=0, isolation_level=None, check_same_thread=False)
    try:
        try:
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if "locked" in str(error):
                raise busy from None
        yield
        with contextlib.suppress(PermissionError):  # Windows: while it is open
            file.unlink(missing_ok=True)
    finally:
        lock.close()
    if WINDOWS:  # elsewhere the file may be another process's by now
        with contextlib.suppress(OSError):
            file.unlink()


def replace(source: Path, target: Path, patience_s: float = BUSY_S) -> None:
    """Give a closed file the name of another one, which goes; wait for a program that has it open.

    Raises:
        OSError: the system refuses.
    """
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return os.replace(source, target)
        except PermissionError:
            if not portable() or time.monotonic() > deadline:
                raise
        time.sleep(_RETRY_S)


def publish(source: Path, spare: Path, target: Path) -> bool:
    """Give the bytes of a file that this process has open another name, all at once.

    Args:
        source: the file; its writer has flushed it.
        spare: a name in the same folder, for a moment.
        target: the name.

    Returns:
        whether the name belongs to the file itself from now on, which must then stay as it is; else to a copy.

    Raises:
        OSError: the system refuses.
    """
    spare.unlink(missing_ok=True)  # left by a call that failed
    copied = True
    if portable():  # Windows gives no second name to an open file
        shutil.copyfile(source, spare)
    else:
        copied = link_or_copy(source, spare)
    replace(spare, target)
    return not copied


def link_or_copy(original: Path, target: Path) -> bool:
    """Give a file a second name, or copy it if the file system has none; return whether it is a copy."""
    try:
        os.link(original, target)
        return False
    except OSError:
        shutil.copy2(original, target)
        return True
