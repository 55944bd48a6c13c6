"""Measures how close refined cameras come to the true ones, and the effect on the joints' errors.

    python -m scripts.refined_cameras CAPTURE… [--seeds 3] [--late] [--masks none] [--work DIR]

Every camera of a capture with exact calibration is turned by 0.25° and its centre moved by 10 mm, each in a random
direction (another for each seed); with ``--late`` the first frame of the second camera's video is removed, too. A
capture with a ``calibration_true.toml`` is used unchanged. It is tracked with ``refine = false`` and by default. A line
a run: mean joint errors of both, and errors of the given and of the refined cameras after the rigid motion that brings
them closest to the true ones; the scale is fixed, because a recording of one person does not determine it.
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
from scripts.faults import make_faulty
from scripts.synthetic.capture import write_calibration
from tk.evaluation.joints import evaluate
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints, read_result
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.refinement import aligned, turn_between
from tk.run.session import track
from tk.run.task import RecordingOptions
from tk.settings import Settings

TURN_DEG, MOVE_M = 0.25, 0.010
# Weights of turns and centres in the alignment, degrees and metres: the goal of a refinement.
GOAL_DEG, GOAL_M = 0.1, 0.005


def disturbed(
    camera: Camera, rng: np.random.Generator, turn_deg: float = TURN_DEG, move_m: float = MOVE_M, focal: float = 0.0
) -> Camera:
    """Return the camera turned by 0.25° and moved by 10 mm in random directions, with a focal length that is longer or
    shorter by a share ``focal``."""
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = np.asarray(cv2.Rodrigues(np.radians(turn_deg) * axis)[0])
    center = camera.center + move_m * direction
    matrix = camera.matrix.copy()
    if focal:
        matrix[:2, :2] *= 1 + focal * rng.choice([-1, 1])
    return replace(
        camera, matrix=matrix, rotation=turn @ camera.rotation, translation=-turn @ camera.rotation @ center
    )  # fmt: skip


def camera_errors(rig: Rig, true: Rig) -> str:
    """Return the mean and the largest errors of cameras as text."""
    near = aligned(rig, true, np.radians(GOAL_DEG), GOAL_M, scaling=False)
    deg = [turn_between(one, other) for one, other in zip(near, true, strict=True)]
    mm = 1000 * np.linalg.norm(near.centers - true.centers, axis=1)
    return f"{np.mean(deg):.2f}° {np.mean(mm):.1f} mm (worst {np.max(deg):.2f}° {np.max(mm):.1f} mm)"


def compare(capture: Path, seeds: int, late: bool, masks: str, work: Path) -> Iterator[str]:
    """Yield one line for each seed."""
    known = capture / "calibration_true.toml"
    true = read_calibration(known if known.exists() else capture / "calibration.toml").rig
    truth = read_joints(capture / "truth.h5")
    for seed in range(1 if known.exists() else seeds):
        folder = work / f"{capture.name}-{seed}"
        faulty = make_faulty("none", capture, folder, None, 0)
        if not known.exists():
            rng = np.random.default_rng(seed)
            (folder / "calibration.toml").unlink()
            write_calibration(Rig(tuple(disturbed(camera, rng) for camera in true)), folder / "calibration.toml")
        if late:
            faulty.change(lambda video: video[1:])
        opened, errors = open_capture(folder, masks=masks), []
        for refine in (False, True):
            output = work / f"{folder.name}-{refine}.h5"
            track(opened, output, RecordingOptions(Settings(refine=refine)), Quiet(), force=True)
            result = read_result(output)
            found = evaluate(read_joints(output), truth)
            errors.append(f"{found.raw.all.mean_cm:.2f} {found.corrected.limbs.mean_cm:.2f}")
        used = result.cameras
        rig = opened.rig if used is None else used.rig
        delays = np.zeros(len(rig)) if used is None else opened.fps * used.time_offset_s
        yield (
            f"{capture.name:8} seed {seed}{', late' if late else ''}: raw, limbs [cm] {errors[0]} → {errors[1]}; "
            f"cameras {camera_errors(opened.rig, true)} → {camera_errors(rig, true)}; "
            f"frames late {' '.join(f'{x:+.2f}' for x in delays)}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--late", action="store_true", help="remove the first frame of the second camera")
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
