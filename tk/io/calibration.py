"""`calibration.toml`: the camera file that Anipose, Pose2Sim, FreeMoCap and Caliscope exchange."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tk.errors import CalibrationError, CaptureError
from tk.io.toml import Table, load_toml
from tk.model.camera import Camera, Rig

#: metres in one unit of ``[metadata] units``
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}

#: a reciprocal condition number below this is a singular intrinsic matrix: focal lengths of 10^-9 of the rest
_SINGULAR = 1e-9

#: pixels of a side of a picture
_MOST_PIXELS = 2**16


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says.

    Attributes:
        path: the file.
        rig: its cameras, in the file's order.
        keys: the table's key of each camera, which may differ from its name.
    """

    path: Path
    rig: Rig
    keys: tuple[str, ...]

    def select(self, names: Sequence[str] | None) -> Calibration:
        """The calibration of these cameras only, still in the file's order; all of them for None.

        Raises:
            CaptureError: a name is unknown, or fewer than two cameras are left.
        """
        known = self.rig.names
        wanted = known if names is None else [name.strip() for name in names]
        for name in wanted:
            if name not in known:
                raise CaptureError(f"--cameras: no camera {name!r} in {self.path}, which has {', '.join(known)}")
        chosen = [index for index, name in enumerate(known) if name in wanted]
        if len(chosen) < 2:
            source = self.path if names is None else f"--cameras {','.join(wanted)}"
            raise CaptureError(f"{source}: {len(chosen)} camera; a visual hull needs at least 2")
        return Calibration(self.path, Rig(tuple(self.rig[i] for i in chosen)), tuple(self.keys[i] for i in chosen))


def read_calibration(path: str | Path) -> Calibration:
    """Read and check a calibration file.

    One table a camera, `metadata` skipped; Caliscope's ``[cameras.1]`` is read too. Each has ``size = [width, height]``
    (pixels), ``matrix`` (3×3), ``distortions`` (4 or 5 numbers in OpenCV's order), ``rotation`` (Rodrigues vector,
    world to camera), ``translation`` (metres, or ``[metadata] units``) and, optionally, ``name`` (by default the
    table's key) and ``fisheye``.

    Raises:
        CalibrationError: with the file, the camera and the key that is wrong.
    """
    path = Path(path)
    if not path.exists():
        raise CalibrationError(f"{path}: there is no such file; a capture needs its cameras' calibration")
    document = load_toml(path, CalibrationError)
    metadata = Table(document, str(path), CalibrationError).table("metadata")
    units = metadata.text("units", "m")
    if units not in UNITS:
        metadata.fail(f"units = {units!r} must be one of {', '.join(UNITS)}")

    tables: Mapping[str, object] = {key: value for key, value in document.items() if key != "metadata"}
    nested = tables.get("cameras")
    if isinstance(nested, Mapping) and all(isinstance(value, Mapping) for value in nested.values()):
        tables = nested
    # plain values beside the tables (a date, a tool's version) are nobody's camera
    tables = {key: value for key, value in tables.items() if isinstance(value, Mapping)}
    if not tables:
        raise CalibrationError(f"{path}: has no cameras; it needs one table a camera")

    cameras: list[Camera] = []
    for key, values in tables.items():
        assert isinstance(values, Mapping)
        camera = _camera(key, values, path, UNITS[units])
        if camera.name in [other.name for other in cameras]:
            raise CalibrationError(f"{path}: two cameras have the name {camera.name!r}; give each its own")
        cameras.append(camera)
    return Calibration(path, Rig(tuple(cameras)), tuple(tables))


def _camera(key: str, values: Mapping[str, object], path: Path, unit_m: float) -> Camera:
    name = Table(values, f"{path}: camera {key!r}", CalibrationError).text("name", key)
    table = Table(values, f"{path}: camera {name!r}", CalibrationError)

    size = table.array("size", (2,))
    if (size <= 0).any() or (size != np.round(size)).any():
        table.fail(f"size = {values['size']} must be two positive whole numbers [width, height]")
    if (size > _MOST_PIXELS).any():
        table.fail(f"size = {values['size']} is too large; {_MOST_PIXELS} pixels a side are the most")

    matrix = table.array("matrix", (3, 3))
    if np.linalg.cond(matrix) > 1 / _SINGULAR:
        table.fail("matrix is singular; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or matrix[1, 0] != 0 or (matrix[2] != (0, 0, 1)).any():
        table.fail("matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths")

    fisheye = table.flag("fisheye", False)
    distortions = table.array("distortions", (4,), (5,))
    if fisheye and len(distortions) == 5:
        if distortions[4] != 0:
            table.fail("distortions has 5 numbers; a fisheye lens has 4 (k1 k2 k3 k4)")
        distortions = distortions[:4]

    rotation, _ = cv2.Rodrigues(table.array("rotation", (3,)))
    return Camera(
        name=name,
        width=int(size[0]),
        height=int(size[1]),
        matrix=matrix,
        distortions=distortions,
        rotation=np.asarray(rotation, dtype=np.float64),
        translation=table.array("translation", (3,)) * unit_m,
        fisheye=fisheye,
    )


def match_camera(name: str, key: str, stems: Iterable[str]) -> str | None:
    """The file stem that belongs to a camera, None when there is none.

    It is the one that equals the camera's ``name``, else its table's ``key``, else the one that equals either once
    everything but letters and digits is dropped (`cam_01` and `cam01`).

    Raises:
        CaptureError: several stems are equal in that last sense.
    """
    stems = list(stems)
    for exact in (name, key):
        if exact in stems:
            return exact
    bare = {_bare(name), _bare(key)} - {""}
    close = [stem for stem in stems if _bare(stem) in bare]
    if len(close) > 1:
        raise CaptureError(f"camera {name!r} could be any of {', '.join(sorted(close))}; rename the files to the names")
    return close[0] if close else None


def _bare(text: str) -> str:
    return re.sub(r"[\W_]", "", text)
