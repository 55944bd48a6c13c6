"""Where a result is made before it takes its name, and what the file system says to it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import h5py

from tk.errors import ConfigError, ResultBusyError, ResultError
from tk.io.hdf5 import open_hdf5
from tk.io.results.data import FORMAT


class Workshop:
    """The hidden folder beside a result in which its twins are made. Holding it keeps other runs away."""

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
            pass  # no locks on this file system: nothing keeps a second run away
        for leftover in self._folder.iterdir():  # of a run that was killed
            leftover.unlink()
        self.twin_paths = (self._folder / "0.h5", self._folder / "1.h5")

    def publish(self, twin: Path) -> None:
        """Let the result's name stand for this twin, in one step."""
        new = self._folder / "new.h5"
        try:
            os.link(twin, new)
        except FileExistsError:  # a rename failed before
            new.unlink()
            os.link(twin, new)
        except OSError:
            shutil.copyfile(twin, new)
        os.replace(new, self._target)

    def close(self) -> None:
        os.close(self._handle)
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Workshop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# --- files and their errors -------------------------------------------------------------------------------------------


#: what h5py raises for a full disk, a lost folder, or a file that turns out to be damaged
WRITE_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError)


def open_for_writing(path: Path, mode: str) -> h5py.File:
    # "earliest": newer superblocks carry a flag "being written" that a killed process leaves set, and the file then
    # refuses to open. No locks: readers of the published twin must not be kept out.
    return h5py.File(path, mode, libver="earliest", locking=False)


def check_is_result(target: Path) -> None:
    """Refuse to replace what is not a result of any version."""
    try:
        with open_hdf5(target) as file:
            if file.is_format(FORMAT):
                return
    except ResultError:
        pass
    raise ResultError(f"{target}: exists and is not a {FORMAT}; it is not overwritten: choose another name")


def check_output(path: Path, force: bool, resume: bool = False) -> None:
    """Refuse a path where a result cannot be written, or must not be: nothing that exists is replaced unasked.

    Args:
        path: where the result is to be.
        force: replace a result that is there; other files are left alone all the same.
        resume: go on with a result that is there.

    Raises:
        ResultError: what is there, and what to do about it.
        ConfigError: both ``force`` and ``resume``.
    """
    if force and resume:
        raise ConfigError("--force replaces a result and --resume goes on with it: give one of them")
    target = writable(path)
    if resume or not target.exists():
        return
    check_is_result(target)
    if not force:
        raise ResultError(f"{path}: exists; go on with it by --resume, replace it by --force, or choose another name")


def move_to_memory(file: h5py.File) -> None:
    """After a failed write: let HDF5 go on in memory, for the file is lost.

    HDF5 1.10 to 2.0 crash the process when a file is closed, at the latest at exit, that still cannot be written.
    """
    if not hasattr(os, "memfd_create"):  # Linux
        return
    handle = file.id.get_vfd_handle()
    memory = os.memfd_create("tk-result")
    size, done = os.fstat(handle).st_size, 0
    while done < size:
        done += os.sendfile(memory, handle, done, size - done)
    os.dup2(memory, handle)
    os.close(memory)


@contextlib.contextmanager
def as_result_error(target: Path) -> Iterator[None]:
    """The system's and HDF5's refusals as one line; HDF5 reports a full disk as either of the two types."""
    try:
        yield
    except WRITE_ERRORS as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        system = re.search(r"error message = '([^']+)'", reason)
        reason = system[1] if system else reason
        raise ResultError(f"{target}: cannot be written: {reason}") from error


def writable(path: Path) -> Path:
    """The path with links followed, so that a rename does not replace the link; refuse what can be seen to fail."""
    target = path.resolve()
    if target.is_dir():
        raise ResultError(f"{path}: is a folder; name a file in it")
    if not target.parent.is_dir():
        raise ResultError(f"{path}: the folder {target.parent} does not exist; make it first")
    if target.exists() and not (target.is_file() and os.access(target, os.W_OK)):
        raise ResultError(f"{path}: cannot be written; choose another name")
    return target
