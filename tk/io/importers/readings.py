"""Choose between readings of the poses of a format whose public description leaves them open.

The cameras of a motion capture look at one place. Read in a wrong way, they look past each other, or away from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from tk.errors import CalibrationError
from tk.io.importers.project import Tables
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import closest_to_lines
from tk.model.cameras.mounting import infer_up

Float = NDArray[np.float64]

#: (R (3, 3), v (3,)) of a file to rotation (3, 3) and translation (3,), world to camera, x right, y down, z forward
Reading = Callable[[Float, Float], tuple[Float, Float]]

#: camera frame with y up and z backwards to OpenCV's
Y_UP = np.diag([1.0, -1.0, -1.0])

#: degrees between a camera's axis and the direction to the place that all cameras look at, root mean square: half the
#: field of view of a wide lens. The first reading is replaced if it has more, by one that has half as much. It is also
#: replaced if its cameras are not upright, by one whose cameras are, and that has less than half of this: poses that
#: are read in a wrong way may by chance look at one place, but not upright.
_APART_DEG = 45.0


def to_camera(R: Float, v: Float) -> tuple[Float, Float]:
    """R and v map world to camera, in OpenCV's axes."""
    return R, v


def of_camera(R: Float, v: Float) -> tuple[Float, Float]:
    """R and v map camera to world, in OpenCV's axes."""
    return R.T, -R.T @ v


def placed(R: Float, v: Float) -> tuple[Float, Float]:
    """R maps world to camera, in OpenCV's axes; v is the camera's centre."""
    return R, -R @ v


def y_up(reading: Reading) -> Reading:
    """Return a reading whose camera frame has y up and z backwards."""

    def read(R: Float, v: Float) -> tuple[Float, Float]:
        rotation, translation = reading(R, v)
        return Y_UP @ rotation, Y_UP @ translation

    return read


def choose(found: Tables, readings: Mapping[str, Reading]) -> None:
    """Replace the raw rotations and translations of all cameras by those of the most plausible reading.

    Args:
        found: cameras whose `rotation` is R, a matrix, and whose `translation` is v, as the file has them.
        readings: by what they say about the file, the first one first.

    Raises:
        CalibrationError: the first reading is implausible, and several others are equally plausible.
    """
    if not found.cameras:
        return  # read_format says so
    raw = [
        (np.array(table["rotation"], dtype=np.float64), np.array(table["translation"], dtype=np.float64).ravel())
        for table in found.cameras.values()
    ]
    if any(not np.isfinite(R).all() or np.linalg.matrix_rank(R) < 3 or not np.isfinite(v).all() for R, v in raw):
        return  # calibration_of says what is wrong
    poses = {name: [read(R, v) for R, v in raw] for name, read in readings.items()}
    apart = {name: _apart_deg(of_all) for name, of_all in poses.items()}
    first = best = next(iter(readings))
    closer = sorted(set(readings) - {first}, key=lambda name: apart[name])
    if apart[first] > _APART_DEG:
        closer = [name for name in closer if apart[name] < min(_APART_DEG, apart[first] / 2)]
    elif _upright(poses[first]):
        closer = []
    else:
        closer = [name for name in closer if apart[name] < _APART_DEG / 2 and _upright(poses[name])]
    if len(closer) > 1 and apart[closer[1]] < 1.5 * apart[closer[0]] + 1.0:
        raise CalibrationError(
            f"{found.source}: in the first reading ({first}), its cameras look past each other, or lie on their side; "
            f"they do not if {closer[0]}, and if {closer[1]}: write calibration.toml, where this is fixed"
        )
    best = closer[0] if closer else first
    if best != first:
        found.notes.append(
            f"{found.source}: {best}: in the first reading ({first}), the cameras would look past each other, or "
            "lie on their side; look at them with tk inspect"
        )
    for (key, table), (rotation, translation) in zip(list(found.cameras.items()), poses[best], strict=True):
        found.cameras[key] = {**table, "rotation": rotation.tolist(), "translation": translation.tolist()}


def _upright(poses: list[tuple[Float, Float]]) -> bool:
    """Return whether most cameras are mounted upright along one direction."""
    return infer_up(Rig(tuple(Camera("", 2, 2, np.eye(3), np.zeros(5), R, t) for R, t in poses))).sure


def _apart_deg(poses: list[tuple[Float, Float]]) -> float:
    """Return the angle between the cameras' axes and the direction to the point nearest to all axes, degrees, root
    mean square; 0 if the axes are parallel, which shows nothing."""
    centers = np.array([-R.T @ t for R, t in poses])
    axes = np.array([R[2] / np.linalg.norm(R[2]) for R, _ in poses])
    if len(poses) < 2 or (middle := closest_to_lines(centers, axes)) is None:
        return 0.0
    rays = middle - centers
    lengths = np.linalg.norm(rays, axis=1)
    if (lengths < 1e-9 * np.abs(centers).max(initial=1e-9)).any():
        return 90.0  # a camera in the place that all look at
    cosines = np.einsum("ci,ci->c", rays, axes) / lengths
    return float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosines, -1, 1)) ** 2))))
