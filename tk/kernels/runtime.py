"""The one place where Taichi is imported and started.

Other modules write ``from tk.kernels.runtime import ti`` and call :func:`ensure_runtime` in each public host
function. The runtime starts lazily on the first call; a runtime that the caller made before is left as it is.
Never ``fork`` after it has started: use the ``spawn`` start method for worker processes.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import warnings

# Taichi greets on import unless told otherwise; a library has no business on the user's stdout.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_LOG_LEVEL", "error")

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # taichi's own deprecation notices are not ours to mend
    import taichi as ti

__all__ = ["ensure_runtime", "spread_of", "ti"]

# Taichi hands a CPU thread at least so many turns of a loop; what loop_config says of block_dim changes nothing.
_LEAST_TURNS = 512


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
    with contextlib.redirect_stdout(io.StringIO()):  # it prints that it starts, whatever the log level
        ti.init(**options)


def spread_of(tasks: int) -> int:
    """How many turns of a kernel's loop to give to each of a few long tasks, so that they go to all threads.

    A loop of fewer than 512 turns runs on one thread, however long a turn takes. So a loop over tasks is written as one
    over ``spread * tasks`` turns of which every ``spread``-th does a task::

        for turn in range(spread * tasks):
            if turn % spread != 0:
                continue
            task = turn // spread
    """
    return max(-(-_LEAST_TURNS * _threads() // max(tasks, 1)), 1)


@functools.cache
def _threads() -> int:
    ensure_runtime()
    return int(ti.lang.impl.get_runtime().prog.config().cpu_max_num_threads)
