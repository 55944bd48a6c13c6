"""Results made from poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tk.io.results.data import ResultMeta, Value
from tk.io.results.writer import ResultWriter
from tk.model.body.skeleton import Skeleton

#: groups of the run, not of a person
RUN = ("frames", "time", "timing")


def write_motion(
    path: Path,
    skeleton: Skeleton,
    poses: np.ndarray,
    model: Mapping[str, Value],
    row: Callable[[int], dict[str, Any]] = lambda f: {},
    second: Collection[int] = (),
    **meta: Any,
) -> Path:
    """Write a result of poses (F, D) at 15 frames/s.

    Args:
        path: the file.
        skeleton: the skeleton of the poses.
        poses: (F, D).
        model: the body.
        row: values of a row that differ from the usual ones or are optional, by path.
        second: rows in which another person makes the same movement.
        meta: metadata that differ from the usual ones.
    """
    usual = {"fps": 15.0, "up": "z", "capture": "walk", "method": "made", "seed": 0, "config_toml": ""}
    known = {"pose_names": skeleton.names, "pose_units": skeleton.units, "stages": ("all",)}
    whole = ResultMeta(**{"timing_stages": ("total",), **usual, **known, **meta})
    people = range(2 if second else 1)
    with ResultWriter.create(path, whole) as writer:
        for person in people:
            writer.write_model(model, person)
        for f, pose in enumerate(poses):
            values = {
                "frames": f, "pose": pose, "joints/position": skeleton.joints(pose), "status": 0, "objective": 0.1,
                "iterations": [9], **row(f),
            }  # fmt: skip
            frame = {name: values.pop(name) for name in list(values) if name.split("/")[0] in RUN}
            frame = {"time": frame["frames"] / whole.fps, **frame}
            writer.append(frame, {person: values for person in people if person == 0 or f in second})
    return path
