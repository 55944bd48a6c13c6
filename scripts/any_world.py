"""Track a capture in rotated and shifted world frames and compare the results.

    python -m scripts.any_world CAPTURE [--draws 10] [--frames 0:40] [--masks none] [--no-up] [--seed 0]

The world frame is rotated at random (uniformly over all rotations), with ``up``, and shifted by up to 5 m. With
``--no-up`` the direction is inferred from the cameras. In the last row the world is the first camera's frame, as in
calibrations without a board on the floor, without ``up``. Each row shows the largest and the mean distance of a joint
from its position in the original world, mm.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scripts.any_start import Quiet
from tk.io.captures.capture import Capture, open_capture
from tk.io.results.data import Result
from tk.io.results.reader import read_result
from tk.io.results.status import Status
from tk.model.cameras.mounting import infer_up
from tk.model.cameras.tracker_frame import seen_from
from tk.model.cameras.up import up_text
from tk.model.cameras.volume import Volume
from tk.run.session import track
from tk.run.task import RecordingOptions

Float = NDArray[np.float64]


def turned(capture: Capture, turn: Float, shift: Float, up: bool = True) -> Capture:
    """Return the capture in a world where point p is ``turn @ p + shift``; its volume encloses the rotated one.

    Without ``up`` the direction is inferred from the cameras.
    """
    rig = seen_from(capture.rig, turn.T, -turn.T @ shift)
    low, high = capture.volume.lower, capture.volume.upper
    corners = np.array(list(product(*zip(low, high, strict=True)))) @ turn.T + shift
    middle, size = (corners.min(axis=0) + corners.max(axis=0)) / 2, np.ptp(corners, axis=0)
    volume = Volume(tuple(middle.tolist()), tuple(size.tolist()))
    text = up_text(turn @ capture.up_axis) if up else infer_up(rig).up
    return replace(capture, rig=rig, volume=volume, up=text)


def run(capture: Capture, frames: tuple[int, int | None], work: Path) -> tuple[Result, list[str]]:
    """Track the capture; return the result and the notes."""
    reporter = Quiet()
    track(capture, work / "r.h5", RecordingOptions(frames=frames), reporter, force=True)
    return read_result(work / "r.h5"), reporter.notes


def main(arguments: Sequence[str] | None = None) -> None:
    """Track the capture in all worlds and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.any_world", description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--frames", default="0:40", metavar="A:B")
    parser.add_argument("--masks", default="none", help="as for tk track")
    parser.add_argument("--no-up", action="store_true", help="infer up from the cameras")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    begin, end = given.frames.split(":")
    frames = int(begin or 0), int(end) if end else None
    capture = open_capture(given.capture, masks=given.masks)
    rng = np.random.default_rng(given.seed)
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        expected, _ = run(capture, frames, work)
        print("draw  turned   up err   largest     mean   lost  notes")
        for draw in range(given.draws + 1):
            turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
            shift = rng.uniform(-5, 5, 3)
            if draw == given.draws:
                turn, shift = capture.rig[0].rotation, capture.rig[0].translation
            other = turned(capture, turn, shift, draw < given.draws and not given.no_up)
            found, notes = run(other, frames, work)
            mm = 1000 * np.linalg.norm((found.joints - shift) @ turn - expected.joints, axis=2)
            degrees = np.degrees(Rotation.from_matrix(turn).magnitude())
            tilt = np.degrees(np.arccos(np.clip(other.up_axis @ turn @ capture.up_axis, -1, 1)))
            lost = int((found.status == Status.LOST).sum())
            name = str(draw) if draw < given.draws else capture.rig[0].name
            print(
                f"{name:>4} {degrees:6.0f}° {tilt:7.1f}° {mm.max():6.2f} mm {mm.mean():5.2f} mm {lost:6}"
                f"  {' | '.join(notes)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
