"""What the overlay video and the report cost beside the run that they are of. `python -m scripts.bench --pictures`."""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tk.io.captures.capture import open_capture
from tk.report.after import write_video_and_report
from tk.run import session
from tk.run.reporter import Silent
from tk.run.task import RecordingOptions


@dataclass(frozen=True)
class Cost:
    """Seconds of wall time and of processor time, of the run without its pictures and of these."""

    frames: int
    run: tuple[float, float]
    pictures: tuple[float, float]

    @property
    def shares(self) -> list[float]:
        """Of the pictures in the whole, of wall time and of processor time."""
        return [pictures / (run + pictures) for run, pictures in zip(self.run, self.pictures, strict=True)]


def _clocks() -> tuple[float, float]:
    """Wall time and processor time, seconds, that of ended child processes included."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return time.perf_counter(), sum(one.ru_utime + one.ru_stime for one in used)


def run_once(capture_path: Path, masks: str, frames: int | None, output: Path) -> Cost:
    """A default run and its pictures; meant for a process of its own."""
    started = _clocks()
    capture = open_capture(capture_path, masks=masks)
    summary = session.track(capture, output, RecordingOptions(frames=(0, frames)), Silent())
    tracked = _clocks()
    warnings: list[str] = []
    write_video_and_report(capture, output, warnings.append)
    if warnings:
        raise SystemExit(warnings[0])
    done = _clocks()
    run, pictures = (
        (after[0] - before[0], after[1] - before[1]) for before, after in ((started, tracked), (tracked, done))
    )
    return Cost(summary.frames, run, pictures)


def measure(capture: Path, masks: str, frames: int | None, repeat: int) -> str:
    """A line on the run with the median share, each in a process of its own."""
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(repeat):
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
                runs.append(process.submit(run_once, capture, masks, frames, Path(folder) / f"{k}.h5").result())
    cost = sorted(runs, key=lambda cost: cost.shares[1])[(len(runs) - 1) // 2]
    wall, processor = (f"{100 * share:.1f} %" for share in cost.shares)
    return (
        f"{capture.name}: {cost.frames} frames tracked in {cost.run[0]:.1f} s ({cost.run[1]:.1f} s of processors); "
        f"overlay video and report {cost.pictures[0]:.1f} s ({cost.pictures[1]:.1f} s) more: {wall} of the whole "
        f"({processor} of the processors' time)"
    )
