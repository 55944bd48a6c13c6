"""The machine and the user's folders."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from tk.system import LINUX, WINDOWS, portable


def cores() -> int:
    """Return the number of cores that this process may use; all of the machine where the system limits no process."""
    return (os.cpu_count() or 1) if portable() else len(os.sched_getaffinity(0))


def available_memory() -> int | None:
    """Return the bytes of memory that programs may still use; None if the system does not report them."""
    if portable():
        return None
    # MemAvailable counts what the system's cache can give back, too
    found = re.search(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text(encoding="ascii"))
    return 1024 * int(found[1]) if found else None


def cache_folder() -> Path:
    """Return the system's folder for files that programs can make again; it need not exist."""
    if WINDOWS:
        base = os.environ.get("LOCALAPPDATA", "")
    elif LINUX:
        base = os.environ.get("XDG_CACHE_HOME", "")
    else:
        base = os.path.join("~", "Library", "Caches")
    return Path(os.path.expanduser(base or os.path.join("~", ".cache")))  # the password file has homes


def temporary_folder(name: str) -> Path:
    """Return a folder of temporary files for this user; it need not exist, and :func:`is_ours` says whose it is."""
    return Path(tempfile.gettempdir()) / f"{name}-{_user()}"


def is_ours(path: Path) -> bool:
    """Return whether a file or folder belongs to this user."""
    return path.stat().st_uid == _user()


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0  # Windows numbers no users; os.stat then says 0
