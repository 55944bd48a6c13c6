"""Whether memory stays flat over a long recording.

    python -m scripts.bench_memory [--capture CAPTURE] [--frames 10000] [--every 1000] [--scale 0.375] [--causal]

A capture's videos (the demo's by default), made small, run forwards and backwards until there are as many frames. They
are tracked, and what the tracker and the process ahead of it hold is reported every so many frames, and with the time
at the begin of each later stage; the overlay video and the report follow. Linux only. A capture with [init] pose =
"any" shows the whole second pass.
"""

from __future__ import annotations

import argparse
import logging
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.capture import write_calibration
from tk.io.captures.capture import Capture, open_capture
from tk.model.cameras.camera import Camera, Rig
from tk.render.video import video_writer
from tk.report.after import film_for, write_video_and_report
from tk.run import session
from tk.run.reporter import Silent
from tk.run.task import RecordingOptions
from tk.trackers.protocol import Estimate

DEMO = Path(__file__).resolve().parents[1] / "tk" / "data" / "demo"


def _smaller(camera: Camera, scale: float) -> Camera:
    width, height = round(scale * camera.width), round(scale * camera.height)
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # pixel centres lie at integers
    matrix = np.linalg.inv(half) @ np.diag([scale, scale, 1.0]) @ half @ camera.matrix
    return replace(camera, width=width, height=height, matrix=matrix)


def _shrink(pictures: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """(N, h, w, 3) pictures at the size of a camera of the smaller rig."""
    size = (camera.width, camera.height)
    return np.array([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures])


def make_loop(folder: Path, count: int, source: Path = DEMO, scale: float = 0.375) -> Capture:
    """A capture of ``count`` frames, made of another one's, each side of an image ``scale`` times as long."""
    demo = open_capture(source, masks="none")
    rig = Rig(tuple(_smaller(camera, scale) for camera in demo.rig))
    write_calibration(rig, folder / "calibration.toml")
    (folder / "capture.toml").write_bytes((source / "capture.toml").read_bytes())
    with demo.frames() as frames:
        sets = np.array([[_shrink(image[None], c)[0] for image, c in zip(f.images, rig, strict=True)] for f in frames])
    there = np.arange(len(sets))
    order = np.resize(np.concatenate([there, there[-2:0:-1]]), count)
    background = demo.background()
    assert background is not None
    for name in ("videos", "background"):
        (folder / name).mkdir()
    for c, camera in enumerate(rig):
        with ExitStack() as stack:
            add, add_empty = (
                stack.enter_context(video_writer(folder / name / f"{camera.name}.mp4", demo.fps))
                for name in ("videos", "background")
            )
            for k in order:
                add(sets[k, c])
            for picture in _shrink(background[c], camera):
                add_empty(picture)
    return open_capture(folder)


def peak_mib() -> float:
    """The most that this process has held in memory, MiB."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(fields["VmHWM"].split()[0]) / 1024


def held_mib(process: int | str = "self") -> float:
    """What a process holds, MiB: in memory, and the part that the system has swapped out."""
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
    return sum(int(fields.get(name, "0").split()[0]) for name in ("VmRSS", "VmSwap")) / 1024  # none once it has ended


def _children() -> list[int]:
    tasks = Path("/proc/self/task").iterdir()
    return sorted(int(pid) for task in tasks for pid in (task / "children").read_text().split())


class MemoryReport(Silent, logging.Handler):
    """Report the memory held, and the time of each stage."""

    def __init__(self, every: int) -> None:
        logging.Handler.__init__(self, logging.INFO)
        self._every, self._count, self._begun = every, 0, time.perf_counter()

    def emit(self, record: logging.LogRecord) -> None:
        passed = time.perf_counter() - self._begun
        held = f"{held_mib():.1f} MiB, at most {peak_mib():.1f} until now"
        print(f"[{passed:6.1f} s] {record.getMessage()}: tracker {held}", flush=True)

    def advance(self, frame: int, estimate: Estimate | None) -> None:
        self._count += 1
        if self._count % self._every == 0 or self._count == 100:
            ahead = ", ".join(f"{held_mib(child):.1f}" for child in _children())
            passed = time.perf_counter() - self._begun
            print(
                f"[{passed:6.1f} s] {self._count} frames: tracker {held_mib():.1f} MiB, ahead {ahead} MiB", flush=True
            )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=DEMO)
    parser.add_argument("--scale", type=float, default=0.375)
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--every", type=int, default=1000)
    parser.add_argument("--causal", action="store_true", help="without the second pass")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        os.mkdir(folder := Path(scratch) / "loop")
        capture = make_loop(folder, chosen.frames, chosen.capture, chosen.scale)
        print(f"{len(capture.rig)} cameras of {capture.rig[0].width}×{capture.rig[0].height}", flush=True)
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins here
        report, log = MemoryReport(chosen.every), logging.getLogger("tk")
        log.addHandler(report)
        log.setLevel(logging.INFO)
        begun = time.perf_counter()
        result = Path(scratch) / "loop.h5"
        film = film_for(capture, result)
        done = session.track(capture, result, RecordingOptions(causal=chosen.causal), report, film=film)
        log.removeHandler(report)
        print(
            f"{done.frames} frames in {done.seconds:.0f} s, {done.lost} lost; at the end {held_mib():.1f} MiB, at most "
            f"{peak_mib():.1f}"
        )
        written = write_video_and_report(capture, result, print, film)
        sizes = ", ".join(f"{path.suffix[1:]} {path.stat().st_size / 1e6:.1f} MB" for path in written)
        print(f"{sizes}, after {time.perf_counter() - begun:.0f} s; at most {peak_mib():.1f} MiB")


if __name__ == "__main__":
    main()
