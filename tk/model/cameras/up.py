"""The world's up direction: an axis, or any other direction.

In memory and in a result's attribute `up` it is a text: the name of an axis ("z", "-y"), or a unit vector in the syntax
of TOML and JSON ("[0.02, -0.9998, 0.01]").
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import ConfigError

Float = NDArray[np.float64]

#: names of axes
UP_AXES = ("x", "y", "z", "-x", "-y", "-z")

#: valid values of ``up``, for messages
UP_FORMS = f"one of {', '.join(UP_AXES)} or three numbers, a direction in the world frame"

#: a shorter vector is refused: it is mistyped, and its direction is mostly rounding
_SHORT = 1e-3


def up_vector(up: str) -> Float:
    """Return the unit vector (3,) that points up, world frame.

    Raises:
        ConfigError: ``up`` is neither an axis nor three numbers.
    """
    name = up.strip().lower().removeprefix("+")
    if name in UP_AXES:
        axis = np.zeros(3)
        axis["xyz".index(name[-1])] = -1.0 if name.startswith("-") else 1.0
        return axis
    try:
        values = json.loads(name)
    except json.JSONDecodeError:
        values = None
    if not isinstance(values, list):
        raise ConfigError(f"up = {up!r} must be {UP_FORMS}")
    return _unit(values)


def up_text(up: str | Sequence[float] | Float) -> str:
    """Return the text of a direction: the axis's name if it is one, else the normalised vector.

    Raises:
        ConfigError: ``up`` is not a direction.
    """
    vector = up_vector(up) if isinstance(up, str) else _unit(up)
    for name in UP_AXES:
        if np.array_equal(vector, up_vector(name)):
            return name
    return json.dumps([float(value) for value in vector])


def shown(up: str) -> str:
    """Return the text of a direction for messages: a vector with three digits."""
    return up if up in UP_AXES else f"[{', '.join(f'{value + 0.0:.3f}' for value in up_vector(up).round(3))}]"


def _unit(values: ArrayLike) -> Float:
    try:
        vector = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ConfigError(f"up = {values!r} must be {UP_FORMS}")
    length = float(np.linalg.norm(vector))
    if length < _SHORT:
        raise ConfigError(f"up = {np.round(vector, 3).tolist()} has no direction: its length is {length:g}")
    if abs(length - 1.0) < 1e-12:  # the text of a unit vector does not change
        return vector
    return vector / length
