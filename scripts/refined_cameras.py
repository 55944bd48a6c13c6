"""How near refined cameras come to the true ones, and what that is worth.

    python -m scripts.refined_cameras CAPTURE… [--seeds 3] [--late] [--masks none] [--work DIR]

Every camera of a capture with exact calibration is turned by 0.25° and its place moved by 10 mm, each in a random
direction (another for each seed); with ``--late`` the first picture of the second camera's video is left out, too. A
capture that has a ``calibration_true.toml`` beside its own is taken as it is. It is tracked with ``refine = false`` and
by default. A line a run: errors of both, and how far the cameras that the result tells are from the true ones, after
the rigid motion that brings them closest; scale is held, as a recording of one person does not tell it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from scripts.any_start import Quiet
from scripts.faults import spoil
from scripts.synthetic.capture import write_calibration
from tk.evaluation.joints import evaluate
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture import open_capture
from tk.io.results.writer import read_joints, read_result
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.refinement import aligned, turn_between
from tk.run.session import track
from tk.settings import Settings

TURN_DEG, MOVE_M = 0.25, 0.010
# Turns and places are weighed by these, degrees and metres, when the rigid motion is taken off: the goal.
GOAL_DEG, GOAL_M = 0.1, 0.005


def disturbed(camera: Camera, rng: np.random.Generator) -> Camera:
    """The camera turned by 0.25° and moved by 10 mm in random directions."""
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = np.asarray(cv2.Rodrigues(np.radians(TURN_DEG) * axis)[0])
    center = camera.center + MOVE_M * way
    return replace(camera, rotation=turn @ camera.rotation, translation=-turn @ camera.rotation @ center)


def off(rig: Rig, true: Rig) -> str:
    """How far the cameras are from the true ones: by the mean, and the worst."""
    near = aligned(rig, true, np.radians(GOAL_DEG), GOAL_M, scaling=False)
    deg = [turn_between(one, other) for one, other in zip(near, true, strict=True)]
    mm = 1000 * np.linalg.norm(near.centers - true.centers, axis=1)
    return f"{np.mean(deg):.2f}° {np.mean(mm):.1f} mm (worst {np.max(deg):.2f}° {np.max(mm):.1f} mm)"


def compare(capture: Path, seeds: int, late: bool, masks: str, work: Path) -> Iterator[str]:
    """A line a seed."""
    known = capture / "calibration_true.toml"
    true = read_calibration(known if known.exists() else capture / "calibration.toml").rig
    truth = read_joints(capture / "truth.h5")
    for seed in range(1 if known.exists() else seeds):
        folder = work / f"{capture.name}-{seed}"
        spoiled = spoil("none", capture, folder, None, 0)
        if not known.exists():
            rng = np.random.default_rng(seed)
            (folder / "calibration.toml").unlink()
            write_calibration(Rig(tuple(disturbed(camera, rng) for camera in true)), folder / "calibration.toml")
        if late:
            spoiled.change(lambda video: video[1:])
        opened, told = open_capture(folder, masks=masks), []
        for refine in (False, True):
            output = work / f"{folder.name}-{refine}.h5"
            track(opened, output, Settings(refine=refine), Quiet(), force=True)
            result = read_result(output)
            judged = evaluate(read_joints(output), truth)
            told.append(f"{judged.raw.all.mean_cm:.2f} {judged.corrected.limbs.mean_cm:.2f}")
        used = result.cameras
        rig = opened.rig if used is None else used.rig
        delays = np.zeros(len(rig)) if used is None else opened.fps * used.time_offset_s
        yield (
            f"{capture.name:8} seed {seed}{', late' if late else ''}: raw, limbs [cm] {told[0]} → {told[1]}; "
            f"cameras {off(opened.rig, true)} → {off(rig, true)}; "
            f"frames late {' '.join(f'{x:+.2f}' for x in delays)}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--late", action="store_true", help="the second camera's first picture is left out")
    parser.add_argument("--masks", default="none", help="as for tk track")
    parser.add_argument("--work", type=Path, help="where copies and results go; a temporary folder otherwise")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for capture in args.captures:
            for line in compare(capture, args.seeds, args.late, args.masks, args.work or Path(temporary)):
                sys.stdout.write(line + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
