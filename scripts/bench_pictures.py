"""What the overlay video and the report cost, the images that a run keeps for them included. `python -m scripts.bench
--pictures`. Each run with them is compared with one without, as with `tk track --no-report`, right after it."""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from tk.io.captures.capture import open_capture
from tk.report.after import film_for, write_video_and_report
from tk.run import session
from tk.run.reporter import Silent
from tk.run.task import RecordingOptions


def _clocks() -> tuple[float, float]:
    """Wall time and processor time, seconds, that of ended child processes included."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return time.perf_counter(), sum(one.ru_utime + one.ru_stime for one in used)


def run_once(
    capture_path: Path, masks: str, frames: int | None, output: Path, pictures: bool
) -> tuple[int, float, float]:
    """Return the frames, the wall time and the processor time, seconds, of a default run; meant for a process of its
    own."""
    started = _clocks()
    capture = open_capture(capture_path, masks=masks)
    film = film_for(capture, output) if pictures else None
    summary = session.track(capture, output, RecordingOptions(frames=(0, frames)), Silent(), film=film)
    warnings: list[str] = []
    if pictures:
        write_video_and_report(capture, output, warnings.append, film)
    if warnings:
        raise SystemExit(warnings[0])
    done = _clocks()
    return summary.frames, done[0] - started[0], done[1] - started[1]


def measure(capture: Path, masks: str, frames: int | None, repeat: int) -> str:
    """Return a line with the medians over pairs of runs, each run in a process of its own."""
    count, pairs = 0, []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(repeat):
            seconds = {}
            for pictures in (k % 2 == 0, k % 2 != 0):
                output = Path(folder) / f"{k}-{pictures}.h5"
                with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
                    run = process.submit(run_once, capture, masks, frames, output, pictures)
                    count, *seconds[pictures] = run.result()
            pairs.append((seconds[True], seconds[False]))
    return f"{capture.name}, {count} frames: {compared(pairs)}"


def compared(pairs: Sequence[tuple[Sequence[float], Sequence[float]]]) -> str:
    """Return the medians of pairs of runs, with and without pictures: wall time and processor time, seconds."""
    both, plain = np.median(pairs, axis=0)
    shares = np.median([100 * (1 - np.divide(without, whole)) for whole, without in pairs], axis=0)
    return (
        f"{both[0]:.1f} s ({both[1]:.1f} s of processors), without overlay video and report {plain[0]:.1f} s "
        f"({plain[1]:.1f} s); these take {shares[0]:.1f} % of the whole ({shares[1]:.1f} % of the processors' time)"
    )
