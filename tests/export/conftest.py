"""Small results, made from poses: a person who waves, turns and bends, with two frames lost."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.made_results import write_motion
from tk.io.results.status import Status
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import Skeleton, build_skeleton

BODY = BodyDimensions.from_stature(1.75)
SKELETON = build_skeleton(BODY)
FRAMES, FPS, FIRST = 24, 12.5, 5
LOST = (10, 11)

Write = Callable[..., Path]


def poses(skeleton: Skeleton = SKELETON) -> np.ndarray:
    """(F, D) smooth, within the limits; no arm is near the singular direction of a MOT file's angles."""
    rng = np.random.default_rng(3)
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
    """``write(name)``: a result with what every result has; ``meta`` and ``rows`` add optional datasets."""

    def run(
        name: str = "walk.h5",
        skeleton: Skeleton = SKELETON,
        up: str = "z",
        meta: dict[str, Any] | None = None,
        rows: Callable[[int], dict[str, Any]] = lambda f: {},
        lost: np.ndarray | None = None,
        frames: np.ndarray | None = None,
        second: Collection[int] = (),  # rows in which another person makes the same movement
    ) -> Path:
        states, numbers = status() if lost is None else lost, FIRST + np.arange(FRAMES) if frames is None else frames
        model = {f"dimensions/{key}": value for key, value in asdict(BODY).items()}

        def row(f: int) -> dict[str, Any]:
            return {"frames": numbers[f], "status": states[f], **rows(f)}

        return write_motion(
            tmp_path / name, skeleton, poses(skeleton), model, row, second, fps=FPS, up=up, **(meta or {})
        )

    return run
