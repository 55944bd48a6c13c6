"""The one place where Taichi is imported and started.

Other modules write ``from tk.kernels.runtime import ti`` and call :func:`ensure_runtime` in each public host
function. The runtime starts lazily on the first call; a runtime that the caller has started is left as it is.
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

from tk.kernels.taichi_internals import program, quick_decorators, quick_import, shorten_notes
from tk.system import WINDOWS, machine

_LOG = logging.getLogger(__name__)

# Without this Taichi prints a greeting on import; a library does not write to the user's stdout.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_LOG_LEVEL", "error")
# Without this Taichi asks a server for its latest version, once a day, or at each start where there is no network.
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")


def _choose_cache() -> None:
    """Set the folder for compiled kernels where Taichi's default fails: without HOME Taichi aborts the process, and
    without write permission it compiles everything again at each start."""
    if WINDOWS:  # Taichi's folder there depends on no variable
        return
    default = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # the password file has homes
    if _is_usable(default):
        if "HOME" not in os.environ:
            os.environ["XDG_CACHE_HOME"] = str(default)
        return
    temporary = machine.temporary_folder("tk-cache")
    # compiled kernels are code: those of another user must not run
    ours = _is_usable(temporary) and machine.is_ours(temporary)
    os.environ["XDG_CACHE_HOME"] = str(temporary) if ours else tempfile.mkdtemp(prefix="tk-cache-")


def _is_usable(folder: Path) -> bool:
    """Return whether the folder exists or can be made, and is writable."""
    if folder.is_absolute():
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            return os.access(folder, os.W_OK | os.X_OK)
    return False


_choose_cache()

with warnings.catch_warnings(), quick_import():
    warnings.simplefilter("ignore")  # deprecation notices inside Taichi
    import taichi as ti

quick_decorators(getattr(ti.lang, "kernel_impl", None))

__all__ = ["ensure_runtime", "spread_of", "ti"]

# Turns of a loop that Taichi gives to a CPU thread at once; block_dim of loop_config does not change it (measured).
_LEAST_TURNS = 512
# Long tasks are split into about this many shares a thread, so that threads that wake late or have longer tasks are
# compensated. Affects speed only.
_SHARES = 8
# Age above which the lock on Taichi's cache of compiled kernels is stale, seconds: Taichi holds it for milliseconds, so
# an older lock was left by a killed process.
_STALE_S = 60.0


def ensure_runtime() -> None:
    """Start Taichi on CPU threads unless a runtime exists already.

    ``fast_math`` is off, so that NaN and infinity keep their meaning. ``TK_DEBUG=1`` in the environment turns on
    bounds checking (slow), ``TK_THREADS`` limits the number of CPU threads.
    """
    if program() is not None:
        return
    options: dict[str, object] = {
        "arch": ti.cpu,
        "fast_math": False,
        "default_fp": ti.f32,
        "offline_cache": True,
        "log_level": ti.ERROR,
        # Taichi's own optimisations: LLVM's, which follow, make them superfluous. Launches take as long as with 1, the
        # default, and the tracker's kernels compile in 3 s instead of 32.
        "opt_level": 0,
        "debug": os.environ.get("TK_DEBUG") == "1",
    }
    threads = os.environ.get("TK_THREADS")
    if threads:
        options["cpu_max_num_threads"] = int(threads)
    _break_stale_lock()
    with contextlib.suppress(ImportError, AttributeError):  # another Taichi
        shorten_notes(importlib.import_module("taichi.lang.ast.ast_transformer_utils"), ti.lang.kernel_impl)
    if not any(_cache_folder().glob("*.tic")):
        _LOG.info("compiling the kernels for the first time takes some seconds")
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a line at start at any log level
        ti.init(**options)
    # else the program and its threads are destroyed at the interpreter's end, in any order
    atexit.register(ti.reset)


def _cache_folder() -> Path:
    """Return the folder of Taichi's cache of compiled kernels; it need not exist."""
    given = os.environ.get("TI_OFFLINE_CACHE_FILE_PATH", "")
    with contextlib.suppress(AttributeError):  # another Taichi
        given = given or ti.lang.impl.default_cfg().offline_cache_file_path
    return Path(given)


def _break_stale_lock() -> None:
    """Remove the lock of a killed process from Taichi's cache of compiled kernels.

    Taichi never removes it: nothing would be cached any more, and every start would compile all kernels again.
    """
    with contextlib.suppress(OSError):  # no lock, or somebody else's folder
        lock = _cache_folder() / "ticache.lock"
        if time.time() - lock.stat().st_mtime > _STALE_S:
            lock.unlink()


def spread_of(tasks: int) -> int:
    """Return the number of loop turns for each of a few long tasks that lets them run on all threads.

    A loop of fewer than 512 turns runs on one thread, even if a turn takes long. So a loop over tasks is written as a
    loop over ``spread * tasks`` turns, of which every ``spread``-th does a task::

        for turn in range(spread * tasks):
            if turn % spread != 0:
                continue
            task = turn // spread
    """
    return max(-(-_LEAST_TURNS * min(_SHARES * _threads(), tasks) // max(tasks, 1)), 1)


@functools.cache
def _threads() -> int:
    ensure_runtime()
    return int(program().config().cpu_max_num_threads)
