"""Track a capture with its true cameras, and with cameras that are wrong as those of `tk calibrate` are.

    python -m scripts.board_limbs CAPTURE [--seeds 2] [--frames 60]

Each camera has the largest errors of the report rigs of scripts/board_rigs.py, in directions at random: larger errors
than a calibration has, whose cameras are not all as wrong as the worst one, and whose errors compensate each other.
Prints the mean distance of the 12 limb joints from the truth, without their constant offsets, and the ratio.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np

from scripts.any_start import Quiet
from scripts.refined_cameras import disturbed
from scripts.synthetic.capture import write_calibration
from tk.evaluation.joints import evaluate
from tk.io.captures.calibration import read_calibration
from tk.io.captures.capture import open_capture
from tk.io.results.reader import read_joints
from tk.model.cameras.camera import Rig
from tk.run.session import track
from tk.run.task import RecordingOptions

#: largest errors of the rigs report4, report5 and report8: degrees, metres, share
TURN_DEG, MOVE_M, FOCAL = 0.033, 0.00135, 0.00045


def limbs_cm(capture: Path, output: Path, frames: int, truth: Path) -> float:
    """Track a capture and return the error of its limbs, cm."""
    track(open_capture(capture), output, RecordingOptions(frames=(0, frames)), Quiet(), force=True)
    return float(evaluate(read_joints(output), read_joints(truth)).corrected.limbs.mean_cm)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=60)
    given = parser.parse_args()
    truth = given.capture / "truth.h5"
    rig = read_calibration(given.capture / "calibration.toml").rig
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        true = limbs_cm(given.capture, work / "true.h5", given.frames, truth)
        print(f"true cameras: {true:.3f} cm", flush=True)
        for seed in range(given.seeds):
            folder = work / f"wrong-{seed}"
            shutil.copytree(given.capture, folder, ignore=shutil.ignore_patterns("calibration.toml"))
            folder.chmod(0o755)
            random = np.random.default_rng(seed)
            wrong = Rig(tuple(disturbed(camera, random, TURN_DEG, MOVE_M, FOCAL) for camera in rig))
            write_calibration(wrong, folder / "calibration.toml")
            found = limbs_cm(folder, work / f"wrong-{seed}.h5", given.frames, truth)
            print(f"seed {seed}: {found:.3f} cm, ratio {found / true:.2f}", flush=True)


if __name__ == "__main__":
    main()
