"""A result with everything in it: a person who marches through the tiny capture, two frames lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import FRAMES
from tests.io.result_files import revise_result
from tests.made_results import write_motion
from tk.io import settings_file
from tk.io.captures.capture import open_capture
from tk.io.results.data import JointAngles, Result
from tk.io.results.reader import read_joints
from tk.io.results.status import Status
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.body.skeleton import SEGMENTS
from tk.model.body.stored_body import body_values
from tk.model.motion.derived import derive
from tk.settings import Settings

LOST = (6, 7)
NOTE = 'said </script><b>"loudly"</b> & more'


def complete_result(path: Path, capture_path: Path, count: int = FRAMES) -> Path:
    """Write it; the poses are made up, but stand where the capture's actor stands."""
    capture = open_capture(capture_path)
    body = build_cone_body(BodyDimensions.from_stature(1.7), capture.up)
    skeleton = body.skeleton
    truth = read_joints(capture_path / "truth.h5").positions
    rng = np.random.default_rng(1)
    poses = np.zeros((count, len(skeleton.names)))
    poses[:, :3] = truth[:count, 0]
    for side, sign in (("l", 1), ("r", -1)):
        poses[:, skeleton.index(f"hip_{side}_pitch")] = -0.5 * np.clip(sign * np.sin(np.arange(count)), 0, 1)
        poses[:, skeleton.index(f"knee_{side}_flexion")] = np.clip(sign * np.sin(np.arange(count)), 0, 1)
    derived = derive(skeleton, body.dimensions, poses)
    sigma = rng.uniform(0.005, 0.03, (count, 15))
    sigma[3, 8] = np.nan

    def row(f: int) -> dict[str, Any]:
        return {
            "joints/position": derived.joints[f], "joints/sigma": sigma[f], "objective": 0.1 + 0.01 * f,
            "status": Status.LOST if f in LOST else Status.INITIALISED if f == 0 else Status.TRACKED,
            "residual": np.full((len(capture.rig), 2), 0.05 + (0.1 if f == 11 else 0.0005 * f)),
            "segments/rotation": derived.rotations[f], "feet/position": derived.feet[f],
            **{f"angles/{joint}": values[f] for joint, values in derived.angles.items()},
            "timing/decode": 0.01, "timing/optimise": 0.12, "timing/total": 0.15,
        }  # fmt: skip

    write_motion(
        path, skeleton, poses, body_values(body), row,
        fps=capture.fps, up=capture.up, capture="made <up>", method="region",
        config_toml=settings_file.to_toml(Settings()), timing_stages=("decode", "optimise", "total"), sigma=True,
        residual_cameras=capture.rig.names, segment_names=SEGMENTS, feet=True,
        angles=JointAngles.of_body(skeleton.names), objective_kind="E_S",
    )  # fmt: skip
    revise_result(path, notes=["first", NOTE])
    return path


def with_partner(result: Result) -> Result:
    """Return a result with a second person half a metre aside, who enters in frame 4 and is lost in frame 5."""
    second = result.at_rows(np.where(np.arange(len(result)) < 4, -1, np.arange(len(result))))
    second = replace(second, frames=result.frames, time=result.time, timing=result.timing)
    aside = np.array([0.5, 0, 0])
    second.pose[:, :3] += aside
    second.joints[...] += aside
    second.status[4:] = Status.TRACKED
    second.status[5] = Status.LOST
    return replace(result, others=(replace(second, person=1),))


@pytest.fixture(scope="session")
def complete(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of :func:`complete_result`. Not to be changed."""
    return complete_result(tmp_path_factory.mktemp("complete") / "walk.h5", tiny)
