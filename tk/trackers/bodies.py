"""What results were tracked with: bodies, also from a TOML file with dimensions, and cameras."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import ConfigError, ResultError
from tk.io.captures.capture import Capture
from tk.io.results.data import Result
from tk.io.results.reader import as_damage_error, read_result
from tk.io.toml import parse_toml, read_text
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.skeleton import convert_poses, skeleton_of_names
from tk.model.body.stored_body import restore_body, restore_dimensions
from tk.model.cameras.camera import Rig
from tk.model.setup import AVERAGE_STATURE_M


def read_body(path: Path, up: str) -> ConeBody:
    """Return the body of a result, or of a TOML file with ``[dimensions]`` in metres, or with ``stature``.

    Missing dimensions are the average ones of the stature.

    Raises:
        ConfigError: there is no such file, or it has no cone body.
        ResultError: a damaged result.
    """
    if path.suffix.lower() != ".toml":
        model = read_result(path).model
        if "parts/shape" not in model:
            raise ConfigError(f"{path}: holds no body of contours; give a result of the method region or a TOML file")
        with as_damage_error(path, "the body"):
            return restore_body(model, up)
    values = parse_toml(read_text(path, ConfigError), str(path), ConfigError)
    unknown = sorted(set(values) - {"dimensions", "stature"})
    if unknown or not values:
        what = f"unknown entry {unknown[0]}" if unknown else "is empty"
        raise ConfigError(f"{path}: {what}; a body has stature, or [dimensions], in metres")
    given = values.get("dimensions", {})
    known = {field.name for field in fields(BodyDimensions)}
    stature = values.get("stature", AVERAGE_STATURE_M)
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
    """Return the body that a result was tracked with, and its poses (F, D); None if it stores no body.

    Angles that the result does not have are 0: the volumetric tracker has no ankles.

    Raises:
        ResultError: the pose vector is not one of this body.
    """
    if not {"parts/shape", "dimensions/trunk"} & result.model.keys():
        return None
    with as_damage_error(result.path, "the body"):
        if "parts/shape" in result.model:
            body = restore_body(result.model, result.meta.up)
        else:
            body = build_cone_body(restore_dimensions(result.model), result.meta.up)
    try:
        own = skeleton_of_names(result.meta.pose_names, body.dimensions, result.meta.up)
    except ValueError as error:
        raise ResultError(f"{result.path}: /pose: {error}; track the capture again") from error
    return body, convert_poses(result.pose, own, body.skeleton)


def as_tracked(capture: Capture, result: Result) -> Capture:
    """Return the capture with the cameras and time offsets of the run, if the result has them."""
    if result.cameras is None:
        return capture
    of_run = {
        (camera.name, camera.width, camera.height): (camera, float(late))
        for camera, late in zip(result.cameras.rig, result.cameras.time_offset_s, strict=True)
    }
    used = [
        of_run.get((camera.name, camera.width, camera.height), (camera, late))
        for camera, late in zip(capture.rig, capture.time_offset_s, strict=True)
    ]
    return replace(capture, rig=Rig(tuple(camera for camera, _ in used)), time_offset_s=tuple(late for _, late in used))
