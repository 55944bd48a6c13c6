"""Measure the effect of smoothing and bridging on a result with ground truth.

Prints the mean distance of the joints from the ground truth, raw and without each joint's constant offset, and the mean
error of velocity and acceleration, before and after smoothing; then the mean distance between tracked and bridged
joints in frames that were removed.

    python -m scripts.smoothing RESULT.h5 TRUTH.h5 [--gaps 2 4 7]
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from tk.export import read_motion
from tk.io.results.reader import read_joints
from tk.io.results.status import Status
from tk.model.body.skeleton import JOINTS

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """Mean errors of F frames' joints."""

    distance_cm: float
    less_offset_cm: float
    velocity_m_s: float
    acceleration_m_s2: float


def errors(joints: Float, true: Float, fps: float) -> Errors:
    """Return the errors of joints (F, 15, 3) against the ground truth, metres."""
    e = joints - true

    def mean(differences: Float) -> float:
        return float(np.linalg.norm(differences, axis=2).mean())

    velocity, acceleration = fps * np.diff(e, axis=0), fps**2 * np.diff(e, 2, axis=0)
    return Errors(100 * mean(e), 100 * mean(e - e.mean(axis=0)), mean(velocity), mean(acceleration))


def compare(result: Path, truth: Path) -> tuple[Errors, Errors]:
    """Return the errors before and after smoothing in the frames that both have."""
    plain, smoothed = (read_motion(result, is_smoothed)[0] for is_smoothed in (False, True))
    true = read_joints(truth)
    where = {int(frame): k for k, frame in enumerate(true.frames)}
    rows = [f for f, frame in enumerate(plain.result.frames) if int(frame) in where]
    place = true.positions[[where[int(plain.result.frames[f])] for f in rows]]
    before, after = (errors(motion.points[rows][:, : len(JOINTS)], place, motion.fps) for motion in (plain, smoothed))
    return before, after


def bridging_cm(result: Path, gap: int) -> float:
    """Return the mean distance of bridged from tracked joints if ``gap`` of every ``gap + 8`` frames are removed."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(shutil.copyfile(result, Path(folder) / "gaps.h5"))
        with h5py.File(copy, "r+") as file:
            taken = np.arange(len(file["status"])) % (gap + 8) >= 8
            taken[np.arange(len(taken)) >= len(taken) - 8] = False
            file["status"][taken] = Status.LOST
        bridged, _ = read_motion(copy, smoothed=True)
    tracked, _ = read_motion(result)
    count = bridged.bridged & tracked.known
    difference = bridged.points[count] - tracked.points[count]
    return 100 * float(np.linalg.norm(difference[:, : len(JOINTS)], axis=2).mean())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--gaps", type=int, nargs="+", default=[2, 4, 7], metavar="FRAMES")
    options = parser.parse_args(arguments)
    print(f"{'':10}{'distance':>10}{'less offset':>13}{'velocity':>11}{'acceleration':>14}")
    for name, found in zip(("tracked", "smoothed"), compare(options.result, options.truth), strict=True):
        print(
            f"{name:10}{found.distance_cm:7.2f} cm{found.less_offset_cm:10.2f} cm{found.velocity_m_s:7.3f} m/s"
            f"{found.acceleration_m_s2:9.2f} m/s²"
        )
    for gap in options.gaps:
        print(f"gaps of {gap} frames: bridged {bridging_cm(options.result, gap):.2f} cm from tracked")


if __name__ == "__main__":
    main()
