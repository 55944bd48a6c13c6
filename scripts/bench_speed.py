"""A whole run beside decoding its videos alone. `python -m scripts.bench CAPTURE --speed`."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_result
from tk.run import session
from tk.run.reporter import Silent
from tk.run.task import RecordingOptions
from tk.trackers.protocol import Estimate


class _Clock(Silent):
    """Record the time of each report of frames."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def advance(self, frame: int, estimate: Estimate | None) -> None:
        self.times.append(time.perf_counter())


@dataclass(frozen=True)
class Speed:
    """One run.

    Attributes:
        decoding: milliseconds a set of pictures, decoded by nobody but this run's reader.
        mean: milliseconds a frame, from the first finished one to the last.
        frames: (F - 1,) milliseconds that each of them took, as the tracker's own clock says.
        searched: (F - 1,) frames with a limb search.
        first_s: from opening the capture to the first pose.
        after_s: what followed the last frame: the second pass, unless causal.
    """

    decoding: float
    mean: float
    frames: np.ndarray
    searched: np.ndarray
    first_s: float
    after_s: float

    def line(self) -> str:
        mean, median = self.mean, float(np.median(self.frames))
        whole = mean + 1e3 * self.after_s / len(self.frames)
        easy = self.frames[~self.searched].mean() if (~self.searched).any() else np.nan
        hard = self.frames[self.searched].mean() if self.searched.any() else np.nan
        return (
            f"decoding {self.decoding:.1f} ms a set; a frame {mean:.1f} ms by the mean, {median:.1f} by the median: "
            f"{mean / self.decoding:.1f} times decoding, {whole / self.decoding:.1f} with what follows the last frame; "
            f"{100 * self.searched.mean():.0f} % of the frames searched ({hard:.0f} ms, the others {easy:.0f}); "
            f"first pose after {self.first_s:.1f} s"
        )


def run_once(folder: Path, masks: str, output: Path, causal: bool) -> Speed:
    """Decode, then track; meant for a process of its own."""
    opened = time.perf_counter()
    capture = open_capture(folder, masks=masks)
    clock = _Clock()
    session.track(capture, output, RecordingOptions(causal=causal), clock, force=True)
    ended = time.perf_counter()
    with capture.frames() as reader:
        started = time.perf_counter()
        count = sum(1 for _ in reader)
        decoding = 1e3 * (time.perf_counter() - started) / count
    times = np.array(clock.times)
    result = read_result(output)
    frames = 1e3 * result.timing["total"][1:]
    mean = 1e3 * (times[-1] - times[0]) / len(frames)
    return Speed(decoding, mean, frames, result.iterations[1:, 1] > 0, times[0] - opened, ended - times[-1])


def measure(capture: Path, masks: str, repeat: int) -> str:
    """Lines on the median of several runs, causal and by default, each in a process of its own."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        for causal in (True, False):
            runs = []
            for k in range(repeat):
                with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
                    output = Path(folder) / f"{k}.h5"
                    runs.append(process.submit(run_once, capture, masks, output, causal).result())
            chosen = sorted(runs, key=lambda run: run.mean / run.decoding)[(len(runs) - 1) // 2]
            lines.append(f"{capture.name}, {'causal' if causal else 'by default'}: {chosen.line()}")
    return "\n".join(lines)
