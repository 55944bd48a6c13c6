"""Track scenes with several people, and each person alone, and compare the errors.

    python -m scripts.people_scenes FOLDER [--work DIR] [options of tk track, e.g. --cameras cam1,cam2,cam3,cam4]

Each folder in FOLDER is a scene with captures that ``scripts/make_capture.py`` renders, without masks:

- ``both`` and ``alone-0``, ``alone-1``: the people together, and each alone (``--only N``);
- or ``with`` and ``without``: a subject with a bystander, and without (``--only 0``).

Scenes of the first kind are tracked with ``--people all``, the other captures with ``--people auto``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.evaluation.people import PeopleEvaluation, evaluate_people
from tk.io.results.data import JointTrack
from tk.io.results.reader import read_people
from tk.model.body.joints import JOINTS

#: an embrace: pelvises nearer than this, metres
EMBRACE_M = 0.45
PELVIS = JOINTS.index("pelvis")


@dataclass(frozen=True)
class Run:
    """One run of ``tk track``.

    Attributes:
        people: what was tracked; nobody if the command refused the capture.
        seconds: processor time of the command.
        mib: peak memory of its largest process.
    """

    people: tuple[JointTrack, ...]
    seconds: float
    mib: float


def track(capture: Path, result: Path, people: str, options: Sequence[str]) -> Run:
    """Track a capture against its empty scene; the messages of the command are in ``result`` with suffix .log."""
    command = ["track", capture, "-o", result, "--people", people, "--masks", "none", "--no-report", "--force"]
    log = result.with_suffix(".log")
    with log.open("w") as stderr:
        process = subprocess.Popen([sys.executable, "-m", "tk", *map(str, command), *options], stderr=stderr)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    cost = usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024
    if process.returncode in (0, 3):  # 3: many frames are lost, which the table shows
        return Run(read_people(result), *cost)
    print(log.read_text().splitlines()[-1], file=sys.stderr)
    return Run((), *cost)


def compare(run: Run, truth: Sequence[JointTrack]) -> PeopleEvaluation | None:
    """Return the errors of a run; None if the capture was refused."""
    return evaluate_people(run.people, truth) if run.people else None


def embraces(truth: Sequence[JointTrack]) -> NDArray[np.int64]:
    """Return the frames in which two people are nearer than EMBRACE_M, by their pelvises."""
    near = []
    for i, a in enumerate(truth):
        for b in truth[:i]:
            frames, in_a, in_b = np.intersect1d(a.frames, b.frames, return_indices=True)
            apart = np.linalg.norm(a.positions[in_a, PELVIS] - b.positions[in_b, PELVIS], axis=1)
            near.append(frames[apart < EMBRACE_M])
    return np.unique(np.concatenate([np.zeros(0, np.int64), *near]))


def missed(found: PeopleEvaluation | None, person: int) -> int | None:
    """Return the number of frames in which a person of the ground truth has no match within 50 cm."""
    return None if found is None else found.people[person].frames - found.people[person].matches


def outside(truth: Sequence[JointTrack], frames: NDArray[np.int64]) -> list[JointTrack]:
    """Return the ground truth without some frames."""
    kept = [~np.isin(track.frames, frames) for track in truth]
    return [
        replace(track, frames=track.frames[k], positions=track.positions[k])
        for track, k in zip(truth, kept, strict=True)
    ]


def cm(found: PeopleEvaluation | None, person: int) -> tuple[float | None, float | None]:
    """Return the mean errors of the limbs without the joints' offsets and of all joints, cm; None if never found."""
    errors = None if found is None else found.people[person].errors
    return (None, None) if errors is None else (errors.corrected.limbs.mean_cm, errors.raw.all.mean_cm)


def row(name: str, cells: Sequence[float | int | str | None]) -> str:
    """Return a line of a table; None is printed as "-"."""
    texts = ["-" if cell is None else f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in cells]
    return f"{name:20}" + "".join(f"{text:>9}" for text in texts)


def compare_together(scene: Path, work: Path, options: Sequence[str]) -> Iterator[str]:
    """Yield a line of the first table for each person of a scene."""
    truth = read_people(scene / "both" / "truth.h5")
    together = track(scene / "both", work / f"{scene.name}-both.h5", "all", options)
    found, apart = compare(together, truth), compare(together, outside(truth, embraces(truth)))
    alone = [
        track(scene / f"alone-{k}", work / f"{scene.name}-alone-{k}.h5", "auto", options) for k in range(len(truth))
    ]
    whole = [run for run in alone if run.people]
    for k, run in enumerate(alone):
        single = compare(run, read_people(scene / f"alone-{k}" / "truth.h5"))
        (limbs, raw), (limbs_alone, raw_alone) = cm(found, k), cm(single, 0)
        ratio = limbs / limbs_alone if limbs and limbs_alone else None
        lost, all_lost = missed(apart, k), missed(found, k)
        embraced = None if lost is None or all_lost is None else all_lost - lost
        cells = [limbs, limbs_alone, ratio, raw, raw_alone, lost, embraced, missed(single, 0)]
        cells.append(None if found is None else found.people[k].switches)
        if k == 0 and whole:
            cells.append(together.seconds / float(np.mean([run.seconds for run in whole])))
            cells.append(together.mib / float(np.mean([run.mib for run in whole])))
        yield row(f"{scene.name} {k}", cells)


def compare_bystander(scene: Path, work: Path, options: Sequence[str]) -> str:
    """Return the line of the second table for a scene: the subject, who is person 0, with and without the bystander."""
    found = []
    for name in ("with", "without"):
        run = track(scene / name, work / f"{scene.name}-{name}.h5", "auto", options)
        found.append(compare(run, read_people(scene / name / "truth.h5")[:1]))
    (limbs, raw), (limbs_without, raw_without) = (cm(one, 0) for one in found)
    difference = None if limbs is None or limbs_without is None else limbs - limbs_without
    lost, lost_without = (missed(one, 0) for one in found)
    return row(scene.name, [limbs, limbs_without, difference, raw, raw_without, lost, lost_without])


def main(arguments: Sequence[str] | None = None) -> None:
    """Track the scenes and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m scripts.people_scenes", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of scenes")
    parser.add_argument("--work", type=Path, help="folder for the results [default: temporary]")
    parser.add_argument("--scenes", default="*", metavar="GLOB", help="names of the scenes [default: all]")
    given, options = parser.parse_known_args(arguments)
    scenes = sorted(given.folder.glob(given.scenes))
    together = [scene for scene in scenes if (scene / "both").is_dir()]
    bystander = [scene for scene in scenes if (scene / "without").is_dir()]
    with tempfile.TemporaryDirectory() as scratch:
        work = given.work or Path(scratch)
        work.mkdir(parents=True, exist_ok=True)
        if together:
            print("cm: limbs without the joints' offsets, all joints raw. Frames missed outside embraces, in embraces,")
            print("and alone. Processor time and peak memory as multiples of those for one person.")
            names = [
                "limbs",
                "alone",
                "ratio",
                "raw",
                "alone",
                "missed",
                "embrace",
                "alone",
                "switches",
                "time",
                "memory",
            ]
            print(row("scene, person", names))
        for scene in together:
            for line in compare_together(scene, work, options):
                print(line, flush=True)
        if bystander:
            print("\nThe subject with and without a bystander, cm, and frames missed.")
            print(row("scene", ["limbs", "without", "change", "raw", "without", "missed", "without"]))
        for scene in bystander:
            print(compare_bystander(scene, work, options), flush=True)


if __name__ == "__main__":
    main()
