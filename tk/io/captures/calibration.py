"""`calibration.toml`: the camera file that Anipose, Pose2Sim, FreeMoCap and Caliscope exchange."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from tk.errors import CalibrationError, CaptureError
from tk.io.captures.units import UNITS, FoundUnit, infer_unit
from tk.io.paths import Kind, replacing
from tk.io.toml import Table, load_toml
from tk.model.cameras.camera import Camera, Rig, shortened
from tk.model.cameras.mounting import DEFAULT_UP, FoundUp, infer_up

#: reciprocal condition number below which an intrinsic matrix counts as singular
_SINGULAR = 1e-9

#: most pixels of a side of an image; a larger number is a mistake in the file
_MOST_PIXELS = 65_536
#: largest delay of a video, seconds; a larger number is a mistake in the file
_MOST_OFFSET_S = 3600.0
#: range of the focal lengths, larger sides of the image, and pixels if the size is unknown
_FOCAL_SIDES, _FOCAL_PX = (0.02, 1000.0), (1.0, 1e7)
#: largest skew, focal lengths: real ones are below 0.01; a larger one is another kind of matrix
_MOST_SKEW = 0.3
#: largest element of R Rᵀ - 1 of a rotation: files have six digits and more
_ORTHONORMAL = 1e-4


@dataclass(frozen=True)
class Calibration:
    """Content of a calibration file.

    Attributes:
        path: the file.
        rig: its cameras, in the file's order.
        keys: the table's key of each camera, which may differ from its name.
        notes: lines for the user about inferred values.
        time_offset_s: delay of each camera, seconds; empty: no delays.
        metres: length of the unit of the file's translations, metres.
        mounting: up direction in which all cameras of the file are mounted, also those that are not selected.
        turns: clockwise quarter turns after which each camera's image is upright, from Caliscope's `rotation_count`.
    """

    path: Path
    rig: Rig
    keys: tuple[str, ...]
    notes: tuple[str, ...] = ()
    time_offset_s: tuple[float, ...] = ()
    metres: float = 1.0
    mounting: FoundUp = field(default=FoundUp(DEFAULT_UP, "the default", sure=False))
    turns: tuple[int, ...] = ()

    def select(self, names: Sequence[str] | None) -> Calibration:
        """Return the calibration of these cameras, in the file's order; of all cameras if None.

        Raises:
            CaptureError: a name is unknown, or fewer than two cameras are left.
        """
        known = self.rig.names
        wanted = known if names is None else [name.strip() for name in names]
        for name in wanted:
            if name not in known:
                raise CaptureError(f"no camera {name!r} in {self.path}, which has {', '.join(known)}")
        chosen = [index for index, name in enumerate(known) if name in wanted]
        if len(chosen) < 2:
            source = self.path if names is None else f"cameras {', '.join(wanted)}"
            raise CaptureError(f"{source}: {len(chosen)} camera; a visual hull needs at least 2")
        return replace(
            self,
            rig=Rig(tuple(self.rig[i] for i in chosen)),
            keys=tuple(self.keys[i] for i in chosen),
            time_offset_s=tuple(self.time_offset_s[i] for i in chosen if self.time_offset_s),
            turns=tuple(self.turns[i] for i in chosen if self.turns),
        )


def read_calibration(path: str | Path) -> Calibration:
    """Read and check a calibration file.

    One table a camera, `metadata` skipped; Caliscope's ``[cameras.1]`` is read too. Each has ``size = [width, height]``
    (pixels), ``matrix`` (3×3, a skew included), ``distortions`` (4, 5 or 8 numbers in OpenCV's order), ``rotation``
    (Rodrigues vector or 3×3, world to camera), ``translation`` (in ``[metadata] units``; without these, metres unless
    the cameras' distances say otherwise, see :func:`tk.io.captures.units.infer_unit`) and, optionally, ``name`` (by
    default the table's key), ``fisheye``, ``time_offset`` (seconds by which picture k was taken later than k / fps; 0
    by default) and ``rotation_count`` (clockwise quarter turns after which its image is upright; 0 by default).

    Raises:
        CalibrationError: with the file, the camera and the key that is wrong.
    """
    path = Path(path)
    if not path.exists():
        raise CalibrationError(f"{path}: there is no such file; write it with tk calibrate, or copy it there")
    document = load_toml(path, CalibrationError)
    tables = camera_tables(document, path)
    return calibration_of(path, tables, given_unit(document, path))


def camera_tables(document: Mapping[str, object], path: Path) -> dict[str, Mapping[str, object]]:
    """Return the tables of the cameras in a calibration document, by key.

    Raises:
        CalibrationError: there are none.
    """
    tables: Mapping[str, object] = {key: value for key, value in document.items() if key != "metadata"}
    nested = tables.get("cameras")
    if isinstance(nested, Mapping) and all(isinstance(value, Mapping) for value in nested.values()):
        tables = nested
    # plain values beside the tables, such as a date or a version, are not cameras
    found = {key: value for key, value in tables.items() if isinstance(value, Mapping)}
    if not found:
        raise CalibrationError(f"{path}: has no cameras; it needs one table a camera")
    return found


def given_unit(document: Mapping[str, object], path: Path) -> str | None:
    """Return ``[metadata] units`` of a calibration document; None if it has none.

    Raises:
        CalibrationError: the unit is unknown.
    """
    metadata = Table(document, str(path), CalibrationError).table("metadata")
    if "units" not in metadata:
        return None
    units = metadata.text("units", "m")
    if units not in UNITS:
        metadata.fail(f"units = {units!r} must be one of {', '.join(UNITS)}")
    return units


def calibration_of(
    path: Path, tables: Mapping[str, Mapping[str, object]], unit: str | None, sizes_known: bool = True
) -> Calibration:
    """Return the calibration in these tables; ``unit``: unit of the translations, None to infer it. Without
    ``sizes_known`` the videos decide about a size that is 0×0, fractional or missing.

    Raises:
        CalibrationError: with the file, the camera and the key that is wrong.
    """
    cameras: list[Camera] = []
    late: list[float] = []
    turns: list[int] = []
    for key, values in tables.items():
        camera, late_s, turn = _camera(key, values, path, sizes_known)
        late.append(late_s)
        turns.append(turn)
        if camera.name in [other.name for other in cameras]:
            raise CalibrationError(f"{path}: two cameras have the name {camera.name!r}; give each its own")
        cameras.append(camera)
    _check_poses(cameras, path)
    found = FoundUnit(unit) if unit else infer_unit(Rig(tuple(cameras)).centers)
    notes = (f"{path}: {found.note}; [metadata] units says it for sure",) if found.note else ()
    rig = scale_world(Rig(tuple(cameras)), found.metres)
    return Calibration(path, rig, tuple(tables), notes, tuple(late), found.metres, infer_up(rig, turns), tuple(turns))


def _check_poses(cameras: Sequence[Camera], path: Path) -> None:
    """Refuse cameras without a pose: all in one place, or several at the world's origin that look along its z axis."""
    poses = np.array([np.column_stack([camera.rotation, camera.translation]) for camera in cameras])
    if len(cameras) > 1 and np.allclose(poses, poses[0], rtol=1e-9, atol=1e-9):
        zero = " (zero)" if np.allclose(poses[0], np.eye(3, 4)) else ""
        raise CalibrationError(
            f"{path}: all {len(cameras)} cameras have the same rotation and translation{zero}; "
            "calibrate where they stand (extrinsic calibration)"
        )
    centers = np.array([camera.center for camera in cameras])
    if len(cameras) > 1 and np.ptp(centers, axis=0).max() <= 1e-9 * np.abs(poses[:, :, 3]).max(initial=1.0):
        raise CalibrationError(
            f"{path}: all {len(cameras)} cameras stand in the same place; the translations are missing or wrong"
        )
    lost = [camera.name for camera, pose in zip(cameras, poses, strict=True) if (pose == np.eye(3, 4)).all()]
    if len(lost) > 1:
        raise CalibrationError(
            f"{path}: the cameras {', '.join(lost)} have a rotation and translation of zero: calibrate where they "
            "stand (extrinsic calibration), or remove them"
        )


def camera_table(camera: Camera, turns: int = 0, late_s: float = 0.0) -> dict[str, object]:
    """Return the table of a camera in `calibration.toml`, metres, with its clockwise quarter turns and its delay,
    seconds, if there are any."""
    others = ({"rotation_count": turns} if turns else {}) | ({"time_offset": late_s} if late_s else {})
    return {
        "name": camera.name,
        "size": [camera.width, camera.height],
        "matrix": camera.matrix.tolist(),
        "distortions": camera.distortions.tolist(),
        "rotation": np.asarray(cv2.Rodrigues(camera.rotation)[0]).ravel().tolist(),
        "translation": camera.translation.tolist(),
        "fisheye": camera.fisheye,
        **others,
    }


def _is_calibration(path: Path) -> bool:
    try:
        return bool(camera_tables(load_toml(path, CalibrationError), path))
    except CalibrationError:
        return False


CALIBRATION = Kind("a calibration", (".toml",), _is_calibration)


def write_calibration(path: Path, source: Calibration, rig: Rig, time_offset_s: Sequence[float]) -> None:
    """Write a copy of the file that ``source`` was read from, with other cameras. Other entries do not change.

    Args:
        path: the new file.
        source: the calibration as it was read.
        rig: its cameras, in its order, metres.
        time_offset_s: delay of each camera, seconds.

    Raises:
        CalibrationError: the source is no TOML file, or the new one cannot be written.
    """
    document = load_toml(source.path, CalibrationError)
    tables = camera_tables(document, source.path)
    for key, camera, late in zip(source.keys, rig, time_offset_s, strict=True):
        table = dict(tables[key])
        table["matrix"] = camera.matrix.tolist()
        table["rotation"] = np.asarray(cv2.Rodrigues(camera.rotation)[0]).ravel().tolist()
        table["translation"] = (camera.translation / source.metres).tolist()
        table["time_offset"] = float(late)
        (document if key in document else document["cameras"])[key] = table
    with replacing(path, CalibrationError) as part:
        part.write_text(tomli_w.dumps(document), encoding="utf-8")


def scale_world(rig: Rig, metres: float) -> Rig:
    """Return the rig with translations multiplied by ``metres``; its projections do not change."""
    return Rig(tuple(replace(camera, translation=camera.translation * metres) for camera in rig))


def _camera(key: str, values: Mapping[str, object], path: Path, sizes_known: bool) -> tuple[Camera, float, int]:
    """Return the camera of a table, with its translation in the file's unit; its delay, seconds; and the clockwise
    quarter turns after which its image is upright."""
    name = Table(values, f"{path}: camera {key!r}", CalibrationError).text("name", key)
    table = Table(values, f"{path}: camera {name!r}", CalibrationError)

    size = table.array("size", (2,)) if sizes_known or "size" in table else np.zeros(2)
    unknown = not sizes_known and not size.any()
    if not sizes_known:  # Pose2Sim's conversions have fractions
        size = np.round(size)
    if not unknown and ((size <= 0).any() or (size != np.round(size)).any()):
        table.fail(f"size = {values['size']} must be two positive whole numbers [width, height]")
    if (size > _MOST_PIXELS).any():
        table.fail(f"size = {values['size']} is too large; {_MOST_PIXELS} pixels a side are the most")

    fisheye = table.flag("fisheye", False)
    late_s = table.number("time_offset", 0.0)
    if abs(late_s) > _MOST_OFFSET_S:
        table.fail(f"time_offset = {late_s:g} must be seconds, {_MOST_OFFSET_S:g} at most")

    camera = Camera(
        name=name,
        width=int(size[0]),
        height=int(size[1]),
        matrix=_matrix(table, float(size.max())),
        distortions=_distortions(table, fisheye),
        rotation=_rotation(table),
        translation=table.array("translation", (3,)),
        fisheye=fisheye,
    )
    return camera, late_s, table.integer("rotation_count", 0) % 4


def _matrix(table: Table, side_px: float) -> NDArray[np.float64]:
    """Return the intrinsic matrix (3, 3) of an image whose larger side is ``side_px``, 0 if unknown."""
    matrix = table.array("matrix", (3, 3))
    if np.linalg.cond(matrix) > 1 / _SINGULAR:
        table.fail("matrix is singular; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or matrix[1, 0] != 0 or (matrix[2] != (0, 0, 1)).any():
        table.fail("matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths")
    focal, skew = matrix[[0, 1], [0, 1]], matrix[0, 1]
    least, most = np.array(_FOCAL_SIDES) * side_px if side_px else _FOCAL_PX
    if (focal < least).any() or (focal > most).any():
        image = f" in an image of {side_px:g} pixels" if side_px else ""
        table.fail(f"matrix has focal lengths of {focal[0]:.4g} and {focal[1]:.4g}{image}; they must be in pixels")
    if abs(skew) > _MOST_SKEW * focal.min():
        table.fail(f"matrix has a skew of {skew:.4g} pixels; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return matrix


def _distortions(table: Table, fisheye: bool) -> NDArray[np.float64]:
    """Return the distortion coefficients (4,), (5,) or (8,)."""
    given = table.array("distortions", (4,), (5,), (8,), (12,), (14,))
    last = int(np.flatnonzero(given).max(initial=-1)) + 1
    if fisheye and last > 4:
        table.fail(f"distortions has {len(given)} numbers; a fisheye lens has 4 (k1 k2 k3 k4)")
    if last > 8:
        table.fail(
            f"distortions has {len(given)} numbers, of a thin prism or a tilted sensor; tk has 8 "
            "(k1 k2 p1 p2 k3 k4 k5 k6): calibrate without these models"
        )
    return shortened(given, fisheye)


def _rotation(table: Table) -> NDArray[np.float64]:
    """(3, 3) world to camera, from a Rodrigues vector or a matrix."""
    given = table.array("rotation", (3,), (3, 3))
    if given.shape == (3, 3):
        off = float(np.abs(given @ given.T - np.eye(3)).max())
        if off > _ORTHONORMAL or np.linalg.det(given) < 0:
            table.fail(f"rotation is no rotation matrix: R Rᵀ is off the identity by {off:.2g}, det R has to be 1")
        given = np.asarray(cv2.Rodrigues(given)[0], dtype=np.float64)  # of the nearest orthonormal matrix
    return np.asarray(cv2.Rodrigues(given)[0], dtype=np.float64)


def match_camera(name: str, key: str, stems: Iterable[str]) -> str | None:
    """Return the file stem of a camera; None if there is none.

    The stem equals the camera's ``name``, else its table's ``key``, else one of these up to characters that are no
    letters and no digits (`cam_01` and `cam01`), else up to these and the case of letters (`Cam 1` and `cam1`).

    Raises:
        CaptureError: several stems match in one of the last two senses.
    """
    stems = list(stems)
    for exact in (name, key):
        if exact in stems:
            return exact
    for reduced in (_bare, lambda text: _bare(text).casefold()):
        wanted = {reduced(name), reduced(key)} - {""}
        close = [stem for stem in stems if reduced(stem) in wanted]
        if len(close) > 1:
            raise CaptureError(
                f"camera {name!r} could be any of {', '.join(sorted(close))}; rename the files to the names"
            )
        if close:
            return close[0]
    return None


def _bare(text: str) -> str:
    composed = unicodedata.normalize("NFC", text)  # macOS separates letters and their accents
    return re.sub(r"[\W_]", "", composed)
