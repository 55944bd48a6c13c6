"""A person's body from an earlier recording: a result file, or a TOML file with its dimensions."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError, ResultError
from tk.io.results.writer import Result, blamed_on, read_result
from tk.io.toml import parse_toml, read_text
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.skeleton import DEGREES_OF_FREEDOM, join_pose
from tk.trackers.contour_tracker import restore_body, restore_dimensions


def read_body(path: Path, up: str) -> ConeBody:
    """The body that a result holds, or that a TOML file describes by ``[dimensions]`` in metres, or by ``stature``.

    Dimensions that the TOML file leaves out are the average ones of its stature.

    Raises:
        ConfigError: there is no such file, or no body of contours in it.
        ResultError: a damaged result.
    """
    if path.suffix.lower() != ".toml":
        model = read_result(path).model
        if "parts/shape" not in model or "body" not in model:
            raise ConfigError(f"{path}: holds no body of contours; give a result of --method region or a TOML file")
        with blamed_on(path, "the body"):
            return restore_body(model, up)
    values = parse_toml(read_text(path, ConfigError), str(path), ConfigError)
    given = values.get("dimensions", {})
    known = {field.name for field in fields(BodyDimensions)}
    stature = values.get("stature", 1.75)
    numbers = {"stature": stature, **(given if isinstance(given, dict) else {"dimensions": given})}
    for name, value in numbers.items():
        if name != "stature" and name not in known:
            raise ConfigError(f"{path}: unknown dimension {name}; known are {', '.join(sorted(known))}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 3:
            raise ConfigError(f"{path}: {name} = {value} must be a number of metres between 0 and 3")
    average = BodyDimensions.from_stature(float(stature))
    lengths = {name: float(given.get(name, getattr(average, name))) for name in known}
    return build_cone_body(BodyDimensions(**lengths), up)


def body_and_poses(result: Result) -> tuple[ConeBody, NDArray[np.float64]] | None:
    """The body that a result was tracked with, and its poses (F, D); None where it holds none.

    Angles that the result does not tell, as the volumetric tracker's do not tell the ankles', are 0. Of the volumetric
    tracker's results of 0.x only the dimensions are taken: their shapes were of another kind.

    Raises:
        ResultError: the poses are not of this body.
    """
    if "parts/shape" in result.model and "body" in result.model:
        body = restore_body(result.model, result.meta.up)
    elif "dimensions/trunk" in result.model:
        body = build_cone_body(restore_dimensions(result.model), result.meta.up)
    else:
        return None
    skeleton = body.skeleton
    F = len(result.frames)
    columns = []
    for name, values, count in (
        ("pose", result.pose, DEGREES_OF_FREEDOM),
        ("waist", result.waist, int(skeleton.is_waist.sum())),
        ("ankles", result.ankles, int(skeleton.is_ankle.sum())),
    ):
        column = np.zeros((F, count)) if values is None else values
        if column.shape[1:] != (count,):
            raise ResultError(
                f"{result.path}: /{name} has {column.shape[1]} entries a frame, its body {count} such degrees of "
                "freedom; track anew"
            )
        columns.append(column)
    poses = [join_pose(skeleton, pose, waist, ankles) for pose, waist, ankles in zip(*columns, strict=True)]
    return body, np.array(poses).reshape(F, len(skeleton.names))
