"""The same capture in worlds that lie otherwise: is the result the same up to the rotation?

    python -m scripts.any_world CAPTURE [--draws 10] [--frames 0:40] [--masks none] [--no-up] [--seed 0]

The calibration's world is turned at random (uniformly over all rotations) and moved by up to 5 m, and ``up`` with it;
with ``--no-up`` nobody says what points up, and the cameras have to tell. The last line is the world that is the frame
of the first camera, as tools leave it that saw no board on the floor, without ``up``. A line a world: the largest and
the mean distance of any joint from the first run's, turned back.
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
from tk.io.results.writer import Result, Status, read_result
from tk.model.cameras.mounting import infer_up
from tk.model.cameras.tracker_frame import seen_from
from tk.model.cameras.up import up_text
from tk.model.cameras.volume import Volume
from tk.run.session import track
from tk.settings import Settings

Float = NDArray[np.float64]


def turned(capture: Capture, turn: Float, shift: Float, up: bool = True) -> Capture:
    """The capture in a world in which point p has become ``turn @ p + shift``; the volume is the box about the turned
    one. Without ``up`` the cameras tell what points up."""
    rig = seen_from(capture.rig, turn.T, -turn.T @ shift)
    low, high = capture.volume.lower, capture.volume.upper
    corners = np.array(list(product(*zip(low, high, strict=True)))) @ turn.T + shift
    middle, size = (corners.min(axis=0) + corners.max(axis=0)) / 2, np.ptp(corners, axis=0)
    volume = Volume(tuple(middle.tolist()), tuple(size.tolist()))
    text = up_text(turn @ capture.up_axis) if up else infer_up(rig).up
    return replace(capture, rig=rig, volume=volume, up=text)


def run(capture: Capture, frames: tuple[int, int | None], work: Path) -> tuple[Result, list[str]]:
    """Track it."""
    said = Quiet()
    track(capture, work / "r.h5", Settings(), said, frames=frames, force=True)
    return read_result(work / "r.h5"), said.said


def main(arguments: Sequence[str] | None = None) -> None:
    """Track in worlds that are turned, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.any_world", description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--frames", default="0:40", metavar="A:B")
    parser.add_argument("--masks", default="none", help="as tk track has it")
    parser.add_argument("--no-up", action="store_true", help="do not say what points up")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    begin, end = given.frames.split(":")
    frames = int(begin or 0), int(end) if end else None
    capture = open_capture(given.capture, masks=given.masks)
    rng = np.random.default_rng(given.seed)
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        expected, _ = run(capture, frames, work)
        print("draw  turned   up off   largest     mean   lost  said")
        for draw in range(given.draws + 1):
            turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
            shift = rng.uniform(-5, 5, 3)
            if draw == given.draws:
                turn, shift = capture.rig[0].rotation, capture.rig[0].translation
            other = turned(capture, turn, shift, draw < given.draws and not given.no_up)
            found, said = run(other, frames, work)
            mm = 1000 * np.linalg.norm((found.joints - shift) @ turn - expected.joints, axis=2)
            degrees = np.degrees(Rotation.from_matrix(turn).magnitude())
            tilt = np.degrees(np.arccos(np.clip(other.up_axis @ turn @ capture.up_axis, -1, 1)))
            lost = int((found.status == Status.LOST).sum())
            name = str(draw) if draw < given.draws else capture.rig[0].name
            print(
                f"{name:>4} {degrees:6.0f}° {tilt:7.1f}° {mm.max():6.2f} mm {mm.mean():5.2f} mm {lost:6}"
                f"  {' | '.join(said)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
