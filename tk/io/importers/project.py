"""What all formats share: a format's description, and a project in metres with a video for every camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from tk.errors import CalibrationError, VideoError, VolumeError
from tk.io.captures.calibration import scale_world
from tk.io.captures.units import LEAST_APART_M, MOST_APART_M, UNITS, FoundUnit, apart, infer_unit
from tk.io.importers.videos import CameraNames, find_clips
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.common_view import view_height

#: metres, least height of the views in which a person fits: a child of one metre, and a margin
PERSON_VIEW_M = 1.2


@dataclass(frozen=True)
class Project:
    """A project of another tool.

    Attributes:
        tool: name of the tool.
        source: calibration file or folder.
        rig: cameras with a video, metres. A width and height of 0 are unknown: the video's size is used.
        clips: video file or folder of images of each camera.
        masks, backgrounds: the same for masks and images of the empty scene; empty without any.
        up: the world's up direction if the format fixes it ("-y"), else None.
        notes: lines for the user about what was inferred or left out.
    """

    tool: str
    source: Path
    rig: Rig
    clips: tuple[Path, ...]
    masks: tuple[Path, ...] = ()
    backgrounds: tuple[Path, ...] = ()
    up: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cameras:
    """The cameras of a calibration.

    Attributes:
        source: calibration file or folder.
        rig: cameras, lengths in the file's unit.
        keys: a second name of each camera, which its video may have.
        notes: as in :class:`Project`.
        unit: unit of lengths, None if unknown; unit_from: what specifies it.
    """

    source: Path
    rig: Rig
    keys: tuple[str, ...]
    notes: tuple[str, ...] = ()
    unit: str | None = None
    unit_from: str = "the file"


@dataclass(frozen=True)
class Format:
    """A calibration format: the constant ``FORMAT`` of a module of this package.

    Attributes:
        tool: name of the tool.
        files: calibration files that ``find`` searches for, for messages.
        find: returns the calibration files in a folder, [] without any; it opens as few files as possible.
        read: reads the cameras from these files; raises CalibrationError.
        videos: folders that hold videos, as patterns relative to the project; the first that matches is used.
        unit: unit of lengths in this format, if the file does not say and the distances of the cameras allow it.
        nests: recordings lie in folders below the calibration.
        up: the world's up direction if the format fixes it.
        in_order: the tool matches cameras and videos in the order of their names.
        videos_of_all: a camera without a video is worth a note by name.
    """

    tool: str
    files: str
    find: Callable[[Path], list[Path]]
    read: Callable[[Sequence[Path]], Cameras]
    videos: tuple[str, ...]
    unit: str = "m"
    nests: bool = False
    up: str | None = None
    in_order: bool = False
    videos_of_all: bool = True


def read_format(form: Format, files: Sequence[Path], folder: Path, unit: str | None, trial: str | None) -> Project:
    """Read the calibration ``files``, and find a video in ``folder`` for every camera.

    Raises:
        CalibrationError: the calibration cannot be used.
        VideoError: see :func:`tk.io.importers.videos.find_clips`.
    """
    cameras = _in_metres(form.read(files), unit, form.unit)
    names = [CameraNames(camera.name, key) for camera, key in zip(cameras.rig, cameras.keys, strict=True)]
    found = find_clips(folder, form.videos, names, trial, form.in_order)
    chosen = [index for index, clip in enumerate(found.clips) if clip is not None]
    notes = [*cameras.notes, *found.notes]
    missing = [names[index].name for index, clip in enumerate(found.clips) if clip is None]
    if missing and form.videos_of_all:
        notes.append(f"{found.folder}: no video of {', '.join(missing)}: left out")
    elif missing:
        notes.append(f"{cameras.source}: {len(missing)} of its {len(names)} cameras have no video here: left out")
    chosen_names = [names[index] for index in chosen]
    return Project(
        tool=form.tool,
        source=cameras.source,
        rig=Rig(tuple(cameras.rig[index] for index in chosen)),
        clips=tuple(clip for clip in found.clips if clip is not None),
        masks=_beside(folder, found.folder, ("masks", "mask"), chosen_names, notes),
        backgrounds=_beside(folder, found.folder, ("background", "backgrounds"), chosen_names, notes),
        up=form.up,
        notes=tuple(notes),
    )


def _in_metres(cameras: Cameras, requested: str | None, default: str) -> Cameras:
    """Return the cameras with lengths in metres, and a note about the unit: requested, specified, or inferred.

    Raises:
        CalibrationError: a table top in millimetres and a room in centimetres are both possible.
    """
    if requested:
        found, reason = FoundUnit(requested), "as requested"
    elif cameras.unit:
        found, reason = FoundUnit(cameras.unit), f"as {cameras.unit_from} says"
    else:
        found, reason = infer_unit(cameras.rig.centers, default), "the default of this format"
        if found.name == "cm" and apart(cameras.rig.centers) * UNITS["mm"] >= LEAST_APART_M:
            found = _by_person(cameras)
    rig = scale_world(cameras.rig, found.metres)
    if found.note:
        note = f"{found.note}; the option units (m, cm or mm) overrides it"
    else:
        note = f"lengths are in {found.name}, {reason}"
        if not LEAST_APART_M <= apart(rig.centers) <= MOST_APART_M:
            note += f": the cameras are then up to {apart(rig.centers):.3g} m apart, which is unlikely"
    return replace(cameras, rig=rig, notes=(*cameras.notes, f"{cameras.source}: {note}"))


def _by_person(cameras: Cameras) -> FoundUnit:
    """Return millimetres if a person fits into the views then; the same numbers are a larger room in centimetres.

    Raises:
        CalibrationError: a person fits in centimetres alone, so the numbers are either those or a table top.
    """
    try:
        view = view_height(cameras.rig)
    except VolumeError:
        view = 0.0
    if view * UNITS["mm"] >= PERSON_VIEW_M:
        return FoundUnit("mm", "lengths are taken for mm: a person fits into the views")
    wide = apart(cameras.rig.centers)
    sizes = [
        f"{unit} ({wide * UNITS[unit]:.2g} m apart, views {view * UNITS[unit]:.2g} m high)" for unit in ("cm", "mm")
    ]
    raise CalibrationError(
        f"{cameras.source}: the cameras may be in {' or '.join(sizes)}: give the unit",
        hint="--units cm or --units mm",
    )


def check_camera(camera: Camera, where: str) -> Camera:
    """Return the camera with an exactly orthonormal rotation, if it is valid.

    Raises:
        CalibrationError: a number is not finite, a focal length not positive, or the rotation not orthonormal.
    """
    numbers = (camera.matrix, camera.distortions, camera.rotation, camera.translation)
    if not all(np.isfinite(values).all() for values in numbers):
        raise CalibrationError(f"{where}: holds a number that is not finite")
    if not (camera.matrix[0, 0] > 0 and camera.matrix[1, 1] > 0):
        raise CalibrationError(
            f"{where}: focal lengths {camera.matrix[0, 0]:g}, {camera.matrix[1, 1]:g} must be positive"
        )
    error = float(np.abs(camera.rotation @ camera.rotation.T - np.eye(3)).max())
    if error > 1e-3 or np.linalg.det(camera.rotation) < 0:
        raise CalibrationError(
            f"{where}: the rotation is no rotation matrix (R Rᵀ differs from the identity by {error:.2g})"
        )
    nearest = cv2.Rodrigues(cv2.Rodrigues(camera.rotation)[0])[0]
    return replace(camera, rotation=np.asarray(nearest, dtype=np.float64))


def _beside(
    root: Path, videos: Path, folders: Sequence[str], cameras: Sequence[CameraNames], notes: list[str]
) -> tuple[Path, ...]:
    """Return masks or backgrounds from the first existing folder; () and a note if they are not complete."""
    for parent in dict.fromkeys((videos.parent, root)):
        for name in folders:
            if not (parent / name).is_dir():
                continue
            try:
                found = find_clips(parent, (name,), cameras, None, False, images=True)
            except VideoError as reason:
                notes.append(f"{reason}: {name}/ is left out")
                return ()
            missing = [camera.name for camera, clip in zip(cameras, found.clips, strict=True) if clip is None]
            if missing:
                notes.append(f"{found.folder}: has nothing of {', '.join(missing)}: all of it is left out")
                return ()
            return tuple(clip for clip in found.clips if clip is not None)
    return ()
