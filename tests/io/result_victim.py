"""Write a result as fast as possible until the process is killed: ``python -m tests.io.result_victim RESULT FRAMES``.

Prints the number of finished frames after each one. All values of a frame follow from its index, so that a test can
check the file.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from tk.io.results.data import JointAngles, ResultMeta
from tk.io.results.status import Status
from tk.io.results.writer import ResultWriter

META = ResultMeta(
    pose_names=tuple(f"p{i}" for i in range(24)),
    pose_units=("m",) * 3 + ("rad",) * 21,
    stages=("all", "chains"),
    timing_stages=("hull", "optimise", "total"),
    fps=15.0,
    up="z",
    capture="walk",
    method="volumetric",
    seed=7,
    config_toml='method = "volumetric"\n[smd]\nmu = 0.1\n',
    sigma=True,
    residual_cameras=("cam1", "cam2", "cam3"),
    landmark_names=("nose", "toe_r"),
    depth=True,
    mask_sources=("scene", "segmenter"),
    reasons=("0: nothing", "1: a loss"),
    judged=True,
    deviation=True,
    modes=3,
    camera_states=("0: used", "1: torn"),
    segment_names=("torso", "head"),
    feet=True,
    angles=(
        JointAngles("knee_l", ("flexion",), "0 is straight, flexion positive"),
        JointAngles("hip_l", ("flexion", "abduction", "rotation"), "Grood and Suntay"),
    ),
    objective_kind="negative log-likelihood",
)


def make_run(index: int) -> dict[str, Any]:
    """Return the values of the run in frame ``index`` by path."""
    return {"frames": index + 3, "time": index / 15, "timing/hull": 0.01, "timing/total": 0.05 + index}


def make_frame(index: int) -> dict[str, Any]:
    """Return a person's values in frame ``index`` by path; some frames have no voxels, no sigma or no landmarks."""
    frame: dict[str, Any] = {
        "pose": np.arange(24) + 100.0 * index,
        "joints/position": np.arange(45.0).reshape(15, 3) + index,
        "status": Status.INITIALISED if index == 0 else Status.TRACKED,
        "objective": index / 2,
        "iterations": np.array([index, index + 1]),
        "residual": np.array([[0.1, 0.0], [0.1, 0.1], [0.0, index]]),
        "mask_source": np.array([0, 1, index % 2], np.uint8),
        "segments/rotation": np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        "feet/position": np.arange(12.0).reshape(4, 3) - index,
        "angles/knee_l": np.array([5.0 * index]),
        "angles/hip_l": np.array([1.0, 2.0, index]),
    }
    if index % 4 != 3:
        frame["joints/sigma"] = np.full(15, 0.01 * index)
    if index % 4 != 1:
        frame["landmarks"] = np.arange(18.0).reshape(3, 2, 3) + index
        frame["landmark_depth"] = np.arange(6.0).reshape(3, 2) - index
    if index % 5:
        count = 200 + index % 37
        frame["hull/positions"] = np.full((count, 3), index / 8)
        frame["hull/colors"] = np.full((count, 3), index % 256, dtype=np.uint8)
    return frame


def make_state(index: int) -> dict[str, np.ndarray | str]:
    return {"mean": np.full((220, 3), float(index)), "generator": "{" + "9" * (20 + index % 9) + f", {index}}}"}


def main() -> None:
    writer, done = ResultWriter.resume(sys.argv[1], META)
    with writer:
        if done == 0:
            writer.write_model({"torso/radii_m": np.array([0.1, 0.2]), "sex": "any"})
        for index in range(done, int(sys.argv[2])):
            writer.append(make_run(index), {0: make_frame(index)}, make_state(index))
            print(index + 1, flush=True)


if __name__ == "__main__":
    main()
