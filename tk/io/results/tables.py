"""Convert a result to a pandas table or an xarray dataset. Each package is imported only when it is needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import ExportError
from tk.io.results.status import STATUS_MEANING
from tk.model.body.joints import FOOT_POINTS

if TYPE_CHECKING:
    import pandas
    import xarray

    from tk.io.results.data import Result

#: dimensions of a field of Result after the frame, and attributes of its variable
_FIELDS: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "joints": (("joint", "axis"), {"units": "m"}),
    "sigma": (("joint",), {"units": "m"}),
    "feet": (("foot", "axis"), {"units": "m"}),
    "pose": (("dof",), {}),
    "residual": (("camera", "area"), {}),
    "segments_rotation": (("segment", "quaternion"), {}),
    "angles": (("angle",), {"units": "degrees"}),
}


def to_pandas(result: Result) -> pandas.DataFrame:
    """Return a table with one row per frame, indexed by frame number.

    Columns: ``time`` (seconds), ``status`` (a word), ``objective``; ``<joint>_x``, ``_y``, ``_z`` and ``<joint>_sigma``
    (metres); ``_x``, ``_y``, ``_z`` of the points of the feet; ``<joint>_<angle>_deg``; ``<camera>_missing`` and
    ``<camera>_surplus``, the residual. A result without joint angles has its pose instead, ``<name>_rad`` and
    ``<name>_m``.

    Raises:
        ExportError: pandas is not installed.
    """
    pd = _load("pandas")
    columns: dict[str, Any] = {
        "time": result.time,
        "status": np.array(STATUS_MEANING)[np.minimum(result.status, len(STATUS_MEANING) - 1)],
        "objective": result.objective,
    }
    suffix = {"sigma": "_sigma", "angles": "_deg"}
    omitted = {"segments_rotation"} | ({"pose"} if result.angles else set())
    for name, values, labels in _variables(result):
        if name == "pose":
            labels = [[f"{dof}_{unit}" for dof, unit in zip(*labels, result.meta.pose_units, strict=True)]]
        if name not in omitted:
            headers = ["_".join(parts).replace(" ", "_") + suffix.get(name, "") for parts in product(*labels)]
            columns |= dict(zip(headers, values.reshape(len(result), len(headers)).T, strict=True))
    return pd.DataFrame(columns, index=pd.Index(result.frames, name="frame"))


def to_xarray(result: Result) -> xarray.Dataset:
    """Return arrays with named dimensions: ``frame``, ``joint``, ``axis``, ``dof``, ``foot``, ``camera``, ``segment`` …

    ``time`` is a second coordinate of the dimension ``frame``. The attribute ``units`` is the unit of a variable.

    Raises:
        ExportError: xarray is not installed.
    """
    xr = _load("xarray")
    meta = result.meta
    variables: dict[str, Any] = {
        "status": (("frame",), result.status, {"meaning": ", ".join(STATUS_MEANING)}),
        "objective": (("frame",), result.objective, {"kind": meta.objective_kind}),
    }
    coords: dict[str, Any] = {
        "frame": result.frames,
        "time": ("frame", result.time, {"units": "s"}),
        "dof_unit": ("dof", list(meta.pose_units)),
    }
    for name, values, labels in _variables(result):
        dimensions, attributes = _FIELDS[name]
        variables["rotation" if name == "segments_rotation" else name] = (("frame", *dimensions), values, attributes)
        coords |= {dimension: list(names) for dimension, names in zip(dimensions, labels, strict=True)}
    shared = {"fps": meta.fps, "up": meta.up, "capture": meta.capture, "method": meta.method}
    return xr.Dataset(variables, coords, shared)


def _variables(result: Result) -> Iterator[tuple[str, NDArray[np.float64], list[Sequence[str]]]]:
    """Yield the name, the values (F, …) and the labels along each further axis of the fields that the result has."""
    meta = result.meta
    angles = {
        f"{item.joint} {name}": result.angles[item.joint][:, i]
        for item in meta.angles
        if item.joint in result.angles
        for i, name in enumerate(item.names)
    }
    labels: dict[str, Sequence[str]] = {
        "joint": meta.joint_names, "axis": "xyz", "foot": FOOT_POINTS, "dof": meta.pose_names, "angle": list(angles),
        "camera": meta.residual_cameras, "area": ("missing", "surplus"), "segment": meta.segment_names,
        "quaternion": "wxyz",
    }  # fmt: skip
    for name, (dimensions, _) in _FIELDS.items():
        values = getattr(result, name)
        if name == "angles":
            values = np.stack(list(angles.values()), axis=1) if angles else None
        if values is not None:
            yield name, values, [labels[dimension] for dimension in dimensions]


def _load(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError:
        raise ExportError(f"this needs {package}, which is not installed: pip install {package}") from None
