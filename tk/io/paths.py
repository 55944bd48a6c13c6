"""Paths that a user gives: where a command may write, and names for C libraries.

An output never replaces an input: not by its name, not through a link, not inside a capture's own folders. `--force`
replaces only a file of the kind that the command writes.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tk.errors import ConfigError, ExportError, TkError, unwritable
from tk.io.toml import load_toml
from tk.system.files import replace

#: files and folders of a capture that tk reads
_CAPTURE_PARTS = (
    "calibration.toml", "capture.toml", "session.toml", "truth.h5", "videos", "images", "background", "masks",
    "timestamps",
)  # fmt: skip


#: bytes of a file in which its kind is recognised; the first lines of every format lie in them
_HEAD_BYTES = 4096


@dataclass(frozen=True)
class Kind:
    """A kind of file that tk writes."""

    name: str  # its name in messages, with an article
    suffixes: tuple[str, ...]  # suffixes that its name may have, lower case
    is_one: Callable[[Path], bool]  # returns whether an existing file is of this kind


def looks_like(pattern: bytes) -> Callable[[Path], bool]:
    """Return a function that says whether the first bytes of a file match a regular expression."""

    def check(path: Path) -> bool:
        try:
            with path.open("rb") as file:
                return re.match(pattern, file.read(_HEAD_BYTES), re.DOTALL) is not None
        except OSError:
            return False

    return check


def check_output(
    path: Path,
    kind: Kind,
    force: bool = False,
    inputs: Iterable[Path | None] = (),
    capture: Path | None = None,
    error: type[TkError] = ExportError,
) -> Path:
    """Return the path with links resolved, if a file of this kind may be written there.

    Args:
        path: where to write.
        kind: what to write.
        force: replace an existing file of the kind.
        inputs: files and folders that the command reads; None stands for an input that was not given.
        capture: folder of the capture that the command reads.
        error: raised if the file cannot be written there.

    Raises:
        ConfigError: the path is an input, or has the suffix of another kind.
        TkError: ``error``; the message says what to do instead.
    """
    target = check_not_input(path, inputs, capture)
    if target.is_dir():
        raise error(f"{path}: is a folder; name a file in it")
    if target.suffix.lower() not in kind.suffixes:
        raise ConfigError(f"{path}: {kind.name} must end in {' or '.join(kind.suffixes)}")
    if not target.parent.is_dir():
        raise error(f"{path}: the folder {path.parent} does not exist; make it first")
    if target.exists() or target.is_symlink():
        if not kind.is_one(target):
            raise error(f"{path}: exists and is not {kind.name}; it is not overwritten: choose another name")
        if not force:
            raise error(f"{path}: exists; choose another name", hint="or replace it with --force")
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise error(f"{path}: no permission to write it; choose another name")
    return target


def check_files(
    folder: Path,
    files: Iterable[Path],
    kind: Kind,
    force: bool = False,
    inputs: Iterable[Path | None] = (),
    capture: Path | None = None,
    error: type[TkError] = ExportError,
) -> None:
    """Check files that a command writes into a folder, which need not exist; see :func:`check_output`."""
    check_not_input(folder, inputs, capture)
    for file in files:
        if file.exists():
            check_output(file, kind, force, inputs, capture, error)


def check_not_input(path: Path, inputs: Iterable[Path | None] = (), capture: Path | None = None) -> Path:
    """Return the path with links resolved, if it is not an input and does not lie in one; arguments as of
    :func:`check_output`.

    Raises:
        ConfigError: it is, or it cannot be resolved.
    """
    target = resolved(path)
    given = [part for part in inputs if part is not None]
    if capture is not None:
        given += [part for pattern in _CAPTURE_PARTS for part in sorted(capture.glob(pattern))]
        given += referred_files(capture)
    for part in given:
        real = resolved(part)
        if target == real or (real in target.parents and real.is_dir()):
            where = "is an input of this command" if target == real else f"lies in {part}, an input of this command"
            raise ConfigError(f"{path}: {where}; choose another name")
    if target.is_file():
        identity = _identity(target)
        for file in (file for part in given for file in _files(part)):
            if _identity(file) == identity:
                raise ConfigError(f"{path}: is the same file as an input of this command, {file}; choose another name")
    return target


def referred_files(capture: Path) -> list[Path]:
    """Return the files that `[videos]` in a capture's `capture.toml` names; who reads the capture reports errors."""
    try:
        videos = load_toml(capture / "capture.toml").get("videos")
    except TkError:
        return []
    tables = videos.values() if isinstance(videos, dict) else ()
    given = [table.get("path") for table in tables if isinstance(table, dict)]
    paths = [path for own in given for path in (own if isinstance(own, list) else [own])]
    return [capture / path for path in paths if isinstance(path, str)]


#: an image that tk writes
PNG = Kind("an image", (".png",), looks_like(rb"\x89PNG"))


@contextlib.contextmanager
def replacing(path: Path, kind: type[TkError] = ExportError) -> Iterator[Path]:
    """Yield a temporary path for a file or folder, which is renamed to ``path`` when the block ends without an error.

    Raises:
        TkError: ``kind``: it cannot be written.
    """
    part = path.with_name(f".{path.stem}.part{path.suffix}")  # some writers add a missing suffix
    try:
        yield part
        if part.exists():
            replace(part, path)
    except OSError as error:
        raise unwritable(path, error, kind) from error
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(part) if part.is_dir() else part.unlink()


def resolved(path: Path) -> Path:
    """Return the absolute path without links.

    Raises:
        ConfigError: the links form a loop, or no file can have this name.
    """
    try:
        real = path.resolve()
        os.stat(real)  # from Python 3.13 on, resolve() does not report a loop
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return real
    except (RuntimeError, OSError, ValueError) as reason:
        cause = (isinstance(reason, OSError) and reason.strerror) or " ".join(str(reason).split())
        raise ConfigError(f"{path}: cannot be written: {cause}; choose another name") from None
    return real


def _files(part: Path) -> Iterator[Path]:
    """Yield the files of an input: itself, or all files below the folder."""
    if not part.is_dir():
        yield part
        return
    for folder, _, names in os.walk(part, followlinks=False):
        yield from (Path(folder, name) for name in names)


def _identity(file: Path) -> tuple[int, int] | None:
    """Return what hard links and symbolic links to a file have in common; None if there is no file."""
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def c_name(path: Path, error: type[TkError]) -> str:
    """Return a path as text for OpenCV, FFmpeg and Open3D, which encode it as UTF-8.

    Where the locale is not UTF-8, Python keeps the bytes of a name in a form that they cannot encode; OpenCV 4.10 to
    4.13 then ends the process.

    Raises:
        TkError: ``error``: the name is not UTF-8.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise error(f"{path}: its name is not UTF-8; rename the file") from None


def text_of(name: str | bytes) -> str:
    """Return text that a file can hold: bytes that are not UTF-8 become a replacement character.

    Python, and h5py, read such bytes as surrogates, which cannot be written.
    """
    return (name if isinstance(name, bytes) else name.encode("utf-8", "surrogateescape")).decode("utf-8", "replace")
