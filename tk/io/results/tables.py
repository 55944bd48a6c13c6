"""Convert a result to a pandas table or an xarray dataset. Each package is imported only when it is needed."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
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

_AXES = ("x", "y", "z")


def to_pandas(result: Result) -> pandas.DataFrame:
    """Return a table with one row per frame, indexed by frame number.

    Columns: ``time`` (seconds), ``status`` (a word), ``objective``; ``<joint>_x``, ``_y``, ``_z`` and ``<joint>_sigma``
    (metres); ``_x``, ``_y``, ``_z`` of the points of the feet; the pose by its names (radians and metres);
    ``<joint>_<angle>_deg``; ``<camera>_missing`` and ``<camera>_surplus``, the residual.

    Raises:
        ExportError: pandas is not installed.
    """
    pd = _load("pandas")
    columns: dict[str, Any] = {
        "time": result.time,
        "status": np.array(STATUS_MEANING)[np.minimum(result.status, len(STATUS_MEANING) - 1)],
        "objective": result.objective,
    }
    for values, names in _points(result):
        columns |= {f"{name}_{axis}": values[:, i, k] for i, name in enumerate(names) for k, axis in enumerate(_AXES)}
    if result.sigma is not None:
        columns |= {f"{name}_sigma": result.sigma[:, i] for i, name in enumerate(result.meta.joint_names)}
    columns |= {name: result.pose[:, i] for i, name in enumerate(result.meta.pose_names)}
    columns |= {
        f"{angles.joint}_{name}_deg": result.angles[angles.joint][:, i]
        for angles in result.meta.angles
        if angles.joint in result.angles
        for i, name in enumerate(angles.names)
    }
    if result.residual is not None:
        columns |= {
            f"{name}_{area}": result.residual[:, i, k]
            for i, name in enumerate(result.meta.residual_cameras)
            for k, area in enumerate(("missing", "surplus"))
        }
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
        "joints": (("frame", "joint", "axis"), result.joints, {"units": "m"}),
        "pose": (("frame", "dof"), result.pose),
        "status": (("frame",), result.status, {"meaning": ", ".join(STATUS_MEANING)}),
        "objective": (("frame",), result.objective, {"kind": meta.objective_kind}),
    }
    coords: dict[str, Any] = {
        "frame": result.frames,
        "time": ("frame", result.time, {"units": "s"}),
        "joint": list(meta.joint_names),
        "axis": list(_AXES),
        "dof": list(meta.pose_names),
        "dof_unit": ("dof", list(meta.pose_units)),
    }
    if result.sigma is not None:
        variables["sigma"] = (("frame", "joint"), result.sigma, {"units": "m"})
    if result.feet is not None:
        variables["feet"] = (("frame", "foot", "axis"), result.feet, {"units": "m"})
        coords["foot"] = list(FOOT_POINTS)
    if result.residual is not None:
        variables["residual"] = (("frame", "camera", "area"), result.residual)
        coords["area"] = ["missing", "surplus"]
        coords["camera"] = list(meta.residual_cameras)
    if result.segments_rotation is not None:
        variables["rotation"] = (("frame", "segment", "quaternion"), result.segments_rotation)
        coords |= {"segment": list(meta.segment_names), "quaternion": list("wxyz")}
    angles = {
        f"{joint_angles.joint} {name}": result.angles[joint_angles.joint][:, i]
        for joint_angles in meta.angles
        if joint_angles.joint in result.angles
        for i, name in enumerate(joint_angles.names)
    }
    if angles:
        variables["angles"] = (("frame", "angle"), np.stack(list(angles.values()), axis=1), {"units": "degrees"})
        coords["angle"] = list(angles)
    attributes = {"fps": meta.fps, "up": meta.up, "capture": meta.capture, "method": meta.method}
    return xr.Dataset(variables, coords, attributes)


def _points(result: Result) -> Iterator[tuple[NDArray[np.float64], tuple[str, ...]]]:
    yield result.joints, result.meta.joint_names
    if result.feet is not None:
        yield result.feet, FOOT_POINTS


def _load(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError:
        raise ExportError(f"this needs {package}, which is not installed: pip install {package}") from None
