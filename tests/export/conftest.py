"""Small results, made from poses: a person who waves, turns and bends, with two frames lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tk.io.results.writer import FrameResult, ResultMeta, ResultWriter, Status
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import WAIST, Skeleton, build_skeleton, split_pose

BODY = BodyDimensions.from_stature(1.75)
SKELETON = build_skeleton(BODY, waist=True)
FRAMES, FPS, FIRST = 24, 12.5, 5
LOST = (10, 11)

Write = Callable[..., Path]


def poses(skeleton: Skeleton = SKELETON) -> np.ndarray:
    """(F, D) smooth, within the limits."""
    rng = np.random.default_rng(0)
    t = np.arange(FRAMES)[:, None] / FPS
    low, high = np.maximum(skeleton.lower, -1.0), np.minimum(skeleton.upper, 1.0)
    count = len(skeleton.names)
    swing = np.sin(2 * np.pi * rng.uniform(0.2, 0.5, count) * t + rng.uniform(0, 6, count))
    found = (low + high) / 2 + 0.4 * (high - low) * swing
    found[:, [skeleton.index("torso_roll"), skeleton.index("torso_pitch")]] *= 0.3
    found[:, skeleton.index("torso_yaw")] = np.linspace(0, 2 * np.pi, FRAMES)
    return np.asarray(found)


def status() -> np.ndarray:
    found = np.zeros(FRAMES, dtype=np.uint8)
    found[0] = Status.INITIALISED
    found[list(LOST)] = Status.LOST
    return found


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """``write(name)``: a result file of version 1's content; ``meta`` and ``rows`` add what version 2 may hold."""

    def run(
        name: str = "walk.h5",
        skeleton: Skeleton = SKELETON,
        up: str = "z",
        meta: dict[str, Any] | None = None,
        rows: Callable[[int], dict[str, Any]] = lambda f: {},
        version: int | None = 1,
        lost: np.ndarray | None = None,
        frames: np.ndarray | None = None,
    ) -> Path:
        has_waist = bool(skeleton.is_waist.any())
        states = status() if lost is None else lost
        names = tuple(name for name in skeleton.names if name not in WAIST)
        fixed = ResultMeta(
            pose_names=names,
            pose_units=tuple("m" if name in ("torso_x", "torso_y", "torso_z") else "rad" for name in names),
            stages=("all",),
            timing_stages=("total",),
            fps=FPS,
            up=up,
            capture="walk",
            method="volumetric",
            seed=0,
            config_toml="",
            waist_names=WAIST if has_waist else (),
            **(meta or {}),
        )
        path = tmp_path / name
        with ResultWriter.create(path, fixed) as writer:
            writer.write_model({f"dimensions/{key}": value for key, value in asdict(BODY).items()})
            for f, pose in enumerate(poses(skeleton)):
                short, waist, _ = split_pose(skeleton, pose)
                index = FIRST + f if frames is None else int(frames[f])
                writer.append(
                    FrameResult(
                        frame=index,
                        time=index / FPS,
                        pose=short,
                        joints=skeleton.joints(pose),
                        status=int(states[f]),
                        objective=0.0,
                        iterations=np.zeros(1, int),
                        timing={},
                        waist=waist,
                        **rows(f),
                    )
                )
        if version is not None:
            with h5py.File(path, "r+") as file:
                file.attrs["format_version"] = version
        return path

    return run
