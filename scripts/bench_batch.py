"""What more workers bring: the same captures by `tk batch` with one worker, with two …

    python -m scripts.bench_batch [CAPTURE] [--copies 4] [--frames 45] [--workers 1 2]

The capture, by default the demo, is given several times under different names. Each count of workers gets a folder of
its own; the reported time includes the start of the workers and both passes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tk.batch import Outcome, run_batch
from tk.batch.jobs import DONE
from tk.run.task import RecordingOptions

DEMO = Path(__file__).resolve().parents[1] / "tk" / "data" / "demo"


class _Quiet:
    def note(self, text: str) -> None:
        pass

    def progress(self, name: str, done: int, total: int) -> None:
        pass

    def finished(self, name: str, outcome: Outcome, done: int, total: int) -> None:
        if outcome.state != DONE:
            raise SystemExit(f"{name}: {outcome.failure}")


def measure(capture: Path, copies: int, frames: int, workers: int) -> tuple[int, float]:
    """Frames that were tracked, and seconds that it took."""
    with tempfile.TemporaryDirectory() as scratch:
        takes = [Path(scratch) / f"take{k}" for k in range(copies)]
        for take in takes:
            take.mkdir()
            for item in capture.resolve().iterdir():
                (take / item.name).symlink_to(item)
        started = time.perf_counter()
        outcomes = run_batch(takes, Path(scratch) / "out", RecordingOptions(frames=(0, frames)), _Quiet(), workers)
        return sum(outcome.frames for outcome in outcomes.values()), time.perf_counter() - started


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?", default=DEMO)
    parser.add_argument("--copies", type=int, default=4)
    parser.add_argument("--frames", type=int, default=45, help="of each copy")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    chosen = parser.parse_args(arguments)
    first = None
    for workers in chosen.workers:
        count, seconds = measure(chosen.capture, chosen.copies, chosen.frames, workers)
        rate = count / seconds
        first = first or rate
        print(f"{workers} workers: {count} frames in {seconds:.1f} s, {rate:.2f} frames/s, {rate / first:.2f} times")


if __name__ == "__main__":
    main()
