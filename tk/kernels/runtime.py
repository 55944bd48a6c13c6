"""The one place where Taichi is imported and started.

Other modules write ``from tk.kernels.runtime import ti`` and call :func:`ensure_runtime` in each public host
function. The runtime starts lazily on the first call; a runtime that the caller made before is left as it is.
Never ``fork`` after it has started: use the ``spawn`` start method for worker processes.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import io
import logging
import os
import tempfile
import time
import warnings
from pathlib import Path

from tk.kernels.source_notes import brief

_LOG = logging.getLogger(__name__)

# Taichi greets on import unless told otherwise; a library has no business on the user's stdout.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_LOG_LEVEL", "error")


def _choose_cache() -> None:
    """Name a folder for compiled kernels where Taichi would find none: without HOME it aborts the process, and where it
    may not write it compiles everything anew at each start."""
    usual = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # the password file knows homes
    if _is_usable(usual):
        if "HOME" not in os.environ:
            os.environ["XDG_CACHE_HOME"] = str(usual)
        return
    temporary = Path(tempfile.gettempdir()) / f"tk-cache-{os.getuid()}"
    # compiled kernels are code: what somebody else has put there is not ours to run
    ours = _is_usable(temporary) and temporary.stat().st_uid == os.getuid()
    os.environ["XDG_CACHE_HOME"] = str(temporary) if ours else tempfile.mkdtemp(prefix="tk-cache-")


def _is_usable(folder: Path) -> bool:
    """Whether the folder is there or can be made, and can be written to."""
    if folder.is_absolute():
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            return os.access(folder, os.W_OK | os.X_OK)
    return False


_choose_cache()

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # taichi's own deprecation notices are not ours to mend
    import taichi as ti

__all__ = ["ensure_runtime", "spread_of", "ti"]

# Taichi hands a CPU thread so many turns of a loop at once; what loop_config says of block_dim changes nothing. Long
# tasks are handed out in about so many shares a thread: one that wakes late, or has the longer tasks, is made up for.
_LEAST_TURNS, _SHARES = 512, 8

# Taichi locks its cache of compiled kernels for milliseconds; an older lock was left by a process that was killed
_STALE_S = 60.0


def ensure_runtime() -> None:
    """Start Taichi on CPU threads unless a runtime exists already.

    ``fast_math`` is off, so that NaN and infinity keep their meaning. ``TK_DEBUG=1`` in the environment turns on
    bounds checking (slow), ``TK_THREADS`` limits the number of CPU threads.
    """
    if ti.lang.impl.get_runtime().prog is not None:
        return
    options: dict[str, object] = {
        "arch": ti.cpu,
        "fast_math": False,
        "default_fp": ti.f32,
        "offline_cache": True,
        "log_level": ti.ERROR,
        "debug": os.environ.get("TK_DEBUG") == "1",
    }
    threads = os.environ.get("TK_THREADS")
    if threads:
        options["cpu_max_num_threads"] = int(threads)
    _break_stale_lock()
    with contextlib.suppress(ImportError, AttributeError):  # another Taichi
        brief(importlib.import_module("taichi.lang.ast.ast_transformer_utils"), ti.lang.kernel_impl)
    _LOG.info("starting the kernels; what this machine has not compiled yet takes some seconds")
    with contextlib.redirect_stdout(io.StringIO()):  # it prints that it starts, whatever the log level
        ti.init(**options)
    # Taichi leaves its program, and the threads of it, to the interpreter's end, which takes modules apart in any order
    atexit.register(ti.reset)


def _break_stale_lock() -> None:
    """Remove the lock that a killed process has left on Taichi's cache of compiled kernels.

    Taichi itself never does: from then on nothing is cached any more, and every start compiles all kernels again.
    """
    with contextlib.suppress(OSError, AttributeError):  # no lock, somebody else's folder, or another Taichi
        folder = Path(
            os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or ti.lang.impl.default_cfg().offline_cache_file_path
        )
        lock = folder / "ticache.lock"
        if time.time() - lock.stat().st_mtime > _STALE_S:
            lock.unlink()


def spread_of(tasks: int) -> int:
    """How many turns of a kernel's loop to give to each of a few long tasks, so that they go to all threads.

    A loop of fewer than 512 turns runs on one thread, however long a turn takes. So a loop over tasks is written as one
    over ``spread * tasks`` turns of which every ``spread``-th does a task::

        for turn in range(spread * tasks):
            if turn % spread != 0:
                continue
            task = turn // spread
    """
    return max(-(-_LEAST_TURNS * min(_SHARES * _threads(), tasks) // max(tasks, 1)), 1)


@functools.cache
def _threads() -> int:
    ensure_runtime()
    return int(ti.lang.impl.get_runtime().prog.config().cpu_max_num_threads)
