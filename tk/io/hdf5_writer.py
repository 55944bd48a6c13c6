"""Write an HDF5 file that is complete under its name at any time, also after ``kill -9`` and on a full disk.

HDF5 changes its metadata in place and in several steps, so a process that is killed meanwhile leaves a file that does
not open. A published file is therefore never changed. Two files with the same bytes, the twins, are in a hidden folder
beside it. HDF5 writes to one of them. :meth:`Hdf5Writer.publish` gives this twin the published name. Before the next
write, the other twin receives the same changes, and HDF5 continues there. Where an open file can have no second name, a
copy is published, and there is one twin. Only a closed file is synced to the disk, so a power cut may lose an open one.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py

from tk.errors import FULL, DiskFullError, ResultBusyError, ResultError
from tk.system.files import locked, publish
from tk.system.signals import deferred

#: exceptions that h5py raises for a full disk, a removed folder or a damaged file
_WRITE_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError)

_File = io.FileIO | io.BytesIO


class Hdf5Writer:
    """An HDF5 file under construction; a context manager. A lock on the hidden folder excludes other runs.

    Attributes:
        file: the HDF5 file; changes become visible with :meth:`publish` or :meth:`close`.

    Args:
        target: path of the published file.
        source: file to start from; None for an empty one.

    Raises:
        ResultBusyError: another run is writing the file.
        OSError: the system cannot write it; see :func:`writing`.
    """

    def __init__(self, target: Path, source: Path | None = None) -> None:
        self._target = target
        self._folder = target.with_name(f".{target.name}.tmp")
        self._folder.mkdir(exist_ok=True)
        with contextlib.ExitStack() as undo:
            busy = f"{target}: another run is writing this result; wait for it, or choose another name"
            undo.enter_context(locked(self._folder, ResultBusyError(busy)))
            undo.callback(shutil.rmtree, self._folder, ignore_errors=True)
            for leftover in self._folder.glob("*.h5"):  # of a run that was killed
                leftover.unlink()
            self._twins = _Twins(self._folder, source)
            undo.callback(self._twins.close)
            # libver: newer superblocks have a flag "being written"; a killed process leaves it set, and HDF5 then
            # refuses to open the file
            # rdcc_nbytes: HDF5 would keep 1 MB of each dataset's rows, 110 MB after 36,000 frames
            self.file = h5py.File(self._twins, "r+" if source else "w", libver="earliest", rdcc_nbytes=0)
            self._clean_up = undo.pop_all()
        self._close_file = weakref.finalize(self, self.file.close)  # HDF5 itself would call Python too late at exit

    def flush(self) -> None:
        """Write all that HDF5 holds back; raise OSError if a write has failed."""
        self.file.flush()
        self._twins.check()

    def publish(self) -> None:
        """Make all changes visible in the target; raise OSError if a write has failed."""
        self.flush()
        self._rename()

    def close(self, publish: bool = True) -> None:
        """Close the file, publish it if requested, and remove the hidden folder. A second call does nothing."""
        if not self.file:
            return
        with self._clean_up:
            self._close_file()  # HDF5 changes the file while closing it
            if publish:
                self._twins.check()
                with self._twins.path.open("r+b") as stream:  # Windows syncs only what may be written
                    os.fsync(stream.fileno())
                self._rename()
        with contextlib.suppress(OSError):  # still there on Windows, where the lock's file goes with the lock
            self._folder.rmdir()

    def __enter__(self) -> Hdf5Writer:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(publish=kind is None)

    def _rename(self) -> None:
        if publish(self._twins.path, self._folder / "new.h5", self._target):
            self._twins.keep()


class _Twins:
    """Two files with the same bytes, as one file object for h5py.

    HDF5 (1.10 to 2.0) does not survive a failed write: it can neither flush nor close the file, tries again when the
    process ends, and crashes. A change that fails is therefore made in a copy in memory, as are all later ones.

    Attributes:
        path: the twin that HDF5 reads and writes.
    """

    def __init__(self, folder: Path, source: Path | None) -> None:
        self.path, self._other_path = folder / "0.h5", folder / "1.h5"
        if source:
            shutil.copyfile(source, self.path)
        self._file: _File = io.FileIO(self.path, "r+" if source else "w+")
        self._other: _File | None = None
        self._changes: list[Callable[[_File], object]] = []  # changes that the other twin still misses
        self._kept = False
        self._error: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)  # seek, tell, readinto …

    def check(self) -> None:
        """Raise the error of the first change that failed."""
        if self._error is not None:
            raise self._error

    def keep(self) -> None:
        """Leave this twin as it is: further changes go to the other one."""
        self._kept = True

    def close(self) -> None:
        self._file.close()
        if self._other:
            self._other.close()

    def write(self, data: memoryview) -> int:
        place, content = self._file.tell(), bytes(data)
        self._change(lambda file: _write(file, place, content))
        return len(content)

    def truncate(self, size: int) -> None:
        self._change(lambda file: file.truncate(size))

    def _change(self, change: Callable[[_File], object]) -> None:
        try:
            if self._kept and self._error is None:
                self._swap()
            change(self._file)
            if self._other is not None:
                self._changes.append(change)
        except OSError as error:
            self._error = error
            self._file.close()
            self._file = io.BytesIO(self.path.read_bytes())
            change(self._file)

    def _swap(self) -> None:
        """Bring the other twin up to date and continue in it."""
        if self._other is None:
            shutil.copyfile(self.path, self._other_path)
            self._other = io.FileIO(self._other_path, "r+")
        else:
            for change in self._changes:
                change(self._other)
        self._changes.clear()
        self.path, self._other_path = self._other_path, self.path
        self._file, self._other = self._other, self._file
        self._kept = False


def _write(file: _File, place: int, data: bytes) -> None:
    rest = memoryview(data)
    file.seek(place)
    while len(rest):  # a disk that becomes full takes a part
        rest = rest[file.write(rest) :]


@contextlib.contextmanager
def writing(target: Path, hint: str = "make space, then continue with --resume") -> Iterator[None]:
    """Convert errors of the system and of HDF5 to a ResultError of one line; handle signals after the block.

    A signal handler that raises an exception, as for Ctrl-C, would interrupt HDF5 where it calls Python. ``hint`` is
    the remedy for a full disk.
    """
    try:
        with deferred():
            yield
    except _WRITE_ERRORS as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        kind = DiskFullError if getattr(error, "errno", None) in FULL else ResultError
        raise kind(f"{target}: cannot be written: {reason}", hint if kind is DiskFullError else "") from error
