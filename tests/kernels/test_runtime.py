"""The lazy start of Taichi."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from tk.kernels.runtime import ensure_runtime, spread_of, ti


def run(code, **environment):
    """What a fresh interpreter prints; its environment is this one's with these variables."""
    inherited = {"PYTHONFAULTHANDLER": "1"} | {
        k: v for k, v in os.environ.items() if k not in ("TK_DEBUG", "TK_THREADS", "ENABLE_TAICHI_HEADER_PRINT")
    }
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=inherited | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


STATE = """
    import threading, urllib.request
    urllib.request.urlopen = lambda *_, **__: print("asked")
    import tk.kernels.objective, tk.model.cues.objective, tk.model.body.initial_pose
    from tk.kernels.runtime import ensure_runtime, ti
    print(ti.lang.impl.get_runtime().prog is None)
    ensure_runtime()
    ensure_runtime()
    config = ti.lang.impl.current_cfg()
    [thread.join(5) for thread in threading.enumerate() if thread.daemon]
    print(config.arch == ti.cpu, config.debug, config.cpu_max_num_threads, config.fast_math)
"""


def test_starts_once_on_the_cpu_by_the_environment_asks_no_server_and_says_nothing():
    """Importing starts nothing. The words are all that the process prints: a greeting would spoil a user's pipe."""
    assert run(STATE, TK_THREADS="1", TK_DEBUG="1") == ["True", "True", "True", "1", "False"]


def test_leaves_the_callers_runtime_and_its_notes_alone():
    printed = run(
        """
        from tk.kernels.runtime import ensure_runtime, ti
        ti.init(arch=ti.cpu, cpu_max_num_threads=1, random_seed=7, log_level=ti.ERROR)
        program = ti.lang.impl.get_runtime().prog
        ensure_runtime()
        notes = ti.lang.ast.ast_transformer_utils.ASTTransformerContext.get_pos_info
        print(ti.lang.impl.get_runtime().prog is program, ti.lang.impl.current_cfg().random_seed)
        print(hasattr(notes, "__wrapped__"))
        ti.reset()  # the caller's part: Taichi may crash if its threads end after the interpreter
        """,
        TK_THREADS="2",
    )
    assert printed[-3:] == ["True", "7", "False"]


CACHE = """
    import os, sys
    for name in ("HOME", "XDG_CACHE_HOME"):
        os.environ.pop(name, None)
    os.environ.update(item.split("=") for item in sys.argv[1:])
    from tk.kernels.runtime import ensure_runtime, ti
    ensure_runtime()
    print(ti.lang.impl.default_cfg().offline_cache_file_path)
"""


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="needs a folder that nobody can write to")
@pytest.mark.parametrize("home", [None, "/proc/nobody"])
def test_compiled_kernels_are_kept_where_there_is_no_home(tmp_path, home):
    """Without HOME Taichi would abort the process."""
    code = CACHE.replace("sys.argv[1:]", repr([f"TMPDIR={tmp_path}"] + ([f"HOME={home}"] if home else [])))
    (folder,) = run(code)
    assert not folder.startswith("/proc") and os.access(os.path.dirname(os.path.dirname(folder)), os.W_OK)
    if home:
        assert folder.startswith(str(tmp_path))


def test_a_cache_that_is_named_is_used(tmp_path):
    (folder,) = run(CACHE.replace("sys.argv[1:]", repr([f"XDG_CACHE_HOME={tmp_path}"])))
    assert folder.startswith(str(tmp_path))


@pytest.mark.parametrize(("age_s", "stays", "is_compiled"), [(3600, False, False), (1, True, True)])
def test_a_killed_process_does_not_switch_the_cache_off_for_good(tmp_path, age_s, stays, is_compiled):
    """Compiling is announced only if nothing is compiled yet."""
    lock = tmp_path / "ticache.lock"
    lock.touch()
    os.utime(lock, (lock.stat().st_mtime - age_s,) * 2)
    if is_compiled:
        (tmp_path / "T1.tic").touch()
    code = """
        import logging, sys
        from tk.kernels.runtime import ensure_runtime
        logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
        ensure_runtime()
    """
    words = run(code, TI_OFFLINE_CACHE_FILE_PATH=str(tmp_path))
    assert lock.exists() == stays
    assert ("compiling" in words) != is_compiled


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="needs a list of the process's threads")
def test_the_threads_end_before_the_interpreter_does():
    """A runtime that is taken apart with the interpreter has crashed one in some thousand processes at its end."""
    before, running, after = run(
        """
        import atexit, os, time
        def threads():
            return len(os.listdir("/proc/self/task"))
        from tk.kernels.runtime import ensure_runtime
        before = threads()
        def at_end():
            patience = time.monotonic() + 5
            while threads() > before and time.monotonic() < patience:
                time.sleep(0.01)  # the system lists a thread that has been waited for a moment longer
            print(threads())
        print(before)
        atexit.register(at_end)
        ensure_runtime()
        print(threads())
        """
    )
    assert after == before < running


@ti.kernel
def _count_odd(values: ti.types.ndarray(dtype=ti.f32, ndim=1), found: ti.types.ndarray(dtype=ti.i32, ndim=1)):
    for _ in range(1):
        for i in range(values.shape[0]):
            if not values[i] < 0.0 and not values[i] >= 0.0:
                found[0] += 1
            if values[i] > 3e38:
                found[1] += 1


def test_nan_and_infinity_keep_their_meaning():
    ensure_runtime()
    found = np.zeros(2, np.int32)
    _count_odd(np.array([1, np.nan, np.inf, np.nan, -np.inf], np.float32), found)
    np.testing.assert_array_equal(found, [2, 1])


@ti.kernel
def _count_kernel(spread: ti.i32, done: ti.types.ndarray(dtype=ti.i32, ndim=1)):
    for turn in range(spread * done.shape[0]):
        if turn % spread != 0:
            continue
        task = turn // spread
        done[task] = done[task] + 1


@pytest.mark.parametrize("tasks", [1, 2, 3, 11, 511, 512, 513, 5000])
def test_spread_tasks_are_done_once_each_by_all_threads(tasks: int) -> None:
    spread = spread_of(tasks)
    threads = ti.cfg.cpu_max_num_threads
    wanted = 512 * min(tasks, 8 * threads)  # Taichi gives a thread 512 turns at once: so many shares
    assert spread * tasks >= wanted
    assert spread == 1 or (spread - 1) * tasks < wanted
    done = np.zeros(tasks, np.int32)
    _count_kernel(spread, done)
    np.testing.assert_array_equal(done, 1)
