"""Run `tk track` on recordings with artificial faults and print a table.

    python -m scripts.faults CAPTURE [--only NAME,…] [--begin N] [--camera NAME] [--foreign CAPTURE] [--work DIR]
        [-- further options]

Each fault is made in a copy of the capture without masks, so that the masks show the fault, too. ``tk track`` runs in a
process of its own. Columns:

- mean, worst: distance of all joints from the ground truth, mean over a frame, over frames that are neither lost nor
  suspect, cm.
- lost, suspect: number of such frames.
- bad: frames more than 10 cm off that are neither lost nor suspect; "unflagged": those of them whose sigma, the mean
  of the joints, is at most 5 cm.
- silent: joints more than 15 cm off without a warning (their frame is neither lost nor suspect, their sigma is at most
  5 cm), % of all joints.
- alarm: frames less than 6 cm off that are lost, suspect or have a joint without sigma, % of all frames.

Without a ``truth.h5`` the run without a fault is the reference.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from scripts.fault_kinds import FAULTS
from scripts.faulty import Faulty
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints
from tk.io.results.status import Status, has_pose

OFF_M = 0.10
"""A frame with a larger mean error must not be "tracked"."""
SILENT_M, SIGMA_M = 0.15, 0.05
"""A joint with a larger error must be marked; a larger sigma marks it."""
RIGHT_M = 0.06
"""A frame with a smaller mean error should not be marked."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run.

    Attributes:
        code: exit code; None after a timeout.
        messages: lines printed, without progress.
        error_m: (F, 15), error of each joint.
        status: (F,), status of each frame.
        sigma_m: (F, 15), sigma of each joint.
    """

    code: int | None
    messages: list[str]
    error_m: NDArray[np.float64]
    status: NDArray[np.uint8]
    sigma_m: NDArray[np.float64]

    @staticmethod
    def empty(code: int | None, messages: list[str]) -> Outcome:
        """Return the outcome of a run without a result."""
        return Outcome(code, messages, np.zeros((0, 15)), np.zeros(0, np.uint8), np.zeros((0, 15)))

    @property
    def lost(self) -> NDArray[np.bool_]:
        return ~has_pose(self.status)

    @property
    def suspect(self) -> NDArray[np.bool_]:
        return self.status == Status.SUSPECT

    @property
    def silent(self) -> NDArray[np.bool_]:
        """(F, 15), joints far off without a warning."""
        marked = (self.lost | self.suspect)[:, None] | ~(self.sigma_m <= SIGMA_M)
        return (self.error_m > SILENT_M) & ~marked

    @property
    def alarm(self) -> NDArray[np.bool_]:
        """(F,), correct frames that are marked."""
        marked = self.lost | self.suspect | np.isnan(self.sigma_m).any(axis=1)
        return (self.error_m.mean(axis=1) < RIGHT_M) & marked

    def row(self, name: str) -> str:
        F = len(self.status)
        tracked = ~(self.lost | self.suspect)
        cm, sure = 100 * self.error_m.mean(axis=1)[tracked], self.sigma_m.mean(axis=1)[tracked] <= SIGMA_M
        bad = cm > 100 * OFF_M
        figures = f"{cm.mean():6.2f} {cm.max():6.2f}" if len(cm) else "     -      -"
        shares = f"{100 * self.silent.mean():6.2f} {100 * self.alarm.mean():5.1f}" if F else "     -     -"
        code = "hang" if self.code is None else str(self.code)
        return (
            f"{name:20} {code:>4} {figures} {self.lost.sum():4}/{F:<4} {self.suspect.sum():7} "
            f"{bad.sum():4} {(bad & sure).sum():9} {shares}  {' | '.join(self.messages)}"
        )


def make_faulty(
    name: str, capture: Path, folder: Path, camera: str | None, begin: int, foreign: Path | None = None
) -> Faulty:
    """Copy the capture without its masks and add a fault.

    Args:
        name: of the fault.
        capture: the capture.
        folder: the copy.
        camera: the faulty camera; None: the second one.
        begin: first frame of faults that do not last from the start.
        foreign: another capture with as many cameras; None: the first one beside the capture.
    """
    shutil.copytree(
        capture, folder, copy_function=os.link, ignore=shutil.ignore_patterns("masks*", "*.h5", "calibration_*")
    )
    settings = folder / "capture.toml"
    if not settings.exists():
        settings.write_text(tomli_w.dumps({"name": capture.name}), encoding="utf-8")
    original = open_capture(folder)
    names = original.rig.names
    if foreign is None and name == "foreign calibration":
        others = (path.parent for path in sorted(capture.resolve().parent.glob("*/calibration.toml")))
        same = (
            o for o in others if o != capture.resolve() and read_calibration(o / "calibration.toml").rig.names == names
        )
        foreign = next(same, None)
    faulty = Faulty(folder, original, names.index(camera) if camera else 1, begin, foreign)
    FAULTS[name](faulty)
    return faulty


def run(faulty: Faulty, truth: Path | None, result: Path, options: Sequence[str], limit_s: float) -> Outcome:
    """Track a copy in a process of its own and compare it with the ground truth, if there is one."""
    folder = faulty.folder
    command = [
        sys.executable,
        "-c",
        "from tk.cli import main; main()",
        "track",
        str(folder),
        "-o",
        str(result),
        *options,
    ]
    if faulty.used:
        command += ["--cameras", ",".join(faulty.used)]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, timeout=limit_s)
    except subprocess.TimeoutExpired:
        return Outcome.empty(None, [])
    lines = [line.replace(str(folder) + "/", "") for line in ran.stderr.splitlines()]
    if (crash := "Traceback (most recent call last):") in lines:
        lines = [*lines[: lines.index(crash)], f"crash: {lines[-1]}"]
    messages = [line for line in lines if line and not line.startswith(("frame ", "["))]
    if not result.exists():
        return Outcome.empty(ran.returncode, messages)
    found = read_joints(result)
    assert found.status is not None
    sigma = np.full(found.positions.shape[:2], np.nan) if found.sigma is None else found.sigma
    if truth is None:
        return Outcome(ran.returncode, messages, np.zeros(sigma.shape), found.status, sigma)
    true = read_joints(truth)
    rows = {int(frame): row for row, frame in enumerate(true.frames)}
    frames = np.where(found.frames < faulty.begin, found.frames, found.frames + faulty.cut)
    known = np.array([int(frame) in rows for frame in frames])
    expected = true.positions[[rows[int(frame)] for frame in frames[known]]]
    error = np.linalg.norm(found.positions[known] - expected, axis=2)
    return Outcome(ran.returncode, messages, error, found.status[known], sigma[known])


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the faults, track, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m scripts.faults", description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--only", default=",".join(FAULTS), help=f"some of {', '.join(FAULTS)}")
    parser.add_argument("--camera", help="the faulty camera [default: the second]")
    parser.add_argument("--begin", type=int, default=30, help="first frame of the fault")
    parser.add_argument("--foreign", type=Path, help="another capture with as many cameras [default: one beside it]")
    parser.add_argument("--work", type=Path, help="folder for captures and results [default: temporary]")
    parser.add_argument("--limit", type=float, default=1200.0, help="time limit of a run, seconds")
    given, options = parser.parse_known_args(arguments)
    options = [option for option in options if option != "--"]
    names = given.only.split(",")
    if unknown := set(names) - set(FAULTS):
        parser.error(f"no such fault: {', '.join(sorted(unknown))}; there are {', '.join(FAULTS)}")
    print(f"{'fault':20} exit   mean  worst   lost     suspect  bad unflagged silent alarm  messages")
    with tempfile.TemporaryDirectory() as scratch:
        work = given.work or Path(scratch)
        truth = given.capture / "truth.h5"
        known: Path | None = truth if truth.exists() else None
        if known is None and "none" not in names:
            names = ["none", *names]
        for name in names:
            folder, result = work / name, work / f"{name}.h5"
            shutil.rmtree(folder, ignore_errors=True)
            result.unlink(missing_ok=True)
            work.mkdir(parents=True, exist_ok=True)
            faulty = make_faulty(name, given.capture, folder, given.camera, given.begin, given.foreign)
            started = time.perf_counter()
            outcome = run(faulty, known, result, options, given.limit)
            print(outcome.row(name), f"[{time.perf_counter() - started:.0f} s]", flush=True)
            if known is None and name == "none":
                known = result


if __name__ == "__main__":
    main()
