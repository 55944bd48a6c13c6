"""What a start without the initialisation pose costs.

    python -m scripts.any_start CAPTURE… [--from 22] [--masks none] [--work DIR]

Each capture opens with the initialisation pose and has a ``truth.h5``. It is tracked as it is; then from frame
``--from`` on with ``pose = "any"``, so that the initialisation pose is never shown; in this way once more without the
person's height; and once from 2D keypoints of that frame (the true joints with noise of 5 px, one in ten anywhere).
All are compared with the truth over the same frames: the mean distance of all joints as they are.
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
from tk.io.results.writer import Status, read_joints, read_result
from tk.run.session import track
from tk.settings import Settings

FROM = 22
"""The development captures hold the initialisation pose for 10 frames and leave it during the 12 that follow."""


STARTS = ("normal", "cut", "cut, no height", "cut, keypoints")


class Quiet:
    """A reporter that keeps what is said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def note(self, text: str) -> None:
        self.said.append(text)

    def begin(self, total: int, done: int) -> None:
        pass

    def advance(self, frame: int, estimate: object) -> None:
        pass


def starts(capture: Capture, keypoints: Path) -> dict[str, Capture]:
    """The capture as it is, and as those that nobody stands still for."""
    cut = replace(capture, init_pose="any")
    unmeasured = replace(cut, subject_height_m=None)
    told = replace(unmeasured, init_keypoints=keypoints)
    return {"normal": capture, "cut": cut, "cut, no height": unmeasured, "cut, keypoints": told}


def compare(capture: Capture, begin: int, work: Path, names: Sequence[str]) -> Iterator[str]:
    """A line a start, of those that are named."""
    truth = read_joints(capture.path / "truth.h5")
    rows = {int(frame): row for row, frame in enumerate(truth.frames)}
    keypoints = work / f"{capture.name}-keypoints"
    rng = np.random.default_rng(0)
    write_keypoints(keypoints, capture.rig, begin, [truth.positions[rows[begin]]], rng)
    for name, started in starts(capture, keypoints).items():
        if name not in names:
            continue
        said = Quiet()
        output = work / f"{capture.name}-{name.replace(', ', '-').replace(' ', '-')}.h5"
        track(started, output, Settings(), said, frames=(0 if name == "normal" else begin, None), force=True)
        result = read_result(output)
        kept = result.frames >= begin
        expected = truth.positions[[rows[int(frame)] for frame in result.frames[kept]]]
        cm = 100 * np.linalg.norm(result.joints[kept] - expected, axis=2)
        tracked = result.status[kept] != Status.LOST
        bad = int((tracked & (cm.mean(axis=1) > 100 * OFF_M)).sum())
        yield (
            f"{capture.name:16} {name:15} {cm.mean():6.2f} {cm.mean(axis=1).max():6.2f} {(~tracked).sum():4}/"
            f"{len(tracked):<4} {bad:4}  {' | '.join(said.said)}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Track and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.any_start", description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--from", type=int, default=FROM, dest="begin", help="first frame that is shown")
    parser.add_argument("--only", default=";".join(STARTS), help=f"some of {'; '.join(STARTS)}")
    parser.add_argument("--masks", default="none", help="as tk track has it")
    parser.add_argument("--work", type=Path, help="keep the results here")
    given = parser.parse_args(arguments)
    print("capture          start           mean   worst   lost    bad  said")
    with tempfile.TemporaryDirectory() as scratch:
        work = given.work or Path(scratch)
        work.mkdir(parents=True, exist_ok=True)
        for path in given.captures:
            for line in compare(open_capture(path, masks=given.masks), given.begin, work, given.only.split(";")):
                print(line, flush=True)


if __name__ == "__main__":
    main()
