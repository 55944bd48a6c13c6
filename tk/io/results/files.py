"""The hidden folder in which a result is written, checks of the output path, and file system errors."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import h5py

from tk.errors import ConfigError, ResultBusyError, ResultError
from tk.io.hdf5 import open_hdf5
from tk.io.paths import Kind, check_output, resolved
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


@contextlib.contextmanager
def opened_for_writing(path: Path, mode: str) -> Iterator[h5py.File]:
    """Open a twin, so that it can be read even if this process is killed; flush and close it at the end.

    A file that cannot be written is redirected to memory before it is closed. Otherwise HDF5 (1.10 to 2.0) keeps it in
    its list of open files, tries to write it once more when the process ends, and crashes.
    """
    # libver: newer superblocks have a flag "being written"; a killed process leaves it set, and HDF5 then refuses to
    # open the file. No locks: other processes must be able to read the published twin.
    file = h5py.File(path, mode, libver="earliest", locking=False)
    try:
        yield file
    finally:
        try:
            file.flush()
        except WRITE_ERRORS:
            _move_to_memory(file)
            raise
        finally:
            file.close()


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


def check_is_result(target: Path) -> None:
    """Raise ResultError if the file is not a tk result of any version."""
    if not RESULT.is_one(target):
        raise ResultError(f"{target}: exists and is not {RESULT.name}; it is not overwritten: choose another name")


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
        # resuming reports by itself what is wrong with a file
        kind = replace(RESULT, is_one=lambda _: True) if resume else RESULT
        check_output(path, kind, force or resume, inputs, capture, ResultError)
    except ResultError as error:
        if error.hint:
            error.hint = "continue it with --resume, or replace it with --force"
        raise


def _move_to_memory(file: h5py.File) -> None:
    if not hasattr(os, "memfd_create"):  # not on Linux
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
    """Convert errors of the system and of HDF5 to a ResultError of one line."""
    try:
        yield
    except WRITE_ERRORS as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        system = re.search(r"error message = '([^']+)'", reason)
        reason = system[1] if system else reason
        raise ResultError(f"{target}: cannot be written: {reason}") from error


def writable(path: Path) -> Path:
    """Return the path with links resolved, so that a rename does not replace the link.

    Raises:
        ResultError: no file can be written there.
    """
    target = resolved(path, ResultError)
    if target.is_dir():
        raise ResultError(f"{path}: is a folder; name a file in it")
    if not target.parent.is_dir():
        raise ResultError(f"{path}: the folder {target.parent} does not exist; make it first")
    if target.is_symlink() or (target.exists() and not (target.is_file() and os.access(target, os.W_OK))):
        raise ResultError(f"{path}: cannot be written; choose another name")
    return target
