"""A cone body as plain values by name, as result files store it in `/model`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from tk.kernels.cones import CONE, ELLIPSOID
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import ConeBody, ConePart, build_cone_body
from tk.model.body.joints import SEGMENTS

_DIMENSIONS = "dimensions/"


def body_values(body: ConeBody) -> dict[str, Any]:
    """Return the dimensions and the parts of a body."""
    return {
        **{f"{_DIMENSIONS}{name}": value for name, value in asdict(body.dimensions).items()},
        "parts/name": json.dumps([part.name for part in body.parts]),
        "parts/segment": json.dumps([part.segment for part in body.parts]),
        "parts/kind": np.array([part.kind for part in body.parts]),
        "parts/shape": np.array([part.shape for part in body.parts]),
        "parts/T_body_part": np.array([part.T_body_part for part in body.parts]),
    }


def restore_dimensions(model: Mapping[str, Any]) -> BodyDimensions:
    """Return the dimensions that :func:`body_values` stored.

    Raises:
        ConfigError, TypeError, ValueError: they are incomplete, or impossible.
    """
    stored = {name: value for name, value in model.items() if name.startswith(_DIMENSIONS)}
    return BodyDimensions(**{name.removeprefix(_DIMENSIONS): float(value) for name, value in stored.items()})


def restore_body(model: Mapping[str, Any], up: str = "z") -> ConeBody:
    """Return the body that :func:`body_values` stored.

    Raises:
        ConfigError, LookupError, TypeError, ValueError: the model is incomplete, or describes no body.
    """
    body = build_cone_body(restore_dimensions(model), up)
    # the stored parts, because another version of the program may divide the body differently
    names, segments = (json.loads(str(model[f"parts/{name}"])) for name in ("name", "segment"))
    kinds = np.asarray(model["parts/kind"])
    shapes, places = (np.asarray(model[f"parts/{name}"], np.float64) for name in ("shape", "T_body_part"))
    count = len(names)
    if not set(segments) <= set(SEGMENTS) or not set(kinds.ravel().tolist()) <= {CONE, ELLIPSOID}:
        raise ValueError("a part has an unknown segment or kind")
    found = [np.shape(values) for values in (names, segments, kinds, shapes, places)]
    if found != [(count,), (count,), (count,), (count, 4), (count, 4, 4)] or not (
        np.isfinite(shapes).all() and np.isfinite(places).all()
    ):
        raise ValueError("the parts have the wrong number, shape or values")
    drawn = {part.name: (part.ends, part.has_contours) for part in body.parts}
    return replace(
        body,
        parts=tuple(
            ConePart(str(name), segment, int(kind), tuple(shape), T, *drawn.get(str(name), ()))
            for name, segment, kind, shape, T in zip(names, segments, kinds, shapes.tolist(), places, strict=True)
        ),
    )
