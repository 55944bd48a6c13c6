"""Write files completely or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from tk.errors import ExportError, unwritable


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
        raise unwritable(path, error, ExportError) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
