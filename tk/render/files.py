"""Write files completely or not at all, and replace none without permission."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from tk.errors import ExportError


def check_target(path: Path, force: bool = False) -> Path:
    """Return the path, if a file may be written there.

    Raises:
        ExportError: it is a folder, its folder does not exist, or it exists and ``force`` is not set.
    """
    if path.is_dir():
        raise ExportError(f"{path}: is a folder; name a file in it")
    if not path.parent.is_dir():
        raise ExportError(f"{path}: the folder {path.parent} does not exist; make it first")
    if path.exists() and not force:
        raise ExportError(f"{path}: exists; choose another name with -o, or replace it with --force")
    return path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path, which is renamed to ``path`` when the block ends without an error.

    Raises:
        ExportError: the file cannot be written.
    """
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        if part.exists():
            os.replace(part, path)
    except OSError as error:
        raise ExportError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
