"""Compare the accuracy with and without an initialisation pose.

    python -m scripts.any_start CAPTURE… [--from 22] [--masks none] [--work DIR]

Each capture begins with the initialisation pose and has a ``truth.h5``. It is tracked four times: as it is; from frame
``--from`` with ``pose = "any"``, so that the initialisation pose is not visible; the same without the person's height;
and from 2D keypoints of that frame (true joints with noise of 5 px, one in ten at a random place). The table shows the
mean distance of all joints from the ground truth over the same frames, cm; lower is better.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scripts.faults import OFF_M
from scripts.synthetic.keypoints import write_keypoints
from tk.io.captures.capture import Capture, open_capture
from tk.io.captures.capture_toml import GivenSubject
from tk.io.results.reader import read_joints, read_result
from tk.io.results.status import Status
from tk.run.reporter import Silent
from tk.run.session import track
from tk.run.task import RecordingOptions

FROM = 22
"""The development captures show the initialisation pose for 10 frames and leave it in the next 12."""


STARTS = ("normal", "cut", "cut, no height", "cut, keypoints")


class Quiet(Silent):
    """A reporter that records the notes."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


def starts(capture: Capture, keypoints: Path) -> dict[str, Capture]:
    """Return the capture by name of its start."""
    cut = replace(capture, init_pose="any")
    unmeasured = replace(cut, subjects=(GivenSubject(),))
    with_keypoints = replace(unmeasured, init_keypoints=keypoints)
    return {"normal": capture, "cut": cut, "cut, no height": unmeasured, "cut, keypoints": with_keypoints}


def compare(capture: Capture, begin: int, work: Path, names: Sequence[str]) -> Iterator[str]:
    """Yield a line of the table for each named start."""
    truth = read_joints(capture.path / "truth.h5")
    rows = {int(frame): row for row, frame in enumerate(truth.frames)}
    keypoints = work / f"{capture.name}-keypoints"
    rng = np.random.default_rng(0)
    write_keypoints(keypoints, capture.rig, begin, [truth.positions[rows[begin]]], rng)
    for name, started in starts(capture, keypoints).items():
        if name not in names:
            continue
        reporter = Quiet()
        output = work / f"{capture.name}-{name.replace(', ', '-').replace(' ', '-')}.h5"
        options = RecordingOptions(frames=(0 if name == "normal" else begin, None))
        track(started, output, options, reporter, force=True)
        result = read_result(output)
        kept = result.frames >= begin
        expected = truth.positions[[rows[int(frame)] for frame in result.frames[kept]]]
        cm = 100 * np.linalg.norm(result.joints[kept] - expected, axis=2)
        tracked = result.status[kept] != Status.LOST
        bad = int((tracked & (cm.mean(axis=1) > 100 * OFF_M)).sum())
        yield (
            f"{capture.name:16} {name:15} {cm.mean():6.2f} {cm.mean(axis=1).max():6.2f} {(~tracked).sum():4}/"
            f"{len(tracked):<4} {bad:4}  {' | '.join(reporter.notes)}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Track the captures and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.any_start", description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--from", type=int, default=FROM, dest="begin", help="first frame of the cut captures")
    parser.add_argument("--only", default=";".join(STARTS), help=f"some of {'; '.join(STARTS)}")
    parser.add_argument("--masks", default="none", help="as for tk track")
    parser.add_argument("--work", type=Path, help="folder for the results [default: temporary]")
    given = parser.parse_args(arguments)
    print("capture          start           mean   worst   lost    bad  notes")
    with tempfile.TemporaryDirectory() as scratch:
        work = given.work or Path(scratch)
        work.mkdir(parents=True, exist_ok=True)
        for path in given.captures:
            for line in compare(open_capture(path, masks=given.masks), given.begin, work, given.only.split(";")):
                print(line, flush=True)


if __name__ == "__main__":
    main()
