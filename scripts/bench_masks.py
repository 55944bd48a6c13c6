"""How good the masks are, and what they cost beside decoding alone.

    python -m scripts.bench_masks CAPTURE… [--frames 60]

A line a capture: E_S of each camera where the capture has exact masks (share of wrong pixels, |mask xor truth| over
|truth|), the share of the person that is missed, and milliseconds a set of pictures: of decoding, of the masks, and
their ratio. Both are given as wall time and as processor time over all threads, which is more reliable while other
processes run. Each is measured alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from tk.io.captures.capture import Capture, open_capture
from tk.kernels.mask_values import PERSON
from tk.run.segmentation import make_labeller
from tk.run.task import Task
from tk.settings import Settings

TIMED = 40
"""Frames that are held in memory to be segmented while nothing is decoded."""

T = TypeVar("T")


def timed(work: Callable[[], T]) -> tuple[T, float, float]:
    """What ``work`` returns; its wall and its processor time, milliseconds."""
    wall, processor = time.perf_counter(), time.process_time()
    result = work()
    return result, 1000 * (time.perf_counter() - wall), 1000 * (time.process_time() - processor)


def truth_of(folder: Path, capture: Capture, index: int) -> np.ndarray:
    """(C, H, W) bool, exact masks of a frame."""
    result = np.zeros((len(capture.clips), *capture.rig.frame_shape), bool)
    for out, clip in zip(result, capture.clips, strict=True):
        mask = cv2.imread(str(folder / clip.path.stem / f"{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
        out[: mask.shape[0], : mask.shape[1]] = mask >= PERSON
    return result


def measure(path: Path, frames: int | None) -> str:
    """The line of one capture."""
    capture = open_capture(path, masks="none")
    label = make_labeller(Task.of(capture, Settings()), print)
    label(next(capture.frames(0, 1)))  # compiles
    stop = min(frames or capture.frame_count, capture.frame_count)
    with capture.frames(0, stop) as reader:
        count, wall, processor = timed(lambda: sum(1 for _ in reader))
    decoding = processor / count
    with capture.frames(0, min(stop, TIMED)) as reader:
        held = list(reader)
    laps = np.array([timed(lambda frame=frame: label(frame))[1:] for frame in held])
    line = f"{capture.name}: "
    if (path / "masks").is_dir():
        wrong, missed = [], []
        for frame in capture.frames(0, stop):
            masks, truth = label(frame)[0] > 0, truth_of(path / "masks", capture, frame.index)
            area = np.maximum(truth.sum(axis=(1, 2)), 1)
            wrong.append((masks != truth).sum(axis=(1, 2)) / area)
            missed.append((truth & ~masks).sum(axis=(1, 2)) / area)
        cameras = " ".join(f"{share:.2f}" for share in 100 * np.mean(wrong, axis=0))
        line += f"E_S {100 * np.mean(wrong):.2f} % ({cameras}), missed {100 * np.mean(missed):.2f} %; "
    masks_ms, median_ms = laps[:, 1].mean(), np.median(laps[:, 1])
    return line + (
        f"processor ms a set: decoding {decoding:.1f}, masks {masks_ms:.1f} (median {median_ms:.1f}), "
        f"ratio {masks_ms / decoding:.2f}; wall: decoding {wall / count:.1f}, masks {laps[:, 0].mean():.1f} "
        f"(median {np.median(laps[:, 0]):.1f})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="How good the masks are, and what they cost beside decoding alone.")
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, help="how many from the start; all by default")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for path in arguments.captures:
        print(measure(path, arguments.frames), flush=True)


if __name__ == "__main__":
    main()
